"""Calibration from the person: cameras of a recording without any calibration, from the keypoints of the person it
shows."""

import dataclasses
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hnerf.calibration.bundle import adjust, adjust_shared_lens, align, undistort
from hnerf.calibration.diagnosis import Measure, body_height_m, measure, median_height_px
from hnerf.calibration.outline_adjustment import FRAMES, follow_outlines
from hnerf.calibration.person.lens import LensFit, fit_lenses
from hnerf.calibration.person.rig import first_poses
from hnerf.calibration.person.upright import CHAIN_SD, MEAN_STATURE_M, STATURE_SD_M, scale_to, stand_on_ground
from hnerf.calibration.silhouettes import Outlines
from hnerf.capture.capture import Capture
from hnerf.capture.formats.export import write_calibration
from hnerf.capture.lens import Lens
from hnerf.capture.subject import ranked_people, subject_keypoints
from hnerf.capture.timing import median_step
from hnerf.config import CalibrationSettings
from hnerf.errors import InputError
from hnerf.geometry.camera import Camera
from hnerf.results.files import write_result
from hnerf.results.preparation import CamerasReport

PARTS = 5  # of the frames and of the joints: each is left out once
MIN_MOTION = 0.05  # of the stature: how far parts of the person must move, three times a detector's noise
COLLINEAR = 0.02  # width over length of a rig whose cameras count as on one line, which leaves a focal length open
MAX_TURN_SD_DEG, MAX_MOVE_SD = 5.0, 0.1  # beyond which a camera is not determined; the move as a share of its distance
MAX_RESIDUAL_SHARE = 0.028  # of the person's height in pixels: from here on the calibration check rejects a camera

log = logging.getLogger("hnerf.calibration")


@dataclass(frozen=True)
class Uncertainty:
    """Standard errors of a camera: turn_deg of its direction, move_m of its position, focal of its focal length as a
    share."""

    turn_deg: float
    move_m: float
    focal: float


@dataclass(frozen=True)
class PersonCalibration:
    """Result of a calibration from the person. cameras: of the capture's images, Z up, metres; lenses: as recorded;
    uncertainty: by camera; measured: residuals of the keypoints; intrinsics: where each camera's come from, in words;
    height_m: the person's, to which the rig was scaled; scale_sd: standard error of its scale, as a share; up_sd_deg:
    of up; held_out_px: cost of each kind of lens that was tried."""

    cameras: list[Camera]
    lenses: list[Lens]
    uncertainty: dict[str, Uncertainty]
    measured: Measure
    intrinsics: dict[str, str]
    height_m: float
    height_given: bool
    scale_sd: float
    up_sd_deg: float
    held_out_px: dict[str, float]

    def report(self) -> dict[str, Any]:
        """Return the content of `report.json`. Residuals are in pixels of the capture's images."""
        cameras = {
            camera.name: {
                "median_px": self.measured.median_px[camera.name],
                "p95_px": self.measured.p95_px[camera.name],
                "focal_px": float(lens.K[0, 0]),
                "k1": float(lens.distortion[0]),
                "intrinsics": self.intrinsics[camera.name],
                "uncertainty": dataclasses.asdict(self.uncertainty[camera.name]),
            }
            for camera, lens in zip(self.cameras, self.lenses, strict=True)
        }
        whole = {"height_m": self.height_m, "scale_sd": self.scale_sd, "up_sd_deg": self.up_sd_deg}
        return whole | {
            "notes": self.notes(),
            "cost_px": self.measured.cost_px,
            "held_out_px": self.held_out_px,
            "cameras": cameras,
        }

    def notes(self) -> list[str]:
        """Return notes about the whole rig, in words."""
        mean = "" if self.height_given else ", the mean of adults (state stature_m in capture.toml)"
        return [
            f"scale: a person of {self.height_m:.2f} m{mean}, +- {100 * self.scale_sd:.0f} %",
            f"up: from trunk and feet, +- {self.up_sd_deg:.1f} degrees; the ground is at 0, Z is up",
        ]

    def save(self, out: Path, layouts: Sequence[str] = (), pose2sim: bool = False) -> None:
        """Write `report.json`, and the cameras as `write_calibration` does."""
        write_calibration(out, self.lenses, "person", layouts, pose2sim)
        write_result(out / "report.json", CamerasReport, self.report())


def calibrate_from_person(
    capture: Capture, unknown_focal: Sequence[str], intrinsics: dict[str, str], height_m: float | None
) -> PersonCalibration:
    """Calibrate the training cameras of a capture from its keypoints and outlines; the poses of its cameras are not
    read.

    unknown_focal: cameras whose focal length is a guess, to be estimated; intrinsics: where each camera's come from, in
    words; height_m: the person's, the mean stature if None. If distortion was estimated, cameras are fitted to
    keypoints only. Raises InputError if the recording does not determine the cameras.
    """
    if len(capture.train_cameras) < 2:
        raise InputError(f"{capture.name}: one camera cannot be calibrated from the person; film with two or more")
    min_improvement = CalibrationSettings().min_improvement
    try:
        keypoints = _each_alone(capture)
        start = [capture.cameras[name] for name in capture.train_cameras]
        rig = first_poses(start, keypoints)
        keypoints = ranked_people(capture.with_cameras(capture.cameras | {c.name: c for c in rig}))[0].keypoints
        fit, held_out_px = fit_lenses(rig, keypoints, unknown_focal, min_improvement)
        straight = undistort(keypoints, fit.cameras, unknown_focal, fit.k1)
        found = measure(fit.cameras, straight)
        _check_determined(fit.cameras, found, straight, unknown_focal)
        height = height_m or MEAN_STATURE_M
        scaled, points_m = scale_to(fit.cameras, found.points_m, height)
        if fit.k1 == 0:
            outlines = Outlines.of(capture.with_cameras(capture.cameras | {c.name: c for c in scaled}), FRAMES)
            followed, _ = follow_outlines(
                outlines, scaled, capture.train_cameras, points_m, min_improvement, unknown_focal
            )
            scaled, points_m = scale_to(followed, measure(followed, straight).points_m, height)
        frame_s = median_step(capture.frames) / capture.fps
        cameras, up_sd_deg = stand_on_ground(scaled, points_m, frame_s)
        uncertainty = _uncertainty(cameras, keypoints, unknown_focal, fit)
        _check_uncertainty(cameras, uncertainty)
    except InputError as error:
        raise InputError(f"{capture.name}: {str(error).removeprefix(f'{capture.name}: ')}") from None
    return PersonCalibration(
        cameras=cameras,
        lenses=[_as_recorded(capture, camera, fit.k1 if camera.name in unknown_focal else 0.0) for camera in cameras],
        uncertainty=uncertainty,
        measured=measure(cameras, straight),
        intrinsics={n: f"{fit.what}, from the person" if n in unknown_focal else intrinsics[n] for n in intrinsics},
        height_m=height,
        height_given=height_m is not None,
        scale_sd=CHAIN_SD if height_m else float(np.hypot(CHAIN_SD, STATURE_SD_M / MEAN_STATURE_M)),
        up_sd_deg=up_sd_deg,
        held_out_px=held_out_px,
    )


def _each_alone(capture: Capture) -> np.ndarray:
    """Return the keypoints (C, frames, 25, 3) of the person whom each camera separately takes as the subject: the one
    named there, else the one with the best claim."""
    found = subject_keypoints(dataclasses.replace(capture, subject_point=None))
    if point := capture.subject_point:
        found |= subject_keypoints(dataclasses.replace(capture, train_cameras=(point.camera,)))
    return np.stack(list(found.values()))


def _check_determined(
    cameras: Sequence[Camera], found: Measure, keypoints: np.ndarray, unknown_focal: Sequence[str]
) -> None:
    """Raise InputError if the recording cannot determine a rig, whatever the adjustment found."""
    worst = max(found.median_px, key=found.median_px.__getitem__)
    if found.median_px[worst] > MAX_RESIDUAL_SHARE * median_height_px(keypoints):
        raise InputError(
            f"camera {worst} does not see the same person at the same time as the others (keypoints off by "
            f"{found.median_px[worst]:.0f} px); check that all recordings start together, name the subject among "
            "several people (docs/formats.md), or leave it out"
        )
    moved = _motion(found.points_m)
    if moved < MIN_MOTION:
        raise InputError(
            f"the person stands still (moves by {100 * moved:.1f} % of the height): one posture does not "
            "determine the cameras; let the person walk and turn where all cameras see it"
        )
    centres = np.stack([camera.centre_m for camera in cameras])
    length, width = np.linalg.svd(centres - centres.mean(0))[1][:2]
    if unknown_focal and width < COLLINEAR * length:
        raise InputError(
            "all cameras stand in one line, which leaves their focal length open; give it "
            "(field_of_view_deg in capture.toml, --fov or --lens), or add a camera beside that line"
        )


def _motion(points_m: np.ndarray) -> float:
    """Return how far the most mobile parts of a person (frames, 25, 3) move from their median position, as a share of
    the stature: the median over frames, for the joint at the 90th percentile."""
    seen_m = points_m[:, np.isfinite(points_m).all(-1).any(0)]
    away = np.linalg.norm(seen_m - np.nanmedian(seen_m, axis=0), axis=-1)
    return float(np.percentile(np.nanmedian(away, axis=0), 90)) / body_height_m(points_m)


def _uncertainty(
    cameras: Sequence[Camera], keypoints: np.ndarray, unknown: Sequence[str], fit: LensFit
) -> dict[str, Uncertainty]:
    """Return the standard errors of the cameras by the jackknife (Efron and Tibshirani 1993, chapter 11): over
    successive parts of the frames, for noise, and over parts of the joints, for a detector's systematic errors."""
    by_frames = [np.delete(keypoints, part, axis=1) for part in np.array_split(np.arange(keypoints.shape[1]), PARTS)]
    by_joints = [np.delete(keypoints, np.arange(part, 25, PARTS), axis=2) for part in range(PARTS)]
    variances = []
    for parts in (by_frames, by_joints):
        rigs = [align(_again(cameras, part, unknown, fit), cameras) for part in parts]
        offs = np.array([[_difference(new, old) for new, old in zip(rig, cameras, strict=True)] for rig in rigs])
        variances.append((PARTS - 1) * ((offs - offs.mean(0)) ** 2).mean(0))
    errors = np.sqrt(sum(variances))
    return {
        camera.name: Uncertainty(float(np.rad2deg(np.linalg.norm(e[:3]))), float(np.linalg.norm(e[3:6])), float(e[6]))
        for camera, e in zip(cameras, errors, strict=True)
    }


def _again(cameras: Sequence[Camera], keypoints: np.ndarray, unknown: Sequence[str], fit: LensFit) -> list[Camera]:
    """Return the rig adjusted to a part of the keypoints, with the same unknowns as the whole fit."""
    names = [camera.name for camera in cameras]
    if not unknown:
        return adjust(cameras, keypoints, names)
    if fit.what == "a focal length each":
        return adjust(cameras, keypoints, names, unknown)
    return adjust_shared_lens(cameras, keypoints, unknown, fit.k1 != 0)[0]


def _difference(new: Camera, old: Camera) -> np.ndarray:
    """Return the rotation vector, the shift in metres and the relative focal length between two cameras, (7,)."""
    turn = Rotation.from_matrix(new.R @ old.R.T).as_rotvec()
    return np.array([*turn, *(new.centre_m - old.centre_m), new.K[0, 0] / old.K[0, 0] - 1])


def _check_uncertainty(cameras: Sequence[Camera], uncertainty: dict[str, Uncertainty]) -> None:
    """Raise InputError naming the worst camera that the keypoints do not determine."""
    far_m = {camera.name: float(np.linalg.norm(camera.centre_m)) for camera in cameras}
    worst = max(uncertainty, key=lambda name: uncertainty[name].turn_deg)
    loosest = max(uncertainty, key=lambda name: uncertainty[name].move_m / far_m[name])
    if uncertainty[worst].turn_deg > MAX_TURN_SD_DEG or uncertainty[loosest].move_m > MAX_MOVE_SD * far_m[loosest]:
        name = worst if uncertainty[worst].turn_deg > MAX_TURN_SD_DEG else loosest
        raise InputError(
            f"camera {name} is not determined (+- {uncertainty[name].turn_deg:.1f} degrees, "
            f"{100 * uncertainty[name].move_m:.0f} cm): film longer, with the person walking and turning, or give the "
            "field of view (field_of_view_deg in capture.toml, or --fov)"
        )


def _as_recorded(capture: Capture, camera: Camera, k1: float) -> Lens:
    """Return a camera of the capture's images as a lens of the recorded files."""
    size_px = capture.recorded_sizes_px[camera.name]
    found = Lens(camera.name, camera.resized(*size_px).K, np.array([k1, 0.0, 0.0, 0.0]), camera.R, camera.t_m, size_px)
    given = capture.recorded_lens(camera.name)
    return dataclasses.replace(found, distortion=given.distortion, fisheye=given.fisheye) if given else found
