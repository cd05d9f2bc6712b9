"""A naked body of known shape and pose, recorded without error: keypoints and masks from a ring of cameras."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from hnerf.body.anny import ADULT, BETA_NAMES, anny_rig
from hnerf.body.articulation import Pose
from hnerf.body.body_model import body_model
from hnerf.body.fit import make_problem
from hnerf.body.fit_result import BodyFit
from hnerf.body.keypoint_fit import Problem
from hnerf.body.observations import observe, runs
from hnerf.body.pose_prior import Smoothness
from hnerf.body.rig import Rig, joint_transforms, rotation_from_axis_angle
from hnerf.capture.capture import Capture
from hnerf.capture.masks import Masks, encode
from hnerf.config import FitSettings
from hnerf.geometry.camera import Camera
from hnerf.geometry.silhouette import silhouette


def silhouettes(capture: Capture, body: BodyFit) -> Masks:
    """Return masks of the training cameras; requesting another camera's mask fails."""
    encoded, faces = {}, body.rig.faces.numpy()
    for frame, vertices_m in zip(body.frames, body.vertices_m().numpy(), strict=True):
        for name in capture.train_cameras:
            encoded[name, frame] = encode(silhouette(capture.cameras[name], vertices_m, faces))
    return Masks(encoded, {})


def ring_camera(name: str, angle: float) -> Camera:
    """Return a camera 3 m from the z axis at a height of 1 m, looking horizontally at the axis; 256 x 256 px."""
    forward = -np.array([np.cos(angle), np.sin(angle), 0])
    R = np.stack([np.cross(forward, [0, 0, 1]), [0, 0, -1], forward])
    K = np.array([[281.6, 0, 128], [0, 281.6, 128], [0, 0, 1]])
    return Camera(name, K, R, -R @ np.array([*(-3 * forward[:2]), 1.0]), 256, 256)


RING = {str(k): ring_camera(str(k), 0.3 + k * np.pi / 2) for k in range(4)}


def moving_body(frames: tuple[int, ...]) -> BodyFit:
    """Return a tall, slim person with long shins who swings arms and legs, with feet near z = 0."""
    beta = torch.tensor(ADULT)
    for name, value in (("height", 0.55), ("weight", 0.4), ("measure-lowerleg-height", 0.3), ("hip-scale-horiz", -0.3)):
        beta[BETA_NAMES.index(name)] = value
    rig = anny_rig(beta)
    theta = torch.zeros(len(frames), len(rig.joints_m), 3)
    for i in range(len(frames)):
        swing = 0.3 * np.sin(i * 0.5)
        for name, turn in (("upperarm01.L", -0.3 - swing), ("upperarm01.R", -0.3 + swing), ("upperleg01.L", swing)):
            theta[i, rig.joint_names.index(name), 0] = turn
        theta[i, rig.joint_names.index("lowerleg01.R"), 0] = 0.4 + swing
        theta[i, rig.joint_names.index("spine03"), 2] = swing / 2
    root = torch.eye(4).repeat(len(frames), 1, 1)
    root[:, :3, :3] = rotation_from_axis_angle(torch.tensor([0.0, 0.05, 0.6]))
    root[:, 2, 3] = -rig.vertices_m[:, 2].min()
    root[:, 0, 3] = torch.linspace(0, 0.1, len(frames))
    return BodyFit(rig, frames, theta, root)


def true_pose(body: BodyFit) -> Pose:
    """Return the poses of a body in double precision, as used by the fit."""
    rig, nothing = body.rig.to(dtype=torch.float64), torch.zeros(25, 3, dtype=torch.float64)
    return Pose(rig, body.theta.double(), body.root.double(), nothing)


def joints_m(body: BodyFit | Pose) -> Tensor:
    """Return the posed joints, (n, J, 3) world."""
    return joint_transforms(body.rig, body.theta, body.root)[..., :3, 3].double()


def problem_at(pose: Pose, capture: Capture, acceleration_mps2: float, proportions: float) -> Problem:
    """Return the least-squares problem of a fit at a pose."""
    settings, observations = FitSettings(), observe(capture)
    smoothness = Smoothness(runs(capture), capture.fps, np.full(25, acceleration_mps2))
    return make_problem(body_model(settings), pose, observations, smoothness, settings, 1, proportions)


def of_linear_model(problem: Problem, rig: Rig) -> Problem:
    """Return the problem with a model whose shapes are linear around a rig: anny's own reshaping takes half of a
    step."""
    model = replace(problem.model, rig=lambda beta: rig if beta is None else rig.reshaped(beta))
    return replace(problem, model=model)


def record(root: Path, body: BodyFit, cameras: dict[str, Camera], train: tuple[str, ...]) -> Capture:
    """Record exact keypoints in the training cameras. Test cameras get nonsense, because nothing may read them."""
    keypoints_m = (body.rig.keypoint_weights @ body.vertices_m()).double().numpy()
    stored = {}
    for name, camera in cameras.items():
        pixels = camera.project(keypoints_m)[0] if name in train else np.full((*keypoints_m.shape[:2], 2), 1e5)
        stored[name] = np.concatenate([pixels, np.ones((*pixels.shape[:2], 1))], -1)[:, None]
    np.savez(root / "keypoints.npz", **stored)  # type: ignore[arg-type]
    sizes = {name: camera.size_px for name, camera in cameras.items()}
    test = tuple(name for name in cameras if name not in train)
    return Capture("body", root, cameras, train, test, body.frames, (), 25.0, "z", sizes, sizes)
