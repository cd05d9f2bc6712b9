"""The networks F and DH of the fast field: feature grids over the canonical shell and small MLPs (docs/method.md)."""

from collections.abc import Callable, Iterator

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
        """Build untrained networks over a box. near: where there is anything to learn, as for SparseGrids."""
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

    def residual(self, y_m: Tensor, d_m: Tensor, pose: Tensor, row: Tensor) -> Tensor:
        """Return dd (N,) in metres at y (N, 3) and d (N,), in the pose of `row` (N,) among poses (n, P); zero at the
        start of training."""
        return self._residual(self.geometry_grids(y_m), d_m, pose, row)

    def residual_in_each(self, y_m: Tensor, d_m: Tensor, pose: Tensor) -> Iterator[Tensor]:
        """Yield dd (N,) in metres in each of poses (n, P)."""
        features, row = self.geometry_grids(y_m), torch.zeros(len(y_m), dtype=torch.long, device=y_m.device)
        for one in pose.split(1):
            yield self._residual(features, d_m, one, row)

    def colour(self, y_m: Tensor, d_m: Tensor, normal: Tensor, pose: Tensor, row: Tensor) -> Tensor:
        """Return c (N, 3) in [0, 1]."""
        first, *others = self.radiance
        hidden = self._hidden(first, self.colour_grids(y_m), d_m, pose, row, positional_encoding(normal, 1))
        for layer in others:
            hidden = layer(hidden)
        return torch.sigmoid(hidden)

    def _residual(self, features: Tensor, d_m: Tensor, pose: Tensor, row: Tensor) -> Tensor:
        first, activation, last = self.geometry
        return self.unit_m * last(activation(self._hidden(first, features, d_m, pose, row)))[:, 0]

    def _hidden(
        self, first: nn.Module, features: Tensor, d_m: Tensor, pose: Tensor, row: Tensor, *more: Tensor
    ) -> Tensor:
        """Return the output of a network's first layer for features, d, the pose code and any further inputs. A single
        pose is folded into the bias, which takes nine tenths of the time."""
        code, inputs = self.pose_code(pose), [features, d_m[:, None] / self.unit_m]
        if len(code) > 1:
            hidden: Tensor = first(torch.cat([*inputs, code.index_select(0, row), *more], -1))
            return hidden
        assert isinstance(first, nn.Linear)
        start = features.shape[1] + 1
        before, of_code, after = first.weight.split(
            [start, code.shape[1], first.in_features - start - code.shape[1]], 1
        )
        weight, bias = torch.cat([before, after], 1), first.bias + of_code @ code[0]
        return nn.functional.linear(torch.cat([*inputs, *more], -1), weight, bias)
