import math

import pytest
import torch

from hnerf.fields.compositing import alpha_from_density, alpha_from_sdf, composite, occupancy, weights_from_alpha


def test_alpha_from_density():
    """1 - exp(-2 * 0.5) = 1 - 1/e."""
    assert alpha_from_density(torch.tensor([[2.0]]), torch.tensor([[0.5]])).item() == pytest.approx(1 - 1 / math.e)


def test_occupancy_by_hand():
    """sigmoid(-100 d): 1/2 on the surface, sigmoid(2) two centimetres inside."""
    assert occupancy(torch.tensor([0.0, -0.02]), 100.0).tolist() == pytest.approx([0.5, 1 / (1 + math.exp(-2))])


def test_weights_and_compositing_by_hand():
    """Alphas 0.5, 0.5, 1 give weights 0.5, 0.25, 0.25, and red, green and blue are composited with these."""
    weights = weights_from_alpha(torch.tensor([[0.5, 0.5, 1.0]]))
    assert weights.tolist() == [[0.5, 0.25, 0.25]]
    assert composite(weights, torch.eye(3)[None]).tolist() == [[0.5, 0.25, 0.25]]


def test_alpha_from_sdf_by_hand():
    """Phi = sigmoid(ln(3) d): d = 1 gives 3/4, 0 gives 1/2 and -1 gives 1/4, so alphas are 1/3 and 1/2."""
    alpha = alpha_from_sdf(torch.tensor([[1.0, 0.0, -1.0]]), torch.tensor(math.log(3.0)))
    assert alpha[0].tolist() == pytest.approx([1 / 3, 1 / 2, 0.0])


def test_the_only_sample_of_a_ray_is_its_last():
    assert alpha_from_sdf(torch.tensor([[-1.0], [1.0]]), torch.tensor(10.0)).tolist() == [[0.0], [0.0]]


def test_alpha_from_sdf_is_independent_of_sampling():
    """A ray that passes at 5 mm from the surface has a coverage of 1 - Phi(5 mm) / Phi(far), whatever its number of
    samples."""
    sharpness = torch.tensor(200.0)
    for samples in (33, 129):
        t = torch.linspace(-0.2, 0.2, samples)
        distance = (t**2 + 0.005**2).sqrt()[None]
        covered = weights_from_alpha(alpha_from_sdf(distance, sharpness)).sum().item()
        assert covered == pytest.approx(1 - 1 / (1 + math.exp(-1.0)), abs=1e-3)


@pytest.mark.parametrize(
    "function", [alpha_from_sdf, lambda d, s: weights_from_alpha(alpha_from_density(d.abs() * s, s + d * 0))]
)
def test_gradients_match_finite_differences(function):
    distance = torch.tensor([[0.021, 0.007, -0.004, -0.02]], dtype=torch.float64, requires_grad=True)
    sharpness = torch.tensor(80.0, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(function, (distance, sharpness))
