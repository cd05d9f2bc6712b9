"""Poses that come with a recording, used to start a fit, and in place of keypoints if the recording has none."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from hnerf.body.articulation import Pose
from hnerf.body.body_model import BodyModel
from hnerf.body.canonical import axis_angle_from_rotation
from hnerf.body.observations import Observations
from hnerf.body.reprojection import NEAR_M, project
from hnerf.body.rig import Rig, pose_vertices, rotation_from_axis_angle
from hnerf.body.smpl import BODY_FROM_SMPL, JOINTS, LOCKED
from hnerf.capture.capture import Capture
from hnerf.capture.given_poses import GivenPoses
from hnerf.capture.timing import nearest_rows

PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19)  # of JOINTS
# Of the mean SMPL body, rounded; anny has no joint at the pelvis.
PELVIS_M = (0.0, -0.23, 0.03)  # in SMPL's axes
PELVIS_ABOVE_HIPS_M = 0.09
CONFIDENCE = 0.5  # of a keypoint on a given body; a detected keypoint's is at most 1


def initial_pose_from_given(given: GivenPoses, model: BodyModel, frames: Sequence[int]) -> Pose:
    """Return given SMPL poses as poses of the model: exactly for SMPL, with the given shape; for other models on the
    average body, by the joints that correspond to SMPL's.

    frames (n,): numbers of the given rows. Frames without a pose take the pose of the nearest frame that has one.
    """
    nearest = nearest_rows(given.known.nonzero()[0].tolist(), frames)
    rig = model.rig(torch.from_numpy(given.betas) if model.is_smpl else None)
    turns = rotation_from_axis_angle(torch.from_numpy(given.theta))[nearest]
    placed = torch.from_numpy(given.root)[nearest]
    theta = torch.zeros(len(turns), len(rig.joints_m), 3, dtype=torch.float64)
    for j, name in enumerate(JOINTS):
        if name in LOCKED:
            continue
        own, parent = (rig.joint_names.index(joint) for joint in (name, JOINTS[PARENTS[j]]))
        turn = BODY_FROM_SMPL @ turns[:, j] @ BODY_FROM_SMPL.T
        theta[:, own] = axis_angle_from_rotation(model.rest_rotations[parent] @ turn @ model.rest_rotations[own].T)
    return Pose(rig, theta, _root(rig, turns[:, 0], placed, model.is_smpl), torch.zeros(25, 3, dtype=torch.float64))


def _root(rig: Rig, pelvis_turns: Tensor, placed: Tensor, is_smpl: bool) -> Tensor:
    """Return world from body (n, 4, 4). SMPL is first turned about its pelvis, pelvis_turns (n, 3, 3), then placed (n,
    4, 4)."""
    if is_smpl:
        pelvis_m = rig.joints_m[0]
        smpl_pelvis_m = BODY_FROM_SMPL.T @ pelvis_m
    else:
        hips = [rig.joint_names.index(f"upperleg01.{side}") for side in "LR"]
        pelvis_m = rig.joints_m[hips].mean(0) + torch.tensor([0, 0, PELVIS_ABOVE_HIPS_M], dtype=torch.float64)
        smpl_pelvis_m = torch.tensor(PELVIS_M, dtype=torch.float64)
    root = torch.eye(4, dtype=torch.float64).repeat(len(placed), 1, 1)
    root[:, :3, :3] = placed[:, :3, :3] @ pelvis_turns @ BODY_FROM_SMPL.T
    root[:, :3, 3] = placed[:, :3, :3] @ smpl_pelvis_m + placed[:, :3, 3] - root[:, :3, :3] @ pelvis_m
    return root


def given_poses_note(model: BodyModel, capture: Capture) -> str:
    """Return the report's note about given poses."""
    how = "used as the start" if model.is_smpl else "are SMPL's: used as the start, by corresponding joints"
    return how if capture.has_keypoints else f"{how}, and in place of keypoints, which are missing"


def observations_of_pose(pose: Pose, known: np.ndarray, capture: Capture) -> Observations:
    """Return the pose's own keypoints as the training cameras would see them in the frames whose pose is `known`, (n,)
    bool; the others show nothing."""
    cameras = tuple(capture.cameras[name] for name in capture.train_cameras)
    points_m = pose.rig.keypoint_weights @ pose_vertices(pose.rig, pose.theta, pose.root)  # (n, 25, 3)
    pixels = torch.stack([project(camera, points_m)[0] for camera in cameras])
    ahead = torch.stack([torch.from_numpy(camera.project(points_m.numpy())[1]) > NEAR_M for camera in cameras])
    given = torch.from_numpy(known)[:, None]
    return Observations(
        cameras, pixels, CONFIDENCE * (ahead & given).double(), torch.where(given[..., None], points_m, torch.nan)
    )
