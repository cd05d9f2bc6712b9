"""Reference for hnerf/fields/sparse_grids.py: the same grids with all of their nodes, in plain torch."""

import torch
from torch import Tensor, nn


def everywhere(nodes_m: Tensor, beyond_m: float) -> Tensor:
    """Return True for all nodes, for SparseGrids: features are learned everywhere."""
    return torch.ones(len(nodes_m), dtype=torch.bool)


class FeatureGrids(nn.Module):
    """Dense feature grids of several resolutions over a box, interpolated trilinearly and concatenated. Features start
    at zero and stay zero where nothing is learned.

    cells: number of cells of each level along the box's longest side; channels: features per level.
    """

    lower_m: Tensor
    upper_m: Tensor

    def __init__(self, lower_m: Tensor, upper_m: Tensor, cells: tuple[int, ...], channels: int):
        super().__init__()
        self.register_buffer("lower_m", lower_m.clone())
        self.register_buffer("upper_m", upper_m.clone())
        size = upper_m - lower_m
        self.levels = nn.ParameterList()
        for n in cells:
            x, y, z = (int(s) + 1 for s in (size / size.max() * n).round())
            self.levels.append(nn.Parameter(torch.zeros(1, channels, z, y, x)))
        self.width = channels * len(cells)

    def forward(self, y_m: Tensor) -> Tensor:
        """Interpolate features (N, levels * channels) at positions (N, 3) in canonical metres. Positions outside the
        box take the features of its border."""
        unit = 2 * (y_m - self.lower_m) / (self.upper_m - self.lower_m) - 1
        at = unit[None, None, None]
        found = [
            nn.functional.grid_sample(level, at, align_corners=True, padding_mode="border")[0, :, 0, 0]
            for level in self.levels
        ]
        return torch.cat(found, 0).T
