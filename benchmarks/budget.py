"""Test the automatic settings: train with twice and half of each.

usage: python benchmarks/budget.py STORE OUT [CAPTURE ...] [--preset NAME] [--at-once N]

Trains shared captures (default: the three rendered ones), whose stages up to the body fit are in STORE, with the
settings that hnerf/training/auto_settings.py chooses, three times with different seeds; then with twice and half of one
setting at a time: cells of the grids, spacing of samples, nodes, width of the pose code and of the layers, rays a step,
steps, and steps on novel frames. Scores a few held-out images by the evaluation protocol. Training and scoring are
those of the pipeline's stages, without Prefect. Reuses what is in OUT. Writes `benchmarks/results/budget.json` and
`.md`, where other captures keep their results.
"""

import json
import shutil
from concurrent.futures import Future, ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch
from provenance import RESULTS, SHARED, arguments, log_progress, provenance, provenance_line, table, write_result

from hnerf.avatar.finished import recording_of
from hnerf.body.fit_result import BodyFit
from hnerf.capture.capture import Capture
from hnerf.capture.masks import Masks
from hnerf.config import TrainingSettings, load_settings, overridden
from hnerf.evaluation.ground_truth import truth_of
from hnerf.study.benchmark.plan import ScoringSettings
from hnerf.study.benchmark.scoring import ScoringScene, score
from hnerf.tables import pick, shown
from hnerf.training.auto_settings import SceneStatistics, decide
from hnerf.training.trainer import train

CAPTURES = ["valid-wave", "valid-walk", "valid-turn-mono"]
DECIDED = "as decided"
SEEDS = (1, 2)  # besides the first, 0
PARTS = {
    "cells": ("field.geometry_cells", "field.colour_cells"),
    "spacing": ("field.spacing_m",),
    "nodes": ("field.nodes",),
    "pose code": ("field.pose_width",),
    "layer width": ("field.width",),
    "rays": ("rays_per_frame",),
    "steps": ("steps",),
    "steps on novel frames": ("novel_pose_steps",),
}
COLUMNS = {  # by name in the results: place among the scores, title and format
    "training_s": ("training.seconds", "training, s", "{:.0f}"),
    "model_mib": ("training.model_mib", "model, MiB", "{:.1f}"),
    "peak_memory_gib": ("training.peak_memory_gib", "memory, GiB", "{:.1f}"),
    "frame_256_s": ("frame_seconds.256", "256 px frame, s", "{:.2f}"),
    "novel_view_psnr": ("novel_view.psnr", "PSNR", "{:.2f}"),
    "novel_pose_psnr": ("novel_pose.psnr", "animated", "{:.2f}"),
    "tracked_psnr": ("novel_pose_tracked.psnr", "tracked", "{:.2f}"),
    "chamfer_l2_e3": ("novel_view.geometry.chamfer_l2_e3", "Chamfer", "{:.3f}"),
}
SCORING = ScoringSettings(images=8, meshes=1, snapshot_images=1, snapshot_meshes=0, frame_sizes_px=(256,))


def main() -> None:
    """Train and score all variants of all captures, print and write."""
    parser = arguments(__doc__)
    parser.add_argument("store", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("captures", nargs="*", default=CAPTURES, metavar="CAPTURE")
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--at-once", type=int, default=1, metavar="N", help="trainings at a time (default: 1)")
    options = parser.parse_args()
    where, found = provenance(), RESULTS / "budget.json"
    where |= {"preset": options.preset, "at_once": options.at_once}
    captures = json.loads(found.read_text())["captures"] if found.exists() else {}
    settings = load_settings(options.preset).training
    with ProcessPoolExecutor(
        options.at_once,
        get_context("spawn"),
        initializer=start_process,
        max_tasks_per_child=1,  # peak memory is that of a process, and of one training
    ) as processes:
        subjects = {name: options.store / "subjects" / name for name in options.captures}
        started = {name: start(subject, settings, options.out, processes) for name, subject in subjects.items()}
        for name, trainings in started.items():
            captures[name] = where | measure(trainings, options.out / name)
            write_result("budget", {"captures": captures}, as_markdown(captures))


def start_process() -> None:
    """Prepare a process that shares the machine's cores with others."""
    torch.set_num_threads(1)
    log_progress()


def start(subject: Path, settings: TrainingSettings, out: Path, processes: ProcessPoolExecutor) -> dict[str, Future]:
    """Start the trainings of a subject; return their scores to come, by variant."""
    decided = decide(SceneStatistics.of(*prepared(subject)), settings)[0]
    variants = {DECIDED: settings}
    variants |= {f"{DECIDED}, seed {seed}": decided.model_copy(update={"seed": seed}) for seed in SEEDS}
    for part, keys in PARTS.items():
        variants |= {f"{name} the {part}": scaled(decided, keys, by) for name, by in (("twice", 2.0), ("half", 0.5))}
    return {
        name: processes.submit(train_and_score, subject, training, out / subject.name / name)
        for name, training in variants.items()
        if training != decided  # a subject may have no nodes
    }


def measure(trainings: dict[str, Future], out: Path) -> dict[str, Any]:
    """Return a subject's automatic settings with their reasons, and the scores of each variant."""
    found = {name: training.result() for name, training in trainings.items()}
    figures = {name: {key: pick(f, place) for key, (place, *_) in COLUMNS.items()} for name, f in found.items()}
    stored = json.loads((out / DECIDED / "training" / "settings.json").read_text())
    return {"decisions": stored["decisions"], "variants": figures}


def train_and_score(subject: Path, settings: TrainingSettings, out: Path) -> dict[str, Any]:
    """Return the scores of a training, unless they are in `out` already."""
    training, scored = out / "training", out / "scores" / "scores.json"
    if not scored.exists():
        capture, masks, body = prepared(subject)
        training.mkdir(parents=True, exist_ok=True)
        train(capture, masks, body, settings, training)  # goes on where it stopped
        truth = truth_of(SHARED / "data" / subject.name, capture)
        shutil.rmtree(scored.parent, ignore_errors=True)
        scored.parent.mkdir()
        score(ScoringScene(capture, body, truth), training, SCORING, scored.parent)
    return dict(json.loads(scored.read_text()))


def prepared(subject: Path) -> tuple[Capture, Masks, BodyFit]:
    """Return the recording with calibrated cameras, the masks and the body fit of a store's subject."""
    return recording_of(subject), Masks.load(subject / "segmentation"), BodyFit.load(subject / "fit")


def scaled(training: TrainingSettings, keys: tuple[str, ...], factor: float) -> TrainingSettings:
    """Return the settings with these values times `factor`; of grids, their numbers of cells in the volume."""
    decided, side, changes = training.model_dump(), float(np.cbrt(factor)), []
    for key in keys:
        value = pick(decided, key)
        if isinstance(value, tuple):
            changed: Any = [round(side * n) for n in value]
        elif isinstance(value, float):
            changed = factor * value
        else:
            changed = max(round(factor * value), min(value, 1))  # settings that are 0 would be chosen from the scene
        changes.append(f"{key}={changed}")
    return overridden(training, changes)


def as_markdown(captures: dict[str, Any]) -> str:
    """Format a section for each capture: automatic settings with reasons, then a table of the variants."""
    lines = ["# Settings chosen from the scene"]
    for name, found in captures.items():
        decisions = [[key, f"{d['value']}", d["reason"]] for key, d in found["decisions"].items()]
        how = f"Preset `{found['preset']}`; trainings at a time, which lengthens their seconds: {found['at_once']}."
        lines += ["", f"## {name}", "", provenance_line(found), "", how]
        lines += ["", *table([["setting", "value", "reason"], *decisions]), ""]
        titles = ["", *(title for _, title, _ in COLUMNS.values())]
        lines += table([titles, *([title, *cells(row)] for title, row in found["variants"].items())])
    return "\n".join([*lines, ""])


def cells(row: dict[str, Any]) -> list[str]:
    """Format a variant's scores as table cells."""
    return [shown(row.get(key), form) for key, (*_, form) in COLUMNS.items()]


if __name__ == "__main__":
    main()
