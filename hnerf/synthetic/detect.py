"""Simulated keypoint detections: noisy, with low confidence where the body hides them, and sometimes wrong."""

import numpy as np

from hnerf.geometry.camera import Camera
from hnerf.geometry.rays import cast
from hnerf.warp_import import wp

NOISE_OF_WIDTH = 1.5 / 256  # 1.5 px in an image of 256: a detector's error scales with the person
HIDDEN_NOISE = 3.0  # factor on the noise where the body itself hides a keypoint
HIDDEN_BEHIND_M = 0.20  # behind the surface, from which it is hidden; visible joints lie less deep under skin and cloth
OUTLIERS, OUTLIER_OF_WIDTH = 0.02, 0.16


def detect(keypoints_m: np.ndarray, camera: Camera, mesh: wp.Mesh, rng: np.random.Generator) -> np.ndarray:
    """Return detections (25, 3) x_px, y_px, confidence of world keypoints (25, 3); zero for those outside the image."""
    exact_px, _ = camera.project(keypoints_m)
    towards = keypoints_m - camera.centre_m
    distance_m = np.linalg.norm(towards, axis=1)
    hits = cast(mesh, camera.centre_m, towards / distance_m[:, None])
    hidden = np.logical_and(hits.face >= 0, distance_m - hits.distance_m > HIDDEN_BEHIND_M)

    sigma_px = NOISE_OF_WIDTH * camera.width_px * np.where(hidden, HIDDEN_NOISE, 1.0)
    found_px = exact_px + rng.normal(size=(25, 2)) * sigma_px[:, None]
    wrong = np.asarray(rng.random(25) < OUTLIERS)
    found_px[wrong] += rng.uniform(-1, 1, (wrong.sum(), 2)) * OUTLIER_OF_WIDTH * camera.width_px
    confidence = np.where(hidden, rng.uniform(0.15, 0.45, 25), rng.uniform(0.7, 0.95, 25))
    in_image = np.logical_and(found_px >= 0, found_px <= [camera.width_px - 1, camera.height_px - 1])
    return np.concatenate([found_px, confidence[:, None]], 1) * np.all(in_image, axis=1, keepdims=True)
