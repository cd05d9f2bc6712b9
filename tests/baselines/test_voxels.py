import torch

from hnerf.baselines.neural_body import SparseConvolution
from hnerf.baselines.voxels import Level, Voxels

SIZE = 7


def scattered() -> tuple[torch.Tensor, torch.Tensor]:
    """Return a grid of 7 x 7 x 7 voxels, a tenth of them active: coordinates (N, 3), grid (7, 7, 7) bool."""
    active = torch.rand(SIZE, SIZE, SIZE, generator=torch.Generator().manual_seed(0)) < 0.1
    active[0, 0, 0] = active[-1, -1, -1] = True  # so that coordinates span 0 to 6
    return torch.nonzero(active), active


def dense(coordinates: torch.Tensor, values: torch.Tensor, size: int) -> torch.Tensor:
    grid = values.new_zeros(size, size, size, values.shape[1])
    grid[tuple(coordinates.T)] = values
    return grid.permute(3, 0, 1, 2)[None]


def coordinates_of(level: Level) -> torch.Tensor:
    """Return the voxel coordinates (N, 3) of each row."""
    at = torch.nonzero(level.rows < level.rows.max())
    return (at - 2)[level.rows[tuple(at.T)].argsort()]


def convolution(inputs: int, outputs: int) -> tuple[SparseConvolution, torch.Tensor]:
    """Return a sparse convolution without normalisation, and its kernel in torch's layout."""
    torch.manual_seed(0)
    sparse = SparseConvolution(inputs, outputs)
    sparse.norm = torch.nn.Identity()
    return sparse, sparse.linear.weight.view(outputs, 3, 3, 3, inputs).permute(0, 4, 1, 2, 3)


def padded(values: torch.Tensor) -> torch.Tensor:
    return torch.cat([values, torch.zeros_like(values[:1])])


def test_sparse_convolution_matches_dense_at_active_voxels() -> None:
    coordinates, _ = scattered()
    values = torch.randn(len(coordinates), 3)
    sparse, kernel = convolution(3, 2)
    level = Level.of(coordinates, None)
    wanted = torch.nn.functional.conv3d(dense(coordinates, values, SIZE), kernel, padding=1).relu()
    found = sparse(padded(values), level.neighbours)
    torch.testing.assert_close(found[:-1], wanted[0][:, *coordinates.T].T, atol=1e-6, rtol=1e-5)
    assert not found[-1].any()


def test_strided_sparse_convolution_matches_dense() -> None:
    """The coarse active voxels match too: those whose stencil contains an active voxel."""
    coordinates, active = scattered()
    values = torch.randn(len(coordinates), 3)
    finest = Voxels.around(coordinates.float(), 1.0, 2)
    coarse, order = finest.levels[1], finest.vertex
    by_row = torch.zeros_like(values).index_copy(0, order, values)
    sparse, kernel = convolution(3, 2)
    wanted = torch.nn.functional.conv3d(dense(coordinates, values, SIZE), kernel, stride=2, padding=1).relu()
    met = torch.nn.functional.max_pool3d(active.float()[None], 3, stride=2, padding=1)[0] > 0
    there = coordinates_of(coarse)
    assert sorted(map(tuple, there.tolist())) == sorted(map(tuple, torch.nonzero(met).tolist()))
    found = sparse(padded(by_row), coarse.finer_neighbours)[:-1]
    torch.testing.assert_close(found, wanted[0][:, *there.T].T, atol=1e-6, rtol=1e-5)


def test_interpolation_matches_a_dense_grid() -> None:
    """Interpolation is trilinear between active and empty voxels, and zero outside the grid and far from active
    voxels."""
    coordinates, _ = scattered()
    values = torch.randn(len(coordinates), 4)
    at = torch.rand(500, 3) * (SIZE + 6) - 3
    unit = (2 * at / (SIZE - 1) - 1).flip(-1)[None, None, None]
    wanted = torch.nn.functional.grid_sample(
        dense(coordinates, values, SIZE), unit, align_corners=True, padding_mode="zeros"
    )
    found = Level.of(coordinates, None).interpolate(padded(values), at)
    torch.testing.assert_close(found, wanted[0, :, 0, 0].T, atol=1e-5, rtol=1e-5)


def test_every_vertex_is_assigned_its_nearest_voxel() -> None:
    """With edges of 0.1 m from the lower corner (1, 2, 3), offsets of 0.04 and 0.06 m fall into voxels 0 and 1."""
    points = torch.tensor([[1.0, 2.0, 3.0], [1.04, 2.0, 3.0], [1.06, 2.0, 3.0], [1.0, 2.0, 3.3]])
    voxels = Voxels.around(points, 0.1, 1)
    places = coordinates_of(voxels.levels[0])[voxels.vertex]
    assert places.tolist() == [[0, 0, 0], [0, 0, 0], [1, 0, 0], [0, 0, 3]]
    assert voxels.count[voxels.vertex].tolist() == [2, 2, 1, 1]
    torch.testing.assert_close(voxels.coordinates(points[3:], 1), torch.tensor([[0.0, 0.0, 1.5]]), atol=1e-5, rtol=0)


def test_coordinates_halve_from_level_to_level() -> None:
    """The point is 8 edges of 5 cm from the lower corner along x, 4 along y and 2 along z."""
    voxels = Voxels.around(torch.tensor([[0.1, 0.2, 0.3], [0.6, 0.7, 0.8]]), 0.05, 4)
    point_m = torch.tensor([[0.5, 0.4, 0.4]])
    found = torch.cat([voxels.coordinates(point_m, level) for level in range(4)])
    torch.testing.assert_close(found, torch.tensor([[8.0, 4, 2], [4, 2, 1], [2, 1, 0.5], [1, 0.5, 0.25]]))
