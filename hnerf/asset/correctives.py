"""Corrective blend shapes: the part of each frame's surface that skinning misses, as a few shapes with weights per
frame."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from hnerf.avatar.avatar import Avatar
from hnerf.avatar.surface import move_onto_surface
from hnerf.body.fit_result import BodyFit
from hnerf.body.rig import pose_vertices, vertex_skinning
from hnerf.progress import tracked
from hnerf.side_by_side import side_by_side


@dataclass(frozen=True)
class Correctives:
    """Blend shapes of a surface. offsets_m (K, V, 3): displacements in the rest pose at weight 1; weights (n, K): one
    row per frame."""

    offsets_m: np.ndarray
    weights: np.ndarray


def as_they_are(displacement_m: np.ndarray) -> np.ndarray:
    """Return the displacements (V, 3) unchanged."""
    return displacement_m


def frame_surfaces(
    avatar: Avatar, clothed: BodyFit, settle: Callable[[np.ndarray], np.ndarray] = as_they_are
) -> tuple[np.ndarray, np.ndarray]:
    """Move the skinned surface of `clothed` onto the avatar's zero surface in each frame. Return these surfaces, (n, V,
    3) float32 in the world, and the displacements (n, V, 3) in the rest pose from which skinning produces them.

    settle: smooths the displacements (V, 3) of one frame in the rest pose.
    """
    rig, device = clothed.rig, avatar.body.theta.device
    learned_m = avatar.frame_displacements(rig.vertices_m.to(device), clothed.theta.to(device), clothed.root.to(device))

    @torch.no_grad()
    def followed(pose: tuple[Tensor, Tensor, Tensor]) -> tuple[np.ndarray, np.ndarray]:
        theta, root, moved_m = pose
        skinned_m, turn = pose_vertices(rig, theta, root), vertex_skinning(rig, theta, root)[..., :3]
        posed = theta.to(device), root.to(device)
        start_m = skinned_m + (turn @ moved_m[..., None])[..., 0]
        surface_m = move_onto_surface(avatar, start_m.to(device), rig.faces.to(device), *posed)[0].cpu()
        displacement_m = settle(torch.linalg.solve(turn, surface_m - skinned_m).numpy()).astype(np.float32)
        return (skinned_m + (turn @ torch.from_numpy(displacement_m)[..., None])[..., 0]).numpy(), displacement_m

    poses = zip(clothed.theta, clothed.root, learned_m.cpu(), strict=True)
    found = tracked(side_by_side(followed, poses, device), "correctives", len(clothed.frames))
    surfaces_m, displacements_m = zip(*found, strict=True)
    return np.stack(surfaces_m), np.stack(displacements_m)


def correctives_of(displacements_m: np.ndarray, count: int) -> Correctives:
    """Return shapes and weights that reproduce displacements (n, V, 3) by the `count` components that leave the least
    squared error. Weights are from 0 to 1, since Blender and others clamp them to that range.

    Components are the leading terms of the singular value decomposition (Eckart and Young 1936). It is not centred, so
    that frames without displacements have zero weights.
    """
    frames = displacements_m.reshape(len(displacements_m), -1)
    count = min(count, len(frames))
    left, scale, right = np.linalg.svd(frames, full_matrices=False)
    weights, shapes_m = _without_negative_weights(left[:, :count] * scale[:count], right[:count])
    return Correctives(shapes_m.reshape(-1, *displacements_m.shape[1:]).astype(np.float32), weights.astype(np.float32))


def _without_negative_weights(weights: np.ndarray, shapes_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return weights (n, K + 1) from 0 to 1 and shapes (K + 1, M) with the same products as weights (n, K) of any sign
    and shapes (K, M).

    Shapes are scaled so that weights are at most 1. One more shape, minus the sum of all, then allows all weights of a
    frame to be raised equally until none is negative.
    """
    if not shapes_m.size:
        return weights, shapes_m
    extreme = weights[np.abs(weights).argmax(0), range(weights.shape[1])]
    extreme = np.where(np.abs(extreme) > 1e-9, extreme, 1.0)
    weights, shapes_m = weights / extreme, extreme[:, None] * shapes_m
    raised = np.maximum(-weights.min(1, keepdims=True), 0)
    weights, shapes_m = np.hstack([weights + raised, raised]), np.vstack([shapes_m, -shapes_m.sum(0)])
    greatest = np.maximum(weights.max(0), 1e-9)
    return weights / greatest, greatest[:, None] * shapes_m
