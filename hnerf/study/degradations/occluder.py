"""Degradation by an occluder: a pillar between the person and a camera."""

from pathlib import Path

import cv2
import numpy as np

from hnerf.capture.capture import Capture
from hnerf.capture.subject import subject_keypoints
from hnerf.errors import NotApplicableError
from hnerf.geometry.camera import Camera
from hnerf.study.degradations.images import rewrite_images

DISTANCE_SHARE = 0.4  # as a share of the distance from the person to the camera
HALF_HEIGHT_M = 1.2  # taller than a person
GREY = np.array([96, 96, 96], np.uint8)


def add_pillar(capture: Capture, width_m: float, rng: np.random.Generator, out: Path) -> None:
    """Put a grey square pillar between the person and a random training camera. It hides what is behind it, also in the
    clean plates, in every training camera for which it stands in front of the person. Points and person masks behind it
    are not detected.

    Cameras that would see it behind or next to the person do not show it. Raises NotApplicableError if the person's
    position is unknown.
    """
    person_m = person_middle(capture)
    up = np.eye(3)["xyz".index(capture.up)]
    corners_m = pillar(person_m, capture.cameras[str(rng.choice(capture.train_cameras))], up, width_m)
    hidden = {name: _hidden(capture.cameras[name], corners_m, person_m) for name in capture.train_cameras}
    rewrite_images(
        capture,
        out,
        lambda camera, rgb: np.where(hidden[camera][..., None], GREY, rgb),
        lambda camera, mask: mask * ~hidden[camera],
        lambda camera, points: _without(points, hidden[camera]) if camera in hidden else points,
    )


def person_middle(capture: Capture) -> np.ndarray:
    """Return the point (3,) nearest to all rays through the mean of the person's keypoints over all frames."""
    if not capture.has_keypoints or len(capture.train_cameras) < 2:
        raise NotApplicableError(f"{capture.name}: the person's position is unknown; needs keypoints from two cameras")
    left, right = np.zeros((3, 3)), np.zeros(3)
    for name, seen in subject_keypoints(capture).items():
        found = seen[seen[..., 2] > 0]
        if len(found):
            origin_m, direction = capture.cameras[name].rays(found[:, :2].mean(0))
            across = np.eye(3) - np.outer(direction, direction)
            left, right = left + across, right + across @ origin_m
    return np.linalg.solve(left, right)


def pillar(person_m: np.ndarray, camera: Camera, up: np.ndarray, width_m: float) -> np.ndarray:
    """Return the corners (8, 3) of an upright square pillar that faces the camera."""
    towards = camera.centre_m - person_m
    towards -= up * (up @ towards)
    middle_m = person_m + DISTANCE_SHARE * towards
    towards /= np.linalg.norm(towards)
    axes = np.stack([towards, np.cross(up, towards), up]) * np.array([[width_m / 2], [width_m / 2], [HALF_HEIGHT_M]])
    signs = np.stack(np.meshgrid(*[(-1, 1)] * 3), -1).reshape(8, 3)
    return middle_m + signs @ axes


def _hidden(camera: Camera, corners_m: np.ndarray, person_m: np.ndarray) -> np.ndarray:
    """Return the pixels that the pillar covers, (H, W) bool; none unless all of it is between the camera and the
    person."""
    hidden = np.zeros((camera.height_px, camera.width_px), np.uint8)
    px, depth_m = camera.project(corners_m)
    if depth_m.min() > 0 and depth_m.max() < camera.project(person_m)[1]:
        cv2.fillConvexPoly(hidden, cv2.convexHull(px.round().astype(np.int32)), 1)
    return hidden.astype(bool)


def _without(points: np.ndarray, hidden: np.ndarray) -> np.ndarray:
    """Return points (..., 3), set to zero where they lie on hidden pixels (H, W)."""
    height_px, width_px = hidden.shape
    x, y = (points[..., k].round().astype(int).clip(0, size - 1) for k, size in enumerate((width_px, height_px)))
    return points * ~hidden[y, x][..., None]
