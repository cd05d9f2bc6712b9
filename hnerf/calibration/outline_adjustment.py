"""Adjustment of camera poses until the person's outlines in all cameras belong to one body.

A detector sees hips and shoulders elsewhere from the front than from behind, alike in all frames, so cameras that
keypoints have refined may be off by pixels. Outlines have no such bias, but say little of cameras that are far off.
"""

import dataclasses
import logging
from collections.abc import Sequence

import cv2
import numpy as np
from scipy.optimize import least_squares

from hnerf.calibration.bundle import align
from hnerf.calibration.silhouettes import Outlines
from hnerf.geometry.camera import Camera

STD = np.array([0.05] * 3 + [0.1] * 3)  # of a pose from keypoints: a turn about the person, rad, and a move, m
STEP = np.array([0.002] * 3 + [0.003] * 3)  # of finite differences: about a pixel
LOSS_SCALE_PX = 1.0  # of Cauchy's loss: errors of masks are larger
EVALUATIONS = 20
MIN_GAIN_PX = 0.01  # of outlines at other instants; cameras from keypoints without bias leave 0.006 px on valid-wave

log = logging.getLogger("hnerf.calibration")


def follow_outlines(
    outlines: Outlines | None,
    cameras: Sequence[Camera],
    free: Sequence[str],
    points_m: np.ndarray,
    min_improvement: float,
) -> tuple[list[Camera], str]:
    """Return the cameras fitted to the outlines, if a fit to every other instant improves the rest by a share of
    `min_improvement` or more; and by how much it does, in words, empty if the cameras are the given ones. points_m
    (frames, 25, 3): the person's joints, NaN where unknown."""
    if outlines is None or len(outlines.instants) < 2:
        return list(cameras), ""
    log.info("trying: fitted to outlines")
    person_m = np.nanmedian(points_m.reshape(-1, 3), 0)
    fitted, judged = outlines.some(slice(0, None, 2)), outlines.some(slice(1, None, 2))
    followed = adjust_to_outlines(fitted, cameras, free, person_m)
    before_px, after_px = judged.cost_px(cameras), judged.cost_px(followed)
    if after_px >= min((1 - min_improvement) * before_px, before_px - MIN_GAIN_PX):
        return list(cameras), ""
    followed = adjust_to_outlines(outlines, followed, free, person_m)
    return followed, f"fitted to outlines: those of held-out frames go from {before_px:.2f} to {after_px:.2f} px"


def adjust_to_outlines(
    outlines: Outlines, cameras: Sequence[Camera], free: Sequence[str], person_m: np.ndarray
) -> list[Camera]:
    """Return the cameras with poses of those named in `free` fitted to the outlines; person_m (3,): where the person
    is, about which they turn. If all are free, the rig is aligned to the given cameras."""

    def residuals(values: np.ndarray) -> np.ndarray:
        moved = _moved(cameras, free, values, person_m)
        return np.concatenate([*outlines.residuals_px(moved).values(), values / np.tile(STD, len(free))])

    def slopes(values: np.ndarray) -> np.ndarray:
        moved, steps = _moved(cameras, free, values, person_m), np.tile(STEP, len(free))
        stepped = [{c.name: c for c in _moved(cameras, free, values + step, person_m)} for step in np.diag(steps)]
        changed_px = outlines.changes_px(moved, [of[free[i // len(STEP)]] for i, of in enumerate(stepped)])
        return np.concatenate([(changed_px / steps[:, None]).T, np.diag(1 / np.tile(STD, len(free)))])

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
