"""The reference grids, by hand."""

import pytest
import torch

from tests.fields.plain_grids import FeatureGrids


def linear_grid() -> FeatureGrids:
    """Return one level over a 1 x 2 x 4 box whose feature is x + 10 y + 100 z at the nodes."""
    grid = FeatureGrids(torch.zeros(3), torch.tensor([1.0, 2.0, 4.0]), (4,), 1)
    z, y, x = torch.meshgrid(torch.arange(5.0), torch.arange(3.0), torch.arange(2.0), indexing="ij")
    with torch.no_grad():
        grid.levels[0][0, 0] = x + 10 * y + 100 * z
    return grid


def test_interpolation_of_a_linear_grid_by_hand():
    """Trilinear interpolation reproduces a linear function; outside, the border's value continues."""
    points = torch.tensor([[0.25, 1.5, 3.25], [1.0, 2.0, 4.0], [7.0, 2.0, 4.0]])
    assert linear_grid()(points)[:, 0].tolist() == pytest.approx([0.25 + 15 + 325, 421, 421], rel=1e-5)


def test_gradients_match_finite_differences():
    grid = linear_grid().double()
    points = torch.tensor([[0.25, 1.5, 3.3], [0.6, 0.7, 1.2]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(grid, (points,))
    torch.autograd.backward(grid(points).sum())
    torch.testing.assert_close(points.grad, torch.tensor([[1.0, 10.0, 100.0]] * 2).double())
