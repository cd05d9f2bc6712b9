"""Adjustment of camera poses until the person's outlines in all cameras belong to one body.

A detector sees hips and shoulders elsewhere from the front than from behind, alike in all frames, so cameras that
keypoints have refined may be off by pixels. Outlines have no such bias, but say little of cameras that are far off.
"""

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np
from scipy.optimize import least_squares

from hnerf.calibration.bundle import align
from hnerf.calibration.silhouettes import Outlines
from hnerf.geometry.camera import Camera

STD = np.array([0.03] * 3 + [0.05] * 3)  # of a pose that keypoints refined: a turn about the person, rad, and a move, m
STEP = 0.06 * STD  # of finite differences: some tenths of a pixel
LOSS_SCALE_PX = 2.0  # of Cauchy's loss: errors of masks are larger
EVALUATIONS = 8


def adjust_to_outlines(
    outlines: Outlines, cameras: Sequence[Camera], free: Sequence[str], person_m: np.ndarray
) -> list[Camera]:
    """Return the cameras with poses of those named in `free` fitted to the outlines; person_m (3,): where the person
    is, about which they turn. If all are free, the rig is aligned to the given cameras."""

    def residuals(values: np.ndarray) -> np.ndarray:
        moved = _moved(cameras, free, values, person_m)
        return np.concatenate([*outlines.residuals_px(moved).values(), values / np.tile(STD, len(free))])

    def slopes(values: np.ndarray) -> np.ndarray:
        steps, at = np.tile(STEP, len(free)), residuals(values)
        return np.stack([(residuals(values + step) - at) / step.max() for step in np.diag(steps)], 1)

    solved = least_squares(
        residuals, np.zeros(6 * len(free)), slopes, loss="cauchy", f_scale=LOSS_SCALE_PX, max_nfev=EVALUATIONS
    )
    adjusted = _moved(cameras, free, solved.x, person_m)
    return align(adjusted, cameras) if len(free) == len(cameras) else adjusted


def _moved(cameras: Sequence[Camera], free: Sequence[str], values: np.ndarray, person_m: np.ndarray) -> list[Camera]:
    """Return the cameras, those named in `free` turned about a point of the world and moved: six values each."""
    changes = dict(zip(free, values.reshape(-1, 6), strict=True))
    return [c if c.name not in changes else _turned(c, changes[c.name], person_m) for c in cameras]


def _turned(camera: Camera, values: np.ndarray, pivot_m: np.ndarray) -> Camera:
    """Return a camera turned about a point of the world, (3,) rad, and moved, (3,) m, in its own axes."""
    R = cv2.Rodrigues(values[:3])[0] @ camera.R
    return dataclasses.replace(camera, R=R, t_m=camera.t_m + (camera.R - R) @ pivot_m + values[3:])
