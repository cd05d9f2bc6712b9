"""Sparse voxels around a body with their neighbours' rows, so that convolutions are gathers and matrix products.

A voxel has integer coordinates (N, 3) and represents the point at that many voxel edges from the lower corner. The next
coarser level has every second coordinate; a voxel is active there if its 3 x 3 x 3 stencil on the finer level contains
an active one (the stride-2 sparse convolution of Graham et al. 2018).
"""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

PAD = 2  # empty coordinates all around, so that no stencil leaves the grid
STENCIL = torch.cartesian_prod(*[torch.arange(-1, 2)] * 3)  # 27 offsets
CORNERS = torch.cartesian_prod(*[torch.arange(2)] * 3)  # of a cell; also the roundings of a halved coordinate


@dataclass(frozen=True)
class Level:
    """Active voxels of one resolution, N of them; row N is an empty one.

    rows (X, Y, Z) int32: the row at each coordinate, padded; neighbours (N, 27) int32: rows of the stencil;
    finer_neighbours (N, 27) int32: rows of the finer level's stencil around the same point, without entries at the
    finest level.
    """

    rows: Tensor
    neighbours: Tensor
    finer_neighbours: Tensor

    @staticmethod
    def of(coordinates: Tensor, finer: "Level | None") -> "Level":
        """Build the level of unique coordinates (N, 3) that start at 0."""
        size = (coordinates.amax(0) + 1 + 2 * PAD).tolist()
        rows = torch.full(size, len(coordinates), dtype=torch.int32, device=coordinates.device)
        rows[tuple((coordinates + PAD).T)] = torch.arange(
            len(coordinates), dtype=torch.int32, device=coordinates.device
        )
        stencil = STENCIL.to(coordinates.device)
        finer_neighbours = stencil.new_zeros(0, len(stencil), dtype=torch.int32)
        if finer is not None:
            finer_neighbours = _look_up(finer.rows, 2 * coordinates[:, None] + stencil)
        return Level(rows, _look_up(rows, coordinates[:, None] + stencil), finer_neighbours)

    def interpolate(self, values: Tensor, at: Tensor) -> Tensor:
        """Interpolate values (N + 1, C), the last of them zero, trilinearly at fractional coordinates (P, 3): (P, C);
        zero where no active voxel is near."""
        limit = torch.tensor(self.rows.shape, device=at.device) - 2 * PAD
        at = at.clamp(min=-1).minimum(limit)  # everything outside is empty
        first = at.floor()
        corners = CORNERS.to(at.device)
        share = at - first
        weights = torch.where(corners == 1, share[:, None], 1 - share[:, None]).prod(-1)
        rows = _look_up(self.rows, first.long()[:, None] + corners)
        return embedding_bag(rows, values, mode="sum", per_sample_weights=weights)


def _unique(coordinates: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the unique coordinates of (P, 3), which start at 0, the index into them (P,), and how often each occurs.
    Integer keys are used because torch's unique of rows is tens of times slower."""
    size = (coordinates.amax(0) + 1).tolist()
    key = (coordinates[:, 0] * size[1] + coordinates[:, 1]) * size[2] + coordinates[:, 2]
    found, inverse, count = key.unique(return_inverse=True, return_counts=True)
    return torch.stack(torch.unravel_index(found, size), 1), inverse, count


def _look_up(rows: Tensor, coordinates: Tensor) -> Tensor:
    """Return the rows at coordinates (..., 3)."""
    x, y, z = (coordinates + PAD).unbind(-1)
    return rows[x, y, z]


@dataclass(frozen=True)
class Voxels:
    """Voxel levels around points, from fine to coarse. vertex (V,): row in the finest level of each point; count (N,):
    number of points of each row; lower_m (3,): lower corner; edge_m: edge of the finest voxels."""

    lower_m: Tensor
    edge_m: float
    vertex: Tensor
    count: Tensor
    levels: tuple[Level, ...]

    @staticmethod
    def around(points_m: Tensor, edge_m: float, levels: int) -> "Voxels":
        """Build the levels around points (V, 3): each point activates its nearest voxel."""
        lower_m = points_m.amin(0)
        nearest = ((points_m - lower_m) / edge_m).round().long()
        coordinates, vertex, count = _unique(nearest)
        found = [Level.of(coordinates, None)]
        for _ in range(levels - 1):
            halves = torch.div(coordinates[:, None] + CORNERS.to(coordinates.device), 2, rounding_mode="floor")
            coordinates = _unique(halves.flatten(0, 1))[0]
            found.append(Level.of(coordinates, found[-1]))
        return Voxels(lower_m, edge_m, vertex, count, tuple(found))

    def coordinates(self, points_m: Tensor, level: int) -> Tensor:
        """Return the fractional coordinates of points (P, 3) at a level."""
        return (points_m - self.lower_m) / (self.edge_m * 2**level)
