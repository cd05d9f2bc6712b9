"""Compare the networks' keypoints and masks with those of the shared captures and with the truth.

usage: python benchmarks/detection.py [--sizes heavy,full,lite]

Needs `../shared/data` beside this checkout, and the networks of `hnerf models`. Writes
`benchmarks/results/detection.json` and `.md`.
"""

import argparse
import logging
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from provenance import SHARED, provenance, provenance_line, table, write_result

from hnerf.capture.capture import PERSON, Capture
from hnerf.capture.ingest import ingest
from hnerf.capture.subject import subject_keypoints
from hnerf.config import CaptureSettings, DetectionSettings
from hnerf.detection.detect import detect
from hnerf.geometry.triangulation import triangulate

REAL, RENDERED = "pose2sim-balance", ("valid-walk", "valid-wave")
DELIVERED = "delivered"
SIZES = ("heavy", "full", "lite")
LIMBS = [2, 3, 4, 5, 6, 7, 9, 10, 11, 12, 13, 14]
PROTOCOL = (
    "Keypoints are the twelve joints of arms and legs in the training cameras and all frames that the capture stage "
    "takes. Residual: distance in pixels of the recording from a keypoint to the point that the cameras' keypoints are "
    "triangulated to, in the cameras as given. Error: distance to the true joint, in pixels of the image. Missed: "
    "joints without a keypoint. Mask: the network's probability above a half against the true mask. Milliseconds are "
    "of a frame and camera, images read and masks written included, with as many processes as cores."
)


def main() -> None:
    """Detect, measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=lambda text: text.split(","), default=list(SIZES), metavar="LIST")
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(name)s: %(message)s", datefmt="%H:%M:%S")
    result: dict[str, Any] = provenance() | {"protocol": PROTOCOL, "captures": {}}
    for name in (REAL, *RENDERED):
        with tempfile.TemporaryDirectory() as scratch:
            result["captures"][name] = measure(SHARED / "data" / name, options.sizes, Path(scratch))
    write_result("detection", result, as_markdown(result))
    print(as_markdown(result))


def measure(folder: Path, sizes: list[str], scratch: Path) -> dict[str, Any]:
    """Score the keypoints that a capture came with, and those of each size of the network."""
    capture = ingest(folder, CaptureSettings(), scratch / "capture")
    score = score_truth if (folder / "ground_truth").is_dir() else score_residuals
    figures = {DELIVERED: score(folder, capture)}
    for size in sizes:
        out = scratch / size
        report = detect(capture, DetectionSettings.model_validate({"source": "network", "size": size}), out)
        ms = float(np.mean([camera["ms"] for camera in report["cameras"].values()]))
        figures[size] = score(folder, Capture.load(out)) | {"ms": round(ms, 1)}
    return figures


def limb_keypoints(capture: Capture) -> np.ndarray:
    """Return the limb keypoints of the subject, (C, frames, 12, 3)."""
    return np.stack(list(subject_keypoints(capture).values()))[:, :, LIMBS]


def score_residuals(folder: Path, capture: Capture) -> dict[str, Any]:
    """Return the residuals of keypoints triangulated with the cameras as given."""
    keypoints = limb_keypoints(capture)
    cameras = [capture.cameras[name] for name in capture.train_cameras]
    projections = np.stack([camera.projection for camera in cameras])
    _, residuals_px, _ = triangulate(projections, keypoints.reshape(len(cameras), -1, 3))
    recorded = [capture.recorded_sizes_px[camera.name][1] / camera.height_px for camera in cameras]
    return _percentiles(residuals_px * np.array(recorded)[:, None], keypoints)


def score_truth(folder: Path, capture: Capture) -> dict[str, Any]:
    """Return the errors of keypoints against the true joints, and of the network's masks, if any, against the true
    ones."""
    stored = np.load(folder / "ground_truth" / "joints.npz")
    joints_m = stored["positions"][: len(capture.frames), LIMBS]
    true_px = np.stack(
        [[capture.cameras[name].project(points)[0] for points in joints_m] for name in capture.train_cameras]
    )
    keypoints = limb_keypoints(capture)
    errors_px = np.where(keypoints[..., 2] > 0, np.linalg.norm(keypoints[..., :2] - true_px, axis=-1), np.nan)
    found = _percentiles(errors_px, keypoints)
    if (capture.root / PERSON).is_dir():
        found["mask_iou"] = round(float(np.mean(list(_ious(folder, capture)))), 4)
    return found


def _ious(folder: Path, capture: Capture) -> list[float]:
    ious = []
    for camera in capture.train_cameras:
        for frame in capture.frames:
            name = Path(camera) / f"{frame:06d}.png"
            mask, true = (
                cv2.imread(str(place / name), cv2.IMREAD_GRAYSCALE) > 127
                for place in (capture.root / PERSON, folder / "ground_truth" / "masks")
            )
            ious.append(float((mask & true).sum() / (mask | true).sum()))
    return ious


def _percentiles(distances_px: np.ndarray, keypoints: np.ndarray) -> dict[str, Any]:
    known = distances_px[np.isfinite(distances_px)]
    return {
        "median_px": round(float(np.median(known)), 2),
        "p90_px": round(float(np.percentile(known, 90)), 2),
        "missed": round(float((keypoints[..., 2] <= 0).mean()), 4),
    }


def as_markdown(result: dict[str, Any]) -> str:
    """Format a row for each capture and source of keypoints."""
    rows = [["capture", "keypoints", "median, px", "90 %, px", "missed", "mask IoU", "ms"]]
    for name, figures in result["captures"].items():
        for source, f in figures.items():
            mask, ms = f.get("mask_iou"), f.get("ms")
            rows.append([name, source, f"{f['median_px']:.2f}", f"{f['p90_px']:.2f}", f"{f['missed']:.2%}",
                         "" if mask is None else f"{mask:.4f}", "" if ms is None else f"{ms:.0f}"])  # fmt: skip
    return "\n".join(["# Detection", "", provenance_line(result), "", *table(rows), "", result["protocol"], ""])


if __name__ == "__main__":
    main()
