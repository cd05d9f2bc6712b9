"""How far a correction of pose and shape carries points, and the gradient of that, each in one pass over the points by
warp."""

# mypy: disable-error-code="no-untyped-def"

from functools import cache
from typing import Any

import torch
from torch import Tensor

from hnerf.warp_import import refuse_second_derivatives, wp


class Displacement(torch.autograd.Function):
    """Displacement (N, 3) of points (N, 3), each carried by one vertex of one frame's body.

    posed (N,) int32: that vertex's row among the n V of all frames; twists (n, C, 2, 3): turn and shift of each chain
    of joints; share (V, C): weight of each vertex in these chains; bulge (V, 3): change of the rest body, turned by
    linear (n V, 3, 3); carried (n, J, 3): displacement of what each joint carries rigidly, blended by skin_joints (V,
    K) int32 and skin_weights (V, K). Gradients flow to twists, bulge and carried. fixed: points, posed, share, linear,
    skin_joints and skin_weights.
    """

    @staticmethod
    def forward(ctx: Any, twists: Tensor, bulge: Tensor, carried: Tensor, *fixed: Tensor) -> Tensor:
        ctx.save_for_backward(*fixed)
        ctx.shapes = twists.shape, bulge.shape, carried.shape
        moved = torch.empty_like(fixed[0])
        _launch(0, (twists.detach(), bulge.detach(), carried.detach()), fixed, moved)
        return moved

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        refuse_second_derivatives()
        found = tuple(gradient.new_zeros(shape) for shape in ctx.shapes)
        _launch(1, found, ctx.saved_tensors, gradient.contiguous())
        return *found, None, None, None, None, None, None


def _launch(which: int, learned: tuple[Tensor, ...], fixed: tuple[Tensor, ...], moved: Tensor) -> None:
    twists, bulge, carried = learned
    points, posed, share, linear, skin_joints, skin_weights = fixed
    if not len(points):
        return
    wp.init()
    scalar = wp.dtype_from_torch(points.dtype)
    vector, matrix = wp.types.vector(length=3, dtype=scalar), wp.types.matrix(shape=(3, 3), dtype=scalar)
    arguments = [wp.from_torch(twists.contiguous(), dtype=vector), wp.from_torch(bulge.contiguous(), dtype=vector)]
    arguments += [wp.from_torch(carried.contiguous(), dtype=vector), wp.from_torch(points, dtype=vector)]
    arguments += [wp.from_torch(posed), wp.from_torch(share), wp.from_torch(linear, dtype=matrix)]
    arguments += [wp.from_torch(skin_joints), wp.from_torch(skin_weights), wp.from_torch(moved, dtype=vector)]
    kernel = _kernels(points.dtype)[which]
    wp.launch(kernel, len(points), arguments, device=wp.device_from_torch(points.device))


@cache
def _kernels(dtype: torch.dtype) -> tuple[wp.Kernel, wp.Kernel]:
    """Return the kernels for displacements and for their gradients, which are added to `twists`, `bulge`, `carried`."""
    scalar = wp.dtype_from_torch(dtype)
    Vector, Matrix = wp.types.vector(length=3, dtype=scalar), wp.types.matrix(shape=(3, 3), dtype=scalar)

    @wp.kernel(module="unique")
    def displace(
        twists: wp.array3d(dtype=Vector),
        bulge: wp.array(dtype=Vector),
        carried: wp.array2d(dtype=Vector),
        points: wp.array(dtype=Vector),
        posed: wp.array(dtype=wp.int32),
        share: wp.array2d(dtype=scalar),
        linear: wp.array(dtype=Matrix),
        skin_joints: wp.array2d(dtype=wp.int32),
        skin_weights: wp.array2d(dtype=scalar),
        moved: wp.array(dtype=Vector),
    ):
        i = wp.tid()
        frame = posed[i] // share.shape[0]
        vertex = posed[i] % share.shape[0]
        turn = Vector()
        shift = linear[posed[i]] * bulge[vertex]
        for c in range(share.shape[1]):
            part = share[vertex, c]
            if part != scalar(0.0):
                turn += part * twists[frame, c, 0]
                shift += part * twists[frame, c, 1]
        for k in range(skin_joints.shape[1]):
            shift += skin_weights[vertex, k] * carried[frame, skin_joints[vertex, k]]
        moved[i] = shift + wp.cross(turn, points[i])

    @wp.kernel(module="unique")
    def differentiate(
        twists: wp.array3d(dtype=Vector),
        bulge: wp.array(dtype=Vector),
        carried: wp.array2d(dtype=Vector),
        points: wp.array(dtype=Vector),
        posed: wp.array(dtype=wp.int32),
        share: wp.array2d(dtype=scalar),
        linear: wp.array(dtype=Matrix),
        skin_joints: wp.array2d(dtype=wp.int32),
        skin_weights: wp.array2d(dtype=scalar),
        gradient: wp.array(dtype=Vector),
    ):
        i = wp.tid()
        frame = posed[i] // share.shape[0]
        vertex = posed[i] % share.shape[0]
        g = gradient[i]
        wp.atomic_add(bulge, vertex, wp.transpose(linear[posed[i]]) * g)
        for c in range(share.shape[1]):
            part = share[vertex, c]
            if part != scalar(0.0):
                wp.atomic_add(twists, frame, c, 0, part * wp.cross(points[i], g))
                wp.atomic_add(twists, frame, c, 1, part * g)
        for k in range(skin_joints.shape[1]):
            wp.atomic_add(carried, frame, skin_joints[vertex, k], skin_weights[vertex, k] * g)

    return displace, differentiate
