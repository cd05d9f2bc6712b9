"""Compare the networks' keypoints and masks with those of the shared captures and with the truth.

usage: python benchmarks/detection.py

Needs `../shared/data` beside this checkout, and the networks of `hnerf models`. Writes
`benchmarks/results/detection.json` and `.md`.
"""

import dataclasses
import multiprocessing
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from peak_memory import peak_mib
from provenance import SHARED, arguments, log_progress, provenance, provenance_line, table, write_result

from hnerf.capture.capture import Capture
from hnerf.capture.ingest import ingest
from hnerf.capture.subject import ranked_people
from hnerf.capture.subset import subset
from hnerf.config import CaptureSettings, DetectionSettings
from hnerf.detection.detect import detect, find_in_camera
from hnerf.evaluation.ground_truth import GroundTruth
from hnerf.evenly_spaced import evenly_spaced
from hnerf.geometry.triangulation import triangulate

REAL, RENDERED = "pose2sim-balance", ("valid-walk", "valid-wave")
DELIVERED = "delivered"
SIZES = ("heavy", "full", "lite")
LIMBS = [2, 3, 4, 5, 6, 7, 9, 10, 11, 12, 13, 14]
FRAMES = 16  # of each capture, evenly spaced: more give the same figures and take minutes
PROTOCOL = (
    "Keypoints are the twelve joints of arms and legs in the training cameras and 16 frames, evenly spaced: persons "
    "are tracked over jumps. pose2sim-balance is looked at as recorded, 1080 x 1920 px. Residual: distance in "
    "pixels of the recording from a keypoint to the point that the cameras' keypoints are triangulated to, in the "
    "cameras as given. Error: distance to the true joint, in pixels of the image. Missed: joints without a "
    "keypoint. Mask: the network's probability above a half against the true mask. Milliseconds are of one core's "
    "time for a frame of one camera with one person, image read and mask written included, networks loaded before; "
    "MiB are the most that this process holds."
)


def main() -> None:
    """Detect, measure, print and write."""
    arguments(__doc__).parse_args()
    log_progress()
    result: dict[str, Any] = provenance() | {"protocol": PROTOCOL, "captures": {}}
    for name in (REAL, *RENDERED):
        with tempfile.TemporaryDirectory() as scratch:
            result["captures"][name] = measure(SHARED / "data" / name, Path(scratch))
    write_result("detection", result, as_markdown(result))


def measure(folder: Path, scratch: Path) -> dict[str, Any]:
    """Score the keypoints that a capture came with, and those of the network in each size."""
    everything = ingest(folder, CaptureSettings(max_side_px=1920), scratch / "everything")
    frames = tuple(evenly_spaced(everything.frames, FRAMES))
    train, novel = (
        tuple(f for f in frames if f in part) for part in (everything.train_frames, everything.novel_pose_frames)
    )
    subset(everything, scratch / "capture", train_frames=train, novel_pose_frames=novel)
    capture = Capture.load(scratch / "capture")
    score = score_truth if (folder / "ground_truth").is_dir() else score_residuals
    figures = {DELIVERED: score(folder, capture)}
    for size in SIZES:
        out = scratch / size
        settings = DetectionSettings.model_validate({"source": "network", "size": size})
        detect(capture, settings, out)
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as alone:
            cost = alone.submit(cost_of_a_frame, capture, settings, scratch / f"{size}-cost").result()
        figures[size] = score(folder, Capture.load(out)) | cost
    return figures


def cost_of_a_frame(capture: Capture, settings: DetectionSettings, out: Path) -> dict[str, float]:
    """Return the milliseconds of one core's time for a frame of the first camera, without the first frame, and the peak
    memory of this process, which must be a new one."""
    camera = capture.train_cameras[0]
    one = dataclasses.replace(capture, train_frames=capture.frames[:1], novel_pose_frames=())
    find_in_camera(one, camera, settings, out / "warm")
    times = []
    for looked_at in (one, capture):
        started = time.process_time()
        find_in_camera(looked_at, camera, settings, out / str(len(looked_at.frames)))
        times.append(time.process_time() - started)
    ms = 1e3 * (times[1] - times[0]) / (len(capture.frames) - 1)
    return {"ms": round(ms, 1), "mib": peak_mib()}


def limb_keypoints(capture: Capture) -> np.ndarray:
    """Return the limb keypoints of the subject, (C, frames, 12, 3)."""
    return ranked_people(capture)[0].keypoints[:, :, LIMBS]


def score_residuals(folder: Path, capture: Capture) -> dict[str, Any]:
    """Return the residuals of keypoints triangulated with the given cameras."""
    keypoints = limb_keypoints(capture)
    cameras = [capture.cameras[name] for name in capture.train_cameras]
    _, residuals_px, _ = triangulate(cameras, keypoints)
    recorded = [capture.recorded_sizes_px[camera.name][1] / camera.height_px for camera in cameras]
    return _percentiles(residuals_px * np.array(recorded)[:, None, None], keypoints)


def score_truth(folder: Path, capture: Capture) -> dict[str, Any]:
    """Return the errors of keypoints against the true joints and, if the network made masks, their IoU with the true
    masks."""
    stored = np.load(folder / "ground_truth" / "joints.npz")
    joints_m = stored["positions"][list(capture.frames)][:, LIMBS]
    true_px = np.stack(
        [[capture.cameras[name].project(points)[0] for points in joints_m] for name in capture.train_cameras]
    )
    keypoints = limb_keypoints(capture)
    errors_px = np.where(keypoints[..., 2] > 0, np.linalg.norm(keypoints[..., :2] - true_px, axis=-1), np.nan)
    found = _percentiles(errors_px, keypoints)
    truth, ious = GroundTruth(folder, capture), []
    for view in product(capture.train_cameras, capture.frames):
        likely = capture.person_probability(*view)
        if likely is not None:
            mask, true = likely > 0.5, truth.mask(*view)
            ious.append(float(np.sum(mask & true) / np.sum(mask | true)))
    return found | ({"mask_iou": round(float(np.mean(ious)), 4)} if ious else {})


def _percentiles(distances_px: np.ndarray, keypoints: np.ndarray) -> dict[str, Any]:
    known = distances_px[np.isfinite(distances_px)]
    return {
        "median_px": round(float(np.median(known)), 2),
        "p90_px": round(float(np.percentile(known, 90)), 2),
        "missed": round(float((keypoints[..., 2] <= 0).mean()), 4),
    }


def as_markdown(result: dict[str, Any]) -> str:
    """Format a row for each capture and each source of keypoints."""
    rows = [["capture", "keypoints", "median, px", "90 %, px", "missed", "mask IoU", "ms", "MiB"]]
    for name, figures in result["captures"].items():
        for source, f in figures.items():
            mask, ms, mib = f.get("mask_iou"), f.get("ms"), f.get("mib")
            rows.append([name, source, f"{f['median_px']:.2f}", f"{f['p90_px']:.2f}", f"{f['missed']:.2%}",
                         "" if mask is None else f"{mask:.4f}", "" if ms is None else f"{ms:.0f}",
                         "" if mib is None else f"{mib:.0f}"])  # fmt: skip
    return "\n".join(["# Detection", "", provenance_line(result), "", *table(rows), "", result["protocol"], ""])


if __name__ == "__main__":
    main()
