"""`fast` beside `paper` after an hour: how long each needs to show unseen pixels as well.

usage: python benchmarks/training.py STORE [CAPTURE] [--seconds S]

Trains preset `paper`, in smaller batches than a GPU would take, for S seconds (default 3600; a step takes 20 s on one
CPU core) and preset `fast` to its end on a shared capture (default valid-wave). Both write down, every 25 steps, the
PSNR of the same pixels of frames that neither is trained on, in training cameras, as the body was fitted: an indicator,
not the evaluation's protocol, and one that a capture without novel poses does not have. What is in STORE is not made
again. Writes `benchmarks/results/training.json`, `.md` and `.png`.
"""

import argparse
import json
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from provenance import RESULTS, SHARED, provenance, sentence, table, write_result

from flows.benchmark import trained
from hnerf.config import Settings, load_settings
from hnerf.study.curves import seconds_to
from tasks.capture import ingest
from tasks.launcher import GaveUpError
from tasks.source import read_capture
from tasks.store import Store

FIELD_ALONE = "training.novel_pose_steps=0"
BATCH = ["training.frames_per_step=4", "training.rays_per_frame=64"]
LINES = {"fast": "-", "paper": "--"}


def main() -> None:
    """Train both, print, draw and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("store", type=Path)
    parser.add_argument("capture", nargs="?", default="valid-wave")
    parser.add_argument("--seconds", type=float, default=3600.0)
    options = parser.parse_args()
    shelf, where = Store(options.store.resolve()), provenance()
    presets = {
        "fast": load_settings("fast", [FIELD_ALONE]),
        "paper": load_settings("paper", [FIELD_ALONE, *BATCH, f"training.seconds={options.seconds}"]),
    }
    found = {name: train_one(shelf, SHARED / "data" / options.capture, s) for name, s in presets.items()}
    curves = {name: curve for name, (curve, _) in found.items()}
    best = max(curves["paper"], key=lambda row: row["psnr"])
    target, paper_s = best["psnr"], best["seconds"]
    reached_s = seconds_to([(row["seconds"], row["psnr"]) for row in curves["fast"]], target)
    result = where | {"capture": options.capture, "batch": BATCH, "curves": curves}
    result |= {"paper_psnr": target, "paper_s": paper_s, "fast_s": reached_s}
    rows = [["preset", "steps", "seconds", "PSNR of unseen frames' pixels", "at best"]]
    for name, curve in curves.items():
        highest, last = max(row["psnr"] for row in curve), curve[-1]
        rows.append([name, str(last["step"]), f"{last['seconds']:.0f}", f"{last['psnr']:.2f}", f"{highest:.2f}"])
    ends = [f"`{name}` ends without a surface: {reason}." for name, (_, reason) in found.items() if reason]
    told = "`fast` never has it."
    if reached_s is not None:
        told = f"`fast` after {reached_s:.1f} s (between two looks), {paper_s / reached_s:.0f} times as soon."
    lines = [f"# `fast` beside `paper`: {options.capture}", "", sentence(result), "", *table(rows), ""]
    lines += [
        " ".join([f"`paper` has {target:.2f} dB at best, after {paper_s:.0f} s; {told}", *ends]),
        "",
        "![PSNR against time](training.png)",
        "",
    ]
    write_result("training", result, "\n".join(lines))
    draw(curves, RESULTS / "training.png")
    print("\n".join(lines))


def train_one(shelf: Store, folder: Path, settings: Settings) -> tuple[list[dict[str, Any]], str | None]:
    """Step, seconds and held-out PSNR along a training; and why there is no avatar, if there is none."""
    source, _ = read_capture(folder)
    try:
        *_, model = trained(shelf, ingest(shelf, source, settings.capture), settings)
        history, reason = model.root / "history.jsonl", None
    except GaveUpError as error:  # the paper's body shrinks before it comes back: docs/method.md
        (history,), reason = (shelf.root / "training").glob("*.partial/history.jsonl"), str(error)
    rows = [json.loads(line) for line in history.read_text().splitlines()]
    curve = [
        {"step": r["step"], "seconds": r["seconds"], "psnr": r["held_out"]["psnr"]} for r in rows if "held_out" in r
    ]
    return curve, reason


def draw(curves: dict[str, list[dict[str, Any]]], path: Path) -> None:
    """PSNR against seconds of training, on a logarithmic axis."""
    figure = Figure(figsize=(6, 3.6), layout="constrained")
    axes = figure.subplots()
    for name, curve in curves.items():
        seconds, psnr = ([row[key] for row in curve] for key in ("seconds", "psnr"))
        axes.semilogx(seconds, psnr, LINES[name], color="black", label=name)
    axes.set_xlabel("seconds of training")
    axes.set_ylabel("PSNR of unseen frames' pixels, dB")
    axes.legend(frameon=False)
    figure.savefig(path, dpi=130)


if __name__ == "__main__":
    main()
