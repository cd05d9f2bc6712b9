"""Test the automatic settings: train with twice and half of each.

usage: python benchmarks/budget.py STORE [CAPTURE ...]

Trains preset `fast` on shared captures (default: the three rendered ones) with the settings that
hnerf/training/auto_settings.py chooses, three times with different seeds; then with twice and half of one setting at a
time: cells of the grids, samples a ray, nodes, width of the pose code and of the layers, rays a step, steps, and steps
on novel frames. Scores a few held-out images by the evaluation protocol. Reuses what is in STORE. Writes
`benchmarks/results/budget.json` and `.md`, where other captures keep their results.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
from provenance import RESULTS, SHARED, provenance, provenance_line, store_and_captures, table, write_result

from flows.preparation import prepare_training
from hnerf.config import Settings, TrainingSettings, load_settings, overridden
from hnerf.study.benchmark.plan import ScoringSettings
from hnerf.tables import pick, shown
from tasks.benchmark import score_training
from tasks.capture import ingest
from tasks.source import read_capture
from tasks.store import Store
from tasks.training import train

CAPTURES = ["valid-wave", "valid-walk", "valid-turn-mono"]
DECIDED = "as decided"
SEEDS = (1, 2)  # besides the first, 0
PARTS = {
    "cells": ("field.geometry_cells", "field.colour_cells"),
    "samples": ("field.samples",),
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
    options = store_and_captures(__doc__, CAPTURES)
    where, found = provenance(), RESULTS / "budget.json"
    captures = json.loads(found.read_text())["captures"] if found.exists() else {}
    for name in options.captures:
        captures[name] = where | measure(SHARED / "data" / name, Store(options.store.resolve()))
        write_result("budget", {"captures": captures}, as_markdown(captures))


def measure(folder: Path, store: Store) -> dict[str, Any]:
    """Return the automatic settings for a capture with their reasons, and the scores of each variant."""
    settings = load_settings("fast")
    decided, scores = train_and_score(folder, store, settings)
    variants = {DECIDED: scores}
    changed = {f"{DECIDED}, seed {seed}": decided.model_copy(update={"seed": seed}) for seed in SEEDS}
    for part, keys in PARTS.items():
        changed |= {f"{name} the {part}": scaled(decided, keys, by) for name, by in (("twice", 2.0), ("half", 0.5))}
    for name, training in changed.items():
        if training != decided:  # a capture may have no nodes
            variants[name] = train_and_score(folder, store, settings.model_copy(update={"training": training}))[1]
    reasons = variants[DECIDED].pop("decisions")
    figures = {name: {key: pick(f, place) for key, (place, *_) in COLUMNS.items()} for name, f in variants.items()}
    return {"decisions": reasons, "variants": figures}


def train_and_score(folder: Path, store: Store, settings: Settings) -> tuple[TrainingSettings, dict[str, Any]]:
    """Return the training's settings with all automatic ones filled in, and its scores, together with the reasons for
    these settings."""
    source, truth = read_capture(folder)
    recording = ingest(store, source, settings.capture)
    prepared = prepare_training(store, recording, settings)
    model = train(store, *prepared, settings.training)
    scores = score_training(store, truth, recording, prepared.calibration, prepared.body, model, SCORING)
    stored = json.loads((model.root / "settings.json").read_text())
    found = json.loads((scores.root / "scores.json").read_text())
    return TrainingSettings.model_validate(stored["training"]), found | {"decisions": stored["decisions"]}


def scaled(training: TrainingSettings, keys: tuple[str, ...], factor: float) -> TrainingSettings:
    """Return the settings with these values times `factor`; of grids, their numbers of cells in the volume."""
    decided, side, changes = training.model_dump(), float(np.cbrt(factor)), []
    for key in keys:
        value = pick(decided, key)
        cells = isinstance(value, tuple)
        # Settings that are 0 would be chosen from the scene.
        changed = [round(side * n) for n in value] if cells else max(round(factor * value), min(value, 1))
        changes.append(f"{key}={changed}")
    return overridden(training, changes)


def as_markdown(captures: dict[str, Any]) -> str:
    """Format a section for each capture: automatic settings with reasons, then a table of the variants."""
    lines = ["# Settings chosen from the scene"]
    for name, found in captures.items():
        decisions = [[key, f"{d['value']}", d["reason"]] for key, d in found["decisions"].items()]
        lines += ["", f"## {name}", "", provenance_line(found)]
        lines += ["", *table([["setting", "value", "reason"], *decisions]), ""]
        titles = ["", *(title for _, title, _ in COLUMNS.values())]
        lines += table([titles, *([title, *cells(row)] for title, row in found["variants"].items())])
    return "\n".join([*lines, ""])


def cells(row: dict[str, Any]) -> list[str]:
    """Format a variant's scores as table cells."""
    return [shown(row.get(key), form) for key, (*_, form) in COLUMNS.items()]


if __name__ == "__main__":
    main()
