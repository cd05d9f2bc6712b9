"""Where the person can be: one voxel grid a frame that says empty, shell or solid. Rays are sampled in the shell
alone."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

EMPTY, SHELL, SOLID = 0, 1, 2


@dataclass(frozen=True)
class ShellGrid:
    """cells (n, X, Y, Z) uint8 of EMPTY, SHELL, SOLID; lower_m (n, 3) corner of each frame's grid; cell_m: edge
    length."""

    cells: Tensor
    lower_m: Tensor
    cell_m: float

    @staticmethod
    def around(surfaces_m: Tensor, outer_m: Tensor, inner_m: Tensor, cell_m: float) -> "ShellGrid":
        """The shell around closed surfaces, from dense points on them (n, V, 3) with the shell's own thickness outside
        and inside at each point, (V,) metres.

        Distances are between the centres of cells, half a diagonal is added to them: the shell is up to a cell thicker
        than asked, seldom thinner. A cell takes the greatest thickness in the neighbourhood of its nearest point.
        """
        margin_m = float(outer_m.max()) + 2 * cell_m
        lower = surfaces_m.amin(1) - margin_m
        size = ((surfaces_m.amax(1) + margin_m - lower).amax(0) / cell_m).ceil().int().tolist()
        index = ((surfaces_m - lower[:, None]) / cell_m).long().cpu().numpy()
        slack_m = cell_m * 3**0.5 / 2
        grids = []
        for frame in index:
            at = tuple(frame.T)
            surface = np.zeros(size, bool)
            surface[at] = True
            nearest = ndimage.distance_transform_edt(~surface, return_distances=False, return_indices=True)
            distance_m = cell_m * np.linalg.norm(nearest - np.indices(size), axis=0)
            outer, inner = (_greatest_nearby(size, at, t.cpu().numpy())[tuple(nearest)] for t in (outer_m, inner_m))
            inside = ndimage.binary_fill_holes(distance_m <= cell_m)  # a cell thicker, so that no gap lets it leak
            cells = np.where(inside | (distance_m <= outer + slack_m), SHELL, EMPTY)
            cells[inside & (distance_m > inner + slack_m)] = SOLID
            grids.append(torch.from_numpy(cells.astype(np.uint8)))
        return ShellGrid(torch.stack(grids).to(surfaces_m.device), lower, cell_m)

    def look_up(self, points_m: Tensor, frame: Tensor) -> Tensor:
        """State of the cell around world points (R, K, 3) in frames (R,): (R, K) uint8, EMPTY outside the grid."""
        x_cells, y_cells, z_cells = self.cells.shape[1:]
        index = ((points_m - self.lower_m[frame][:, None]) / self.cell_m).floor().long()
        limit = torch.tensor([x_cells, y_cells, z_cells], device=index.device)
        outside = ((index < 0) | (index >= limit)).any(-1)
        x, y, z = index.clamp(min=0).minimum(limit - 1).unbind(-1)
        flat = ((frame[:, None] * x_cells + x) * y_cells + y) * z_cells + z
        return self.cells.flatten()[flat].masked_fill(outside, EMPTY)

    def sample_rays(
        self, origins_m: Tensor, directions: Tensor, frame: Tensor, jitter: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Depths (R, K) in metres, sorted, spread evenly over the shell up to the first solid cell; and (R,) bool:
        whether the ray meets the shell at all. jitter (R, K) in [0, 1): where each sample lies in its stratum."""
        edges, cumulative = self._march(origins_m, directions, frame)
        samples = jitter.shape[1]
        strata = torch.arange(samples, device=edges.device, dtype=edges.dtype)
        wanted = (strata + jitter) / samples * cumulative[:, -1:]
        upper = torch.searchsorted(cumulative, wanted.contiguous(), right=True).clamp(1, edges.shape[1] - 1)
        inside = wanted - cumulative.gather(1, upper - 1)
        return edges.gather(1, upper - 1) + inside * self.cell_m, cumulative[:, -1] > 0

    def path_m(self, origins_m: Tensor, directions: Tensor, frame: Tensor) -> Tensor:
        """How long the ways are over which `sample_rays` spreads the samples, (R,) metres."""
        return self.cell_m * self._march(origins_m, directions, frame)[1][:, -1]

    def _march(self, origins_m: Tensor, directions: Tensor, frame: Tensor) -> tuple[Tensor, Tensor]:
        """Depths (R, B + 1) of equal steps through the grid, and how many of the steps before each are in the shell and
        in front of the first solid cell, (R, B + 1)."""
        size_m = self.cell_m * torch.tensor(self.cells.shape[1:], device=origins_m.device)
        near, far = box_interval(origins_m, directions, self.lower_m[frame], self.lower_m[frame] + size_m)
        bins = max(1, math.ceil(float((far - near).max()) / self.cell_m))
        edges = near[:, None] + self.cell_m * torch.arange(bins + 1, device=near.device)  # whatever the other rays
        middles = (edges[:, 1:] + edges[:, :-1]) / 2
        state = self.look_up(origins_m[:, None] + directions[:, None] * middles[..., None], frame)
        before_solid = (state == SOLID).cumsum(1) == 0
        weight = ((state == SHELL) & before_solid).float()
        return edges, torch.cat([torch.zeros_like(near)[:, None], weight.cumsum(1)], 1)


def lattice(vertices_m: Tensor, faces: Tensor, spacing_m: float) -> tuple[Tensor, Tensor]:
    """Points on a surface, vertices among them, no farther apart along edges than `spacing_m`: corner indices (P, 3)
    and barycentric weights (P, 3), which hold in any pose."""
    corners_m = vertices_m[faces]
    longest_m = (corners_m - corners_m.roll(1, 1)).norm(dim=-1).amax(1)
    parts = (longest_m / spacing_m).ceil().long().clamp(min=1)
    corners, weights = [], []
    for n in parts.unique().tolist():
        steps = torch.cartesian_prod(torch.arange(n + 1), torch.arange(n + 1))
        steps = steps[steps.sum(1) <= n]
        inside = torch.cat([steps, n - steps.sum(1, keepdim=True)], 1).to(vertices_m) / n
        split = faces[parts == n]
        corners.append(split.repeat_interleave(len(inside), 0))
        weights.append(inside.repeat(len(split), 1))
    return torch.cat(corners), torch.cat(weights)


def _greatest_nearby(size: list[int], at: tuple[np.ndarray, ...], values: np.ndarray) -> np.ndarray:
    """Greatest of the values that fall into a cell or its neighbours, an array of this size."""
    greatest = np.zeros(size, np.float32)
    np.maximum.at(greatest, at, values)
    return ndimage.maximum_filter(greatest, 3)


def box_interval(origins_m: Tensor, directions: Tensor, lower_m: Tensor, upper_m: Tensor) -> tuple[Tensor, Tensor]:
    """Entry and exit depths (R,) of rays in axis-aligned boxes (R, 3); equal where the box is missed (slab method)."""
    inverse = 1 / torch.where(directions.abs() < 1e-9, torch.full_like(directions, 1e-9), directions)
    a, b = (lower_m - origins_m) * inverse, (upper_m - origins_m) * inverse
    near = torch.minimum(a, b).amax(-1).clamp(min=0)
    return near, torch.maximum(torch.maximum(a, b).amin(-1), near)


def stratified(near: Tensor, far: Tensor, jitter: Tensor) -> Tensor:
    """Depths (R, K), one in each of K equal parts of [near, far] (R,), at jitter (R, K) in [0, 1) of its part."""
    strata = torch.arange(jitter.shape[1], device=near.device)
    return near[:, None] + (far - near)[:, None] * (strata + jitter) / jitter.shape[1]
