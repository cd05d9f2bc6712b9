"""IDR (Yariv et al., Multiview Neural Surface Reconstruction by Disentangling Geometry and Appearance, NeurIPS
2020)."""

import itertools
import math
from collections.abc import Callable

import torch
from torch import Tensor, nn

from hnerf.baselines.box import StaticField, box_samples
from hnerf.body.canonical import PosedBodies
from hnerf.body.fit_result import BodyFit
from hnerf.config import IdrSettings
from hnerf.fields.conditions import Conditions, Draws
from hnerf.fields.encoding import positional_encoding
from hnerf.fields.mlp import SkipMLP
from hnerf.fields.rays import PosedScene, Rays
from hnerf.fields.samples import RaySamples
from hnerf.fields.shell import Boxes, stratified

LAYERS, COLOUR_LAYERS = 8, 4
POSITION_OCTAVES, VIEW_OCTAVES = 6, 4
SOFTPLUS_SHARPNESS = 100.0
INITIAL_RADIUS = 0.75  # of the initial sphere, in halves of the box's shortest side
TRACE_STEPS, SECANT_STEPS = 10, 8
INSIDE_LOGIT = 10.0  # gamma times a depth inside at which the mask loss is practically zero
CONVERGED_M = 1e-4
MIN_SLOPE = 0.05  # of the distance along a ray at the surface; keeps the gradients of grazing rays finite


class SdfNetwork(nn.Module):
    """gamma(x) -> (f, z): the signed distance, and the last hidden layer as a feature."""

    def __init__(self, width: int, radius: float):
        super().__init__()
        self.trunk = SkipMLP(3 * (1 + 2 * POSITION_OCTAVES), width, LAYERS, nn.Softplus(SOFTPLUS_SHARPNESS))
        self.head = nn.Linear(width, 1)
        self._init_sphere(width, radius)

    @torch.no_grad()
    def _init_sphere(self, width: int, radius: float) -> None:
        """Initialise f(x) to about |x| - radius: the geometric initialisation of Atzmon and Lipman 2020 (SAL), theorem
        1, with zero weights for sines, cosines and the skip input. The bias makes f vanish on that sphere on average:
        -radius is the limit for ReLU and wide layers, where softplus does not raise every unit."""
        for k, layer in enumerate(self.trunk.layers):
            assert isinstance(layer, nn.Linear)
            nn.init.zeros_(layer.bias)
            nn.init.normal_(layer.weight, 0, math.sqrt(2 / width))
            layer.weight[:, 3 if k == 0 else width :] = 0
        nn.init.normal_(self.head.weight, math.sqrt(math.pi / width), 1e-4)
        nn.init.zeros_(self.head.bias)
        sphere = radius * nn.functional.normalize(torch.randn(1024, 3), dim=-1)
        nn.init.constant_(self.head.bias, -float(self(sphere)[0].mean()))

    def forward(self, point: Tensor) -> tuple[Tensor, Tensor]:
        """Map point (..., 3) to f (...) and z (..., width)."""
        z = self.trunk(positional_encoding(point, POSITION_OCTAVES))
        return self.head(z)[..., 0], z


class IdrField(StaticField):
    """Static field: a signed distance whose surface is found by sphere tracing and moves with the gradients of the
    colours.

    `sample` returns one sample per ray (K = 1): the surface point, with alpha 1 where the ray hits the surface and 0
    where it misses, coloured by the rendering network on (x, n, v, z). Its `d` is not the distance at that point (which
    is 0). Where the ray misses, it is the least distance along the ray, as the mask loss requires; where it hits, a
    constant deep inside with the gradient of the distance. The loss is then zero for rays that rightly hit the surface,
    and not for the others. So IDR's masked colour loss is `mask`, its mask loss is `segmentation`, and its eikonal
    loss, at points drawn in the box, is `eikonal`.

    Simplified: the mask loss has one sharpness, which the paper doubles five times; tracing is not bidirectional, but
    the samples of the mask loss show whether it overshot; networks are smaller and without weight normalisation (512
    wide in the paper); no camera is learned. Renders have hard silhouettes, as in the paper: a ray hits the surface or
    misses it.
    """

    gamma = 50.0  # per metre: sharpness of the mask loss

    def __init__(self, body: BodyFit, settings: IdrSettings):
        super().__init__(body, settings)
        boxes = Boxes.around(body.vertices_m(), self.margin_m)
        radius = INITIAL_RADIUS * float((boxes.upper_m - boxes.lower_m).min() / 2 / self.scale_m)
        self.geometry = SdfNetwork(settings.width, radius)
        sizes = [6 + 3 * (1 + 2 * VIEW_OCTAVES) + settings.width] + [settings.width] * COLOUR_LAYERS
        layers = [m for a, b in itertools.pairwise(sizes) for m in (nn.Linear(a, b), nn.ReLU())]
        self.rendering = nn.Sequential(*layers, nn.Linear(settings.width, 3), nn.Sigmoid())

    def sample(self, scene: PosedScene[Boxes], rays: Rays, draws: Draws) -> tuple[RaySamples, Tensor]:
        """Evaluate rays as Field.sample does, with one sample per ray."""
        near, far = scene.region.interval(rays)
        with torch.no_grad():
            probe_depths = stratified(near, far, draws.jitter)
            distances = self.distance(rays.points(probe_depths))
            surface_depths, hit = trace_surface(self.distance, rays, near, far, probe_depths, distances)
            least, at = distances.min(1)
            nearest = torch.where(hit & (least > 0), surface_depths, probe_depths.gather(1, at[:, None])[:, 0])
        d = self.distance(rays.points(nearest))[:, None]
        d = torch.where(hit[:, None], d - d.detach() - INSIDE_LOGIT / self.gamma, d)
        pick = torch.nonzero(hit)[:, 0]
        seen = self._surface_colour(rays.pick(pick), surface_depths[pick])
        norms = d.new_zeros(0)
        if draws.probe is not None:
            lower, upper = scene.region.lower_m[rays.frame], scene.region.upper_m[rays.frame]
            norms = self._evaluate(lower + (upper - lower) * draws.fine[:, :3])[1].norm(dim=-1)
        alpha = hit[:, None].to(d)
        colour = torch.zeros_like(rays.origins_m).index_copy(0, pick, seen)[:, None]
        samples = box_samples(alpha, colour, d, gradient_norm=norms)
        return samples, surface_depths[:, None]

    def distance(self, points_m: Tensor) -> Tensor:
        """Return f (...) in metres at points (..., 3)."""
        return self.scale_m * self.geometry(self.scaled(points_m))[0]

    def _evaluate(self, points_m: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return f (N,) in metres, its gradient (N, 3) and z (N, width), with an autograd graph if gradients are
        enabled."""
        with_graph = torch.is_grad_enabled()
        with torch.enable_grad():
            points_m = points_m if points_m.requires_grad else points_m.detach().requires_grad_()
            f, z = self.geometry(self.scaled(points_m))
            f = self.scale_m * f
            (gradient,) = torch.autograd.grad(f.sum(), points_m, create_graph=with_graph)
        return (f, gradient, z) if with_graph else (f.detach(), gradient, z.detach())

    def _surface_colour(self, rays: Rays, depths_m: Tensor) -> Tensor:
        """Return c (N, 3) where rays hit the surface; the point moves with the network's parameters."""
        points = rays.points(depths_m)
        if torch.is_grad_enabled():
            f, gradient, _ = self._evaluate(points)
            points = intersection(points, rays.directions, f, gradient)
        return self._radiance(points, rays.directions)

    def _radiance(self, points_m: Tensor, directions: Tensor) -> Tensor:
        """Evaluate the rendering network on (x, n, v, z)."""
        _, gradient, z = self._evaluate(points_m)
        normal = nn.functional.normalize(gradient, dim=-1)
        view = positional_encoding(directions, VIEW_OCTAVES)
        return self.rendering(torch.cat([self.scaled(points_m), normal, view, z], -1))

    def colour(self, bodies: PosedBodies, points_m: Tensor, directions: Tensor, conditions: Conditions) -> Tensor:
        """Return c (N, 3) at points (N, 3) seen along directions (N, 3)."""
        return self._radiance(points_m, directions)


def intersection(points_m: Tensor, directions: Tensor, distance: Tensor, gradient: Tensor) -> Tensor:
    """Return the points x0 (N, 3) with the derivative of the true intersection with respect to theta: x^ = x0 - v f(x0;
    theta) / (grad f(x0; theta0) . v0) (equation 3). distance f (N,) with its graph, gradient (N, 3), directions v (N,
    3)."""
    slope = (gradient.detach() * directions).sum(-1).clamp(max=-MIN_SLOPE)
    return points_m - directions * ((distance - distance.detach()) / slope)[:, None]


def trace_surface(
    distance: Callable[[Tensor], Tensor], rays: Rays, near: Tensor, far: Tensor, probe_depths: Tensor, distances: Tensor
) -> tuple[Tensor, Tensor]:
    """Find where R rays first enter the surface between near and far (R,): depths (R,), far where they miss, and
    (R,) bool whether they hit.

    Uses sphere tracing, and the secant method where it did not converge or passed a crossing that distances (R, K) at
    sorted depths `probe_depths` (R, K) reveal (section 3 and the supplement's ray tracing).
    """
    surface_depths, hit = _sphere_trace(distance, rays, near, far)
    enters = (distances[:, :-1] > 0) & (distances[:, 1:] <= 0)
    first = enters.int().argmax(1, keepdim=True)
    overshot = enters.any(1) & ~(hit & (surface_depths <= probe_depths.gather(1, first + 1)[:, 0]))
    pick = torch.nonzero(overshot)[:, 0]
    start, end = (probe_depths.gather(1, first + k)[pick, 0] for k in (0, 1))
    above, below = (distances.gather(1, first + k)[pick, 0] for k in (0, 1))
    refined = _secant(distance, rays.pick(pick), start, end, above, below)
    return torch.where(hit, surface_depths, far).index_copy(0, pick, refined), hit | overshot


def _sphere_trace(distance: Callable[[Tensor], Tensor], rays: Rays, near: Tensor, far: Tensor) -> tuple[Tensor, Tensor]:
    """Sphere-trace rays from near; return depths (R,), and whether they ended on the surface."""
    depths, hit, moving = near.clone(), torch.zeros_like(near, dtype=torch.bool), near < far
    for _ in range(TRACE_STEPS):
        pick = torch.nonzero(moving)[:, 0]
        step = distance(rays.pick(pick).points(depths[pick]))
        depths[pick] += step
        within = (depths[pick] >= near[pick]) & (depths[pick] <= far[pick])
        hit[pick] = within & (step.abs() <= CONVERGED_M)
        moving[pick] = within & ~hit[pick]
    return depths, hit


def _secant(
    distance: Callable[[Tensor], Tensor], rays: Rays, start: Tensor, end: Tensor, above: Tensor, below: Tensor
) -> Tensor:
    """Return the root between depths start and end (N,), where the distance is `above` > 0 and `below` <= 0."""
    for _ in range(SECANT_STEPS):
        middle = start + above / (above - below) * (end - start)
        value = distance(rays.points(middle))
        outside = value > 0
        start, above = torch.where(outside, middle, start), torch.where(outside, value, above)
        end, below = torch.where(outside, end, middle), torch.where(outside, below, value)
    return start + above / (above - below) * (end - start)
