"""Encodings of a position: sines and cosines (Mildenhall et al. 2020), and dense grids of learned features."""

import torch
from jaxtyping import Float
from torch import Tensor, nn


def positional_encoding(x: Float[Tensor, "*S D"], octaves: int) -> Float[Tensor, "*S {x.shape[-1]*(1+2*octaves)}"]:
    """Encode positions: x, then sin and cos of 2^k pi x for k = 0 .. octaves - 1."""
    angles = x[..., None, :] * (torch.pi * 2.0 ** torch.arange(octaves, device=x.device, dtype=x.dtype))[:, None]
    return torch.cat([x, angles.sin().flatten(-2), angles.cos().flatten(-2)], -1)


class FeatureGrids(nn.Module):
    """Dense feature grids of several resolutions over a box, trilinearly interpolated and concatenated; features start
    at zero and stay zero where nothing is learned.

    cells: cells of each level along the box's longest side; channels: features per level.
    """

    lower_m: Float[Tensor, "3"]
    upper_m: Float[Tensor, "3"]

    def __init__(self, lower_m: Float[Tensor, "3"], upper_m: Float[Tensor, "3"], cells: tuple[int, ...], channels: int):
        super().__init__()
        self.register_buffer("lower_m", lower_m.clone())
        self.register_buffer("upper_m", upper_m.clone())
        size = upper_m - lower_m
        self.levels = nn.ParameterList()
        for n in cells:
            x, y, z = (int(s) + 1 for s in (size / size.max() * n).round())
            self.levels.append(nn.Parameter(torch.zeros(1, channels, z, y, x)))
        self.width = channels * len(cells)

    def forward(self, y_m: Float[Tensor, "N 3"]) -> Float[Tensor, "N {self.width}"]:
        """Interpolate features at positions in canonical metres. Positions outside the box take the
        border's features."""
        unit = 2 * (y_m - self.lower_m) / (self.upper_m - self.lower_m) - 1
        at = unit[None, None, None]
        found = [
            nn.functional.grid_sample(level, at, align_corners=True, padding_mode="border")[0, :, 0, 0]
            for level in self.levels
        ]
        return torch.cat(found, 0).T
