"""Run the pipeline on the shared captures and score its output with the independent program beside them.

usage: python benchmarks/score_shared.py [CAPTURE ...] [--preset NAME] [--store DIR] [--set a.b=c] [--name RESULT]
       [--without FOLDER ...]

Needs `../shared` beside this checkout (`data/`, `accept/score_run.py`) and the package installed. Writes
`benchmarks/results/RESULT.json` and `.md`, by default `shared-NAME`. Stages that are in the store already are not run
again; for a subject that the store knows, the time of the whole run is therefore omitted. `--without openpose` runs on
a copy of each capture that lacks this folder.
"""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

from provenance import ROOT, SHARED, arguments, provenance, provenance_line, table, write_result

from hnerf.evaluation.views import NOVEL_POSE_SPLITS
from hnerf.processes import end_with_parent

SCORE_RUN = SHARED / "accept" / "score_run.py"
CAPTURES = ("valid-walk", "valid-wave", "valid-turn-mono", "pose2sim-balance")
IMAGE_COLUMNS = {"psnr": ("PSNR", "{:.2f}"), "ssim": ("SSIM", "{:.3f}"), "mask_iou": ("mask IoU", "{:.3f}")}
GEOMETRY_COLUMNS = {
    "chamfer_l2_e3": ("Chamfer x1e-3 m²", "{:.3f}"),
    "chamfer_mm": ("mean mm", "{:.1f}"),
    "normal_consistency": ("NC", "{:.3f}"),
    "iou": ("IoU", "{:.3f}"),
}


def main() -> int:
    """Score all captures, print and write; return 1 if any failed."""
    parser = arguments(__doc__)
    parser.add_argument("captures", nargs="*", default=list(CAPTURES), metavar="CAPTURE")
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--store", type=Path, default=ROOT / "store")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="a.b=c")
    parser.add_argument("--without", nargs="+", default=[], metavar="FOLDER", help="folders that captures lack")
    parser.add_argument("--name", help="name of the result files (default: shared-PRESET)")
    options = parser.parse_args()
    preset = {"preset": options.preset, "overrides": options.overrides, "without": options.without}
    result: dict[str, Any] = provenance() | preset | {"captures": {}}
    for name in options.captures:
        capture = lacking(SHARED / "data" / name, options.without, options.store)
        result["captures"][name] = measure(capture, options.preset, options.store, options.overrides)
        write_result(options.name or f"shared-{options.preset}", result, as_markdown(result))
    return int(any("error" in figures for figures in result["captures"].values()))


def lacking(capture: Path, folders: list[str], store: Path) -> Path:
    """Return the capture, or a copy of it in the store without these folders."""
    if not folders:
        return capture
    absent = [name for name in folders if not (capture / name).is_dir()]
    if absent:
        raise SystemExit(f"{capture / absent[0]}: no such folder to leave out")
    copy = store / "captures" / capture.name
    shutil.rmtree(copy, ignore_errors=True)  # an old copy may have folders that must be left out now
    return Path(shutil.copytree(capture, copy, ignore=lambda folder, _: folders if Path(folder) == capture else []))


def measure(capture: Path, preset: str, store: Path, overrides: list[str]) -> dict[str, Any]:
    """Run the pipeline on one capture and score it; return {"error": the last line of output} if it fails."""
    command = [str(Path(sys.executable).with_name("hnerf")), "run", str(capture), "--preset", preset]
    command += ["--store", str(store), *(f"--set={override}" for override in overrides)]
    known, started = (store / "subjects" / capture.name).exists(), time.perf_counter()
    lines: list[str] = []
    ends = partial(end_with_parent, signal.SIGTERM, os.getpid())
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, preexec_fn=ends) as run:
        assert run.stdout is not None
        for line in run.stdout:
            print(line, end="", flush=True)
            lines.append(line.strip())
    if run.returncode:
        return {"error": next((line for line in reversed(lines) if line), f"exit status {run.returncode}")}
    subject = Path(next(line.removeprefix("subject:").strip() for line in lines if line.startswith("subject:")))
    figures: dict[str, Any] = {"run_seconds": None if known else time.perf_counter() - started}
    figures["training"] = json.loads((subject / "training" / "report.json").read_text())
    figures["own_metrics"] = json.loads((subject / "evaluation" / "metrics.json").read_text())
    return figures | {"score": score(subject, capture)}


def score(subject: Path, capture: Path) -> dict[str, Any] | None:
    """Return the scores by the independent program, or None if the capture has no ground truth."""
    if not (capture / "ground_truth").is_dir():
        return None
    command = [sys.executable, str(SCORE_RUN), str(subject), str(capture)]
    return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout)


def as_markdown(result: dict[str, Any]) -> str:
    """Format one table per split, after the machine and before the protocol."""
    changes = f" with {', '.join(result['overrides'])}" if result["overrides"] else ""
    changes += f" without {', '.join(result['without'])}" if result["without"] else ""
    lines = [
        f"# Shared captures, preset `{result['preset']}`{changes}",
        "",
        f"{provenance_line(result)} Scored by the independent program.",
    ]
    for split, title in (("novel_view", "Training poses, test cameras"), ("novel_pose", "New poses, animated")):
        lines += ["", f"## {title}", "", *_split_table(result["captures"], split)]
    finished = {name: figures for name, figures in result["captures"].items() if "error" not in figures}
    lines += ["", "## New poses in three columns, by the evaluation itself", "", *_columns_table(finished)]
    lines += ["", "## Cameras left out, by the evaluation itself", "", *_holdout_table(finished)]
    lines += ["", "## Cost and body fit", "", *_cost_table(finished)]
    protocols = {figures["own_metrics"]["protocol"] for figures in finished.values()}
    note = "The independent program samples 30 000 points a surface and counts volumes on an 80^3 grid."
    return "\n".join([*lines, "", "## Protocol", "", *protocols, "", note, ""])


def _split_table(captures: dict[str, Any], split: str) -> list[str]:
    columns = IMAGE_COLUMNS | GEOMETRY_COLUMNS
    rows = [["capture", "images", *(title for title, _ in columns.values())]]
    for name, figures in captures.items():
        if not figures.get("score"):
            rows.append([name, figures.get("error", "no ground truth")])
            continue
        rows.append([name, *score_cells(figures["score"][split])])
    return table(rows)


def score_cells(found: dict[str, Any]) -> list[str]:
    """Format a split's number of images and its scores, in the order of IMAGE_COLUMNS and GEOMETRY_COLUMNS. A missing
    score is an empty cell."""
    columns, values = IMAGE_COLUMNS | GEOMETRY_COLUMNS, found | (found["geometry"] or {})
    shown = (form.format(values[key]) if values.get(key) is not None else "" for key, (_, form) in columns.items())
    return [str(found["n"]), *shown]


def _columns_table(captures: dict[str, Any]) -> list[str]:
    """Return a table of PSNR / SSIM / mask IoU for animated, posed and tracked poses, or the reasons why there are
    none."""
    rows = [["capture", "animated", "posed", "tracked"]]
    for name, figures in captures.items():
        rows.append([name, *(_image_cell(figures["own_metrics"][column]) for column in NOVEL_POSE_SPLITS)])
    return table(rows)


def _holdout_table(captures: dict[str, Any]) -> list[str]:
    """Return a table of PSNR / SSIM / mask IoU for every held-out camera and their mean, or the reasons why there are
    none."""
    rows = [["capture", "camera left out", "training poses", "new poses, animated"]]
    for name, figures in captures.items():
        held_out = figures["own_metrics"]["holdout"]
        if held_out is None:
            rows.append([name, "", figures["own_metrics"]["holdout_reason"]])
            continue
        for camera, found in (held_out["cameras"] | {"mean": held_out["mean"]}).items():
            rows.append([name, camera, _image_cell(found["novel_view"]), _image_cell(found["novel_pose"])])
    return table(rows)


def _image_cell(found: dict[str, Any]) -> str:
    if found["psnr"] is None:
        return str(found.get("reason", ""))
    return " / ".join(form.format(found[key]) for key, (_, form) in IMAGE_COLUMNS.items())


def _cost_table(captures: dict[str, Any]) -> list[str]:
    costs = ["setup, s", "training, s", "of that the field, s", "device", "rendering, s per image", "whole run, s"]
    rows = [["capture", "limb joints, mm", *costs]]
    for name, figures in captures.items():
        fit = (figures["score"] or {}).get("fit")
        joints = "" if fit is None else f"{fit['limb_joint_error_mm']:.1f}"
        image = f"{figures['own_metrics']['seconds_per_image']:.2f}"
        run = "" if figures["run_seconds"] is None else f"{figures['run_seconds']:.0f}"
        training = figures["training"]
        seconds = [f"{training[key]:.0f}" for key in ("setup_seconds", "seconds", "field_seconds")]
        rows.append([name, joints, *seconds, training["device"], image, run])
    return table(rows)


if __name__ == "__main__":
    sys.exit(main())
