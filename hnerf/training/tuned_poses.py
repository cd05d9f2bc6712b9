"""Changes that the tuned poses of training frames must not share: distance from the only camera, and rest pose."""

import dataclasses

import torch
from torch import Tensor

from hnerf.body.canonical import PosedBodies, axis_angle_from_rotation
from hnerf.body.fit_result import BodyFit
from hnerf.body.rig import Rig, joint_transforms, pose_vertices, rotation_from_axis_angle


def keep_distance(bodies: PosedBodies, fit: BodyFit, rows: Tensor, centre_m: Tensor) -> None:
    """Scale the roots of the frames in rows about the only camera, at centre_m (3,), so that their mean distance from
    it stays the fit's: to that camera, a larger person farther away looks the same, so training would drift."""
    fitted, tuned = (r[rows, :3, 3] - centre_m for r in (fit.root, bodies.root))
    root = bodies.root.clone()
    root[rows, :3, 3] = centre_m + tuned * (fitted.norm(dim=-1).mean() / tuned.norm(dim=-1).mean())
    bodies.set_poses(bodies.rig, bodies.theta, root)


def share_rest(bodies: PosedBodies, fit: BodyFit, rows: Tensor) -> None:
    """Move the change from the fit that the poses of the frames in rows have in common into the rest pose: it is a
    property of the body, and then also takes effect in poses that no frame has."""
    theta, root = bodies.theta.clone(), bodies.root.clone()
    fitted, tuned = ((t[rows], r[rows]) for t, r in ((fit.theta, fit.root), (theta, root)))
    rig, theta[rows], root[rows] = with_common_rest(bodies.rig, fitted, tuned)
    bodies.set_poses(rig, theta, root)


def with_common_rest(
    rig: Rig, before: tuple[Tensor, Tensor], after: tuple[Tensor, Tensor]
) -> tuple[Rig, Tensor, Tensor]:
    """Return a rig whose rest pose includes the mean change of all poses, and the poses that reproduce `after` with
    this rig. In the poses `before`, this rig shows the body turned and moved by that mean change; exactly so only if a
    single joint of a chain turns, since a joint's change does not commute with turns of the joints below it.

    before, after: theta (n, J, 3) and root (n, 4, 4). Joints, and points that are rigid on one, stay where they were in
    `after`; points blended between joints differ by the square of the mean turn. The shape basis should turn likewise,
    but is kept.
    """
    theta, root = _mean_change(before, after)
    resting = joint_transforms(rig, theta, root)
    vertices_m = pose_vertices(rig, theta, root)
    changed = dataclasses.replace(rig, vertices_m=vertices_m, joints_m=resting[:, :3, 3].contiguous())
    world = joint_transforms(rig, *after)
    rotation = world[..., :3, :3] @ resting[:, :3, :3].mT
    above = rotation[:, rig.parents.clamp(min=0)]
    own = axis_angle_from_rotation(above.mT @ rotation)
    own[:, 0] = 0
    stands = after[1].clone()
    stands[:, :3, :3] = rotation[:, 0]
    stands[:, :3, 3] = world[:, 0, :3, 3] - (rotation[:, 0] @ changed.joints_m[0, :, None])[..., 0]
    return changed, own, stands


def _mean_change(before: tuple[Tensor, Tensor], after: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Return the mean over frames of how joints turn, (J, 3) in their own axes, and of how the body moves in its own
    frame, (4, 4)."""
    turned = rotation_from_axis_angle(before[0]).mT @ rotation_from_axis_angle(after[0])
    moved = torch.linalg.inv(before[1]) @ after[1]
    root = moved.mean(0)
    root[:3, :3] = rotation_from_axis_angle(axis_angle_from_rotation(moved[:, :3, :3]).mean(0))
    return axis_angle_from_rotation(turned).mean(0), root
