"""A person's stature, measured by a single camera as if they stood at height 0; it tells whether that is the ground."""

import numpy as np

from hnerf.capture.body_25 import ANKLES, Body25
from hnerf.geometry.camera import Camera

STANDING_M = (1.2, 2.1)
NEAR_STATURE = (0.85, 1.2)  # the same, relative to a known stature
SOLES = (Body25.L_BIG_TOE, Body25.L_HEEL, Body25.R_BIG_TOE, Body25.R_HEEL)
NOSE_SHARE, ANKLE_SHARE = 0.92, 0.039  # of an adult's stature (Winter 2009, figure 4.1: eyes at 0.936)


def is_standing(measured_m: float, stature_m: float | None) -> bool:
    """Return whether a stature measured at height 0 matches the person's or, if that is not known, anybody's; False if
    it is NaN."""
    low, high = STANDING_M if stature_m is None else (share * stature_m for share in NEAR_STATURE)
    return low <= measured_m <= high


def stature_on_ground_m(camera: Camera, keypoints: np.ndarray, up: str) -> float:
    """Return the person's stature H if they stand on height 0: the median over frames; NaN if never seen.

    The standing foot is where a ray to a toe or heel meets height 0 closest to the camera: rays to a lifted foot meet
    it farther away. If toes and heels are seen in at most half as many frames as ankles, ankles replace them,
    ANKLE_SHARE of H higher. If the ray to the nose falls r times as steeply as the one to the foot, a camera at height
    c sees the nose at c - r (c - ANKLE_SHARE H), which is NOSE_SHARE H. keypoints (frames, 25, 3).
    """
    vertical = "xyz".index(up)
    origin = camera.centre_m
    by_soles, by_ankles = (int((keypoints[:, points, 2] > 0).any(1).sum()) for points in (SOLES, ANKLES))
    feet, share = (SOLES, 0.0) if 2 * by_soles > by_ankles else (ANKLES, ANKLE_SHARE)
    _, soles = camera.rays(keypoints[:, feet, :2])
    with np.errstate(divide="ignore", invalid="ignore"):
        far_m = -origin[vertical] / soles[..., vertical]
    far_m = np.where((far_m > 0) & (keypoints[:, feet, 2] > 0), far_m, np.inf)
    nearest = far_m.argmin(1)
    frames = np.flatnonzero(np.isfinite(far_m.min(1)) & (keypoints[:, Body25.NOSE, 2] > 0))
    if len(frames) == 0:
        return float("nan")
    foot_m = origin + far_m[frames, nearest[frames], None] * soles[frames, nearest[frames]]
    _, noses = camera.rays(keypoints[frames, Body25.NOSE, :2])
    level = [axis for axis in range(3) if axis != vertical]
    away_m = foot_m - origin
    along_m = (away_m[:, level] * noses[:, level]).sum(1) / (noses[:, level] ** 2).sum(1)
    fall = -along_m * noses[:, vertical] / origin[vertical]
    return float(np.median(origin[vertical] * (1 - fall) / (NOSE_SHARE - share * fall)))
