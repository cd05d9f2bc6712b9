"""Where the person can be: one voxel grid a frame that says empty, shell or solid. Rays are sampled in the shell
alone."""

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
    def around(surfaces_m: Tensor, outer_m: float, inner_m: float, cell_m: float) -> "ShellGrid":
        """The shell from `inner_m` inside closed surfaces to `outer_m` outside, from dense points on them (n, V, 3).

        Cell centres are up to half a diagonal from a point's own, so the shell is that much thicker than asked.
        """
        margin_m = outer_m + 2 * cell_m
        lower = surfaces_m.amin(1) - margin_m
        size = ((surfaces_m.amax(1) + margin_m - lower).amax(0) / cell_m).ceil().int().tolist()
        index = ((surfaces_m - lower[:, None]) / cell_m).long().cpu().numpy()
        slack_m = cell_m * 3**0.5 / 2
        grids = []
        for frame in index:
            surface = np.zeros(size, bool)
            surface[frame[:, 0], frame[:, 1], frame[:, 2]] = True
            distance_m = cell_m * ndimage.distance_transform_edt(~surface)
            inside = ndimage.binary_fill_holes(distance_m <= cell_m)  # a cell thicker, so that no gap lets it leak
            cells = np.where(inside | (distance_m <= outer_m + slack_m), SHELL, EMPTY)
            cells[inside & (distance_m > inner_m + slack_m)] = SOLID
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
        size_m = self.cell_m * torch.tensor(self.cells.shape[1:], device=origins_m.device)
        near, far = box_interval(origins_m, directions, self.lower_m[frame], self.lower_m[frame] + size_m)
        bins = max(self.cells.shape[1:])
        edges = near[:, None] + (far - near)[:, None] * torch.linspace(0, 1, bins + 1, device=near.device)
        middles = (edges[:, 1:] + edges[:, :-1]) / 2
        state = self.look_up(origins_m[:, None] + directions[:, None] * middles[..., None], frame)
        before_solid = (state == SOLID).cumsum(1) == 0
        weight = ((state == SHELL) & before_solid).float()
        met = weight.any(1)
        cumulative = torch.cat([torch.zeros_like(near)[:, None], weight.cumsum(1)], 1)
        samples = jitter.shape[1]
        strata = torch.arange(samples, device=near.device, dtype=near.dtype)
        wanted = (strata + jitter) / samples * cumulative[:, -1:]
        upper = torch.searchsorted(cumulative, wanted.contiguous(), right=True).clamp(1, bins)
        inside = wanted - cumulative.gather(1, upper - 1)
        width = (far - near)[:, None] / bins
        return edges.gather(1, upper - 1) + inside * width, met


def box_interval(origins_m: Tensor, directions: Tensor, lower_m: Tensor, upper_m: Tensor) -> tuple[Tensor, Tensor]:
    """Entry and exit depths (R,) of rays in axis-aligned boxes (R, 3); equal where the box is missed (slab method)."""
    inverse = 1 / torch.where(directions.abs() < 1e-9, torch.full_like(directions, 1e-9), directions)
    a, b = (lower_m - origins_m) * inverse, (upper_m - origins_m) * inverse
    near = torch.minimum(a, b).amax(-1).clamp(min=0)
    return near, torch.maximum(torch.maximum(a, b).amin(-1), near)
