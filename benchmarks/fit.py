"""How well the body is fitted to the shared captures, and what it costs.

usage: python benchmarks/fit.py STORE

STORE is where `hnerf run` or `benchmarks/score_shared.py` kept its results. Limb joints are compared by the independent
program `../shared/accept/score_run.py`; silhouettes of the naked body with the true masks, in every frame and training
camera. Writes `benchmarks/results/fit.json` and `.md`.
"""

import argparse
import json
import runpy
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from provenance import SHARED, provenance, sentence, table, write_result

from hnerf.body.fit_result import BodyFit
from hnerf.calibration.report import load_cameras
from hnerf.capture.capture import Capture
from hnerf.render.silhouette import silhouette

COLUMNS = {
    "cameras": ("cameras", "{}"),
    "limb_joint_error_mm": ("limb joints, mm", "{:.1f}"),
    "worst_frame_mm": ("worst frame, mm", "{:.0f}"),
    "iou": ("IoU with the true mask", "{:.3f}"),
    "outside_share": ("outside it, share of its area", "{:.4f}"),
    "outside_share_worst": ("worst image", "{:.4f}"),
    "seconds_per_frame": ("s a frame", "{:.2f}"),
}


def main() -> None:
    """Measure every capture with ground truth that the store has, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("store", type=Path)
    subjects = sorted((parser.parse_args().store / "subjects").iterdir())
    with_truth = [s for s in subjects if (SHARED / "data" / s.name / "ground_truth").is_dir()]
    captures = {subject.name: measure(subject, SHARED / "data" / subject.name) for subject in with_truth}
    result = provenance() | {"captures": captures}
    rows = [["capture", *(title for title, _ in COLUMNS.values())]]
    rows += [
        [name, *(form.format(found[key]) for key, (_, form) in COLUMNS.items())] for name, found in captures.items()
    ]
    markdown = "\n".join(["# Body fit", "", sentence(result), "", *table(rows), ""])
    write_result("fit", result, markdown)
    print(markdown)


def measure(subject: Path, source: Path) -> dict[str, Any]:
    """Figures of one finished fit against the ground truth of its recording."""
    capture = load_cameras(subject / "calibration", Capture.load(subject / "capture"))
    fit, folder = BodyFit.load(subject / "fit"), (subject / "fit").resolve()
    seconds = json.loads(folder.with_name(f"{folder.name}.json").read_text())["metrics"]
    joints = runpy.run_path(str(SHARED / "accept" / "score_run.py"))["joints"](subject, source)
    ious, outside = [], []
    for frame, vertices_m in zip(fit.frames, fit.vertices_m().numpy(), strict=True):
        for name in capture.train_cameras:
            path = source / "ground_truth" / "masks" / name / f"{frame:06d}.png"
            mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) > 127
            body = silhouette(capture.cameras[name], vertices_m, fit.rig.faces.numpy())
            ious.append((body & mask).sum() / (body | mask).sum())
            outside.append((body & ~mask).sum() / mask.sum())
    return joints | {
        "cameras": len(capture.train_cameras),
        "iou": float(np.mean(ious)),
        "outside_share": float(np.mean(outside)),
        "outside_share_worst": float(np.max(outside)),
        "seconds_per_frame": sum(seconds.values()) / len(fit.frames),
    }


if __name__ == "__main__":
    main()
