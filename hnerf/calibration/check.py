"""Check of the given cameras: errors that stop the run, measurements for the report, and refinement if needed."""

import dataclasses
import logging
from collections.abc import Sequence
from itertools import combinations

import cv2
import numpy as np

from hnerf.calibration.diagnosis import (
    BODY_HEIGHT_M,
    UNITS_M,
    USUAL_HEIGHT_M,
    Measure,
    convention_mistake,
    gross_limit_px,
    likely_unit,
    measure,
    median_height_px,
    size_ratio,
    undo_mistake,
)
from hnerf.calibration.doubts import check_spread, doubts
from hnerf.calibration.evidence import Evidence
from hnerf.calibration.monocular import ground_reasons, intrinsics_reasons, raised_above_ground
from hnerf.calibration.refine import refine
from hnerf.calibration.report import CalibrationReport, CameraVerdict
from hnerf.calibration.sizes import size_reasons
from hnerf.calibration.synchronise import Timing, measure_timing, synchronise_capture
from hnerf.capture.capture import Capture
from hnerf.capture.standing import NEAR_STATURE
from hnerf.capture.subject import ranked_people
from hnerf.config import CalibrationSettings
from hnerf.errors import InputError
from hnerf.geometry.camera import Camera

log = logging.getLogger("hnerf.calibration")

COINCIDENT_M = 0.005  # two cameras nearer to each other than this are one, given twice
COMMON_HEIGHT_M = (1.4, 2.05)  # of adults; outside, the person is a child or the unit is wrong
RESIDUAL_SHARE = 0.014  # of the person's height in pixels: 5 px of 357 px
REJECT_FACTOR = 2.0  # times `max_residual_px`: a camera that is still further off after refinement is not used


def check_calibration(capture: Capture, settings: CalibrationSettings) -> CalibrationReport:
    """Judge the training cameras by the subject's keypoints. Undo mistakes, synchronise and refine where held-out
    frames prove an improvement.

    Raises InputError, naming the likely cause, if no person can have been recorded with this calibration.
    """
    if not capture.has_keypoints and capture.given_poses():
        return _unchecked(capture)
    keypoints = ranked_people(capture)[0].keypoints
    empty = [name for name, seen in zip(capture.train_cameras, keypoints, strict=True) if not seen[..., 2].any()]
    if empty:
        return _without(empty, capture, settings)
    check_spread(capture, keypoints)
    given = [capture.cameras[name] for name in capture.train_cameras]
    if len(given) == 1:
        return _monocular(capture, keypoints[0])
    limit_px = RESIDUAL_SHARE * median_height_px(keypoints)  # detectors' errors grow with the person's size in pixels
    settings = settings.model_copy(update={"max_residual_px": max(settings.max_residual_px, limit_px)})
    before = measure(given, keypoints)
    _check_convention(capture, given, keypoints, before)
    cameras, mistakes = undo_mistake(given, keypoints, before)
    _check_height(capture, measure(cameras, keypoints) if mistakes else before)
    synchronised, held_out_px, notes = synchronise_capture(capture, cameras, keypoints, settings)
    keypoints = keypoints if synchronised is capture else ranked_people(synchronised)[0].keypoints
    evidence = Evidence.of(synchronised, keypoints)
    refinement = refine(evidence, cameras, settings)
    used = [new if new is old else _rounded(new) for old, new in zip(cameras, refinement.cameras, strict=True)]
    after = measure(used, keypoints)
    _check_agreement(capture, after, settings)
    timing = measure_timing(used, keypoints, synchronised.frames)
    verdicts = {}
    for old, new in zip(given, used, strict=True):
        name, offset = old.name, synchronised.frame_offsets.get(old.name, 0.0)
        reasons = size_reasons(capture, name) + intrinsics_reasons(old) + _fit_reasons(name, before, settings)
        reasons += [f"{mistakes[name]}: undone"] if name in mistakes else []
        reasons += [_timing_reason(offset, timing[name]), *_change_reasons(old, new), refinement.reasons[name]]
        fault, why = _fault(name, after, settings.max_residual_px)
        status = fault or ("refined" if new is not old or offset else "ok")
        residuals_px = after.median_px[name], after.p95_px[name], before.median_px[name], before.p95_px[name]
        verdicts[name] = CameraVerdict(status, *residuals_px, offset, timing[name], (*reasons, *why))
    if sum(v.status != "rejected" for v in verdicts.values()) < 2:
        raise InputError(f"{capture.name}: fewer than two cameras agree on the person; calibrate again")
    every = capture.cameras | {camera.name: camera for camera in used}
    held_out_px |= refinement.held_out_px
    exchanged = ranked_people(synchronised.with_cameras(every))[0].exchanged
    notes += [*_side_notes(synchronised, exchanged), *refinement.notes]
    notes += _height_notes(after.body_height_m, capture.stature_m)
    return CalibrationReport(
        cameras=every,
        verdicts=verdicts,
        up=capture.up,
        notes=tuple(notes),
        doubts=doubts(synchronised, keypoints, after.points_m),
        before=before,
        after=after,
        evidence=evidence,
        held_out_px=held_out_px,
        outlines_px=refinement.outlines_px,
    )


def _rounded(camera: Camera) -> Camera:
    """Return a refined camera without the digits in which identical runs differ: K to 1e-4 px, R to 1e-7 rad, T to a
    thousandth of a millimetre."""
    turn = np.round(cv2.Rodrigues(camera.R)[0], 7)
    return dataclasses.replace(camera, K=np.round(camera.K, 4), R=cv2.Rodrigues(turn)[0], t_m=np.round(camera.t_m, 6))


def _without(empty: list[str], capture: Capture, settings: CalibrationSettings) -> CalibrationReport:
    """Return the report of the other cameras, with the `empty` ones, which never show the person, rejected. Raises
    InputError if fewer than two are left."""
    others = tuple(name for name in capture.train_cameras if name not in empty)
    if len(others) < 2:
        raise InputError(
            f"{capture.name}: only camera {', '.join(others)} shows the person; correct the others' keypoints, or "
            "train on it alone ([cameras] in capture.toml)"
        )
    report = check_calibration(dataclasses.replace(capture, train_cameras=others), settings)
    verdict = CameraVerdict("rejected", reasons=("never shows the person; check its keypoints if it does",))
    return dataclasses.replace(
        report, verdicts={name: report.verdicts.get(name, verdict) for name in capture.train_cameras}
    )


def _check_convention(capture: Capture, cameras: Sequence[Camera], keypoints: np.ndarray, found: Measure) -> None:
    """Raise InputError if the whole rig follows another convention, its intrinsics are for another image size, or two
    cameras share a position.

    Conventions are checked first, because the centres of an inverted ring of cameras coincide. With a wrong unit, all
    centres may be close to each other; `_check_height` reports that.
    """
    if found.cost_px > gross_limit_px(keypoints):
        off = f"{capture.name}: keypoints are off by {found.cost_px:.0f} px"
        if cause := convention_mistake(cameras, keypoints):
            raise InputError(
                f"{off} because {cause}; write world to camera, x_camera = R x_world + T, y down, z forward"
            )
        if ratio := size_ratio(cameras, keypoints):
            raise InputError(
                f"{off} because intrinsics and keypoints are for images of different sizes (K times {ratio:.2f} would "
                "fit); give both in the pixels of these images"
            )
    for a, b in combinations(cameras, 2):
        if np.linalg.norm(a.centre_m - b.centre_m) < COINCIDENT_M and not likely_unit(found.body_height_m):
            raise InputError(
                f"{capture.name}: cameras {a.name} and {b.name} stand at one place; give each its own extrinsics"
            )


def _check_height(capture: Capture, found: Measure) -> None:
    """Raise InputError if the person's height is impossible, naming the unit in which it would be plausible, else
    unusual intrinsics, which may be the cause."""
    low, high = BODY_HEIGHT_M
    if low <= found.body_height_m <= high or np.isnan(found.body_height_m):
        return
    unit = likely_unit(found.body_height_m)
    cameras = [capture.cameras[name] for name in capture.train_cameras]
    odd = [f"camera {camera.name}: {reason}" for camera in cameras for reason in intrinsics_reasons(camera)]
    cause = f"the translations look like {unit}; " if unit else f"{odd[0]}; calibrate it again, or else " if odd else ""
    factor = UNITS_M[unit] if unit else (capture.stature_m or USUAL_HEIGHT_M) / found.body_height_m
    raise InputError(
        f"{capture.name}: the person would be {found.body_height_m:.4g} m tall; {cause}{_unit_advice(factor)}"
    )


def _side_notes(capture: Capture, exchanged: Sequence[int]) -> list[str]:
    """Return a note on each camera with images in which left and right were exchanged, by their number, and log it."""
    notes = [
        f"camera {name}: left and right of arms or legs were exchanged in {count} of {len(capture.frames)} "
        "images, and are put right"
        for name, count in zip(capture.train_cameras, exchanged, strict=False)
        if count
    ]
    for note in notes:
        log.warning("%s: %s", capture.name, note)
    return notes


def _height_notes(height_m: float, stature_m: float | None) -> list[str]:
    """Return a note on the person's height and, if it is unusual or not the stated one (None: none is stated), on what
    to do if it is wrong."""
    low, high = COMMON_HEIGHT_M if stature_m is None else (share * stature_m for share in NEAR_STATURE)
    if np.isnan(height_m):
        return []
    factor = (stature_m or USUAL_HEIGHT_M) / height_m
    doubt = "" if low <= height_m <= high else f": if that is wrong, {_unit_advice(factor)}"
    return [f"the person is {height_m:.2f} m tall{doubt}"]


def _unit_advice(factor: float) -> str:
    return f'in capture.toml multiply units ("m" is 1, "mm" 0.001) by {factor:.4g}'


def _check_agreement(capture: Capture, found: Measure, settings: CalibrationSettings) -> None:
    """Raise InputError if no set of cameras agrees on the person."""
    if min(found.cost_px, *found.cost_without_px.values(), np.inf) > REJECT_FACTOR * settings.max_residual_px:
        raise InputError(
            f"{capture.name}: the cameras do not see one person (keypoints off by {found.cost_px:.0f} px) and no known "
            "mistake explains it; check which files belong to which camera, or calibrate again"
        )
    _check_height(capture, found)


def _fit_reasons(name: str, before: Measure, settings: CalibrationSettings) -> list[str]:
    """Return, in words, what is wrong with a camera as given."""
    reasons = []
    if before.median_px[name] > settings.max_residual_px:
        reasons.append(
            f"as given, median residual {before.median_px[name]:.1f} px is over {settings.max_residual_px:g} px"
        )
    if before.misfit == name:
        falls = f"from {before.cost_px:.1f} to {before.cost_without_px[name]:.1f} px"
        reasons.append(f"as given, an outlier: without it the trimmed cost falls {falls}")
    return reasons


def _timing_reason(offset_frames: float, left: Timing) -> str:
    """Return, in words, what is known about a camera's time offset: as corrected, and as measured after the
    correction."""
    if offset_frames:
        error = "" if np.isnan(left.error_frames) else f" +- {left.error_frames:.2f}"
        return f"out of step by {offset_frames:+.2f}{error} frames: corrected"
    if left.reason:
        return f"offset in time not observable: {left.reason}"
    return f"in step: measured offset {left.offset_frames:+.2f} +- {left.error_frames:.2f} frames"


def _change_reasons(old: Camera, new: Camera) -> list[str]:
    """Return, in words, by how much a camera was changed."""
    if new is old:
        return []
    turned_deg = np.rad2deg(np.linalg.norm(cv2.Rodrigues(new.R @ old.R.T)[0]))
    moved_cm = 100 * np.linalg.norm(new.centre_m - old.centre_m)
    zoomed = 100 * (new.K[0, 0] / old.K[0, 0] - 1)
    lens = f", focal length changed by {zoomed:+.1f} %" if round(zoomed, 1) else ""
    return [f"turned by {turned_deg:.2f} degrees, moved by {moved_cm:.1f} cm{lens}"]


def _fault(name: str, after: Measure, limit_px: float) -> tuple[str, list[str]]:
    """Return the status of a camera whose residuals are still too large, and why, in words; both empty if they are
    not."""
    if after.median_px[name] <= limit_px:
        return "", []
    why = f"as used, median residual is still {after.median_px[name]:.1f} px"
    if after.misfit == name and after.median_px[name] > REJECT_FACTOR * limit_px:
        return "rejected", [why, "not used from here on"]
    return "suspect", [why]


def _unchecked(capture: Capture) -> CalibrationReport:
    """Return the report of a recording with given body poses and no keypoints: nothing was detected that could check
    the cameras."""
    notes = ("not checked: the recording has no keypoints; cameras are used as given, with the poses given for them",)
    verdicts = {name: CameraVerdict("ok", reasons=tuple(size_reasons(capture, name))) for name in capture.train_cameras}
    return CalibrationReport(capture.cameras, verdicts, capture.up, notes)


def _monocular(capture: Capture, keypoints: np.ndarray) -> CalibrationReport:
    """Return the report of a single camera, with which nothing can be triangulated. keypoints (frames, 25, 3)."""
    name = capture.train_cameras[0]
    shown = int((keypoints[..., 2] > 0).any(1).sum())
    notes = (
        f"one training camera: the person is seen in {shown} of {len(capture.frames)} frames",
        "not checked with one camera: reprojection, units, body height, direction of extrinsics, leave-one-out",
    )
    camera, raised = capture.cameras[name], ""
    if capture.given_poses() is None:  # given poses belong to the given camera
        camera, raised = raised_above_ground(camera, keypoints, capture.up, capture.stature_m or USUAL_HEIGHT_M)
    reasons = size_reasons(capture, name) + intrinsics_reasons(camera)
    reasons += [raised] if raised else ground_reasons(camera, keypoints, capture.up, capture.stature_m)
    timing = Timing(reason="one camera")
    verdict = CameraVerdict("refined" if raised else "ok", timing=timing, reasons=tuple(reasons))
    cameras = capture.cameras | {name: camera}
    return CalibrationReport(cameras, {name: verdict}, capture.up, notes, doubts(capture, keypoints[None], None))
