"""Calibrate the shared captures from the person, without their calibration, and synchronise the embedded performer.

usage: python benchmarks/person_calibration.py

Needs `../shared` beside this checkout and the networks of `hnerf models`, whose detections take minutes. Writes
`benchmarks/results/person-calibration.json` and `.md`.
"""

import dataclasses
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from provenance import SHARED, arguments, log_progress, provenance, provenance_line, table, write_result

from hnerf.body.anny import anny_rig
from hnerf.body.rig import pose_vertices
from hnerf.calibration.bundle import align
from hnerf.calibration.clocks.estimate import estimate_clocks
from hnerf.calibration.clocks.keypoints import Track
from hnerf.calibration.diagnosis import body_height_m, measure
from hnerf.calibration.evidence import Evidence
from hnerf.calibration.matches import Matches
from hnerf.calibration.person.calibrate import PersonCalibration, calibrate_from_person
from hnerf.calibration.refine import refine
from hnerf.capture.capture import Capture
from hnerf.capture.ingest import ingest
from hnerf.capture.subject import ranked_people
from hnerf.capture.uncalibrated import USUAL_FOCAL
from hnerf.config import CalibrationSettings, CaptureSettings, DetectionSettings, SyntheticSettings
from hnerf.detection.detect import detect
from hnerf.geometry.camera import Camera
from hnerf.synthetic.walk import walk_pose
from hnerf.synthetic.write import ring_of_cameras

REAL, RENDERED = "pose2sim-balance", ("valid-walk", "valid-wave")
TRIALS = 5
NOISE = 0.01  # standard deviation, as a share of the person's height in pixels
SECONDS, FPS, WAVES_AT_S = 3.0, 30.0, 1.5
OFFSETS_FRAMES, RATES = (0.0, 37.0, -11.37, 20.6), (30.0, 30.0, 30.0, 25.0)
PROTOCOL = (
    "Cameras: the training cameras of each capture, from keypoints and outlines; poses of the delivered calibration "
    "are not read. Lenses known: its intrinsics are; unknown: one focal length is estimated from a guess of .85 of the "
    "longer side. The height is the one that the reference gives the person. Turn and move: of the worst camera, after "
    "a similarity alignment to the reference, which is the true calibration of the rendered captures, and for "
    "pose2sim-balance the delivered one as the calibration check refines it. Said: the largest standard error that is "
    "reported. Residual: the worst camera's median, and the reference's, in pixels of the capture's images. Up: angle "
    "to the reference's. Clocks: keypoints of the embedded performer, who walks and then waves, from a ring of four "
    "cameras with offsets of 0, 37, -11.37 and 20.6 frames of 1/30 s, the last at 25 frames a second; 3 s, noise of 1 "
    "% of the height; the largest error of five draws, with the cameras' calibration and without."
)


def main() -> None:
    """Measure, print and write."""
    arguments(__doc__).parse_args()
    log_progress()
    result: dict[str, Any] = provenance() | {"protocol": PROTOCOL, "captures": {}}
    for name in (REAL, *RENDERED):
        with tempfile.TemporaryDirectory() as scratch:
            result["captures"][name] = measure_capture(SHARED / "data" / name, Path(scratch))
    result["clocks"] = {"calibrated": clock_errors(True), "not calibrated": clock_errors(False)}
    write_result("person-calibration", result, as_markdown(result))


def measure_capture(folder: Path, scratch: Path) -> dict[str, Any]:
    """Return figures by source of keypoints and by what is known about the lenses."""
    capture = ingest(folder, CaptureSettings(), scratch / "capture")
    reference = _reference(capture)
    detect(capture, DetectionSettings(source="network"), scratch / "detected")
    sources = {"delivered": capture, "detected": Capture.load(scratch / "detected")}
    found = {}
    for source, seen in sources.items():
        for lenses in ("known", "unknown"):
            found[f"{source}, lenses {lenses}"] = _score(seen, reference, lenses == "known")
    return found


def _reference(capture: Capture) -> list[Camera]:
    """Return the cameras to compare with. For the real capture, they are refined by keypoints and image matches if
    held-out frames require it."""
    keypoints = ranked_people(capture)[0].keypoints
    given = [capture.cameras[name] for name in capture.train_cameras]
    if capture.name != REAL:
        return given
    evidence = Evidence(capture, keypoints, None, Matches.of(capture), None)
    return refine(evidence, given, CalibrationSettings()).cameras


def _guessed(camera: Camera) -> Camera:
    """Return the camera with the usual focal length and the principal point at the centre of the image."""
    focal_px = USUAL_FOCAL * max(camera.size_px)
    K = np.array([[focal_px, 0, (camera.width_px - 1) / 2], [0, focal_px, (camera.height_px - 1) / 2], [0, 0, 1.0]])
    return dataclasses.replace(camera, K=K)


def _score(capture: Capture, reference: list[Camera], known: bool) -> dict[str, Any]:
    """Calibrate; return the worst camera's errors and the seconds of processor time."""
    keypoints = ranked_people(capture)[0].keypoints
    of_reference = measure(reference, keypoints)
    lost = {c.name: Camera(c.name, c.K, np.eye(3), np.zeros(3), *c.size_px) for c in reference}
    if not known:
        lost = {name: _guessed(camera) for name, camera in lost.items()}
    unknown = [] if known else list(lost)
    started = time.process_time()
    found = calibrate_from_person(
        capture.with_cameras(lost), unknown, dict.fromkeys(lost, "given"), body_height_m(of_reference.points_m)
    )
    seconds = time.process_time() - started
    turns_deg, moves_m = errors(found.cameras, reference)
    return {
        "turn_deg": max(turns_deg),
        "said_deg": max(off.turn_deg for off in found.uncertainty.values()),
        "move_cm": 100 * max(moves_m),
        "said_cm": 100 * max(off.move_m for off in found.uncertainty.values()),
        "focal_off": found.cameras[0].K[0, 0] / reference[0].K[0, 0] - 1,
        "residual_px": max(found.measured.median_px.values()),
        "reference_px": max(of_reference.median_px.values()),
        "up_deg": _up_deg(found, reference),
        "said_up_deg": found.up_sd_deg,
        "seconds": seconds,
    }


def errors(cameras: list[Camera], reference: list[Camera]) -> tuple[list[float], list[float]]:
    """Return each camera's rotation in degrees and displacement in metres from the reference, after a similarity
    alignment."""
    pairs = list(zip(align(cameras, reference), reference, strict=True))
    turns_deg = [float(np.rad2deg(np.linalg.norm(cv2.Rodrigues(a.R @ b.R.T)[0]))) for a, b in pairs]
    return turns_deg, [float(np.linalg.norm(a.centre_m - b.centre_m)) for a, b in pairs]


def _up_deg(found: PersonCalibration, reference: list[Camera]) -> float:
    """Return the angle between the two worlds' Z axes."""
    up = np.mean([b.R.T @ a.R[:, 2] for a, b in zip(found.cameras, reference, strict=True)], axis=0)
    return float(np.rad2deg(np.arccos(up[2] / np.linalg.norm(up))))


def clock_errors(calibrated: bool) -> float:
    """Return the largest error of any camera's offset, in frames of 1/30 s."""
    cameras = ring_of_cameras(SyntheticSettings())[: len(RATES)]
    joints_m, worst = performer(), 0.0
    for seed in range(TRIALS):
        rng = np.random.default_rng(seed)
        tracks = {
            camera.name: _track(camera, joints_m, offset / FPS, rate, rng)
            for camera, offset, rate in zip(cameras, OFFSETS_FRAMES, RATES, strict=True)
        }
        found = estimate_clocks(tracks, {c.name: c for c in cameras} if calibrated else None)
        offs = [FPS * clock.offset_s - true for clock, true in zip(found.clocks.values(), OFFSETS_FRAMES, strict=True)]
        worst = max(worst, *map(abs, offs))
    return worst


def performer() -> Callable[[float], np.ndarray]:
    """Return a function that maps an instant in seconds to the performer's keypoints (25, 3) in metres."""
    rig = anny_rig()

    def at(instant_s: float) -> np.ndarray:
        waving = float(np.clip((instant_s - WAVES_AT_S) / 0.3, 0, 1))
        pose = walk_pose(rig, instant_s, waving)
        return (rig.keypoint_weights @ pose_vertices(rig, pose.theta, pose.root)).double().numpy()

    return at


def _track(
    camera: Camera, joints_m: Callable[[float], np.ndarray], offset_s: float, rate: float, rng: np.random.Generator
) -> Track:
    own_s = np.arange(int(SECONDS * rate)) / rate
    uv = camera.project(np.stack([joints_m(t - offset_s) for t in own_s]))[0]
    height_px = np.median(np.ptp(uv[..., 1], axis=1))
    uv = uv + rng.normal(size=uv.shape) * NOISE * height_px
    return Track(own_s, np.concatenate([uv, np.full_like(uv[..., :1], 0.8)], -1))


def as_markdown(result: dict[str, Any]) -> str:
    """Format a row for each capture, source of keypoints and knowledge about the lenses."""
    head = ["capture", "keypoints", "turn, deg", "said", "move, cm", "said", "focal off", "residual, px",
            "reference, px", "up off, deg", "said", "s"]  # fmt: skip
    rows = [head]
    for name, figures in result["captures"].items():
        for what, f in figures.items():
            rows.append([name, what, f"{f['turn_deg']:.2f}", f"{f['said_deg']:.2f}", f"{f['move_cm']:.1f}",
                         f"{f['said_cm']:.1f}", f"{f['focal_off']:+.1%}", f"{f['residual_px']:.2f}",
                         f"{f['reference_px']:.2f}", f"{f['up_deg']:.1f}", f"{f['said_up_deg']:.1f}",
                         f"{f['seconds']:.0f}"])  # fmt: skip
    clocks = [["the performer's cameras", "largest error, frames of 1/30 s"]]
    clocks += [[what, f"{error:.3f}"] for what, error in result["clocks"].items()]
    return "\n".join(["# Cameras and clocks from the person", "", provenance_line(result), "", *table(rows), "",
                      *table(clocks), "", result["protocol"], ""])  # fmt: skip


if __name__ == "__main__":
    main()
