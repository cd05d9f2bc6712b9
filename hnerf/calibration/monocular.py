"""Checks of a single camera: its intrinsics, the ground, and the person's height above it."""

import dataclasses

import numpy as np

from hnerf.geometry.camera import Camera

FIELD_OF_VIEW_DEG = (10.0, 120.0)  # of the longer side; people are not filmed with lenses beyond this range
PRINCIPAL_POINT_RANGE = 1 / 3  # of the image's sides, about the middle: an uncropped image's principal point is in it
MAX_ASPECT_ERROR = 0.1  # of the pixel aspect ratio from 1
STANDING_M = (1.2, 2.1)
UNMEASURED_M = 1e-6  # height of a camera whose height nobody has measured
NOSE, SOLES = 0, (19, 21, 22, 24)  # of BODY_25: big toes and heels
NOSE_SHARE = 0.92  # of an adult's stature (Winter 2009, figure 4.1: eyes at 0.936)


def intrinsics_reasons(camera: Camera) -> list[str]:
    """Return, in words, what is unusual about a camera's intrinsics."""
    focal_px = np.array([camera.K[0, 0], camera.K[1, 1]])
    size_px = np.array(camera.size_px)
    centre = (camera.K[:2, 2] + 0.5) / size_px
    field_deg = float(np.rad2deg(2 * np.arctan(size_px / focal_px / 2)).max())
    reasons = []
    if not FIELD_OF_VIEW_DEG[0] <= field_deg <= FIELD_OF_VIEW_DEG[1]:
        reasons.append(f"field of view {field_deg:.0f} degrees: focal length and image size do not belong together")
    if (np.abs(centre - 0.5) > PRINCIPAL_POINT_RANGE / 2).any():
        reasons.append(
            f"principal point at {100 * centre[0]:.0f} % of the width and {100 * centre[1]:.0f} % of the height: "
            "intrinsics of another image size, or of a cropped image"
        )
    if abs(focal_px[0] / focal_px[1] - 1) > MAX_ASPECT_ERROR:
        reasons.append(f"pixels {focal_px[1] / focal_px[0]:.2f} times as wide as high: the picture is stretched")
    return reasons


def ground_reasons(camera: Camera, keypoints: np.ndarray, up: str) -> list[str]:
    """Return, in words, whether world height 0 can be the ground under a person seen as keypoints (frames, 25, 3)."""
    stature_m = stature_on_ground_m(camera, keypoints, up)
    if np.isnan(stature_m):
        return ["world height 0 is not the ground: the camera never sees the person's feet and nose above it"]
    low, high = STANDING_M
    if low <= stature_m <= high:
        return [f"standing on world height 0 the person is {stature_m:.2f} m tall: ground and scale can be true"]
    return [
        f"standing on world height 0 the person would be {stature_m:.2f} m tall: height 0 is not the ground, "
        "or the translation is not in metres"
    ]


def raised_above_ground(camera: Camera, keypoints: np.ndarray, up: str, stature_m: float) -> tuple[Camera, str]:
    """Return a camera that stands at height 0, where nobody has measured its height, raised until a person of
    this stature, seen as keypoints (frames, 25, 3), stands on height 0; and what was done, in words. Any other camera
    is returned as it is, with no words."""
    vertical = np.eye(3)["xyz".index(up)]
    if abs(camera.centre_m @ vertical) > UNMEASURED_M:
        return camera, ""
    by_a_metre = dataclasses.replace(camera, t_m=camera.t_m - camera.R @ vertical)
    height_m = stature_m / stature_on_ground_m(by_a_metre, keypoints, up)
    if not np.isfinite(height_m):
        return camera, ""
    words = f"its height is not known: {height_m:.2f} m if the camera is level and the person {stature_m:.2f} m tall"
    return dataclasses.replace(camera, t_m=camera.t_m - height_m * camera.R @ vertical), words


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
