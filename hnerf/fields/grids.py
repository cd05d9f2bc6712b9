"""The networks F and DH of the fast field: feature grids over the canonical shell and small MLPs (docs/method.md)."""

from collections.abc import Callable

import torch
from torch import Tensor, nn

from hnerf.config import FastFieldSettings
from hnerf.fields.encoding import positional_encoding
from hnerf.fields.sparse_grids import SparseGrids


class CanonicalField(nn.Module):
    """DH: (y, d, theta) -> dd and F: (y, d, theta, n) -> c over the canonical volume.

    The density of F is the SDF's own opacity (the limit of large lambda in the paper's geometry loss), so F is a colour
    here. n is the surface's normal in the world; it carries the effect of the root transform T on shading.
    """

    def __init__(
        self,
        lower_m: Tensor,
        upper_m: Tensor,
        settings: FastFieldSettings,
        pose_inputs: int,
        near: Callable[[Tensor, float], Tensor],
    ):
        """Build untrained networks over a box. near: where anything is to be learned, as SparseGrids takes it."""
        super().__init__()
        width, pose_width, channels = settings.width, settings.pose_width, settings.channels
        self.unit_m = settings.outer_m
        self.geometry_grids = SparseGrids(lower_m, upper_m, settings.geometry_cells, channels, near)
        self.colour_grids = SparseGrids(lower_m, upper_m, settings.colour_cells, channels, near)
        self.pose_code = nn.Linear(pose_inputs, pose_width, bias=False)
        last = nn.Linear(width, 1)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.geometry = nn.Sequential(nn.Linear(self.geometry_grids.width + 1 + pose_width, width), nn.SiLU(), last)
        self.radiance = nn.Sequential(
            nn.Linear(self.colour_grids.width + 1 + 9 + pose_width, width),
            nn.SiLU(),
            nn.Linear(width, width),
            nn.SiLU(),
            nn.Linear(width, 3),
        )

    def _inputs(self, features: Tensor, d: Tensor, pose: Tensor, row: Tensor) -> list[Tensor]:
        return [features, d[:, None] / self.unit_m, self.pose_code(pose).index_select(0, row)]

    def residual(self, y_m: Tensor, d_m: Tensor, pose: Tensor, row: Tensor) -> Tensor:
        """Return dd (N,) in metres at y (N, 3) and d (N,), in the pose of `row` (N,) among poses (n, P); zero at the
        start of training."""
        features = self.geometry_grids(y_m)
        return self.unit_m * self.geometry(torch.cat(self._inputs(features, d_m, pose, row), -1))[:, 0]

    def colour(self, y_m: Tensor, d_m: Tensor, normal: Tensor, pose: Tensor, row: Tensor) -> Tensor:
        """Return c (N, 3) in [0, 1]."""
        features = self.colour_grids(y_m)
        inputs = self._inputs(features, d_m, pose, row)
        return torch.sigmoid(self.radiance(torch.cat([*inputs, positional_encoding(normal, 1)], -1)))
