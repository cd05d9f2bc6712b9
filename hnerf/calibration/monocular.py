"""Checks of a single camera: its intrinsics, the ground, and the person's height above it."""

import dataclasses

import numpy as np

from hnerf.capture.standing import is_standing, stature_on_ground_m
from hnerf.geometry.camera import Camera

FIELD_OF_VIEW_DEG = (10.0, 120.0)  # of the longer side; people are not filmed with lenses beyond this range
PRINCIPAL_POINT_RANGE = 1 / 3  # of the image's sides, about the centre: holds an uncropped image's principal point
MAX_ASPECT_ERROR = 0.1  # of the pixel aspect ratio from 1
UNMEASURED_M = 1e-6  # a camera height below this means that it was not measured


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


def ground_reasons(camera: Camera, keypoints: np.ndarray, up: str, stature_m: float | None) -> list[str]:
    """Return, in words, whether world height 0 can be the ground under a person of this stature (None: not known), seen
    as keypoints (frames, 25, 3)."""
    measured_m = stature_on_ground_m(camera, keypoints, up)
    if np.isnan(measured_m):
        return [
            "whether world height 0 is the ground cannot be checked: no frame shows the nose together with a foot "
            "whose line of sight meets height 0"
        ]
    if is_standing(measured_m, stature_m):
        return [f"standing on world height 0 the person is {measured_m:.2f} m tall: ground and scale can be true"]
    known = "" if stature_m is None else f", not {stature_m:.2f} m"
    return [
        f"standing on world height 0 the person would be {measured_m:.2f} m tall{known}: height 0 is not the ground, "
        "or the translation is not in metres"
    ]


def raised_above_ground(camera: Camera, keypoints: np.ndarray, up: str, stature_m: float) -> tuple[Camera, str]:
    """Return a camera at height 0, whose height was thus not measured, raised until a person of this stature, seen as
    keypoints (frames, 25, 3), stands on height 0; and what was done, in words. Any other camera is returned unchanged,
    with an empty text."""
    vertical = np.eye(3)["xyz".index(up)]
    if abs(camera.centre_m @ vertical) > UNMEASURED_M:
        return camera, ""
    by_a_metre = dataclasses.replace(camera, t_m=camera.t_m - camera.R @ vertical)
    height_m = stature_m / stature_on_ground_m(by_a_metre, keypoints, up)
    if not 0 < height_m < np.inf:  # as when a person lies with the head towards the camera
        return camera, ""
    words = (
        f"its height is not known: {height_m:.2f} m if the camera is level and the person stands {stature_m:.2f} m tall"
    )
    return dataclasses.replace(camera, t_m=camera.t_m - height_m * camera.R @ vertical), words
