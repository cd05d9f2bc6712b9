"""Feature grids that hold only the nodes near a surface, about a fifth of all. All levels are interpolated in one pass,
and differentiated in another, by warp."""

# mypy: disable-error-code="no-untyped-def"

from collections.abc import Callable
from functools import cache
from typing import Any

import torch
from torch import Tensor, nn

from hnerf.warp_import import refuse_second_derivatives, wp


class SparseGrids(nn.Module):
    """Learned features at the nodes of several grids over a box, trilinearly interpolated and concatenated; they start
    at zero, and are zero at nodes that are not kept.

    features (M, channels): of the kept nodes of all levels; rows (nodes,) int32: the row of each node in features, -1
    if it is not kept; x runs fastest, then y, z and level. sizes (levels, 3) int32: nodes of each level along x, y, z.
    """

    lower_m: Tensor
    upper_m: Tensor
    sizes: Tensor
    rows: Tensor

    def __init__(
        self,
        lower_m: Tensor,
        upper_m: Tensor,
        cells: tuple[int, ...],
        channels: int,
        near: Callable[[Tensor, float], Tensor],
    ):
        """Build one grid for each number in `cells`: its cells along the box's longest side. near: maps points (N, 3)
        and a distance in metres to whether there is anything to learn within that distance of each, (N,) bool."""
        super().__init__()
        wp.init()
        size_m = upper_m - lower_m
        sizes, kept = [], []
        for n in cells:
            count = (size_m / size_m.max() * n).round().int().clamp(min=1) + 1
            z, y, x = (torch.linspace(0, 1, int(k), device=size_m.device) for k in count.flip(0))
            nodes = torch.cartesian_prod(z, y, x).flip(1) * size_m + lower_m
            kept.append(near(nodes, float((size_m / (count - 1)).norm())))  # keeps all corners of a cell with samples
            sizes.append(count)
        keep = torch.cat(kept)
        self.register_buffer("lower_m", lower_m.clone())
        self.register_buffer("upper_m", upper_m.clone())
        self.register_buffer("sizes", torch.stack(sizes), persistent=False)
        self.register_buffer("rows", torch.where(keep, keep.cumsum(0) - 1, -1).int(), persistent=False)
        self.features = nn.Parameter(torch.zeros(int(keep.sum()), channels))
        self.width = channels * len(cells)

    def forward(self, y_m: Tensor) -> Tensor:
        """Interpolate features at positions (N, 3) in canonical metres: (N, levels * channels). Positions outside the
        box take the border's features."""
        unit = ((y_m - self.lower_m) / (self.upper_m - self.lower_m)).clamp(0, 1)
        return _Interpolation.apply(unit, self.features, self.sizes, self.rows)

    def dense_levels(self) -> list[Tensor]:
        """Return the features of all nodes of each level, (Z, Y, X, channels)."""
        everywhere = self.features.new_zeros(len(self.rows) + 1, self.features.shape[1])
        everywhere[:-1][self.rows >= 0] = self.features.detach()
        counts = self.sizes.prod(1).tolist()
        levels = everywhere[:-1].split(counts)
        return [level.view(*size, -1) for level, size in zip(levels, self.sizes.flip(1).tolist(), strict=True)]

    @torch.no_grad()
    def set_levels(self, levels: list[Tensor]) -> None:
        """Take the kept nodes' features from those of all nodes, as `dense_levels` returns them."""
        self.features.copy_(torch.cat([level.flatten(0, 2) for level in levels])[self.rows >= 0])


class _Interpolation(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, unit: Tensor, features: Tensor, sizes: Tensor, rows: Tensor) -> Tensor:
        ctx.save_for_backward(unit, features, sizes, rows)
        found = features.new_empty(len(unit), len(sizes), features.shape[1])
        _launch(0, (unit, features, sizes, rows), [found])
        return found.flatten(1)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor, None, None]:
        refuse_second_derivatives()
        unit, features, sizes, _ = ctx.saved_tensors
        of_features = torch.zeros_like(features)
        of_unit = torch.empty_like(unit) if ctx.needs_input_grad[0] else None
        gradient = gradient.unflatten(1, (len(sizes), -1)).contiguous()
        _launch(1, ctx.saved_tensors, [gradient, of_features], of_unit)
        return of_unit, of_features, None, None


def _launch(which: int, common: tuple[Tensor, ...], nodes: list[Tensor], of_unit: Tensor | None = None) -> None:
    """Run a kernel of `_kernels` over N points; `nodes` and `of_unit` are its arguments in addition to the common
    ones."""
    unit, features, sizes, rows = common
    if not len(unit):
        return
    node = wp.types.vector(length=features.shape[1], dtype=wp.float32)
    counts = sizes.prod(1)
    arguments = [
        wp.from_torch(unit.detach().contiguous(), dtype=wp.vec3),
        wp.from_torch(sizes, dtype=wp.vec3i),
        wp.from_torch((counts.cumsum(0) - counts).int()),
        wp.from_torch(rows),
        wp.from_torch(features.detach(), dtype=node),
    ]
    arguments += [wp.from_torch(tensor, dtype=node) for tensor in nodes]
    if which == 1:
        arguments.append(None if of_unit is None else wp.from_torch(of_unit, dtype=wp.vec3))
    kernel = _kernels(features.shape[1])[which]
    wp.launch(kernel, len(unit), arguments, device=wp.device_from_torch(unit.device))


@wp.func
def _lowest_node(at: wp.vec3, size: wp.vec3i):
    """Return the node with the least coordinates in the cell that contains fractional coordinates."""
    last = size - wp.vec3i(2, 2, 2)  # type: ignore[operator]
    return wp.min(wp.vec3i(int(at[0]), int(at[1]), int(at[2])), last)


@wp.func
def _share(far: int, fraction: float):
    """Return the weight of a cell's near or far node along an axis."""
    return wp.where(far == 1, fraction, 1.0 - fraction)


@cache
def _kernels(channels: int) -> tuple[wp.Kernel, wp.Kernel]:
    """Return two kernels over points (N,) in the unit cube: interpolation, and its gradients with respect to the
    features, added to existing ones, and, if requested, to the points. starts (levels,): the first node of each
    level."""
    Node = wp.types.vector(length=channels, dtype=wp.float32)

    @wp.kernel(module="unique")
    def interpolate(
        points: wp.array(dtype=wp.vec3),
        sizes: wp.array(dtype=wp.vec3i),
        starts: wp.array(dtype=wp.int32),
        rows: wp.array(dtype=wp.int32),
        features: wp.array(dtype=Node),
        found: wp.array2d(dtype=Node),
    ):
        i = wp.tid()
        for level in range(sizes.shape[0]):
            size = sizes[level]
            at = wp.cw_mul(points[i], wp.vec3(float(size[0] - 1), float(size[1] - 1), float(size[2] - 1)))
            low = _lowest_node(at, size)
            u, v, w = at[0] - float(low[0]), at[1] - float(low[1]), at[2] - float(low[2])
            total = Node()
            for k in range(2):
                for j in range(2):
                    node = starts[level] + ((low[2] + k) * size[1] + low[1] + j) * size[0] + low[0]
                    share = _share(k, w) * _share(j, v)
                    left = rows[node]
                    right = rows[node + 1]
                    if left >= 0:
                        total += (share * (1.0 - u)) * features[left]
                    if right >= 0:
                        total += (share * u) * features[right]
            found[i, level] = total

    @wp.kernel(module="unique")
    def differentiate(
        points: wp.array(dtype=wp.vec3),
        sizes: wp.array(dtype=wp.vec3i),
        starts: wp.array(dtype=wp.int32),
        rows: wp.array(dtype=wp.int32),
        features: wp.array(dtype=Node),
        gradient: wp.array2d(dtype=Node),
        of_features: wp.array(dtype=Node),
        of_points: wp.array(dtype=wp.vec3),
    ):
        i = wp.tid()
        slope = wp.vec3()
        for level in range(sizes.shape[0]):
            size = sizes[level]
            cells = wp.vec3(float(size[0] - 1), float(size[1] - 1), float(size[2] - 1))
            at = wp.cw_mul(points[i], cells)
            low = _lowest_node(at, size)
            u, v, w = at[0] - float(low[0]), at[1] - float(low[1]), at[2] - float(low[2])
            g = gradient[i, level]
            for k in range(2):
                for j in range(2):
                    node = starts[level] + ((low[2] + k) * size[1] + low[1] + j) * size[0] + low[0]
                    along_z = _share(k, w)
                    along_y = _share(j, v)
                    before = wp.float32(0.0)
                    after = wp.float32(0.0)
                    left = rows[node]
                    right = rows[node + 1]
                    if left >= 0:
                        before = wp.dot(features[left], g)
                        wp.atomic_add(of_features, left, (along_z * along_y * (1.0 - u)) * g)
                    if right >= 0:
                        after = wp.dot(features[right], g)
                        wp.atomic_add(of_features, right, (along_z * along_y * u) * g)
                    middle = (1.0 - u) * before + u * after
                    by_y = along_z * middle * (2.0 * float(j) - 1.0)
                    by_z = along_y * middle * (2.0 * float(k) - 1.0)
                    slope += wp.cw_mul(cells, wp.vec3(along_z * along_y * (after - before), by_y, by_z))
        if of_points:
            of_points[i] = slope

    return interpolate, differentiate
