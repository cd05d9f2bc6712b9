"""One ray through the published field with known functions instead of its networks: the networks' inputs, and the
results of their outputs.

A scene unit is 2 m. The body is the unit box, turned by a quarter about z: it lies between x = 1.55 and 2.55 m, and its
box B between 1.45 and 2.65 m. The ray runs along x and starts 1 m before the scene, so x is its depth minus 1 m. A fog
halves the light per metre. Four coarse samples in the middles of their metres have weights 1/2, 1/4, 1/8 and 1/8. Fine
samples at .6 of the quarters of these lie at 1.3 and 1.8 m in the first metre, 2.6 m in the second and 4.2 m in the
last.
"""

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn

from hnerf.body.canonical import PosedBodies
from hnerf.config import LossSettings, PaperFieldSettings, load_settings
from hnerf.fields.conditions import Conditions, Draws
from hnerf.fields.paper import PaperField, sample_pdf
from hnerf.fields.rays import Rays
from hnerf.fields.samples import RaySamples
from hnerf.training.pixels import PixelRays
from hnerf.training.step import Objective
from tests.body.boxes import box_rig

RIG = box_rig()
THETA = torch.tensor([[[0.0, 0, 0], [-0.4, 0.5, 0.6]], [[0.0, 0, 0], [0.1, 0.2, 0.3]]])
ROOT = torch.eye(4).repeat(2, 1, 1)
ROOT[0, :3, 3] = torch.tensor([1.45, 0.4, -1.0])  # so that the centre of the scene is (2, 0.2, -0.5)
ROOT[1, :2] = torch.tensor([[0.0, -1, 0, 2.55], [1, 0, 0, 0]])
SETTINGS = PaperFieldSettings(scene_m=2.0, samples=4)
RAY = Rays(torch.tensor([[-1.0, 0.4, 0.25]]), torch.tensor([[1.0, 0, 0]]), torch.tensor([1]))
DRAWS = Draws(torch.full((1, 4), 0.5), torch.ones(1, 3), torch.full((1, 4), 0.6), probe=torch.zeros(1))

DEPTHS_M = [1.3, 1.5, 1.8, 2.5, 2.6, 3.5, 4.2, 4.5]
INSIDE = torch.tensor([0.0, 0, 0, 1, 1, 1, 0, 0])  # in B: 5 cm before the body, 5 cm inside at either face
X = [-0.85, -0.75, -0.6, -0.25, -0.2, 0.25, 0.6, 0.75]  # in scene units
S_D = [[0.2, 0.5, 0.125, 0.025], [0.2, 0.5, 0.125, -0.025], [0.2, 0.0, 0.125, -0.025]]
TURN = [0.0, -1, 0, 0.275, 1, 0, 0, -0.1, 0, 0, 1, 0.25]  # the rows of T, relative to the scene's centre in scene units


class Fog(nn.Module):
    """F with constant density and colours given by the position."""

    def __init__(self, paint: Callable[[Tensor], Tensor] = lambda point: point[:, :3]):
        super().__init__()
        self.paint, self.asked = paint, []
        self.density = nn.Parameter(torch.tensor(2 * math.log(2)))  # per scene unit, which is two metres

    def forward(self, point: Tensor, pose: Tensor, root: Tensor, view: Tensor) -> tuple[Tensor, Tensor]:
        self.asked.append((point.detach(), pose, root, view))
        return self.density.expand(len(point)), self.paint(point)


class Slope(nn.Module):
    """DH that returns a tenth of its first input."""

    def __init__(self) -> None:
        super().__init__()
        self.asked: list[tuple[Tensor, Tensor]] = []

    def forward(self, point: Tensor, pose: Tensor) -> Tensor:
        self.asked.append((point.detach(), pose))
        return 0.1 * point[:, 0]


def field_of(static: bool = False, root: Tensor = ROOT, **changes: object) -> PaperField:
    field = PaperField(RIG, root, SETTINGS.model_copy(update=changes), static)
    field.radiance, field.residual = Fog(), Slope()
    return field


def bodies(theta: Tensor = THETA, root: Tensor = ROOT) -> tuple[PosedBodies, Conditions]:
    posed = PosedBodies(RIG, theta, root, RIG.vertices_m)
    return posed, Conditions.of(posed, torch.arange(2), 2.0)


def sampled(field: PaperField, draws: Draws = DRAWS) -> tuple[RaySamples, Tensor]:
    return field.sample(field.scene(*bodies()), RAY, draws)


def rows(values: list[list[float]]) -> Tensor:
    return torch.tensor(values)


def outside(dimensions: int) -> Tensor:
    """Return the ray's points in scene units; with four dimensions, the last is the constant distance outside B."""
    return rows([[x, 0.1, 0.375, 1.0][:dimensions] for x in X])


def expect_close(found: Tensor, expected: Tensor, atol: float = 2e-4) -> None:
    """Assert equality with a tolerance of 0.1 mm: fine samples deviate because no cell has zero weight."""
    torch.testing.assert_close(found.detach(), expected, atol=atol, rtol=0)


@pytest.mark.parametrize("static", [False, True])
def test_fine_samples_follow_the_weights_of_the_coarse_ones(static: bool) -> None:
    _, depths = sampled(field_of(static))
    expect_close(depths, rows([DEPTHS_M]))
    assert not depths.requires_grad  # no gradient flows to depths


def test_box_samples_lie_only_in_the_box() -> None:
    """Of four samples, two lie in the middles of the scene's halves, at 2 and 4 m, and two in the middles of the halves
    of B, which the ray crosses from 2.45 to 3.65 m."""
    field = field_of(static=True, box_samples=2)
    sampled(field)
    expect_close(field.radiance.asked[0][0][:, 0], torch.tensor([-0.5, -0.125, 0.175, 0.5]))


@pytest.mark.parametrize(("y_m", "slope"), [(1.9, 0.0), (-1.0, 0.1)])
def test_a_ray_that_misses_the_box_has_all_its_samples_in_the_scene(y_m: float, slope: float) -> None:
    """The first ray passes B along x. The second comes level with B only 4 m beyond the end of the scene."""
    field = field_of(static=True, box_samples=2)
    along = torch.nn.functional.normalize(torch.tensor([[1.0, slope, 0.0]]), dim=1)
    beside = replace(RAY, origins_m=torch.tensor([[-1.0, y_m, 0.25]]), directions=along)
    samples, depths = field.sample(field.scene(*bodies()), beside, DRAWS)
    assert samples.in_box.sum() == 0 and samples.alpha.isfinite().all()
    ahead_m = depths * along[0, 0]
    assert (depths.diff() >= 0).all() and ahead_m.min() >= 1 and ahead_m.max() <= 5


@pytest.mark.parametrize("walk_m", [6.0, -6.0])
def test_a_person_outside_the_scene_is_sampled(walk_m: float) -> None:
    """The first of two bodies stands at y = 0, the second at 6 or -6 m, and the scene of 2 m around their centre
    contains neither. A ray along x through the second body is in the scene from -2 to 2 m. Coarse samples lie at -1.5,
    -.5, .5 and 1.5 m, of which the third is in B, from -.1 to 1.1 m."""
    root = torch.eye(4).repeat(2, 1, 1)
    root[1, 1, 3] = walk_m
    field = field_of(root=root)
    ray = replace(RAY, origins_m=torch.tensor([[-3.0, walk_m + 0.5, 0.5]]))
    samples, depths = field.sample(field.scene(*bodies(0 * THETA, root)), ray, DRAWS)
    assert depths.min() >= 1 and depths.max() <= 5
    within = (depths > 2.9) & (depths < 4.1)
    assert within.sum() > 0 and torch.equal(samples.in_box, within.float())
    assert (field.radiance.asked[0][0][:, 3] != 1).tolist() == [False, False, True, False]


def test_no_background_is_seen_where_a_ray_leaves_scene_and_box_at_once() -> None:
    """The scene ends at y = 7.1 m with the box of the second body, beside which the ray passes along y, in empty space:
    what is opaque is its last sample, which is the background."""
    root = torch.eye(4).repeat(2, 1, 1)
    root[1, 1, 3] = 6.0
    field = field_of(root=root, samples=64)
    field.radiance.density.data.fill_(1e-3)
    ray = Rays(torch.tensor([[1.05, -3.0, 0.5]]), torch.tensor([[0.0, 1, 0]]), torch.tensor([1]))
    rendered = field.render_rays(field.scene(*bodies(0 * THETA, root)), ray)
    assert 1e-4 < rendered[0, 3] < 1e-3


def test_coarse_samples_are_evaluated_before_all_samples() -> None:
    field = field_of()
    sampled(field)
    (coarse, *_), (both, *_) = field.radiance.asked
    expect_close(coarse, rows([outside(4)[1].tolist(), S_D[0], S_D[2], outside(4)[7].tolist()]))
    assert len(both) == 8


def test_inputs_of_f_inside_and_outside_the_box() -> None:
    """Inside: (s, d) in scene units, with pose and root of the ray's frame. Outside: x - centre in scene units,
    distance 1, and zeros."""
    field = field_of()
    sampled(field)
    point, pose, root, view = field.radiance.asked[-1]
    expect_close(point, torch.cat([outside(4)[:3], rows(S_D), outside(4)[6:]]))
    expect_close(pose, INSIDE[:, None] * torch.tensor([0.1, 0.2, 0.3]))
    expect_close(root, INSIDE[:, None] * torch.tensor(TURN))
    expect_close(view, rows([[1.0, 0, 0]] * 8))


def test_inputs_of_dh_are_the_descriptor_and_the_pose() -> None:
    field = field_of()
    sampled(field)
    point, pose = field.residual.asked[-1]
    expect_close(point, rows(S_D))
    expect_close(pose, rows([[0.1, 0.2, 0.3]] * 3))


def test_noise_reaches_the_networks() -> None:
    """Noise is added to theta and T inside B, and to v everywhere."""
    field, (standing, conditions) = field_of(), bodies()
    noisy = replace(conditions, pose=conditions.pose + 0.01, root=conditions.root + 0.02)
    draws = replace(DRAWS, view=torch.tensor([[0.0, 0.03, -0.04]]))
    field.sample(field.scene(standing, noisy), RAY, draws)
    for _, pose, root, view in field.radiance.asked:
        within = pose.abs().sum(1) > 0
        expect_close(pose[within], rows([[0.11, 0.21, 0.31]]).expand(int(within.sum()), 3))
        expect_close(root[within], torch.tensor(TURN).expand(int(within.sum()), 12) + 0.02)
        assert within.any() and not root[~within].any()
        expect_close(view, rows([[1.0, 0.03, -0.04]]).expand_as(view))
    expect_close(field.residual.asked[-1][1], rows([[0.11, 0.21, 0.31]] * 3))


def test_f_has_no_root_input_without_the_root_condition() -> None:
    field = field_of(root_condition=False)
    sampled(field)
    assert field.radiance.asked[-1][2].shape == (8, 0)
    for condition, inputs in ((True, 256 + 12 + 3), (False, 256 + 3)):
        settings = PaperFieldSettings(samples=8, root_condition=condition)
        radiance = PaperField(RIG, torch.eye(4)[None], settings, static=False).radiance
        assert radiance.colour[0].in_features == inputs


def test_the_static_form_has_only_the_position_as_input() -> None:
    """F gets three coordinates inside and outside B, and neither pose nor root. DH is evaluated only inside B."""
    field = field_of(static=True)
    sampled(field)
    point, pose, root, view = field.radiance.asked[-1]
    expect_close(point, outside(3))
    assert pose.shape == root.shape == (8, 0)
    expect_close(view, rows([[1.0, 0, 0]] * 8))
    point, pose = field.residual.asked[-1]
    expect_close(point, outside(3)[3:6])
    assert pose.shape == (3, 0)


@pytest.mark.parametrize("static", [False, True])
def test_density_is_per_scene_unit(static: bool) -> None:
    """A metre halves the light; nothing is visible behind the last sample."""
    samples, _ = sampled(field_of(static))
    ways_m = [0.2, 0.3, 0.7, 0.1, 0.9, 0.7, 0.3]
    expect_close(samples.alpha, rows([[1 - 0.5**way for way in ways_m] + [1.0]]))
    expect_close(samples.density, torch.full((1, 8), 2 * math.log(2)))


@pytest.mark.parametrize(
    ("static", "residual", "norms"),
    [(False, [0.02, 0.02, 0.02], [1.01**0.5] * 3), (True, [-0.025, -0.02, 0.025], [0.9, 0.9, 1.1])],
)
def test_distances_are_in_scene_units_and_their_gradients_per_metre(
    static: bool, residual: list[float], norms: list[float]
) -> None:
    """Outside B the body has a distance of 1 and no residual. From the faces, d rises by 1 per metre, along or against
    x. The residual rises by a tenth: along the face, because s moves with the point, or along x in the static form."""
    samples, _ = sampled(field_of(static))
    expect_close(samples.in_box, INSIDE[None])
    d, dd = torch.ones(8), torch.zeros(8)
    d[3:6], dd[3:6] = torch.tensor([0.025, -0.025, -0.025]), torch.tensor(residual)
    expect_close(samples.d, d[None])
    assert field_of(static).unit_m == 2.0
    expect_close(samples.residual, dd[None])
    expect_close(samples.alpha_dot, 1 / (1 + torch.exp(200 * (d + dd)))[None], atol=2e-3)
    expect_close(samples.gradient_norm, torch.tensor(norms))
    assert sampled(field_of(static), replace(DRAWS, probe=None))[0].gradient_norm.shape == (0,)  # in a rendering


def test_each_loss_of_a_ray_by_hand() -> None:
    """The ray is on the person, who is white. F paints B white and everything else black. The fog halves the light 1.2
    times before B and 1.7 times in it, so the white part of C is 2^-1.2 - 2^-2.9 and that of C~ is 1 - 2^-1.7. d_hat is
    .045, -.005 and -.005. In C^, 2^-1.2 of the light reaches alpha_dot, which is sigmoid(-9), sigmoid(1), sigmoid(1).
    Weights are the paper's. The fog loss is 0, because there is no fog beside the person."""
    field, (standing, conditions) = field_of(), bodies()
    field.radiance = Fog(lambda point: (point[:, 3:] != 1).float().expand(-1, 3))
    correction = standing.correction()
    correction.absorbed_shape.fill_(3.0)
    correction.absorbed_move_m[1, 1] = 4.0  # one of two frames
    rays = PixelRays(*vars(RAY).values(), torch.ones(1, 3), torch.tensor([True]), torch.tensor([False]), None)
    objective = Objective(field, correction, load_settings("paper").training)
    terms, errors = objective(field.scene(standing, conditions), rays, DRAWS)

    def sigmoid(x: float) -> float:
        return 1 / (1 + math.exp(-x))

    opaque = sigmoid(0.02 * (2 * math.log(2) - 50))
    crossed = [-(a * math.log(opaque) + (1 - a) * math.log(1 - opaque)) for a in map(sigmoid, (-9, 1, 1))]
    expected = {
        "reconstruction": 3 * (1 - (2**-1.2 - 2**-2.9)),
        "mask": 3 * 2**-1.7,
        "fog": 0.0,
        "blend": 0.1 * 3 * (1 - 2**-1.2 * (1 - sigmoid(9) * sigmoid(-1) ** 2)),
        "geometry": 0.02 * sum(crossed),
        "segmentation": 0.02 * -math.log(sigmoid(200 * 0.005)),
        "eikonal": 1e-6 * 3 * (1.01**0.5 - 1) ** 2,
        "residual": 5e-4 * 3 * 0.02,
        "fit": 1.0 * -math.log(sigmoid(200 * 0.025)),
        "increment": 0.02 * (3 + 4 / 2),
    }
    assert {name: term.item() for name, term in terms.items()} == pytest.approx(expected, rel=5e-3, abs=1e-12)
    assert errors.tolist() == pytest.approx([expected["reconstruction"]], rel=5e-3)


def test_the_paper_preset_has_the_papers_values() -> None:
    """The values are from section 4 and from the parameters in the supplement."""
    training = load_settings("paper").training
    paper, losses = training.field, training.losses
    assert (paper.samples, paper.gamma, paper.learning_rate, paper.scene_m) == (256, 200, 1e-3, 2.5)
    assert (training.steps, training.frames_per_step * training.rays_per_frame, training.noise) == (10_000, 4096, 0.1)
    assert losses.density_threshold == 50
    weights = [losses.reconstruction, losses.mask, losses.blend, losses.geometry, losses.segmentation]
    weights += [losses.eikonal, losses.residual, losses.fit, losses.increment, losses.elastic]
    assert weights == [1, 1, 0.1, 0.02, 0.02, 1e-6, 5e-4, 1, 0.02, 0]
    assert LossSettings().eta == losses.eta == 1
    printed = load_settings("print").training.losses.increment  # as the paper's is no sum over the 4096 rays
    assert printed == pytest.approx(0.02 / 4096, rel=0.01)


def test_point_queries_use_the_same_inputs_as_training() -> None:
    """5 cm above the first body, at (0.5, 0.2, 1) in its frame, d_hat is .05 + 2 x .1 x .25 m."""
    field, (standing, conditions) = field_of(), bodies()
    point_m, view = torch.tensor([[1.95, 0.6, 0.05]]), torch.tensor([[0.0, 0, -1]])
    expect_close(field.signed_distance(standing, point_m, conditions), torch.tensor([0.1]))
    expect_close(field.colour(standing, point_m, view, conditions), rows([[0.25, 0.1, 0.5]]))
    point, pose, root, seen = field.radiance.asked[-1]
    expect_close(point, rows([[0.25, 0.1, 0.5, 0.025]]))
    expect_close(pose, rows([[-0.4, 0.5, 0.6]]))
    expect_close(root, rows([[1.0, 0, 0, -0.275, 0, 1, 0, 0.1, 0, 0, 1, -0.25]]))
    expect_close(seen, view)
    beyond_m = torch.tensor([[1.95, 0.6, 0.05 + field.margin_m]])  # 5 cm outside B: as far from the surface as from B
    field.residual.forward = lambda point, pose: torch.full_like(point[:, 0], -10.0)
    expect_close(field.signed_distance(standing, beyond_m, conditions), torch.tensor([0.05]))
    static = field_of(static=True)
    expect_close(static.signed_distance(standing, point_m, conditions), torch.tensor([0.05 + 2 * 0.1 * -0.025]))
    expect_close(static.colour(standing, point_m, view, conditions), rows([[-0.025, 0.2, 0.275]]))


def test_fine_samples_by_hand() -> None:
    """All weight is in [1, 2], the second of four unit cells: the four samples are 1.125, 1.375, 1.625 and 1.875."""
    middles = torch.tensor([[0.5, 1.5, 2.5, 3.5]])
    weights = torch.tensor([[0.0, 1000.0, 0.0, 0.0]])
    depths = sample_pdf(middles, torch.zeros(1), torch.full((1,), 4.0), weights, torch.full((1, 4), 0.5))
    torch.testing.assert_close(depths, torch.tensor([[1.125, 1.375, 1.625, 1.875]]), atol=1e-3, rtol=0)
