"""One ray through the fast field with known functions instead of its networks: the networks' inputs, and the slope of
the resulting distance.

The body is the unit box, turned by a quarter about z. The ray runs along x and hits the box's face at x = 1.55 m, where
the canonical position is (0.4, 1, 0.25) and the canonical normal is y. The shell extends 6 cm outwards and 4 cm
inwards.
"""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from hnerf.body.canonical import PosedBodies
from hnerf.body.rig import Rig
from hnerf.config import FastFieldSettings
from hnerf.fields.compositing import weights_from_alpha
from hnerf.fields.conditions import Conditions, Draws
from hnerf.fields.fast import FastField
from hnerf.fields.rays import PosedScene, Rays
from hnerf.fields.samples import RaySamples
from tests.body.boxes import box_rig

RIG = box_rig()
FINE_RIG = box_rig(splits=2)  # whose vertices around the ray have the face's normal
THETA = torch.tensor([[[0.0, 0, 0], [-0.4, 0.5, 0.6]], [[0.0, 0, 0], [0.1, 0.2, 0.3]]])
ROOT = torch.eye(4).repeat(2, 1, 1)
ROOT[1, :2] = torch.tensor([[0.0, -1, 0, 2.55], [1, 0, 0, 0]])
SETTINGS = FastFieldSettings(
    outer_m=0.06, inner_m=0.04, shell_cell_m=0.02, geometry_cells=(2,), colour_cells=(2,), pose_width=1
)
RAY = Rays(torch.tensor([[-1.0, 0.4, 0.25]]), torch.tensor([[1.0, 0, 0]]), torch.tensor([1]))
OUTERMOST, INNERMOST = 0.3, 0.99  # fractions of the ray's samples

Distance = Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]


def field_of(residual: Distance, nodes: int = 0, rig: Rig = RIG) -> FastField:
    """Return a field with a sharp surface and the given function as DH."""
    field = FastField(rig, SETTINGS.model_copy(update={"nodes": nodes}), 2)
    field.log_sharpness.data.fill_(2000.0).log_()
    field.field.residual = residual
    return field


def no_residual(y_m: Tensor, d_m: Tensor, pose: Tensor, row: Tensor) -> Tensor:
    return torch.zeros_like(d_m)


def sampled(field: FastField, probe: float | None = None, rig: Rig = RIG) -> RaySamples:
    bodies = PosedBodies(rig, THETA, ROOT, rig.vertices_m)
    conditions = Conditions.of(bodies, torch.arange(2), 2.5)
    draws = Draws(torch.full((1, 12), 0.5), torch.rand(1, 3), torch.zeros(1, 12))
    if probe is not None:
        draws = Draws(draws.jitter, draws.background, draws.fine, torch.tensor([probe]))
    scene = PosedScene(bodies, field.region(bodies, conditions), conditions, bodies.correction())
    return field.sample(scene, RAY, draws)[0]


def expect_close(found: Tensor, expected: list[float]) -> None:
    torch.testing.assert_close(found.detach(), torch.tensor(expected), atol=1e-4, rtol=0)


def test_network_inputs_are_canonical_position_pose_and_world_normal() -> None:
    """The surface lies 1 cm outside the body. F is evaluated where the ray hits it, DH at every sample."""
    asked: dict[str, tuple[Tensor, ...]] = {}

    def residual(*inputs: Tensor) -> Tensor:
        asked.setdefault("residual", inputs)
        return torch.full_like(inputs[1], -0.01)

    def colour(*inputs: Tensor) -> Tensor:
        asked["colour"] = inputs
        return inputs[0]

    field = field_of(residual, rig=FINE_RIG)
    field.field.colour = colour
    samples = sampled(field, rig=FINE_RIG)
    place, depth, normal, pose, row = asked["colour"]
    at = int((depth - 0.01).abs().argmin())
    expect_close(place[at], [0.4, 1.01, 0.25])
    expect_close(depth[at], 0.01)
    expect_close(normal[at], [-1.0, 0, 0])
    expect_close(pose[row[at]], [0.1, 0.2, 0.3])
    place, depth, pose, row = asked["residual"]
    assert torch.equal(depth.detach(), samples.d[0, -len(depth) :]) and (depth.diff() < 0).all()
    expect_close(place[:, 1], (1 + depth).tolist())
    expect_close(pose[row], [[0.1, 0.2, 0.3]] * len(depth))
    expect_close(samples.colour[0, weights_from_alpha(samples.alpha)[0].argmax()], [0.4, 1.01, 0.25])
    expect_close(samples.residual, [[0.0] * (12 - len(depth)) + [-0.01] * len(depth)])  # the first are off the shell


def test_the_normal_is_that_of_the_surface_not_of_the_body() -> None:
    """The distance rises by 1.5 along y and by 0.3 along x of the rest body, which are -x and y of the world. Gradients
    of a colour loss by the normal reach the distance network."""
    slope, normals = torch.tensor(0.5, requires_grad=True), []
    field = field_of(lambda y, d, pose, row: slope * (y[:, 1] - 1) + 0.3 * (y[:, 0] - 0.4), rig=FINE_RIG)
    field.field.colour = lambda y, d, normal, pose, row: normals.append(normal) or normal
    sampled(field, rig=FINE_RIG)
    expect_close(normals[0], [[-1.5 / 2.34**0.5, 0.3 / 2.34**0.5, 0.0]] * len(normals[0]))
    assert torch.autograd.grad(normals[0][0, 0], slope)[0].item() == pytest.approx(-0.09 / 2.34**1.5, abs=1e-4)


@pytest.mark.parametrize("probe", [OUTERMOST, INNERMOST])
def test_the_gradient_norm_is_per_metre_of_the_world(probe: float) -> None:
    """Along the normal, the distance rises by 1 per metre because of the body, and by 0.5 and 0.2 because of the
    residual's second coordinate and distance. Across the normal it rises by 0.3. This holds outside the skin and
    inside."""
    samples = sampled(field_of(lambda y, d, pose, row: 0.3 * y[:, 0] + 0.5 * y[:, 1] + 0.2 * d), probe)
    assert (samples.d[0, int(12 * probe)] > 0.01) == (probe == OUTERMOST)
    expect_close(samples.gradient_norm, [(1.7**2 + 0.3**2) ** 0.5])


def test_the_gradient_is_a_forward_difference_over_5_mm() -> None:
    """The gradient of 40 (y - 1)^2, where y - 1 is d, is 80 d + 40 x 0.005."""
    samples = sampled(field_of(lambda y, d, pose, row: 40 * (y[:, 1] - 1) ** 2), OUTERMOST)
    expect_close(samples.gradient_norm, [1 + 80 * samples.d[0, int(12 * OUTERMOST)].item() + 0.2])


def test_the_eikonal_loss_has_no_gradient_by_the_body() -> None:
    """Its gradients flow only to the field. Rendering does not compute it."""
    assert not sampled(field_of(lambda y, d, pose, row: y[:, 0] * d), OUTERMOST).gradient_norm.requires_grad
    assert sampled(field_of(no_residual)).gradient_norm.shape == (0,)


def test_the_elastic_energy_of_a_displacement() -> None:
    """A displacement by 2 cm along y in the ray's frame, in units of 1 cm, has energy 4 at each sample. The ray hits
    the body's surface 2 cm earlier."""
    field = field_of(no_residual, nodes=1)
    assert field.deformation is not None
    still = sampled(field)
    assert still.elastic is not None
    expect_close(still.elastic, [0.0])
    field.deformation.displacement.data[1, 0, 1] = 0.02
    field.outer_m.fill_(0.03)
    moved = sampled(field)
    assert moved.elastic is not None
    expect_close(moved.elastic, [4.0])
    assert moved.d.min() < 0 < moved.d.max() < 0.06


def test_samples_out_of_reach_have_no_elastic_energy() -> None:
    """The shell is 1 cm thick outside, and its cells of 2 cm hold samples beyond. The others have energy 4."""
    field = field_of(no_residual, nodes=1, rig=FINE_RIG)
    assert field.deformation is not None
    field.deformation.displacement.data[1, 0, 0] = 0.02
    field.outer_m.fill_(0.01)
    samples = sampled(field, rig=FINE_RIG)
    share = (samples.d < field.reach_m).float().mean().item()
    assert samples.elastic is not None and 0.5 < share < 1
    expect_close(samples.elastic, [4.0 * share])
