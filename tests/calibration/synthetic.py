"""Synthetic captures: a ring of cameras around a walking stick figure, with all true values known."""

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from hnerf.capture.capture import Capture
from hnerf.geometry.camera import Camera
from hnerf.render import trajectory

SIZE_PX = 1000
FRAMES = 12

# BODY_25 of a standing person facing +x, metres; ankle-knee .43, knee-hip .43, hips-neck .50, neck-nose .20 = 1.56.
STANDING_M = np.array([
    [.05, 0, 1.64], [0, 0, 1.446], [0, -.2, 1.44], [0, -.25, 1.15], [.05, -.27, .9], [0, .2, 1.44], [0, .25, 1.15],
    [.05, .27, .9], [0, 0, .946], [0, -.1, .94], [0, -.1, .51], [0, -.1, .08], [0, .1, .94], [0, .1, .51], [0, .1, .08],
    [.06, -.03, 1.67], [.06, .03, 1.67], [0, -.07, 1.65], [0, .07, 1.65],
    [.17, .1, .02], [.15, .14, .02], [-.05, .1, .02], [.17, -.1, .02], [.15, -.14, .02], [-.05, -.1, .02],
])  # fmt: skip


def look_at(name: str, centre_m: np.ndarray, target_m: np.ndarray) -> Camera:
    """Return an upright camera of 1000 x 1000 px and focal length 1000 px."""
    like = Camera(name, np.diag([1000.0, 1000, 1]), np.eye(3), np.zeros(3), SIZE_PX, SIZE_PX)
    return trajectory.look_at(like, centre_m, target_m, np.array([0, 0, 1]))


def ring(count: int) -> list[Camera]:
    """Return cameras unevenly spaced on a circle of 3.5 m around the origin, 1.2 to 1.8 m high, looking at the middle
    of the body."""
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False) + 0.3 * np.sin(np.arange(count))
    heights = 1.2 + 0.6 * (np.arange(count) % 2)
    return [
        look_at(f"c{i}", np.array([3.5 * np.cos(a), 3.5 * np.sin(a), h]), np.array([0, 0, 0.9]))
        for i, (a, h) in enumerate(zip(angles, heights, strict=True))
    ]


def walk_m(frames: int = FRAMES) -> np.ndarray:
    """Return joints (frames, 25, 3) of the figure walking on a small circle, turning and swinging its arms."""
    poses = []
    for angle in np.linspace(0, 2 * np.pi, frames, endpoint=False):
        pose = STANDING_M.copy()
        pose[[3, 4, 6, 7], 0] += 0.2 * np.sin(2 * angle) * np.array([1, 1, -1, -1])
        turn = cv2.Rodrigues(np.array([0, 0, angle]))[0]
        poses.append(pose @ turn.T + [0.4 * np.cos(angle), 0.4 * np.sin(angle), 0])
    return np.stack(poses)


def detections(cameras: list[Camera], noise_px: float, seed: int = 0) -> np.ndarray:
    """Return keypoints (C, frames, 25, 3) of the walk with Gaussian noise and confidence 0.8."""
    uv = np.stack([camera.project(walk_m())[0] for camera in cameras])
    noisy = uv + np.random.default_rng(seed).normal(size=uv.shape) * noise_px
    return np.concatenate([noisy, np.full_like(uv[..., :1], 0.8)], -1)


def true_error_px(camera: Camera, truth: Camera) -> float:
    """Return the median distance between both cameras' projections of the walk."""
    return float(np.median(np.linalg.norm(camera.project(walk_m())[0] - truth.project(walk_m())[0], axis=-1)))


def write_capture(root: Path, cameras: list[Camera], keypoints: np.ndarray) -> Capture:
    """Write a capture without images, with the given cameras as its calibration and keypoints (C, frames, 25, 3) or, of
    several people, (C, frames, P, 25, 3), of the first C cameras."""
    root.mkdir(parents=True, exist_ok=True)
    by_name = {camera.name: camera for camera in cameras}
    people = keypoints if keypoints.ndim == 5 else keypoints[:, :, None]
    np.savez(root / "keypoints.npz", **dict(zip(by_name, people, strict=False)))  # type: ignore[arg-type]
    frames, sizes = tuple(range(keypoints.shape[1])), dict.fromkeys(by_name, (SIZE_PX, SIZE_PX))
    return Capture("ring", root, by_name, tuple(by_name), (), frames, (), 30.0, "z", sizes, sizes)


@contextmanager
def edited_keypoints(root: Path) -> Iterator[dict[str, np.ndarray]]:
    """Yield the keypoints in a capture's folder by camera, and write them back as changed."""
    with np.load(root / "keypoints.npz") as stored:
        found = dict(stored)
    yield found
    np.savez(root / "keypoints.npz", **found)


def turned(camera: Camera, degrees: float, axis: int = 1) -> Camera:
    """Return the camera turned about its own centre and one of its own axes."""
    rotation = cv2.Rodrigues(np.deg2rad(degrees) * np.eye(3)[axis])[0]
    return dataclasses.replace(camera, R=rotation @ camera.R, t_m=rotation @ camera.t_m)
