from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from hnerf.baselines.idr import IdrField, SdfNetwork, intersection, trace_surface
from hnerf.body.canonical import PosedBodies
from hnerf.config import load_settings
from hnerf.fields.conditions import Conditions, Draws
from hnerf.fields.rays import Rays
from tests.baselines.ball import RADIUS_M, RING, body, inner_psnr, psnr, radii_m, trained

SMALL = [
    "training.steps=110",
    "training.rays_per_frame=64",
    "training.field.width=32",
    "training.field.samples=8",
    "training.field.learning_rate=0.004",
]
AXES = torch.cat([torch.eye(3), -torch.eye(3)])


def sphere(points: Tensor) -> Tensor:
    """Return the signed distance to the unit sphere."""
    return points.norm(dim=-1) - 1


def traced(distance, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Trace rays between depths 0 and 8, with 16 samples."""
    near, far = torch.zeros(len(origins)).to(origins), torch.full((len(origins),), 8.0).to(origins)
    probe_depths = torch.linspace(0, 8, 16).to(origins).expand(len(origins), -1)
    rays = Rays(origins, directions, torch.zeros(len(origins), dtype=torch.long))
    return trace_surface(distance, rays, near, far, probe_depths, distance(rays.points(probe_depths)))


def test_rays_hit_the_unit_sphere_at_exact_depths() -> None:
    """Rays start at x = -3. One through the centre hits at depth 2, one 0.6 off the centre at 3 - 0.8; one 1.5 off or
    pointing away never hits. A ray from inside the sphere does not enter it."""
    origins = torch.tensor([[-3.0, 0, 0], [-3, 0.6, 0], [-3, 1.5, 0], [-3, 0, 0], [0, 0, 0]])
    directions = torch.tensor([[1.0, 0, 0], [1, 0, 0], [1, 0, 0], [-1, 0, 0], [1, 0, 0]])
    depth, hit = traced(sphere, origins, directions)
    assert hit.tolist() == [True, True, False, False, False]
    torch.testing.assert_close(depth, torch.tensor([2.0, 2.2, 8.0, 8.0, 8.0]), atol=2e-4, rtol=0)


@pytest.mark.parametrize("slope", [0.05, 2.0])
def test_the_secant_method_corrects_failed_sphere_tracing(slope: float) -> None:
    """Distances twenty times too small stop tracing early; twice too large, they lead to the far side. The signs at the
    samples reveal the crossing. Off the centre, distances along the ray are not linear."""
    origins, directions = torch.tensor([[-3.0, 0.0, 0.0], [-3.0, 0.6, 0.0]]), torch.tensor([[1.0, 0.0, 0.0]] * 2)
    depth, hit = traced(lambda x: slope * sphere(x), origins, directions)
    assert hit.all() and depth.tolist() == pytest.approx([2.0, 2.2], abs=1e-3)


def test_rays_hit_the_first_of_two_surfaces() -> None:
    """The surfaces are unit spheres at x = 0 and x = 3.5."""
    apart = torch.tensor([3.5, 0, 0])
    depth, hit = traced(
        lambda x: torch.minimum(sphere(x), sphere(x - apart)),
        torch.tensor([[-3.0, 0.6, 0], [7, 0.6, 0]]),
        torch.tensor([[1.0, 0, 0], [-1, 0, 0]]),
    )
    assert hit.all()
    torch.testing.assert_close(depth, torch.tensor([2.2, 2.7]), atol=2e-4, rtol=0)


def test_gradients_of_the_intersection_match_finite_differences() -> None:
    """Equation 3 agrees with central differences of the exact intersection, for the sphere's radius and centre, in
    double precision. By hand, through the centre, dx/dr = -v."""
    origins = torch.tensor([[-3.0, 0.0, 0.0], [-3.0, 0.6, 0.2]], dtype=torch.float64)
    directions = torch.nn.functional.normalize(
        torch.tensor([[1.0, 0.0, 0.0], [1.0, 0.05, -0.1]], dtype=torch.float64), dim=-1
    )

    def distance(points: Tensor, theta: Tensor) -> Tensor:
        return (points - theta[1:]).norm(dim=-1) - theta[0]

    def exact(theta: Tensor) -> Tensor:
        """Return the nearer root of |o + t v - m|^2 = r^2."""
        towards = theta[1:] - origins
        middle = (towards * directions).sum(-1)
        depth = middle - (theta[0] ** 2 - (towards**2).sum(-1) + middle**2).sqrt()
        return origins + directions * depth[:, None]

    theta = torch.tensor([1.0, 0.1, -0.05, 0.02], dtype=torch.float64)
    points = exact(theta).requires_grad_()
    (gradient,) = torch.autograd.grad(distance(points, theta).sum(), points)
    points = points.detach()

    def moved(theta: Tensor) -> Tensor:
        return intersection(points, directions, distance(points, theta), gradient)

    torch.testing.assert_close(moved(theta), points, rtol=0, atol=1e-12)
    jacobian = torch.autograd.functional.jacobian(moved, theta)
    step = 1e-5
    for k in range(4):
        change = torch.zeros_like(theta)
        change[k] = step
        numeric = (exact(theta + change) - exact(theta - change)) / (2 * step)
        torch.testing.assert_close(jacobian[..., k], numeric, rtol=1e-7, atol=1e-7)

    straight = torch.tensor([[-1.0, 0, 0]], dtype=torch.float64)
    radius = torch.tensor(1.0, dtype=torch.float64, requires_grad=True)
    ray = torch.tensor([[1.0, 0, 0]], dtype=torch.float64)
    intersection(straight, ray, straight.norm(dim=-1) - radius, straight)[0, 0].backward()
    assert radius.grad is not None and radius.grad.item() == pytest.approx(-1.0)


class Ball(nn.Module):
    """A stand-in for the network: a ball of half a unit, which is 30 cm here."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.middle, self.width = nn.Parameter(torch.zeros(3)), width

    def forward(self, point: Tensor) -> tuple[Tensor, Tensor]:
        return (point - self.middle).norm(dim=-1) - 0.5, point.new_zeros(*point.shape[:-1], self.width)


def test_distances_of_rays_by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three rays along x, 10, 35 and 0 cm beside the ball's middle, cross the box from 2.9 to 4.1 m. The first hits the
    ball 28 cm before 3.5 m, between its samples, and the third 30 cm before, with a sample in the middle. Their
    distance is 10 / gamma inside. For the first, a change of the ball's y changes it by - 60 cm x 10 / 30 a unit. The
    second ray is 5 cm from the ball at 3.5 m. The point that colours the first, here by its position, moves with the
    ball along x, and by - 10 / 28 of what the ball moves along y. The eikonal loss is measured in the box, at .25, .5
    and .75 of its edges of 1.2 m."""
    fit = body()
    settings = load_settings("idr").training.field
    field = IdrField(fit, settings)
    field.geometry = Ball(settings.width)
    bodies = PosedBodies(fit.rig, fit.theta, fit.root, field.canonical_m)
    conditions = Conditions.of(bodies, torch.zeros(1, dtype=torch.long), 2.5)
    origins = torch.tensor([[-3.0, 0.6, 0.5], [-3.0, 0.85, 0.5], [-3.0, 0.5, 0.5]])
    rays = Rays(origins, torch.tensor([[1.0, 0, 0]] * 3), torch.zeros(3, dtype=torch.long))
    jitter = torch.tensor([[0.0, 0.9], [0.5, 0.0], [0.5, 0.0]])  # at 2.9 and 4.04 m; at 3.2 and 3.5 m
    fine = torch.tensor([[0.25, 0.5, 0.75]] * 3)
    asked, evaluate = [], field._evaluate
    monkeypatch.setattr(field, "_evaluate", lambda points_m: asked.append(points_m) or evaluate(points_m))
    monkeypatch.setattr(field, "_radiance", lambda points_m, directions: field.scaled(points_m))
    samples, depths = field.sample(field.scene(bodies, conditions), rays, Draws(jitter, 0 * fine, fine, torch.zeros(3)))
    assert samples.alpha.tolist() == [[1.0], [0.0], [1.0]]
    assert depths.flatten().tolist() == pytest.approx([3.5 - 0.08**0.5, 4.1, 3.2], abs=2e-4)
    assert samples.d.flatten().tolist() == pytest.approx([-10 / 50, 0.05, -10 / 50], abs=1e-4)
    slope = torch.autograd.grad(samples.d[0, 0], field.geometry.middle, retain_graph=True)[0]
    assert slope[1].item() == pytest.approx(-0.6 / 3, abs=1e-3)
    moves = torch.autograd.grad(samples.colour[0, 0, 0], field.geometry.middle)[0]
    assert moves.tolist() == pytest.approx([1, -0.1 / 0.08**0.5, 0], abs=2e-3)
    torch.testing.assert_close(asked[-1].detach(), torch.tensor([[0.2, 0.5, 0.8]] * 3))
    torch.testing.assert_close(samples.gradient_norm, torch.ones(3))


def test_the_untrained_network_is_a_sphere() -> None:
    """Every ray from the centre outwards leaves the surface once, on average at the radius."""
    torch.manual_seed(0)
    network = SdfNetwork(64, 0.4)
    directions = torch.nn.functional.normalize(torch.randn(500, 3), dim=-1)
    steps = torch.linspace(0, 1, 201)
    inside = network(directions[:, None] * steps[:, None])[0] < 0
    assert ((inside[:, 1:] != inside[:, :-1]).sum(1) == 1).all()
    assert inside.sum(1).float().mean() / 200 == pytest.approx(0.4, abs=0.05)


def test_overfits_the_ball(tmp_path: Path) -> None:
    """With eight views, a training view has 23 dB, and its colours are 5 dB better than a single colour. Along the
    axes, the surface is within 4 cm of the ball's radius of 35 cm."""
    avatar = trained(tmp_path, load_settings("idr", SMALL).training, RING)
    assert psnr(avatar, tmp_path, "0") > 23
    colours, one_colour = inner_psnr(avatar, tmp_path, "0")
    assert colours > one_colour + 5
    assert (radii_m(avatar, AXES) - RADIUS_M).abs().max() < 0.04
