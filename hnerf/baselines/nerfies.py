"""Nerfies (Park et al., Nerfies: Deformable Neural Radiance Fields, ICCV 2021)."""

import dataclasses
from collections.abc import Callable

import torch
from torch import Tensor, nn

from hnerf.baselines.box import DynamicField
from hnerf.baselines.nerf import NerfNetwork
from hnerf.body.canonical import PosedBodies
from hnerf.body.fit_result import BodyFit
from hnerf.body.rig import rotation_from_axis_angle
from hnerf.config import NerfiesSettings
from hnerf.fields.compositing import weights_from_alpha
from hnerf.fields.conditions import Conditions, Draws
from hnerf.fields.encoding import positional_encoding
from hnerf.fields.mlp import SkipMLP
from hnerf.fields.paper import sample_pdf
from hnerf.fields.rays import PosedScene, Rays
from hnerf.fields.samples import RaySamples
from hnerf.fields.shell import Boxes, stratified

OCTAVES, LAYERS = 6, 6  # of the deformation network
INITIAL_SCREW_RANGE = 1e-5  # of the last layer's uniform initialisation: almost no deformation
ROBUST_SCALE = 0.03  # c of the elastic energy
MIN_SINGULAR_VALUE = 1e-6  # keeps the logarithm finite


class Deformation(nn.Module):
    """W: (gamma_alpha(x), omega) -> a screw motion of x (section 3.2 of the paper)."""

    def __init__(self, code_width: int, width: int):
        super().__init__()
        self.trunk = SkipMLP(3 * (1 + 2 * OCTAVES) + code_width, width, LAYERS)
        self.screw = nn.Linear(width, 6)
        nn.init.uniform_(self.screw.weight, -INITIAL_SCREW_RANGE, INITIAL_SCREW_RANGE)
        nn.init.zeros_(self.screw.bias)

    def forward(self, points: Tensor, code: Tensor, octaves: Tensor) -> Tensor:
        """Deform points (N, 3) in the field's coordinates by code (N, C): (N, 3). octaves (): how many are annealed in
        so far."""
        encoded = annealed(positional_encoding(points, OCTAVES), octaves)
        turn, move = self.screw(self.trunk(torch.cat([encoded, code], 1))).split(3, 1)
        rotation, translation = screw_motion(turn, move)
        return (rotation @ points[..., None])[..., 0] + translation


class NerfiesField(DynamicField):
    """Dynamic field: each frame's code deforms the space of its instant into one template, a NeRF. Of the body it uses
    only the box.

    It has no pose control. A pose that belongs to no frame (Conditions.frame_row = -1) and a frame that was not trained
    on take the zero code: the template as this code deforms it, the same for every pose, cut by the pose's box. If that
    box is elsewhere, it shows little or nothing.

    Simplified: one template network serves coarse and fine samples, and only the fine pass is trained, as in H-NeRF;
    networks and numbers of samples are smaller, so that minutes on two CPU cores are meaningful; no appearance codes,
    because the captures' cameras keep their exposure; no regularisation of static background points, because the
    background comes from the clean plate; the elastic energy, weighted by a sample's contribution to its pixel, is
    estimated at one sample per ray, drawn by that weight. Activations and the mean absolute colour error are those of
    NerfField.
    """

    progress: Tensor

    def __init__(self, body: BodyFit, settings: NerfiesSettings):
        super().__init__(body, settings, settings.code_width)
        self.deformation = Deformation(settings.code_width, settings.deformation_width)
        self.template = NerfNetwork(settings.width)
        self.register_buffer("progress", torch.zeros(()))

    def sample(self, scene: PosedScene[Boxes], rays: Rays, draws: Draws) -> tuple[RaySamples, Tensor]:
        """Evaluate rays as Field.sample does, at coarse and fine samples together (K = 2 x samples). With draws.probe,
        as in training, the samples include an elastic energy."""
        near, far = scene.region.interval(rays)
        first = stratified(near, far, draws.jitter)

        def evaluate(depths_m: Tensor) -> RaySamples:
            points = rays.points(depths_m)
            code = self.code(scene.conditions)[rays.frame][:, None].expand(-1, depths_m.shape[1], -1)
            template = self._deform(self.scaled(points).flatten(0, 1), code.flatten(0, 1)).view_as(points)
            density, colour = self.template(template, rays.directions[:, None].expand_as(points))
            return self.to_samples(density, colour, depths_m, far)

        with torch.no_grad():
            drawn = sample_pdf(first, near, far, weights_from_alpha(evaluate(first).alpha), draws.fine)
        depths = torch.cat([first, drawn], 1).sort(1).values
        samples = evaluate(depths)
        if draws.probe is None:
            return samples, depths
        weights = weights_from_alpha(samples.alpha.detach())
        pick = sample_index(weights, draws.probe)
        points = rays.points(depths.gather(1, pick[:, None])[:, 0])
        code = self.code(scene.conditions)[rays.frame]
        change = jacobian(lambda x: self._deform(x, code), self.scaled(points))
        return dataclasses.replace(samples, elastic=weights.sum(1) * elastic_energy(change)), depths

    def on_progress(self, progress: float) -> None:
        """Record the progress of training, for annealing."""
        self.progress.fill_(progress)

    def _deform(self, points: Tensor, code: Tensor) -> Tensor:
        octaves = OCTAVES * self.progress / self.settings.anneal_share
        return self.deformation(points, code, octaves)

    def signed_distance(self, bodies: PosedBodies, points_m: Tensor, conditions: Conditions) -> Tensor:
        """Return the pseudo-distance (N,) to the surface of density sigma_h (as NerfField) at the first body's instant,
        cut and closed by its box."""
        density = self._evaluate(points_m, torch.zeros_like(points_m), conditions)[0]
        return torch.maximum(self.pseudo_distance(density), self.region(bodies, conditions).signed_distance(points_m))

    def colour(self, bodies: PosedBodies, points_m: Tensor, directions: Tensor, conditions: Conditions) -> Tensor:
        """Return c (N, 3) at points (N, 3) at the first body's instant, seen along directions (N, 3)."""
        return self._evaluate(points_m, directions, conditions)[1]

    def _evaluate(self, points_m: Tensor, directions: Tensor, conditions: Conditions) -> tuple[Tensor, Tensor]:
        code = self.code(conditions)[:1].expand(len(points_m), -1)
        return self.template(self._deform(self.scaled(points_m), code), directions)


def screw_motion(turn: Tensor, move: Tensor) -> tuple[Tensor, Tensor]:
    """Return the exponential of screws (..., 3) and (..., 3): rotation (..., 3, 3), translation (..., 3) (equations 8
    to 10).

    The translation is G move, G = I + (1 - cos a) / a^2 [turn] + (a - sin a) / a^3 [turn]^2 with the angle a = |turn|.
    """
    angle_squared = turn.square().sum(-1, keepdim=True)
    small = angle_squared < 1e-4
    safe = torch.where(small, torch.ones_like(angle_squared), angle_squared)
    angle = safe.sqrt()
    first = torch.where(small, 0.5 - angle_squared / 24, (1 - angle.cos()) / safe)
    second = torch.where(small, 1 / 6 - angle_squared / 120, (angle - angle.sin()) / (safe * angle))
    once = torch.linalg.cross(turn, move)
    return rotation_from_axis_angle(turn), move + first * once + second * torch.linalg.cross(turn, once)


def annealed(encoded: Tensor, octaves: Tensor) -> Tensor:
    """Weight a positional encoding (N, 3 (1 + 2 m)) by octave (equation 6): octave j by (1 - cos(pi clamp(octaves - j,
    0, 1))) / 2."""
    count = (encoded.shape[1] // 3 - 1) // 2
    share = (octaves - torch.arange(count, device=encoded.device)).clamp(0, 1)
    weight = ((1 - (torch.pi * share).cos()) / 2).repeat_interleave(3)
    return encoded * torch.cat([torch.ones_like(weight[:3]), weight, weight]).to(encoded)


def jacobian(function: Callable[[Tensor], Tensor], points: Tensor) -> Tensor:
    """Return d f_i / d x_j (N, 3, 3), itself differentiable, of a function that maps each point (N, 3)
    independently."""
    points = points.detach().requires_grad_()
    moved = function(points)
    return torch.stack([torch.autograd.grad(moved[:, k].sum(), points, create_graph=True)[0] for k in range(3)], 1)


def elastic_energy(change: Tensor) -> Tensor:
    """Return rho(|log Sigma|_F) (N,) of Jacobians (N, 3, 3) with singular values Sigma; rho(x) = 2 (x/c)^2 / ((x/c)^2 +
    4) (equations 3 and 4)."""
    stretch = torch.linalg.svdvals(change).clamp(min=MIN_SINGULAR_VALUE)
    strain = (stretch.log() / ROBUST_SCALE).square().sum(-1)
    return 2 * strain / (strain + 4)


def sample_index(weights: Tensor, uniform: Tensor) -> Tensor:
    """Draw an index (R,) into each row of weights (R, K) with probabilities proportional to them; uniform (R,) in [0,
    1)."""
    cumulative = weights.cumsum(1)
    wanted = uniform[:, None] * cumulative[:, -1:]
    return torch.searchsorted(cumulative, wanted, right=True)[:, 0].clamp(max=weights.shape[1] - 1)
