"""Can these cameras be trusted? Checks that stop, measures that are reported, and refinement where needed."""

from collections.abc import Sequence
from itertools import combinations

import cv2
import numpy as np

from hnerf.calibration.diagnosis import BODY_HEIGHT_M, Measure, explain, gross_limit_px, measure, unit_of
from hnerf.calibration.refine import refine
from hnerf.calibration.report import CalibrationReport, CameraVerdict, load_cameras
from hnerf.calibration.triangulation import subject_keypoints
from hnerf.capture.camera import Camera
from hnerf.capture.capture import Capture
from hnerf.config import CalibrationSettings
from hnerf.errors import CaptureError

__all__ = ["check_calibration", "load_cameras"]

ROTATION_TOLERANCE = 1e-3
COINCIDENT_M = 0.005
REJECT_FACTOR = 2.0  # times `max_residual_px`: a camera so far off, that no refinement brought back, is not used


def check_calibration(capture: Capture, settings: CalibrationSettings) -> CalibrationReport:
    """Judge the training cameras by the subject's keypoints, and refine them where held-out frames prove it right.

    Raises CaptureError, naming the likely cause, on a calibration that no person can have been seen with.
    """
    _check_numbers(capture)
    found = subject_keypoints(capture)
    for name, seen in found.items():
        if not (seen[..., 2] > 0).any():
            raise CaptureError(
                f"{capture.name}: camera {name} never shows the person; check its keypoints or leave it out"
            )
    keypoints = np.stack([found[name] for name in capture.train_cameras])
    cameras = [capture.cameras[name] for name in capture.train_cameras]
    if len(cameras) == 1:
        return _monocular(capture, keypoints[0])
    before = measure(cameras, keypoints)
    _check_convention(capture, cameras, keypoints, before)
    used, held_out_px, notes = refine(capture, cameras, keypoints, before, settings)
    after = before if used is cameras else measure(used, keypoints)
    _check_result(capture, after, settings)
    verdicts = {}
    for old, new in zip(cameras, used, strict=True):
        reasons = _size_reasons(capture, old.name) + _fit_reasons(old.name, cameras, keypoints, before, settings)
        verdicts[old.name] = _verdict(old, new, before, after, reasons, settings)
    if sum(v.status != "rejected" for v in verdicts.values()) < 2:
        raise CaptureError(f"{capture.name}: fewer than two cameras agree on the person; calibrate again")
    every = capture.cameras | {camera.name: camera for camera in used}
    return CalibrationReport(every, verdicts, before, after, held_out_px, tuple(notes), capture.up)


def _check_numbers(capture: Capture) -> None:
    """What is wrong whatever the cameras saw."""
    for camera in capture.cameras.values():
        where = f"{capture.name}: camera {camera.name}"
        if not all(np.isfinite(values).all() for values in (camera.K, camera.R, camera.t_m)):
            raise CaptureError(f"{where}: NaN or infinity in its calibration; calibrate again")
        if camera.K[0, 0] <= 0 or camera.K[1, 1] <= 0:
            raise CaptureError(f"{where}: focal length is not positive; calibrate again")
        if np.abs(camera.R @ camera.R.T - np.eye(3)).max() > ROTATION_TOLERANCE:
            raise CaptureError(f"{where}: R is not a rotation; write an orthonormal 3x3 matrix")
        if np.linalg.det(camera.R) < 0:
            raise CaptureError(f"{where}: R mirrors (det -1); use right-handed axes")


def _check_convention(capture: Capture, cameras: Sequence[Camera], keypoints: np.ndarray, found: Measure) -> None:
    """CaptureError if the rig as a whole follows another convention, or two cameras stand at one place.

    Conventions come first: the centres of an inverted ring of cameras coincide.
    """
    cause = explain(cameras, keypoints) if found.cost_px > gross_limit_px(keypoints) else None
    if cause:
        raise CaptureError(
            f"{capture.name}: keypoints are off by {found.cost_px:.0f} px because {cause}; "
            "write world to camera, x_camera = R x_world + T, y down, z forward"
        )
    for a, b in combinations(cameras, 2):
        if np.linalg.norm(a.centre_m - b.centre_m) < COINCIDENT_M:
            raise CaptureError(
                f"{capture.name}: cameras {a.name} and {b.name} stand at one place; give each its own extrinsics"
            )


def _check_result(capture: Capture, found: Measure, settings: CalibrationSettings) -> None:
    """CaptureError if no set of cameras agrees on the person, or the person would be a giant or a dwarf."""
    if min(found.cost_px, *found.cost_without_px.values(), np.inf) > REJECT_FACTOR * settings.max_residual_px:
        raise CaptureError(
            f"{capture.name}: the cameras do not see one person (keypoints off by {found.cost_px:.0f} px) and no known "
            "mistake explains it; check which files belong to which camera, or calibrate again"
        )
    low, high = BODY_HEIGHT_M
    if low <= found.body_height_m <= high or np.isnan(found.body_height_m):
        return
    unit = unit_of(found.body_height_m)
    cause = f"the translations look like {unit}; set the right units" if unit else "give the translations in metres"
    raise CaptureError(f"{capture.name}: the person would be {found.body_height_m:.4g} m tall; {cause}")


def _size_reasons(capture: Capture, name: str) -> list[str]:
    calibrated, recorded = capture.calibrated_sizes_px[name], capture.recorded_sizes_px[name]
    if calibrated == recorded:
        return []
    return [f"calibrated at {calibrated[0]}x{calibrated[1]}, recorded at {recorded[0]}x{recorded[1]}"]


def _fit_reasons(
    name: str, cameras: Sequence[Camera], keypoints: np.ndarray, before: Measure, settings: CalibrationSettings
) -> list[str]:
    """What is wrong with a camera as given, and why if one mistake explains it."""
    reasons = []
    if before.median_px[name] > settings.max_residual_px:
        reasons.append(
            f"as given, median residual {before.median_px[name]:.1f} px is over {settings.max_residual_px:g} px"
        )
    if before.misfit == name:
        falls = f"from {before.cost_px:.1f} to {before.cost_without_px[name]:.1f} px"
        reasons.append(f"as given, the worst fit: without it the trimmed cost falls {falls}")
        cause = explain(cameras, keypoints, of=name) if before.cost_px > gross_limit_px(keypoints) else None
        reasons += [f"likely cause: {cause}"] if cause else []
    return reasons


def _verdict(
    old: Camera, new: Camera, before: Measure, after: Measure, reasons: list[str], settings: CalibrationSettings
) -> CameraVerdict:
    """Status of one training camera; reasons to come first are given."""
    name, status = old.name, "ok"
    if new is not old:
        status = "refined"
        turned_deg = np.rad2deg(np.linalg.norm(cv2.Rodrigues(new.R @ old.R.T)[0]))
        moved_cm = 100 * np.linalg.norm(new.centre_m - old.centre_m)
        reasons = [*reasons, f"refined: turned by {turned_deg:.2f} degrees, moved by {moved_cm:.1f} cm"]
    if after.median_px[name] > settings.max_residual_px:
        status = "suspect"
        reasons = [*reasons, f"as used, median residual is still {after.median_px[name]:.1f} px"]
    if after.misfit == name and after.median_px[name] > REJECT_FACTOR * settings.max_residual_px:
        status = "rejected"
        reasons = [*reasons, "not used from here on"]
    return CameraVerdict(
        status=status,
        median_px=after.median_px[name],
        p95_px=after.p95_px[name],
        median_before_px=before.median_px[name],
        p95_before_px=before.p95_px[name],
        frame_offset=0,
        reasons=tuple(reasons),
    )


def _monocular(capture: Capture, keypoints: np.ndarray) -> CalibrationReport:
    """One camera: nothing to triangulate with. keypoints (frames, 25, 3)."""
    name = capture.train_cameras[0]
    shown = int((keypoints[..., 2] > 0).any(1).sum())
    notes = (
        f"one training camera: the person is seen in {shown} of {len(capture.frames)} frames",
        "not checked with one camera: reprojection, units, body height, direction of extrinsics, leave-one-out",
    )
    verdict = CameraVerdict("ok", None, None, None, None, 0, tuple(_size_reasons(capture, name)))
    return CalibrationReport(capture.cameras, {name: verdict}, None, None, {}, notes, capture.up)
