import torch

from hnerf.baselines.neural_body import SparseConvolution
from hnerf.baselines.voxels import Level, Voxels

SIZE = 7


def scattered() -> tuple[torch.Tensor, torch.Tensor]:
    """Return a grid of 7 x 7 x 7 with a tenth of it active: coordinates (N, 3), grid (7, 7, 7) bool."""
    active = torch.rand(SIZE, SIZE, SIZE, generator=torch.Generator().manual_seed(0)) < 0.1
    active[0, 0, 0] = active[-1, -1, -1] = True  # so that coordinates start at 0 and end at 6
    return torch.nonzero(active), active


def dense(coordinates: torch.Tensor, values: torch.Tensor, size: int) -> torch.Tensor:
    grid = values.new_zeros(size, size, size, values.shape[1])
    grid[tuple(coordinates.T)] = values
    return grid.permute(3, 0, 1, 2)[None]


def coordinates_of(level: Level) -> torch.Tensor:
    """Return the coordinates (N, 3) by row."""
    at = torch.nonzero(level.rows < level.rows.max())
    return (at - 2)[level.rows[tuple(at.T)].argsort()]


def convolution(inputs: int, outputs: int) -> tuple[SparseConvolution, torch.Tensor]:
    """Return a sparse convolution without normalisation, and its kernel in the layout of torch's own."""
    torch.manual_seed(0)
    sparse = SparseConvolution(inputs, outputs)
    sparse.norm = torch.nn.Identity()
    return sparse, sparse.linear.weight.view(outputs, 3, 3, 3, inputs).permute(0, 4, 1, 2, 3)


def padded(values: torch.Tensor) -> torch.Tensor:
    return torch.cat([values, torch.zeros_like(values[:1])])


def test_agrees_with_dense_convolution_where_voxels_are_active() -> None:
    coordinates, _ = scattered()
    values = torch.randn(len(coordinates), 3)
    sparse, kernel = convolution(3, 2)
    level = Level.of(coordinates, None)
    wanted = torch.nn.functional.conv3d(dense(coordinates, values, SIZE), kernel, padding=1).relu()
    found = sparse(padded(values), level.neighbours)
    torch.testing.assert_close(found[:-1], wanted[0][:, *coordinates.T].T, atol=1e-6, rtol=1e-5)
    assert not found[-1].any()


def test_stride_two_agrees_with_dense_convolution() -> None:
    """The active voxels agree, too: those whose stencil contains an active one."""
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


def test_reads_as_a_dense_grid_does() -> None:
    """Interpolation is trilinear between active and empty voxels, zero outside the grid and far from it."""
    coordinates, _ = scattered()
    values = torch.randn(len(coordinates), 4)
    at = torch.rand(500, 3) * (SIZE + 6) - 3
    unit = (2 * at / (SIZE - 1) - 1).flip(-1)[None, None, None]
    wanted = torch.nn.functional.grid_sample(
        dense(coordinates, values, SIZE), unit, align_corners=True, padding_mode="zeros"
    )
    found = Level.of(coordinates, None).interpolate(padded(values), at)
    torch.testing.assert_close(found, wanted[0, :, 0, 0].T, atol=1e-5, rtol=1e-5)


def test_every_point_has_the_voxel_nearest_to_it() -> None:
    """Edges of 0.1 m from the lower corner (1, 2, 3): offsets of 0.04 and 0.06 m fall to voxels 0 and 1."""
    points = torch.tensor([[1.0, 2.0, 3.0], [1.04, 2.0, 3.0], [1.06, 2.0, 3.0], [1.0, 2.0, 3.3]])
    voxels = Voxels.around(points, 0.1, 1)
    places = coordinates_of(voxels.levels[0])[voxels.vertex]
    assert places.tolist() == [[0, 0, 0], [0, 0, 0], [1, 0, 0], [0, 0, 3]]
    assert voxels.count[voxels.vertex].tolist() == [2, 2, 1, 1]
    torch.testing.assert_close(voxels.coordinates(points[3:], 1), torch.tensor([[0.0, 0.0, 1.5]]), atol=1e-5, rtol=0)
