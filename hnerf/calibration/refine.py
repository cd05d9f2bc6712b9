"""Refinement of camera poses, taken only where frames that took no part prove it right."""

import logging
from collections.abc import Sequence

import numpy as np

from hnerf.calibration.bundle import adjust
from hnerf.calibration.diagnosis import Measure, trimmed_cost_px
from hnerf.calibration.sizes import CHANGES
from hnerf.capture.camera import Camera
from hnerf.capture.capture import Capture
from hnerf.config import CalibrationSettings

log = logging.getLogger("hnerf.calibration")


def refine(
    capture: Capture, cameras: list[Camera], keypoints: np.ndarray, before: Measure, settings: CalibrationSettings
) -> tuple[list[Camera], dict[str, float], list[str]]:
    """Cameras to use, held-out costs of everything that was tried, and notes.

    Tried where residuals are too large or one camera does not fit the rest; the very `cameras` are returned unless
    held-out frames gain. `before`: what `measure` found; keypoints (C, frames, 25, 3).
    """
    if max(before.median_px.values()) <= settings.max_residual_px and before.misfit is None:
        return cameras, {}, []
    keep = 1 - settings.min_improvement
    everyone = tuple(camera.name for camera in cameras)
    held_out_px = {"as given": halves_cost_px(cameras, keypoints)}
    best, free = held_out_px["as given"], None
    for candidate in ([(before.worst,)] if before.worst else []) + [everyone]:
        what = "all poses refined" if candidate == everyone else f"pose of {before.worst} refined"
        log.info("trying: %s", what)
        held_out_px[what] = held_out_cost_px(cameras, keypoints, candidate)
        if held_out_px[what] < keep * best:
            best, free = held_out_px[what], candidate
    if free is None:
        return cameras, held_out_px, ["refinement did not improve held-out frames: the cameras are used as given"]
    start, note = _resized(capture, cameras, keypoints, free, keep * best, held_out_px)
    return adjust(start, keypoints, free), held_out_px, note


def _resized(
    capture: Capture,
    cameras: list[Camera],
    keypoints: np.ndarray,
    free: Sequence[str],
    must_beat_px: float,
    held_out_px: dict[str, float],
) -> tuple[list[Camera], list[str]]:
    """Intrinsics that explain a recorded size other than the calibrated one, if held-out frames prove them.

    Adds the costs of what was tried to `held_out_px`.
    """
    sizes = {c.name: (capture.calibrated_sizes_px[c.name], capture.recorded_sizes_px[c.name]) for c in cameras}
    if all(calibrated == recorded for calibrated, recorded in sizes.values()):
        return cameras, []
    tried = {}
    for what, change in CHANGES.items():
        log.info("trying: pictures were %s", what)
        tried[what] = [change(c, *sizes[c.name]) if sizes[c.name][0] != sizes[c.name][1] else c for c in cameras]
        held_out_px[f"and pictures {what}"] = held_out_cost_px(tried[what], keypoints, free)
    best = min(tried, key=lambda what: held_out_px[f"and pictures {what}"])
    if held_out_px[f"and pictures {best}"] >= must_beat_px:
        return cameras, ["what changed the picture size cannot be told from keypoints: intrinsics as given"]
    return tried[best], [f"pictures of another size than calibrated were {best}: intrinsics changed to match"]


def halves_cost_px(cameras: Sequence[Camera], keypoints: np.ndarray) -> float:
    """Trimmed cost of the cameras as they are, mean of both halves of the frames of keypoints (C, frames, 25, 3)."""
    halves = np.array_split(keypoints, 2, axis=1)
    return float(np.mean([trimmed_cost_px(cameras, half.reshape(len(cameras), -1, 3)) for half in halves]))


def held_out_cost_px(cameras: Sequence[Camera], keypoints: np.ndarray, free: Sequence[str]) -> float:
    """The same, each half judged with cameras that were adjusted to the other half."""
    halves = np.array_split(keypoints, 2, axis=1)
    costs = []
    for fitted, judged in (halves, halves[::-1]):
        costs.append(trimmed_cost_px(adjust(cameras, fitted, free), judged.reshape(len(cameras), -1, 3)))
    return float(np.mean(costs))
