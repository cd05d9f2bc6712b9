import pytest
import torch

from hnerf.fields.encoding import positional_encoding


def test_positional_encoding_by_hand():
    """0.5 with two octaves is 0.5, sin(pi/2), sin(pi), cos(pi/2), cos(pi)."""
    encoded = positional_encoding(torch.tensor([[0.5]]), 2)
    assert encoded[0].tolist() == pytest.approx([0.5, 1, 0, 0, -1], abs=1e-6)


def test_gradients_of_the_positional_encoding_in_double_precision():
    points = torch.tensor([[0.1, -0.7, 0.3], [1.0, 0.0, -1.2]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: positional_encoding(x, 4), points)
