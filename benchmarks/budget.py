"""Test the automatic settings: train with twice and half the decided model size, or number of steps.

usage: python benchmarks/budget.py STORE [CAPTURE ...]

Trains preset `fast` on shared captures (default: the three rendered ones) with the settings that
hnerf/training/auto_settings.py chooses; then with twice and half the number of grid cells, samples a ray and nodes;
then with twice and half the steps. Everything else stays. Scores a few held-out images by the evaluation protocol.
Reuses what is in STORE. Writes `benchmarks/results/budget.json` and `.md`, where other captures keep their results.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
from provenance import RESULTS, SHARED, provenance, provenance_line, store_and_captures, table, write_result

from flows.preparation import prepare_training
from hnerf.config import Settings, TrainingSettings, load_settings
from hnerf.study.benchmark.plan import ScoringSettings
from tasks.benchmark import score_training
from tasks.capture import ingest
from tasks.source import read_capture
from tasks.store import Store
from tasks.training import train

CAPTURES = ["valid-wave", "valid-walk", "valid-turn-mono"]
DECIDED = "as decided"
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
    for name, training in {
        "twice the size": resized(decided, 2.0),
        "half the size": resized(decided, 0.5),
        "twice the steps": decided.model_copy(update={"steps": 2 * decided.steps}),
        "half the steps": decided.model_copy(update={"steps": decided.steps // 2}),
    }.items():
        variants[name] = train_and_score(folder, store, settings.model_copy(update={"training": training}))[1]
    reasons = variants[DECIDED].pop("decisions")
    return {"decisions": reasons, "variants": {name: figures(found) for name, found in variants.items()}}


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


def resized(training: TrainingSettings, factor: float) -> TrainingSettings:
    """Return the settings with `factor` times as many cells, samples per ray, and nodes that deform the body."""
    field, side = training.field, float(np.cbrt(factor))
    changes = {
        "colour_cells": tuple(round(side * n) for n in field.colour_cells),
        "geometry_cells": tuple(round(side * n) for n in field.geometry_cells),
        "samples": round(factor * field.samples),
        "nodes": round(factor * field.nodes),
    }
    return training.model_copy(update={"field": field.model_copy(update=changes)})


def figures(found: dict[str, Any]) -> dict[str, Any]:
    """Return the scores of a variant that are shown in the table."""
    report, view, pose = found["training"], found["novel_view"], found["novel_pose"]
    geometry = view["geometry"] or {}
    return {
        "training_s": report["seconds"],
        "model_mib": report["model_mib"],
        "peak_memory_gib": report["peak_memory_gib"],
        "frame_256_s": found["frame_seconds"]["256"],
        "novel_view_psnr": view["psnr"],
        "novel_pose_psnr": pose["psnr"],
        "chamfer_l2_e3": geometry.get("chamfer_l2_e3"),
    }


def as_markdown(captures: dict[str, Any]) -> str:
    """Format a section for each capture: automatic settings with reasons, then a table of the variants."""
    lines = ["# Settings chosen from the scene"]
    for name, found in captures.items():
        decisions = [[key, f"{d['value']}", d["reason"]] for key, d in found["decisions"].items()]
        lines += ["", f"## {name}", "", provenance_line(found)]
        lines += ["", *table([["setting", "value", "reason"], *decisions]), ""]
        titles = ["", "training, s", "model, MiB", "memory, GiB", "256 px frame, s", "PSNR", "animated", "Chamfer"]
        lines += table([titles, *([title, *cells(row)] for title, row in found["variants"].items())])
    return "\n".join([*lines, ""])


def cells(row: dict[str, Any]) -> list[str]:
    """Format a variant's scores as table cells."""
    forms = ("{:.0f}", "{:.1f}", "{:.1f}", "{:.2f}", "{:.2f}", "{:.2f}", "{:.3f}")
    return ["-" if v is None else form.format(v) for v, form in zip(row.values(), forms, strict=True)]


if __name__ == "__main__":
    main()
