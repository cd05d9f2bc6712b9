"""Corrective blend shapes: what the surfaces of frames have beyond skinning, in a few shapes with a weight a frame."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from hnerf.avatar.avatar import Avatar
from hnerf.body.descriptor import vertex_normals
from hnerf.body.fit_result import BodyFit
from hnerf.body.rig import joint_transforms, pose_vertices, skinning_transforms, vertex_transforms
from hnerf.progress import tracked

MAX_STEP_M = 0.03  # skinning error stays below this; a longer distance belongs to another limb


@dataclass(frozen=True)
class Correctives:
    """Blend shapes of a surface. offsets_m (K, V, 3): displacements in the rest pose at weight 1; weights (n, K) by
    frame."""

    offsets_m: np.ndarray
    weights: np.ndarray


@torch.no_grad()
def frame_displacements(avatar: Avatar, clothed: BodyFit) -> np.ndarray:
    """Return the displacement in the rest pose, (n, V, 3) float32 metres, that takes the skinned surface of `clothed`
    onto the avatar's zero surface in each frame: a Newton step along the normal, turned back by the skinning."""
    rig, device, found = clothed.rig, avatar.body.theta.device, []
    for theta, root in tracked(zip(clothed.theta, clothed.root, strict=True), "correctives", len(clothed.frames)):
        vertices_m = pose_vertices(rig, theta, root)
        world_m, posed = vertices_m.to(device), (theta.to(device), root.to(device))
        height_m = step_to_surface(avatar.signed_distance(world_m, *posed)).cpu()
        moved_m = -height_m[:, None] * vertex_normals(vertices_m, rig.faces)
        skinning = vertex_transforms(rig, skinning_transforms(joint_transforms(rig, theta, root), rig.joints_m))
        found.append(torch.linalg.solve(skinning[..., :3], moved_m).numpy())
    return np.stack(found)


def step_to_surface(distance_m: Tensor) -> Tensor:
    """Return the distances (V,) to step back along the normal: all of them up to half of MAX_STEP_M, and less beyond,
    down to 0 where the zero surface belongs to another limb."""
    return distance_m * (2 - 2 * distance_m.abs() / MAX_STEP_M).clamp(0, 1)


def correctives_of(displacements_m: np.ndarray, count: int) -> Correctives:
    """Return the `count` shapes that together leave the least squared displacement (n, V, 3), and their weights.

    They are the leading terms of the singular value decomposition (Eckart and Young 1936). It is not centred, so that a
    surface without animation is the one that was meshed. Each shape is scaled to a greatest weight of 1.
    """
    frames = displacements_m.reshape(len(displacements_m), -1)
    count = min(count, len(frames))
    left, scale, right = np.linalg.svd(frames, full_matrices=False)
    weights = left[:, :count] * scale[:count]
    greatest = np.abs(weights).max(0).clip(min=1e-9)
    offsets_m = (greatest[:, None] * right[:count]).reshape(count, *displacements_m.shape[1:])
    return Correctives(offsets_m.astype(np.float32), (weights / greatest).astype(np.float32))


def with_displacements(clothed: BodyFit, displacements_m: np.ndarray) -> np.ndarray:
    """Return the skinned surface of each frame with its displacement in the rest pose, (n, V, 3) float32 metres."""
    rig, posed = clothed.rig, []
    for theta, root, moved_m in zip(clothed.theta, clothed.root, displacements_m, strict=True):
        skinning = vertex_transforms(rig, skinning_transforms(joint_transforms(rig, theta, root), rig.joints_m))
        rest_m = rig.vertices_m + torch.from_numpy(moved_m)
        posed.append(((skinning[..., :3] @ rest_m[..., None])[..., 0] + skinning[..., 3]).float().numpy())
    return np.stack(posed)
