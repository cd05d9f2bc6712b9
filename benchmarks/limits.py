"""Measure what limits accuracy: replace what a run finds out by the truth, one thing at a time.

usage: python benchmarks/limits.py STORE [CAPTURE ...]

Runs preset `fast` on rendered captures (default: valid-wave and valid-walk), and on copies of them that have the true
masks, the exact keypoints, or both: what a perfect segmentation and a perfect detector would give. Each is fitted and
trained anew, with the same seed, and scored on held-out images. Reuses what is in STORE. Writes
`benchmarks/results/limits.json` and `.md`.
"""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from fit import joint_errors
from provenance import SHARED, provenance, provenance_line, store_and_captures, table, write_result

from flows.preparation import prepare_training, with_detections
from hnerf.capture.capture import Capture
from hnerf.capture.keypoint_files import write_openpose
from hnerf.config import load_settings
from hnerf.evaluation.views import ANIMATED, NOVEL_VIEW
from hnerf.study.benchmark.plan import ScoringSettings
from tasks.benchmark import score_training
from tasks.capture import ingest
from tasks.source import read_capture
from tasks.store import Store
from tasks.training import train

CAPTURES = ("valid-wave", "valid-walk")
MASKS, KEYPOINTS = "masks", "keypoints"
REPLACED = {"nothing": (), "masks": (MASKS,), "keypoints": (KEYPOINTS,), "masks and keypoints": (MASKS, KEYPOINTS)}
SCORING = ScoringSettings(images=16, meshes=3, snapshot_images=1, snapshot_meshes=0, frame_sizes_px=(256,))
BODY_25 = 25  # the number of keypoints; they come first among the true joints


def main() -> None:
    """Measure all captures, print and write."""
    options = store_and_captures(__doc__, CAPTURES)
    result: dict[str, Any] = provenance() | {"captures": {}}
    for name in options.captures:
        rows = result["captures"][name] = {}
        for title, parts in REPLACED.items():
            rows[title] = measure(SHARED / "data" / name, parts, options.store.resolve())
            write_result("limits", result, as_markdown(result))


def measure(folder: Path, parts: tuple[str, ...], store_folder: Path) -> dict[str, Any]:
    """Return the scores of a run on a capture in which these parts are replaced by the ground truth."""
    settings, store = load_settings("fast"), Store(store_folder)
    source, truth = read_capture(folder)
    recording = ingest(store, source, settings.capture)
    if parts:
        copy = store_folder / "captures" / "-".join(parts) / folder.name
        copy_with_truth(folder, Capture.load(recording.root), parts, copy)
        source, truth = read_capture(copy)
        recording = ingest(store, source, settings.capture)
    recording = with_detections(store, recording, settings)
    prepared = prepare_training(store, recording, settings)
    training = train(store, *prepared, settings.training)
    scoring = score_training(store, truth, recording, prepared.calibration, prepared.body, training, SCORING)
    found = json.loads((scoring.root / "scores.json").read_text())
    return joint_errors(prepared.body, folder) | {split: found[split] for split in (NOVEL_VIEW, ANIMATED)}


def copy_with_truth(folder: Path, capture: Capture, parts: tuple[str, ...], copy: Path) -> None:
    """Copy a rendered capture; add its true masks, or replace the detected keypoints by the exact ones."""
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(folder, copy)
    if MASKS in parts:
        for name in capture.train_cameras:
            shutil.copytree(folder / "ground_truth" / "masks" / name, copy / "masks" / name)
    if KEYPOINTS in parts:
        with np.load(folder / "ground_truth" / "joints.npz") as joints:
            exact_m = joints["positions"][:, :BODY_25]
        for name in capture.train_cameras:
            for path in sorted((copy / "openpose" / name).glob("*.json")):
                exact_px, _ = capture.cameras[name].project(exact_m[int(path.name.split("_")[0])])
                write_openpose(path, np.concatenate([exact_px, np.ones((BODY_25, 1))], 1))


def as_markdown(result: dict[str, Any]) -> str:
    """Format one table per capture."""
    titles = ["replaced by the truth", "limb joints, mm", "new views, PSNR / SSIM", "new poses, animated"]
    titles += ["Chamfer x1e-3 m², both", "NC", "IoU"]
    lines = ["# What limits accuracy", "", provenance_line(result)]
    for name, rows in result["captures"].items():
        lines += ["", f"## {name}", "", *table([titles, *([title, *cells(row)] for title, row in rows.items())])]
    note = f"At most {SCORING.images} images and {SCORING.meshes} surfaces a split; one seed."
    return "\n".join([*lines, "", note, ""])


def cells(row: dict[str, Any]) -> list[str]:
    """Format a row's scores as table cells."""
    splits = [row[split] for split in (NOVEL_VIEW, ANIMATED)]
    images = [f"{split['psnr']:.2f} / {split['ssim']:.3f}" for split in splits]
    forms = {"chamfer_l2_e3": "{:.3f}", "normal_consistency": "{:.3f}", "iou": "{:.3f}"}
    surfaces = [" / ".join(form.format(split["geometry"][key]) for split in splits) for key, form in forms.items()]
    return [f"{row['limb_joint_error_mm']:.1f}", *images, *surfaces]


if __name__ == "__main__":
    main()
