"""Measure mask IoU against ground truth and time a frame on the shared captures, with and without clean plates.

usage: python benchmarks/segmentation.py [CAPTURE ...] [--sheet FOLDER]

Needs `../shared/data` beside this checkout. Without a plate, fit and segmentation alternate as in the flow. Only
training cameras are segmented and scored. `--sheet` also writes a picture for each capture: false pixels red, missing
ones cyan, worst frames first. Writes `benchmarks/results/segmentation.json` and `.md`.
"""

import itertools
import shutil
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from provenance import SHARED, arguments, log_progress, provenance, provenance_line, table, write_result

from hnerf.body.fit import fit_body
from hnerf.body.fit_result import BodyFit
from hnerf.capture.capture import Capture
from hnerf.capture.ingest import ingest
from hnerf.capture.masks import Masks, movement_px
from hnerf.config import CaptureSettings, FitSettings, SegmentationSettings
from hnerf.evaluation.ground_truth import GroundTruth
from hnerf.segmentation.prior import bounding_window
from hnerf.segmentation.segment import segment

CAPTURES = ("valid-walk", "valid-turn-mono", "valid-wave")
GOAL_CAPTURES = ("valid-walk", "valid-turn-mono")
GOALS = {"clean plate": 0.975, "no plate": 0.96}
SETTINGS = SegmentationSettings()
SHEET_FRAMES = 8
PROTOCOL = (
    "IoU is the mean over all training views; a dropped mask counts 0. Milliseconds are of the whole segmentation, "
    "including reading of images and priors, without the body fits between rounds."
)


def main() -> None:
    """Segment, score, print and write."""
    parser = arguments(__doc__)
    parser.add_argument("captures", nargs="*", default=list(CAPTURES), metavar="CAPTURE")
    parser.add_argument("--sheet", type=Path, help="folder for pictures")
    options = parser.parse_args()
    log_progress()
    result: dict[str, Any] = provenance() | {"protocol": PROTOCOL, "captures": {}}
    for name in options.captures:
        result["captures"][name] = measure(SHARED / "data" / name, options.sheet)
    means = {
        kind: float(np.mean([result["captures"][name][kind]["iou"] for name in GOAL_CAPTURES]))
        for kind in GOALS
        if set(GOAL_CAPTURES) <= set(result["captures"])
    }
    result["mean_iou"] = {"over": GOAL_CAPTURES, **means}
    write_result("segmentation", result, as_markdown(result))


def measure(folder: Path, sheet: Path | None) -> dict[str, Any]:
    """Score one capture, with its clean plates and without them."""
    with tempfile.TemporaryDirectory() as scratch:
        capture = ingest(folder, CaptureSettings(), Path(scratch))
        found = {"clean plate": [_timed_segment(capture, None)]}
        shutil.rmtree(capture.root / "background")
        found["no plate"] = _rounds(capture)
        truth = GroundTruth(folder, capture)
        figures: dict[str, Any] = {"size_px": list(capture.cameras[capture.train_cameras[0]].size_px)}
        for kind, rounds in found.items():
            masks = rounds[-1][0]
            figures[kind] = score(truth, masks) | {
                "ms_per_frame": round(rounds[-1][1], 1),
                "rounds": [round(float(np.mean(list(ious(truth, m).values()))), 4) for m, _ in rounds],
                "moved_px": [round(movement_px(a[0], b[0]), 2) for a, b in itertools.pairwise(rounds)],
            }
            if sheet:
                sheet.mkdir(parents=True, exist_ok=True)
                picture = worst_frames(truth, masks)
                cv2.imwrite(str(sheet / f"{folder.name}-{kind.replace(' ', '-')}.png"), picture[..., ::-1])
    return figures


def _timed_segment(capture: Capture, body: BodyFit | None) -> tuple[Masks, float]:
    """Segment; return the masks and the milliseconds per frame."""
    began = time.perf_counter()
    masks = segment(capture, body, SETTINGS)
    return masks, 1e3 * (time.perf_counter() - began) / (len(capture.train_cameras) * len(capture.frames))


def _rounds(capture: Capture) -> list[tuple[Masks, float]]:
    """Alternate fit and segmentation until the masks converge, as the flow does."""
    rounds: list[tuple[Masks, float]] = []
    while len(rounds) < SETTINGS.rounds:
        body, _ = fit_body(capture, rounds[-1][0] if rounds else None, FitSettings())
        rounds.append(_timed_segment(capture, body))
        if len(rounds) > 1 and movement_px(rounds[-2][0], rounds[-1][0]) < SETTINGS.still_px:
            break
    return rounds


def ious(truth: GroundTruth, masks: Masks) -> dict[tuple[str, int], float]:
    """Return the IoU of each training camera and frame."""
    found = {}
    for view in itertools.product(truth.capture.train_cameras, truth.capture.frames):
        true = truth.mask(*view)
        mask = masks.get(*view) if view in masks else np.zeros_like(true)
        found[view] = float((mask & true).sum() / (mask | true).sum())
    return found


def score(truth: GroundTruth, masks: Masks) -> dict[str, Any]:
    """Return the mean and the worst IoU, and the false and missing pixels as shares of the person's area."""
    by_view = ious(truth, masks)
    wrong = []
    for view in masks.encoded:
        mask, true = masks.get(*view), truth.mask(*view)
        wrong.append([(mask & ~true).sum() / true.sum(), (true & ~mask).sum() / true.sum()])
    values = list(by_view.values())
    return {
        "iou": round(float(np.mean(values)), 4),
        "worst_iou": round(min(values), 4),
        "false_share": round(float(np.mean(wrong, 0)[0]), 4),
        "missing_share": round(float(np.mean(wrong, 0)[1]), 4),
        "dropped": len(values) - len(masks.encoded),
    }


def worst_frames(truth: GroundTruth, masks: Masks) -> np.ndarray:
    """Return the worst frames, cropped to the person, side by side, (H, W, 3) uint8 RGB."""
    by_view = ious(truth, masks)
    cells = []
    for view in sorted(masks.encoded, key=lambda view: by_view[view])[:SHEET_FRAMES]:
        mask, true = masks.get(*view), truth.mask(*view)
        picture = (0.6 * truth.capture.image(*view)).astype(np.uint8)
        picture[mask & ~true], picture[true & ~mask] = (255, 0, 0), (0, 255, 255)
        cell = picture[bounding_window(mask | true)]
        cells.append(cv2.resize(cell, None, fx=500 / len(cell), fy=500 / len(cell), interpolation=cv2.INTER_NEAREST))
    return np.hstack(cells)


def as_markdown(result: dict[str, Any]) -> str:
    """Format a row for each capture and kind, then the means for which there is a goal."""
    rows = [["capture", "", "IoU", "worst", "false", "missing", "dropped", "ms/frame", "IoU by round", "moved, px"]]
    for name, figures in result["captures"].items():
        for kind in GOALS:
            f = figures[kind]
            rows.append([f"{name} ({figures['size_px'][0]} x {figures['size_px'][1]})", kind, f"{f['iou']:.4f}",
                         f"{f['worst_iou']:.4f}", f"{f['false_share']:.2%}", f"{f['missing_share']:.2%}",
                         str(f["dropped"]), f"{f['ms_per_frame']:.0f}", " ".join(f"{v:.4f}" for v in f["rounds"]),
                         " ".join(f"{v:.2f}" for v in f["moved_px"])])  # fmt: skip
    means = result["mean_iou"]
    wanted = [
        f"Mean over {' and '.join(means['over'])}, {kind}: **{means[kind]:.4f}** (goal {goal})."
        for kind, goal in GOALS.items()
        if kind in means
    ]
    return "\n".join(
        ["# Segmentation", "", provenance_line(result), "", *table(rows), "", *wanted, "", result["protocol"], ""]
    )


if __name__ == "__main__":
    main()
