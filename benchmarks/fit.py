"""Measure the accuracy of the body fit on the shared captures, and its cost.

usage: python benchmarks/fit.py STORE [CAPTURE ...]

Fits by preset `fast` (default: the three rendered captures), reusing what is in STORE. Limb joints are compared by the
independent program `../shared/accept/score_run.py`; silhouettes of the unclothed body with the true masks, in every
frame and training camera. Part of a joint's error is constant in the joint's own axes: the true skeleton, of another
character, has the joint elsewhere in the limb. Writes `benchmarks/results/fit.json` and `.md`.
"""

import runpy
import tempfile
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from provenance import SHARED, provenance, provenance_line, store_and_captures, table, write_result

from flows.preparation import prepare_training, with_detections
from hnerf.body.fit_result import BodyFit
from hnerf.body.rig import joint_transforms
from hnerf.config import load_settings
from hnerf.evaluation.ground_truth import GroundTruth
from hnerf.geometry.silhouette import silhouette
from tasks.calibration import calibrated_capture
from tasks.capture import ingest
from tasks.source import read_capture
from tasks.store import Artifact, Store

CAPTURES = ("valid-turn-mono", "valid-walk", "valid-wave")
COLUMNS = {
    "cameras": ("cameras", "{}"),
    "limb_joint_error_mm": ("limb joints, mm", "{:.1f}"),
    "constant_mm": ("constant in the joint's axes, mm", "{:.1f}"),
    "scatter_mm": ("about that, mm", "{:.1f}"),
    "worst_frame_mm": ("worst frame, mm", "{:.0f}"),
    "iou": ("IoU with the true mask", "{:.3f}"),
    "outside_share": ("outside the mask, share of its area", "{:.4f}"),
    "outside_share_worst": ("worst image", "{:.4f}"),
    "seconds_per_frame": ("s a frame", "{:.2f}"),
}


def main() -> None:
    """Fit and measure every capture, print and write."""
    options = store_and_captures(__doc__, CAPTURES)
    where, store = provenance(), Store(options.store.resolve())
    captures = {name: measure(SHARED / "data" / name, store) for name in options.captures}
    result = where | {"captures": captures}
    rows = [["capture", *(title for title, _ in COLUMNS.values())]]
    rows += [
        [name, *(form.format(found[key]) for key, (_, form) in COLUMNS.items())] for name, found in captures.items()
    ]
    markdown = "\n".join(["# Body fit", "", provenance_line(result), "", *table(rows), ""])
    write_result("fit", result, markdown)


def measure(folder: Path, store: Store) -> dict[str, Any]:
    """Score a capture's fit against its ground truth."""
    settings = load_settings("fast")
    source, _ = read_capture(folder)
    recording = with_detections(store, ingest(store, source, settings.capture), settings)
    recording, calibration, _, made = prepare_training(store, recording, settings)
    capture, fit = calibrated_capture(recording, calibration), BodyFit.load(made.root)
    joints, truth = joint_errors(made, folder), GroundTruth(folder, capture)
    ious, outside = [], []
    for frame, vertices_m in zip(fit.frames, fit.vertices_m().numpy(), strict=True):
        for name in capture.train_cameras:
            mask = truth.mask(name, frame)
            body = silhouette(capture.cameras[name], vertices_m, fit.rig.faces.numpy())
            ious.append((body & mask).sum() / (body | mask).sum())
            outside.append((body & ~mask).sum() / mask.sum())
    return joints | {
        "cameras": len(capture.train_cameras),
        "iou": float(np.mean(ious)),
        "outside_share": float(np.mean(outside)),
        "outside_share_worst": float(np.max(outside)),
        "seconds_per_frame": sum(made.metrics.values()) / len(fit.frames),
    }


def joint_errors(made: Artifact, folder: Path) -> dict[str, Any]:
    """Return the errors of a fit's limb joints according to the independent program, and how far they are constant."""
    scoring = runpy.run_path(str(SHARED / "accept" / "score_run.py"))
    with tempfile.TemporaryDirectory() as subject:
        (Path(subject) / "fit").symlink_to(made.root)
        found: dict[str, Any] = scoring["joints"](Path(subject), folder)
    fit, truth = BodyFit.load(made.root), np.load(folder / "ground_truth" / "joints.npz")
    sides = {"L": "Left", "R": "Right"}
    pairs = product(scoring["LIMBS"].items(), sides.items())
    names = [(f"{bone}.{suffix}", f"rig:{side}{joint}") for (bone, joint), (suffix, side) in pairs]
    ours = [fit.rig.joint_names.index(bone) for bone, _ in names]
    true_m = truth["positions"][list(fit.frames)][:, [list(truth["names"]).index(joint) for _, joint in names]]
    placed = joint_transforms(fit.rig, fit.theta, fit.root)[:, ours].numpy()
    return found | constant_and_scatter(placed[..., :3, :3], placed[..., :3, 3] - true_m)


def constant_and_scatter(turns: np.ndarray, errors_m: np.ndarray) -> dict[str, float]:
    """Split errors (frames, J, 3) of joints with rotations (frames, J, 3, 3): return the mean length of each joint's
    mean error in its own axes, and the mean distance of errors from that mean."""
    own_m = np.einsum("fjdk,fjd->fjk", turns, errors_m)
    mean_m = own_m.mean(0)
    lengths_m = np.linalg.norm(mean_m, axis=-1), np.linalg.norm(own_m - mean_m, axis=-1)
    return {name: 1e3 * float(m.mean()) for name, m in zip(("constant_mm", "scatter_mm"), lengths_m, strict=True)}


if __name__ == "__main__":
    main()
