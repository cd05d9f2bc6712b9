"""Each loss on two rays with two samples, compared with values computed by hand."""

import math
from dataclasses import replace

import pytest
import torch

from hnerf.body.canonical import PoseCorrection
from hnerf.fields.samples import RaySamples
from hnerf.training import losses
from hnerf.training.losses import Target

RED, GREEN, BLACK = [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]

# Ray 0 hits the person: red at half opacity, then green, opaque in the SDF. Ray 1 misses: transparent, then black.
SAMPLES = RaySamples(
    alpha=torch.tensor([[0.5, 0.5], [0.0, 0.2]]),
    alpha_dot=torch.tensor([[0.0, 1.0], [0.0, 0.0]]),
    in_box=torch.tensor([[1.0, 1.0], [1.0, 0.0]]),
    colour=torch.tensor([[RED, GREEN], [RED, GREEN]]),
    density=torch.tensor([[60.0, 50.0], [0.0, 0.0]]),
    d=torch.tensor([[0.05, 0.01], [0.10, 0.20]]),
    residual=torch.tensor([[-0.02, -0.03], [0.04, -0.05]]),
    gradient_norm=torch.tensor([1.5, 0.8]),
    elastic=torch.tensor([0.2]),
)
TARGET = Target(torch.tensor([RED, BLACK]), torch.tensor([1.0, 0.0]), torch.ones(2), torch.tensor([BLACK, BLACK]))
DOUBLE = replace(SAMPLES, **{k: v.double() for k, v in vars(SAMPLES).items() if v is not None})
DOUBLE_TARGET = replace(TARGET, **{k: v.double() for k, v in vars(TARGET).items()})


def test_colour_errors():
    """C = (0.5, 0.25, 0) and (0, 0.2, 0)."""
    assert losses.colour_errors(SAMPLES, TARGET).tolist() == pytest.approx([0.75, 0.2])


def test_weightless_rays_have_no_colour_error():
    unweighted = replace(TARGET, weight=torch.tensor([0.0, 1.0]))
    assert losses.colour_errors(SAMPLES, unweighted).tolist() == pytest.approx([0, 0.2])


def test_mask():
    """Only the person's ray counts."""
    assert losses.mask(SAMPLES, TARGET).item() == pytest.approx(0.75 / 2)


def test_mask_ignores_samples_outside_the_box():
    """Without its second sample, the colour of the ray is (0.5, 0, 0): error 0.5."""
    outside = replace(SAMPLES, in_box=torch.tensor([[1.0, 0.0], [1.0, 0.0]]))
    assert losses.mask(outside, TARGET).item() == pytest.approx(0.5 / 2)


def test_mask_and_blend_leave_out_weightless_rays():
    """Ray 0, the person's, does not count: only the error of C^ of ray 1 is left."""
    unweighted = replace(TARGET, weight=torch.tensor([0.0, 1.0]))
    assert losses.mask(SAMPLES, unweighted).item() == 0
    assert losses.blend(SAMPLES, unweighted, eta=0.25).item() == pytest.approx(0.25 * 0.2 / 2)


def test_fog():
    """Ray 1 misses the person. Its C~ is (0, 0.2, 0) with all samples in the box, and black if its fog is outside."""
    assert losses.fog(replace(SAMPLES, in_box=torch.ones(2, 2)), TARGET).item() == pytest.approx(0.2 / 2)
    assert losses.fog(SAMPLES, TARGET).item() == 0
    left_out = replace(TARGET, weight=torch.tensor([1.0, 0.0]))
    assert losses.fog(replace(SAMPLES, in_box=torch.ones(2, 2)), left_out).item() == 0


def test_blend():
    """C^ of ray 0 is green: error 2. C^ of ray 1, which uses alpha outside the box, is (0, 0.2, 0): error 0.2 eta."""
    assert losses.blend(SAMPLES, TARGET, eta=0.25).item() == pytest.approx((2 + 0.25 * 0.2) / 2)


LABELS = 1 / (1 + math.exp(-1)), 0.5, 1 / (1 + math.exp(5))  # sigmoid(0.1 (sigma - 50)) of 60, 50 and 0
OCCUPIED = torch.tensor([[0.2, 0.9], [0.1, 0.5]])
COUPLED = replace(SAMPLES, alpha_dot=OCCUPIED, d=-OCCUPIED.logit() / 80, residual=torch.zeros(2, 2))


def cross_entropies(predicted: tuple[float, ...], labels: tuple[float, ...]) -> float:
    """Return half the sum of binary cross-entropies, which is the mean over two rays."""
    both = zip(predicted, labels, strict=True)
    return sum(-p * math.log(q) - (1 - p) * math.log(1 - q) for q, p in both) / 2


def test_geometry_with_the_roles_in_the_published_formula():
    """Densities are labels for the predictions 0.2, 0.9 and 0.1; samples outside the box are ignored."""
    expected = cross_entropies((0.2, 0.9, 0.1), LABELS)
    assert losses.geometry(COUPLED, 50.0, 0.1, 80.0, "print").item() == pytest.approx(expected, rel=1e-5)
    nearer = replace(COUPLED, d=0.4 * COUPLED.d)  # as sharp, with gamma 200
    assert losses.geometry(nearer, 50.0, 0.1, 200.0, "print").item() == pytest.approx(expected, rel=1e-5)


def test_geometry_with_the_surface_as_labels():
    """Densities are predictions for the labels 0.2, 0.9 and 0.1, which get no gradient."""
    occupied, density = COUPLED.alpha_dot.clone().requires_grad_(), COUPLED.density.clone().requires_grad_()
    loss = losses.geometry(replace(COUPLED, alpha_dot=occupied, density=density), 50.0, 0.1, 80.0, "surface_leads")
    assert loss.item() == pytest.approx(cross_entropies(LABELS, (0.2, 0.9, 0.1)), rel=1e-5)
    loss.backward()
    assert occupied.grad is None and density.grad is not None
    assert density.grad[0].tolist() == pytest.approx([0.1 * (LABELS[0] - 0.2) / 2, 0.1 * (0.5 - 0.9) / 2], rel=1e-4)


@pytest.mark.parametrize("roles", ["print", "surface_leads"])
def test_the_worst_violations_of_geometry_have_the_full_slope(roles: str):
    """Fog of 5000 in free space, 30 units from the surface: BCE(sigmoid(495), 0) = 495 with a slope of 0.1, and
    BCE(sigmoid(-2400), 1) = 2400 with a slope of -80. Each ray has two such samples."""
    density, d = torch.full((2, 2), 5000.0, requires_grad=True), torch.full((2, 2), 30.0, requires_grad=True)
    nowhere, inside = torch.zeros(2, 2), torch.ones(2, 2)
    samples = replace(SAMPLES, alpha_dot=nowhere, in_box=inside, residual=nowhere, density=density, d=d)
    loss = losses.geometry(samples, 50.0, 0.1, 80.0, roles)
    loss.backward()
    led, slope, cost = (d, 80.0, 2400.0) if roles == "print" else (density, 0.1, 495.0)
    assert loss.item() == pytest.approx(2 * cost) and led.grad.unique().item() == pytest.approx(slope / 2)


def test_geometry_is_zero_if_the_sdf_is_the_density():
    assert losses.geometry(replace(SAMPLES, density=None), 50.0, 0.1, 80.0, "print").item() == 0


def test_cross_entropy_of_nan_is_nan():
    """The step is then skipped with a stated cause, instead of an error from the library."""
    broken = torch.full_like(SAMPLES.d, torch.nan)
    assert losses.segmentation(broken, TARGET, 80.0).isnan()


def test_segmentation():
    """min d_hat is -0.02 on the person, 0.14 outside; with gamma 80: -log sigmoid(1.6) - log(1 - sigmoid(-11.2))."""
    expected = -math.log(1 / (1 + math.exp(-1.6))) - math.log(1 - 1 / (1 + math.exp(11.2)))
    assert losses.segmentation(SAMPLES.d_hat, TARGET, 80.0).item() == pytest.approx(expected / 2, rel=1e-3)


def test_a_distant_body_is_pulled_with_full_slope():
    """-log sigmoid(-80 x 0.3) is 24, with a slope of 80 per metre."""
    far = torch.full((2, 1), 0.3, requires_grad=True)
    loss = losses.segmentation(far, replace(TARGET, person=torch.ones(2)), 80.0)
    loss.backward()
    assert loss.item() == pytest.approx(24.0) and far.grad is not None
    assert far.grad.flatten().tolist() == pytest.approx([40.0, 40.0])


def test_eikonal():
    assert losses.eikonal(SAMPLES).item() == pytest.approx((0.25 + 0.04) / 2)


def test_residual_penalises_only_surfaces_inside_the_skin():
    """The only positive residual is 0.04."""
    assert losses.residual(SAMPLES).item() == pytest.approx(0.04 / 2)


def test_increment():
    """|dbeta| = 5; in the two frames |(3, 4)| = 5 and 0: mean 2.5."""
    correction = PoseCorrection(frames=2, free_joints=0, shapes=2)
    with torch.no_grad():
        correction.shape.copy_(torch.tensor([3.0, 4.0]))
        correction.turn[0, 0, 0], correction.absorbed_move_m[0, 1] = 3.0, 4.0
    assert losses.increment(correction).item() == pytest.approx(7.5)


def test_floor():
    """Below the ground, the first ray has samples 2 and 3 cm inside the body and one outside, the second none
    inside."""
    d_hat = torch.tensor([[-0.02, -0.03, 0.5], [-0.04, 0.1, 0.2]], dtype=torch.float64, requires_grad=True)
    height_m = torch.tensor([[-0.01, -0.02, -0.03], [0.01, -0.01, 0.02]])
    assert losses.floor(d_hat, height_m).item() == pytest.approx(0.025)
    assert torch.autograd.gradcheck(lambda d: losses.floor(d, height_m), d_hat)


def test_elastic():
    """Two rays, one of them without a deformation."""
    assert losses.elastic(SAMPLES).item() == pytest.approx(0.1)
    assert losses.elastic(replace(SAMPLES, elastic=None)).item() == 0


@pytest.mark.parametrize("name", ["colour_errors", "mask", "fog", "eikonal", "residual"])
def test_gradients_in_double_precision(name: str):
    def loss(alpha, residual, norms):
        samples = replace(DOUBLE, alpha=alpha, residual=residual, gradient_norm=norms)
        compared = [DOUBLE_TARGET] if name in ("colour_errors", "mask", "fog") else []
        return getattr(losses, name)(samples, *compared)

    inputs = [x.clone().requires_grad_() for x in (DOUBLE.alpha + 0.05, DOUBLE.residual, DOUBLE.gradient_norm)]
    assert torch.autograd.gradcheck(loss, inputs)


def test_gradients_of_coupled_losses_in_double_precision():
    def coupled(alpha_dot, density, residual):
        samples = replace(DOUBLE, alpha_dot=alpha_dot, density=density, residual=residual)
        return (
            losses.blend(samples, DOUBLE_TARGET, 0.25)
            + losses.geometry(samples, 50.0, 0.1, 80.0, "print")
            + losses.segmentation(samples.d_hat, DOUBLE_TARGET, 80.0)
        )

    inputs = [x.clone().requires_grad_() for x in (0.05 + 0.9 * DOUBLE.alpha_dot, DOUBLE.density, DOUBLE.residual)]
    assert torch.autograd.gradcheck(coupled, inputs)


def test_the_gradient_of_geometry_with_the_surface_as_labels_in_double_precision():
    def follow(density):
        return losses.geometry(replace(DOUBLE, density=density), 50.0, 0.1, 80.0, "surface_leads")

    assert torch.autograd.gradcheck(follow, DOUBLE.density.clone().requires_grad_())


def test_gradients_of_pose_and_deformation_losses_in_double_precision():
    correction = PoseCorrection(2, 1, 3).double()
    generator = torch.Generator().manual_seed(0)
    shapes = [p.shape for p in correction.parameters()]
    values = [torch.randn(shape, generator=generator, dtype=torch.float64).requires_grad_() for shape in shapes]

    def pulled(*parameters: torch.Tensor) -> torch.Tensor:
        named = dict(zip((name for name, _ in correction.named_parameters()), parameters, strict=True))
        return torch.func.functional_call(Increment(correction), {f"correction.{k}": v for k, v in named.items()}, ())

    assert torch.autograd.gradcheck(pulled, values)
    energy = torch.rand(3, generator=generator, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(lambda e: losses.elastic(replace(DOUBLE, elastic=e)), energy)


class Increment(torch.nn.Module):
    """The loss as a module, so that parameters can be set."""

    def __init__(self, correction: PoseCorrection) -> None:
        super().__init__()
        self.correction = correction

    def forward(self) -> torch.Tensor:
        return losses.increment(self.correction)
