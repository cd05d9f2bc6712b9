"""Features of the nodes that are kept: interpolation and gradients with warp match the plain grids."""

import pytest
import torch
from torch import Tensor

from hnerf.fields.sparse_grids import SparseGrids
from tests.fields.plain_grids import FeatureGrids, everywhere

LOWER_M, UPPER_M, CELLS, CHANNELS = torch.zeros(3), torch.tensor([1.0, 2.0, 1.5]), (3, 8), 4
ON_BORDERS = torch.tensor([[0.0, 0.0, 0.0], [1.0, 2.0, 1.5], [0.5, 7.0, 0.3], [-1.0, 0.2, 1.5]])
POINTS = torch.cat([torch.rand(200, 3, generator=torch.Generator().manual_seed(1)) * UPPER_M, ON_BORDERS])


def low(nodes_m: Tensor, beyond_m: float) -> Tensor:
    """Return the nodes that lie below 0.6 m, or above it by at most `beyond_m`."""
    return nodes_m[:, 2] <= 0.6 + beyond_m


def both(near=everywhere) -> tuple[SparseGrids, FeatureGrids]:
    """Return sparse and plain grids with the same random features; those that the sparse grids lack are zero."""
    torch.manual_seed(0)
    sparse = SparseGrids(LOWER_M, UPPER_M, CELLS, CHANNELS, near)
    torch.nn.init.normal_(sparse.features)
    plain = FeatureGrids(LOWER_M, UPPER_M, CELLS, CHANNELS)
    for level, features in zip(plain.levels, sparse.dense_levels(), strict=True):
        level.data[0] = features.movedim(-1, 0)
    return sparse, plain


def test_interpolation_and_gradients_match_plain_grids() -> None:
    """This includes the corners of the box and positions beyond its faces."""
    gradient = torch.randn(len(POINTS), len(CELLS) * CHANNELS, generator=torch.Generator().manual_seed(2))
    found = []
    for grids in both():
        points = POINTS.clone().requires_grad_()
        features = grids(points)
        features.backward(gradient)
        levels = [level.grad[0].movedim(0, -1) for level in grids.levels] if isinstance(grids, FeatureGrids) else None
        if levels is None:
            grids.features.data = grids.features.grad
            levels = grids.dense_levels()
        found.append([features.detach(), points.grad[:-4], *levels])
    torch.testing.assert_close(*found, atol=2e-5, rtol=1e-4)


def test_all_nodes_near_samples_are_kept() -> None:
    """Below 0.6 m, samples get the features of the plain grids. More than a cell above it, features are zero."""
    sparse, plain = both(low)
    assert len(sparse.features) < len(sparse.rows)
    below = POINTS[POINTS[:, 2] < 0.6]
    torch.testing.assert_close(sparse(below), plain(below), atol=1e-5, rtol=1e-4)
    assert (sparse(torch.tensor([[0.5, 0.5, 1.45]]))[0, CHANNELS:] == 0).all()


def test_a_flat_box_is_one_cell_thick() -> None:
    """Of 8 cells along 2 m, 4 fit along 1 m, and less than half a cell along 0.1 m. A single cell has two nodes."""
    grids = SparseGrids(LOWER_M, torch.tensor([1.0, 2.0, 0.1]), (8,), CHANNELS, everywhere)
    assert grids.sizes.tolist() == [[5, 9, 2]]


def test_second_derivatives_are_refused() -> None:
    points = POINTS.clone().requires_grad_()
    with pytest.raises(RuntimeError, match="no second derivatives"):
        torch.autograd.grad(both()[0](points).sum(), points, create_graph=True)


def test_an_empty_batch_of_points_gives_empty_features() -> None:
    assert both()[0](POINTS[:0]).shape == (0, len(CELLS) * CHANNELS)
