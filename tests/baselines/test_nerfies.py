import math

import pytest
import torch

from hnerf.baselines.nerfies import (
    OCTAVES,
    Deformation,
    NerfiesField,
    annealed,
    elastic_energy,
    jacobian,
    sample_index,
    screw_motion,
)
from hnerf.body.canonical import PosedBodies
from hnerf.config import load_settings
from hnerf.fields.conditions import Conditions, Draws
from hnerf.fields.encoding import positional_encoding
from hnerf.fields.rays import Rays
from hnerf.fields.samples import RaySamples
from tests.baselines.column import Learned, learn, three_poses

SMALL = [
    "training.steps=60",
    "training.rays_per_frame=64",
    "training.field.samples=12",
    "training.field.width=32",
    "training.field.anneal_share=0.3333",
    "training.field.learning_rate=0.015",
]


def test_screw_motion_of_a_quarter_turn_by_hand() -> None:
    """A quarter turn about z while moving along x takes x to y. It takes the origin along a circle of radius 2 / pi
    about (0, 2 / pi) to (2 / pi, 2 / pi). Without rotation only the translation remains."""
    quarter = math.pi / 2
    rotation, translation = screw_motion(torch.tensor([0.0, 0.0, quarter]), torch.tensor([1.0, 0.0, 0.5]))
    torch.testing.assert_close(rotation, torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), atol=1e-6, rtol=0)
    torch.testing.assert_close(translation, torch.tensor([1 / quarter, 1 / quarter, 0.5]))
    rotation, translation = screw_motion(torch.zeros(3), torch.tensor([1.0, 2.0, 3.0]))
    assert torch.equal(rotation, torch.eye(3)) and torch.equal(translation, torch.tensor([1.0, 2.0, 3.0]))


@pytest.mark.parametrize("size", [1e-9, 5e-3, 2e-2, 1.0, 3.0])
def test_screw_motions_are_matrix_exponentials(size: float) -> None:
    turn, move = size * torch.tensor([0.6, -0.64, 0.48]).double(), torch.tensor([0.3, 1.0, -2.0]).double()
    zero = torch.zeros((), dtype=torch.float64)
    x, y, z = turn
    generator = torch.stack([zero, -z, y, move[0], z, zero, -x, move[1], -y, x, zero, move[2], *[zero] * 4]).view(4, 4)
    rotation, translation = screw_motion(turn, move)
    wanted = torch.linalg.matrix_exp(generator)
    torch.testing.assert_close(rotation, wanted[:3, :3], atol=1e-9, rtol=0)
    torch.testing.assert_close(translation, wanted[:3, 3], atol=1e-9, rtol=0)


def test_gradients_of_screw_motions_are_correct_at_rest_and_where_the_series_ends() -> None:
    turns = torch.tensor([[0.0, 0, 0], [0.00999, 0, 0], [0, 0.01001, 0], [0.3, -0.2, 1.1]], dtype=torch.float64)
    moves = torch.tensor([[0.3, 1.0, -2.0]], dtype=torch.float64).repeat(len(turns), 1)
    assert torch.autograd.gradcheck(screw_motion, (turns.requires_grad_(), moves.requires_grad_()))


def test_annealing_enables_octaves_one_after_another() -> None:
    """With 1.5 of 3 octaves, the first has full weight, the second (1 - cos(pi / 2)) / 2 = 0.5 and the third none. With
    1.25 octaves, the second has (1 - cos(pi / 4)) / 2. The position itself always has full weight."""
    encoded = positional_encoding(torch.tensor([[0.1, 0.2, 0.3]]), 3)
    for octaves, second in ((1.5, 0.5), (1.25, (1 - math.sqrt(0.5)) / 2)):
        share = annealed(encoded, torch.tensor(octaves)) / encoded
        wanted = torch.tensor([1.0] * 3 + ([1.0] * 3 + [second] * 3 + [0.0] * 3) * 2)
        torch.testing.assert_close(share[0], wanted)
    assert torch.equal(annealed(encoded, torch.tensor(3.0)), encoded)


def test_elastic_energy_by_hand() -> None:
    """A rotation costs nothing. For a stretch by e, (x / c)^2 = 1 / 0.03^2 = 1111.1, which costs 2 x 1111.1 / 1115.1.
    For a stretch by e^0.03 it is 1, which costs 2 / 5. For that stretch in all directions, or its inverse, it is 3,
    which costs 6 / 7."""
    rotation = screw_motion(torch.tensor([0.3, -0.5, 0.8]), torch.zeros(3))[0]
    stretches = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 0.03, 0], [0.03, 0.03, 0.03], [-0.03, -0.03, -0.03]]).exp()
    energy = elastic_energy(rotation @ torch.diag_embed(stretches))
    torch.testing.assert_close(energy, torch.tensor([0.0, 1.992827, 0.4, 6 / 7, 6 / 7]), atol=1e-5, rtol=1e-4)


def test_elastic_energy_gradient_matches_finite_differences() -> None:
    change = torch.eye(3).double() + 0.02 * torch.randn(4, 3, 3, generator=torch.Generator().manual_seed(0)).double()
    assert torch.autograd.gradcheck(elastic_energy, change.requires_grad_())


def test_deformation_jacobian_matches_finite_differences() -> None:
    """Compare with central differences in double precision, for a deformation with random weights."""
    torch.manual_seed(0)
    deformation = Deformation(4, 16).double()
    torch.nn.init.normal_(deformation.screw.weight)
    points, code, octaves = torch.rand(5, 3).double(), torch.randn(5, 4).double(), torch.tensor(3.3)

    def moved(x: torch.Tensor) -> torch.Tensor:
        return deformation(x, code, octaves)

    found, step = jacobian(moved, points), 1e-6
    assert (found - torch.eye(3)).abs().max() > 0.1
    for k, axis in enumerate(torch.eye(3).double()):
        numeric = (moved(points + step * axis) - moved(points - step * axis)) / (2 * step)
        torch.testing.assert_close(found[..., k], numeric, atol=1e-7, rtol=1e-6)


def test_samples_are_chosen_by_weight() -> None:
    """With weights 1, 0, 3 the first quarter of draws picks the first sample, the rest the last. If all weights are
    zero, the last sample is picked."""
    weights = torch.tensor([[1.0, 0.0, 3.0]]).repeat(4, 1)
    assert sample_index(weights, torch.tensor([0.0, 0.24, 0.26, 0.999])).tolist() == [0, 0, 2, 2]
    assert sample_index(torch.zeros(1, 3), torch.tensor([0.5])).tolist() == [2]


@pytest.fixture
def field() -> NerfiesField:
    torch.manual_seed(0)
    return NerfiesField(three_poses(), load_settings("nerfies", SMALL).training.field)


def evaluate(field: NerfiesField, training: bool) -> RaySamples:
    """Evaluate one ray that passes from above through the upright column."""
    fit = three_poses()
    bodies = PosedBodies(fit.rig, fit.theta, fit.root, field.canonical_m)
    conditions = Conditions.of(bodies, torch.arange(3), 2.5)
    ray = Rays(torch.tensor([[0.5, 0.4, 5.0]]), torch.tensor([[0.0, 0.0, -1.0]]), torch.zeros(1, dtype=torch.long))
    still = Draws.deterministic(1, field.samples, torch.device("cpu"))
    draws = Draws.random(1, field.samples, 0.0, torch.Generator().manual_seed(0)) if training else still
    return field.sample(field.scene(bodies, conditions), ray, draws)[0]


def test_elastic_loss_is_computed_only_in_training_and_progress_is_set_explicitly(field: NerfiesField) -> None:
    """Evaluating the field does not advance the annealing, because a step may evaluate it twice, with half of its rays
    each."""
    assert evaluate(field, training=False).elastic is None
    assert evaluate(field, training=True).elastic is not None
    assert field.progress == 0
    field.on_progress(0.2)
    assert field.state_dict()["progress"] == pytest.approx(0.2)


def test_rigid_motions_have_no_elastic_loss_and_stretching_has(field: NerfiesField) -> None:
    """A constant screw is a rigid motion; one that grows with the position is not."""
    with torch.no_grad():
        field.deformation.screw.bias.copy_(torch.tensor([0.4, -0.2, 0.7, 0.1, 0.0, -0.3]))
        field.deformation.screw.weight.zero_()
    rigid = evaluate(field, training=True).elastic
    torch.nn.init.normal_(field.deformation.screw.weight)
    swollen = evaluate(field, training=True).elastic
    assert rigid is not None and swollen is not None
    assert rigid.item() < 1e-6 and swollen.item() > 1e-2


def test_empty_space_has_no_elastic_loss(field: NerfiesField, monkeypatch: pytest.MonkeyPatch) -> None:
    """The energy counts as much as its ray is opaque, here not at all."""
    torch.nn.init.normal_(field.deformation.screw.weight)
    monkeypatch.setattr(field.template, "forward", lambda point, view: (0 * point[..., 0], 0 * point))
    found = evaluate(field, training=True).elastic
    assert found is not None and found.item() == 0


def test_samples_are_moved_into_the_template(field: NerfiesField, monkeypatch: pytest.MonkeyPatch) -> None:
    """A constant screw without rotation moves all of them alike."""
    seen: list[torch.Tensor] = []

    def template(point: torch.Tensor, view: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        seen.append(point)
        return 0 * point[..., 0], 0 * point

    monkeypatch.setattr(field.template, "forward", template)
    move = torch.tensor([0.1, -0.2, 0.3])
    with torch.no_grad():
        field.deformation.screw.weight.zero_()
        for turn_and_move in (torch.zeros(6), torch.cat([torch.zeros(3), move])):
            field.deformation.screw.bias.copy_(turn_and_move)
            evaluate(field, training=False)
    still, _, moved, _ = seen  # the fine samples follow the coarse ones
    torch.testing.assert_close(moved - still, move.expand_as(still), atol=1e-6, rtol=0)


def test_the_deformation_uses_all_octaves_only_after_annealing(field: NerfiesField) -> None:
    """After the annealing share of training, a random screw sees the complete encoding; before that, it does not."""
    assert field.settings.anneal_share == 0.3333
    torch.nn.init.normal_(field.deformation.screw.weight)
    points = torch.rand(20, 3)
    code = torch.zeros(20, field.settings.code_width)
    plain = field.deformation(points, code, torch.tensor(float(OCTAVES)))
    for share in (0.0, 0.3):
        field.progress.fill_(share)
        assert not torch.allclose(field._deform(points, code), plain, atol=1e-3)
    field.progress.fill_(0.3333)
    torch.testing.assert_close(field._deform(points, code), plain)


@pytest.fixture(scope="module")
def learned(tmp_path_factory: pytest.TempPathFactory) -> Learned:
    """Train on a column that hardly moves; the third frame is bent by 80 degrees."""
    return learn(tmp_path_factory.mktemp("still"), load_settings("nerfies", SMALL).training, (0.0, 0.2, 1.4))


def test_overfits_two_frames(learned: Learned) -> None:
    """Both frames have 27 dB, and progress is recorded up to the last step."""
    assert learned.avatar.field.progress == pytest.approx(59 / 60)
    assert min(learned.psnr(frame) for frame in (0, 1)) > 27


def test_a_novel_pose_renders_the_template(learned: Learned) -> None:
    """The novel pose is bent, but its rendering is upright as in training, which is 4 dB worse. The surface is the same
    for two novel poses."""
    assert learned.psnr(2) < min(learned.psnr(frame) for frame in (0, 1)) - 4
    one, other = torch.zeros(2, 2, 3)
    one[1, 1], other[1, 1] = 0.3, 0.35
    points = torch.rand(500, 3) * torch.tensor([0.8, 0.8, 1.8])
    distances = [learned.avatar.signed_distance(points, theta, learned.body.root[0]) for theta in (one, other)]
    assert torch.equal(*distances) and distances[0].std() > 1e-4
