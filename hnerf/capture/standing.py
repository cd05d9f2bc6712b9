"""The stature of a person who stands on world height 0, by a single camera, which tells whether that is the ground."""

import numpy as np

from hnerf.geometry.camera import Camera

STANDING_M = (1.2, 2.1)
NOSE, SOLES = 0, (19, 21, 22, 24)  # of BODY_25: big toes and heels
NOSE_SHARE = 0.92  # of an adult's stature (Winter 2009, figure 4.1: eyes at 0.936)


def stature_on_ground_m(camera: Camera, keypoints: np.ndarray, up: str) -> float:
    """Return the person's stature if they stand on height 0: the median over frames of the nose's height above the
    standing foot, divided by NOSE_SHARE; NaN if never seen.

    The standing foot is where a ray to a toe or heel meets height 0 closest to the camera: rays to a lifted foot meet
    it farther away. keypoints (frames, 25, 3).
    """
    vertical = "xyz".index(up)
    origin = camera.centre_m
    _, soles = camera.rays(keypoints[:, SOLES, :2])
    with np.errstate(divide="ignore", invalid="ignore"):
        far_m = -origin[vertical] / soles[..., vertical]
    far_m = np.where((far_m > 0) & (keypoints[:, SOLES, 2] > 0), far_m, np.inf)
    nearest = far_m.argmin(1)
    frames = np.flatnonzero(np.isfinite(far_m.min(1)) & (keypoints[:, NOSE, 2] > 0))
    if len(frames) == 0:
        return float("nan")
    foot_m = origin + far_m[frames, nearest[frames], None] * soles[frames, nearest[frames]]
    _, noses = camera.rays(keypoints[frames, NOSE, :2])
    level = [axis for axis in range(3) if axis != vertical]
    away_m = foot_m - origin
    along_m = (away_m[:, level] * noses[:, level]).sum(1) / (noses[:, level] ** 2).sum(1)
    return float(np.median(origin[vertical] + along_m * noses[:, vertical])) / NOSE_SHARE
