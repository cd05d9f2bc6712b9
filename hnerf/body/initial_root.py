"""The body's placement and heading before its joints are known."""

import cv2
import numpy as np

from hnerf.capture.body_25 import Body25
from hnerf.geometry.camera import Camera

TORSO = (Body25.R_SHOULDER, Body25.L_SHOULDER, Body25.R_HIP, Body25.L_HIP)
HEAD = (Body25.NOSE, Body25.NECK, Body25.R_EYE, Body25.L_EYE, Body25.R_EAR, Body25.L_EAR)
HEAD_AND_TORSO = tuple(sorted((*HEAD, *TORSO, Body25.MID_HIP)))
OUTLIER_ERROR_RATIO = 3.0  # of the error with a keypoint to that without it; 1.2 by chance
MIN_BOX_PX = 4.0  # larger side of the box around keypoints; in a smaller one they are all on one spot
MIN_WIDTH_M = 0.05  # root mean square distance of points from a line that determines the rotation about it


def kabsch(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the rigid transform (4, 4) that best aligns points source (N, 3) with target (N, 3) (Kabsch 1976)."""
    centre_s, centre_t = source.mean(0), target.mean(0)
    u, _, vt = np.linalg.svd((target - centre_t).T @ (source - centre_s))
    rotation = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = rotation, centre_t - rotation @ centre_s
    return transform


def root_from_space(rest_m: np.ndarray, points_m: np.ndarray) -> np.ndarray | None:
    """Return world from body (4, 4) from shoulders and hips or, if one of them is NaN, from the known points of head
    and torso. rest_m and points_m (25, 3). None if fewer than four points are known, or all of them lie on a line."""
    known = np.isfinite(points_m).all(-1)
    chosen = [k for k in (TORSO if known[list(TORSO)].all() else HEAD_AND_TORSO) if known[k]]
    if len(chosen) < 4:
        return None
    width_m = np.linalg.svd(rest_m[chosen] - rest_m[chosen].mean(0), compute_uv=False) / np.sqrt(len(chosen))
    return kabsch(rest_m[chosen], points_m[chosen]) if width_m[1] > MIN_WIDTH_M else None


def root_from_image(camera: Camera, rest_m: np.ndarray, keypoints: np.ndarray) -> np.ndarray | None:
    """Return world from body (4, 4) from one view of head and torso. rest_m (25, 3): the rest body; keypoints (25, 3)
    x_px, y_px, confidence; None with too few keypoints, or all of them on one spot.

    SQPnP (Terzakis and Lourakis 2020) or, for a person so far away that it refuses, EPnP (Lepetit et al. 2009), refined
    by Levenberg-Marquardt; one keypoint is left out if the others contradict it.
    """
    seen = [k for k in HEAD_AND_TORSO if keypoints[k, 2] > 0]
    if len(seen) < 6 or np.ptp(keypoints[seen, :2], axis=0).max() < MIN_BOX_PX:
        return None
    found, error_px = _pnp(camera, rest_m[seen], keypoints[seen, :2])
    if len(seen) > 6:
        fewer = [np.delete(seen, k) for k in range(len(seen))]
        others = [_pnp(camera, rest_m[left], keypoints[left, :2]) for left in fewer]
        without, error_without_px = min(others, key=lambda placed: placed[1])
        if OUTLIER_ERROR_RATIO * error_without_px < error_px:
            found = without
    return found


def _pnp(camera: Camera, rest_m: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray | None, float]:
    """Solve for world from body (4, 4), None if there is no solution, and the root mean square distance in px between
    projected points (N, 3) and pixels (N, 2)."""
    try:
        ok, rvec, tvec = cv2.solvePnP(rest_m, pixels, camera.K, None, flags=cv2.SOLVEPNP_SQPNP)
    except cv2.error:
        ok, rvec, tvec = cv2.solvePnP(rest_m, pixels, camera.K, None, flags=cv2.SOLVEPNP_EPNP)
    if not ok:
        return None, np.inf
    rvec, tvec = cv2.solvePnPRefineLM(rest_m, pixels, camera.K, None, rvec, tvec)
    camera_from_body, camera_from_world = np.eye(4), np.eye(4)
    camera_from_body[:3, :3], camera_from_body[:3, 3] = cv2.Rodrigues(rvec)[0], tvec[:, 0]
    camera_from_world[:3, :3], camera_from_world[:3, 3] = camera.R, camera.t_m
    off_px = cv2.projectPoints(rest_m, rvec, tvec, camera.K, None)[0][:, 0] - pixels
    return np.linalg.inv(camera_from_world) @ camera_from_body, float(np.sqrt((off_px**2).sum(1).mean()))
