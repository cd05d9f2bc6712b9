"""Where the body stands and faces, before its joints are known."""

import cv2
import numpy as np

from hnerf.geometry.camera import Camera

TORSO = (2, 5, 9, 12)  # shoulders and hips in BODY_25
HEAD_AND_TORSO = (0, 1, 2, 5, 8, 9, 12, 15, 16, 17, 18)
CONTRADICTED = 3.0  # times the error that the others leave without it; by chance 1.2
WIDE_M = 0.05  # root mean square distance from a line, below which points do not say how a body is turned about it


def kabsch(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Rigid transform (4, 4) that takes points source (N, 3) nearest to target (N, 3) (Kabsch 1976)."""
    centre_s, centre_t = source.mean(0), target.mean(0)
    u, _, vt = np.linalg.svd((target - centre_t).T @ (source - centre_s))
    rotation = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = rotation, centre_t - rotation @ centre_s
    return transform


def root_from_space(rest_m: np.ndarray, points_m: np.ndarray) -> np.ndarray | None:
    """World from body (4, 4) by shoulders and hips, or if one of them is NaN, by what is known of head and torso:
    rest_m and points_m (25, 3). None where that is fewer than four points, or all of them lie on a line."""
    known = np.isfinite(points_m).all(-1)
    chosen = [k for k in (TORSO if known[list(TORSO)].all() else HEAD_AND_TORSO) if known[k]]
    if len(chosen) < 4:
        return None
    spread_m = np.linalg.svd(rest_m[chosen] - rest_m[chosen].mean(0), compute_uv=False) / np.sqrt(len(chosen))
    return kabsch(rest_m[chosen], points_m[chosen]) if spread_m[1] > WIDE_M else None


def root_from_image(camera: Camera, rest_m: np.ndarray, keypoints: np.ndarray) -> np.ndarray | None:
    """World from body (4, 4) from one view, by the head and torso of a resting body: rest_m (25, 3), keypoints (25, 3)
    x_px, y_px, confidence. SQPnP (Terzakis and Lourakis 2020), refined by Levenberg-Marquardt, without the one keypoint
    that the others contradict, if there is one; None with too few keypoints."""
    seen = [k for k in HEAD_AND_TORSO if keypoints[k, 2] > 0]
    if len(seen) < 6:
        return None
    found, error_px = _placed(camera, rest_m[seen], keypoints[seen, :2])
    if len(seen) > 6:
        fewer = [np.delete(seen, k) for k in range(len(seen))]
        others = [_placed(camera, rest_m[left], keypoints[left, :2]) for left in fewer]
        without, error_without_px = min(others, key=lambda placed: placed[1])
        if CONTRADICTED * error_without_px < error_px:
            found = without
    return found


def _placed(camera: Camera, rest_m: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray | None, float]:
    """World from body (4, 4), None where there is none, and how far its points (N, 3) are off the pixels (N, 2), root
    mean square."""
    ok, rvec, tvec = cv2.solvePnP(rest_m, pixels, camera.K, None, flags=cv2.SOLVEPNP_SQPNP)
    if not ok:
        return None, np.inf
    rvec, tvec = cv2.solvePnPRefineLM(rest_m, pixels, camera.K, None, rvec, tvec)
    camera_from_body, camera_from_world = np.eye(4), np.eye(4)
    camera_from_body[:3, :3], camera_from_body[:3, 3] = cv2.Rodrigues(rvec)[0], tvec[:, 0]
    camera_from_world[:3, :3], camera_from_world[:3, 3] = camera.R, camera.t_m
    off_px = cv2.projectPoints(rest_m, rvec, tvec, camera.K, None)[0][:, 0] - pixels
    return np.linalg.inv(camera_from_world) @ camera_from_body, float(np.sqrt((off_px**2).sum(1).mean()))
