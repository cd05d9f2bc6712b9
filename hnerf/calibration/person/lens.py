"""Focal length and one term of distortion from the person, as far as held-out keypoints determine them."""

import logging
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from hnerf.calibration.bundle import adjust, adjust_shared_lens, undistort
from hnerf.calibration.diagnosis import held_out_parts, trimmed_cost_px
from hnerf.geometry.camera import Camera

log = logging.getLogger("hnerf.calibration")
Fit = Callable[[list[Camera], np.ndarray], tuple[list[Camera], float]]  # of a rig to keypoints: cameras and k1


class LensFit(NamedTuple):
    """Cameras with the lenses found. k1: OpenCV's, common to all estimated lenses; what: which unknowns were estimated,
    in words."""

    cameras: list[Camera]
    k1: float
    what: str


def fit_lenses(
    cameras: list[Camera], keypoints: np.ndarray, unknown: Sequence[str], min_improvement: float
) -> tuple[LensFit, dict[str, float]]:
    """Return the rig with the focal lengths of the cameras named in `unknown`, and the costs in pixels of what was
    tried on held-out keypoints.

    One zoom of all unknown lenses is always estimated. Distortion and, then, a focal length for each camera are
    accepted only if held-out frames and joints improve by the share `min_improvement`: with few poses they explain
    noise, and a wrong focal length moves a camera along its line of sight. keypoints (C, frames, 25, 3).
    """
    if not unknown:
        return LensFit(adjust(cameras, keypoints, [camera.name for camera in cameras]), 0.0, ""), {}
    fits: dict[str, Fit] = {
        "one focal length": lambda rig, seen: adjust_shared_lens(rig, seen, unknown, False),
        "one focal length, one distortion": lambda rig, seen: adjust_shared_lens(rig, seen, unknown, True),
        "a focal length each": lambda rig, seen: (_own(rig, seen, unknown), 0.0),
    }
    costs_px = {what: _held_out_px(cameras, keypoints, unknown, fit) for what, fit in fits.items()}
    for what, cost_px in costs_px.items():
        log.info("tried: %s: %.3f px", what, cost_px)
    chosen = next(iter(fits))
    for what in list(fits)[1:]:
        if costs_px[what] < (1 - min_improvement) * costs_px[chosen]:
            chosen = what
    return LensFit(*fits[chosen](cameras, keypoints), chosen), costs_px


def _own(cameras: list[Camera], keypoints: np.ndarray, unknown: Sequence[str]) -> list[Camera]:
    start, _ = adjust_shared_lens(cameras, keypoints, unknown, False)
    return adjust(start, keypoints, [camera.name for camera in cameras], unknown)


def _held_out_px(cameras: list[Camera], keypoints: np.ndarray, unknown: Sequence[str], fit: Fit) -> float:
    """Return the trimmed cost of keypoints that share neither frames nor joints with those fitted to."""
    costs_px = []
    for fitted, judged in held_out_parts(keypoints):
        found, k1 = fit(cameras, fitted)
        costs_px.append(trimmed_cost_px(found, undistort(judged, found, unknown, k1)))
    return float(np.mean(costs_px))
