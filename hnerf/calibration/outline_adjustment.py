"""Adjustment of cameras until the person's outlines in all cameras belong to one body.

A detector places hips and shoulders differently from the front than from behind, in all frames alike, so cameras
refined by keypoints may be off by pixels. Outlines have no such bias, but say little about cameras that are far off.
"""

import dataclasses
import itertools
import logging
from collections.abc import Sequence
from functools import lru_cache

import cv2
import numpy as np
from scipy.optimize import least_squares

from hnerf.calibration.bundle import align, zoomed
from hnerf.calibration.silhouettes import NearHull, Outlines
from hnerf.geometry.camera import Camera
from hnerf.progress import report

FRAMES = 36  # evenly spaced: masks err by pixels, differently in each frame
STD = np.array([0.05] * 3 + [0.1] * 3)  # of a pose from keypoints: a turn about the person, rad, and a move, m
STEP = np.array([0.002] * 3 + [0.003] * 3)  # of finite differences: about a pixel
FOCAL_STD, FOCAL_STEP = 0.2, 0.02  # of the logarithm of a focal length from keypoints
LOSS_SCALE_PX = 0.5  # of Cauchy's loss: errors of masks are larger
EVALUATIONS = 20
MIN_COST_DECREASE = 0.01  # as a share of the cost: a step that decreases it less is the last
MIN_GAIN_PX = 0.01  # on outlines at held-out instants; cameras from keypoints without bias leave 0.006 px on valid-wave

log = logging.getLogger("hnerf.calibration")


def follow_outlines(
    outlines: Outlines | None,
    cameras: Sequence[Camera],
    free: Sequence[str],
    points_m: np.ndarray,
    min_improvement: float,
    unknown_focal: Sequence[str] = (),
) -> tuple[list[Camera], str]:
    """Return the cameras fitted to the outlines if a fit to every second instant improves the cost of the other
    instants by a share of `min_improvement` or more, else the given cameras; and the gain in words, empty for the given
    cameras. points_m (frames, 25, 3): the person's joints, NaN where unknown; unknown_focal: as in
    `adjust_to_outlines`."""
    if outlines is None or len(outlines.instants) < 2:
        return list(cameras), ""
    log.info("trying: fitted to outlines")
    person_m = np.nanmedian(points_m.reshape(-1, 3), 0)
    fitted, judged = outlines.select(slice(0, None, 2)), outlines.select(slice(1, None, 2))
    followed = adjust_to_outlines(fitted, cameras, free, person_m, unknown_focal)
    before_px, after_px = judged.cost_px(cameras), judged.cost_px(followed)
    if after_px >= min((1 - min_improvement) * before_px, before_px - MIN_GAIN_PX):
        return list(cameras), ""
    followed = adjust_to_outlines(outlines, followed, free, person_m, unknown_focal)
    return followed, f"fitted to outlines: those of held-out frames go from {before_px:.2f} to {after_px:.2f} px"


def adjust_to_outlines(
    outlines: Outlines,
    cameras: Sequence[Camera],
    free: Sequence[str],
    person_m: np.ndarray,
    unknown_focal: Sequence[str] = (),
) -> list[Camera]:
    """Return the cameras fitted to the outlines: the poses of those named in `free`, and one common zoom of those named
    in `unknown_focal`. person_m (3,): the person's position, about which cameras turn. If all are free, the rig is
    aligned to the given cameras."""
    zooms = 1 if unknown_focal else 0
    stds = np.array([*np.tile(STD, len(free)), *[FOCAL_STD] * zooms])
    steps = np.array([*np.tile(STEP, len(free)), *[FOCAL_STEP] * zooms])
    evaluations = itertools.count()

    def moved(values: np.ndarray) -> list[Camera]:
        zoom = float(np.exp(values[6 * len(free) :].sum()))
        at_zoom = [_zoomed_about(c, zoom, person_m) if c.name in unknown_focal else c for c in cameras]
        changes = dict(zip(free, values[: 6 * len(free)].reshape(-1, 6), strict=True))
        return [_turned(c, changes[c.name], person_m) if c.name in changes else c for c in at_zoom]

    @lru_cache(maxsize=1)  # slopes are evaluated where the last residuals were
    def near_hull(*values: float) -> NearHull:
        return outlines.near_hull(moved(np.array(values)))

    def residuals(values: np.ndarray) -> np.ndarray:
        report("cameras to outlines", next(evaluations), EVALUATIONS)
        return np.concatenate([*near_hull(*values).residuals_px().values(), values / stds])

    def slopes(values: np.ndarray) -> np.ndarray:
        changing = [*([name] for name in free for _ in STEP), *[unknown_focal] * zooms]
        ahead, behind = (
            [
                [camera for camera in moved(values + step) if camera.name in names]
                for step, names in zip(np.diag(signed), changing, strict=True)
            ]
            for signed in (steps, -steps)
        )
        up_px, down_px = np.split(near_hull(*values).changes_px([*ahead, *behind]), 2)
        return np.concatenate([((up_px - down_px) / (2 * steps[:, None])).T, np.diag(1 / stds)])

    solved = least_squares(
        residuals,
        np.zeros(len(stds)),
        slopes,
        loss="cauchy",
        f_scale=LOSS_SCALE_PX,
        ftol=MIN_COST_DECREASE,
        max_nfev=EVALUATIONS,
    )
    report("cameras to outlines", EVALUATIONS, EVALUATIONS)
    adjusted = moved(solved.x)
    return align(adjusted, cameras) if len(free) == len(cameras) else adjusted


def _zoomed_about(camera: Camera, zoom: float, pivot_m: np.ndarray) -> Camera:
    """Return a camera with its focal length multiplied, moved along its axis so that a point of the world keeps its
    pixel and its size in the image."""
    back_m = (zoom - 1) * (camera.R @ pivot_m + camera.t_m)[2]
    return dataclasses.replace(zoomed(camera, zoom), t_m=camera.t_m + np.array([0, 0, back_m]))


def _turned(camera: Camera, values: np.ndarray, pivot_m: np.ndarray) -> Camera:
    """Return a camera turned about a point of the world, (3,) rad, and moved, (3,) m, in its own axes."""
    R = cv2.Rodrigues(values[:3])[0] @ camera.R
    return dataclasses.replace(camera, R=R, t_m=camera.t_m + (camera.R - R) @ pivot_m + values[3:])
