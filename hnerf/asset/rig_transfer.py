"""Transfer of the body's rig to the clothed surface, so that it moves with the body beneath."""

import dataclasses

import torch
import trimesh
from torch import Tensor

from hnerf.asset.rigs import EYEBALL_WEIGHT
from hnerf.body.descriptor import BodyMeshes
from hnerf.body.rig import Rig

MAX_INFLUENCES = 8
SMOOTHING_PASSES = 4
REACH_M = 10.0  # no part of a person is further from the body than this


def clothed_rig(rig: Rig, surface: trimesh.Trimesh) -> Rig:
    """Return the rig with another surface in the rest pose, to which its skin weights are transferred."""
    vertices_m = torch.from_numpy(surface.vertices).float()
    faces = torch.from_numpy(surface.faces).long()
    return with_surface(rig, vertices_m, faces, *transfer_skin_weights(rig, vertices_m, faces))


def with_vertices(rig: Rig, vertices_m: Tensor) -> Rig:
    """Return the rig with its vertices at vertices_m (V, 3), and the joint of each eye at the centre of its eyeball."""
    joints_m = rig.joints_m.clone()
    for j in (j for j, name in enumerate(rig.joint_names) if name.startswith("eye.")):
        ball = rig.dense_weights[:, j] > EYEBALL_WEIGHT
        if ball.any():
            joints_m[j] = (vertices_m[ball].amin(0) + vertices_m[ball].amax(0)) / 2
    return dataclasses.replace(rig, vertices_m=vertices_m, joints_m=joints_m)


def with_surface(rig: Rig, vertices_m: Tensor, faces: Tensor, skin_joints: Tensor, skin_weights: Tensor) -> Rig:
    """Return the rig with another surface. The shape is fixed (no basis), and there are no keypoints."""
    return dataclasses.replace(
        rig,
        vertices_m=vertices_m,
        faces=faces,
        beta=rig.beta[:0],
        beta_names=(),
        shape_basis=torch.zeros(0, len(vertices_m), 3),
        joint_basis=torch.zeros(0, len(rig.joints_m), 3),
        skin_joints=skin_joints,
        skin_weights=skin_weights,
        keypoint_weights=torch.zeros(0, len(vertices_m)),
    )


def transfer_skin_weights(rig: Rig, vertices_m: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    """Return joints (V, 8) and weights (V, 8) for a surface (V, 3), (F, 3) around the rest body, largest weight first.

    Each vertex takes the weights at the closest point of the body, interpolated in its triangle. A few Laplacian passes
    then smooth the jumps where the closest point leaps from one limb to another.
    """
    body, only = BodyMeshes(rig.vertices_m[None], rig.faces), torch.zeros(len(vertices_m), dtype=torch.int32)
    found = body.closest_points(vertices_m, only, REACH_M)
    weights = (rig.dense_weights[rig.faces[found.face]] * found.barycentric[..., None]).sum(1)
    start, end = _edges(faces)
    neighbours = torch.bincount(start, minlength=len(weights))[:, None]
    for _ in range(SMOOTHING_PASSES):
        average = torch.zeros_like(weights).index_add_(0, start, weights[end]) / neighbours
        weights = (weights + average) / 2
    return strongest(weights)


def strongest(weights: Tensor) -> tuple[Tensor, Tensor]:
    """Return, for each vertex, the joints (V, 8) with the largest of the weights (V, J), largest first, and these
    weights, scaled to sum to 1."""
    top, joints = weights.topk(min(MAX_INFLUENCES, weights.shape[1]), dim=1)
    return torch.where(top > 0, joints, 0), top / top.sum(1, keepdim=True)


def _edges(faces: Tensor) -> tuple[Tensor, Tensor]:
    """Return the start and end vertex of every edge, in both directions."""
    edges = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    start, end = torch.cat([edges, edges.flip(1)]).unique(dim=0).unbind(1)
    return start, end
