"""Ablations: a training and an evaluation for every file in `configs/ablations/`.

A file holds the settings in which its row differs from the preset. The store lets all rows share the stages whose
settings they do not change, and reuses finished rows.
"""

import json
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from prefect import flow

from flows.arguments import StoreFolder
from flows.preparation import check_presets, ingest_recording, prepare_training, with_detections
from flows.run_page import publish_markdown, shown_progress
from hnerf.capture.capture import Capture
from hnerf.config import CONFIGS, Settings, load_settings, read_yaml, title_of, with_changes
from hnerf.errors import InputError, one_line
from hnerf.files import replace_text
from hnerf.study.benchmark import results
from hnerf.tables import pick, table
from tasks.evaluation import evaluate
from tasks.policy import is_of_the_machine
from tasks.source import Source, read_capture
from tasks.stage import retried
from tasks.store import Store
from tasks.training import train

log = logging.getLogger("hnerf.ablations")

ABLATIONS = CONFIGS / "ablations"
FULL = "full"
COLUMNS = results.COLUMNS | {"psnr": ("PSNR", "{:.2f}")}


@flow(name="ablate", flow_run_name="{capture}-{preset}")
@shown_progress()
def ablate(
    capture: Path,
    preset: str = "fast",
    store: StoreFolder = Path("store"),
    overrides: Sequence[str] = (),
    only: Sequence[str] = (),
) -> Path:
    """Run the full method and each ablation; return the table, `<store>/ablations/<subject>-<preset>.md`. There is a
    JSON file next to it; both are rewritten after every row.

    If a row's training or evaluation fails, the row says why and the others continue. A worker that was killed
    (LostWorkerError) ends the command, and the same command resumes.

    Args:
        capture: The recording's folder, or one video; relative to the repository.
        preset: A name under configs/, or a YAML file.
        store: Folder of results.
        overrides: Settings that differ from the preset in all rows, like training.steps=100.
        only: Names of ablations, all if empty; the table's name then ends in "-part".
    """
    rows, left_out = choose(load_settings(preset, overrides), only)
    artifact_store = Store(store.resolve())
    source, truth = retried(read_capture)(capture, store)
    subject = Capture.load(ingest_recording(artifact_store, source, rows[FULL]).root).name
    table = artifact_store.root / "ablations" / f"{subject}-{title_of(preset)}{'-part' if only else ''}.md"
    artifact_store.claim_table(table, source.digest, source.root)
    result: dict[str, Any] = {"subject": subject, "preset": preset, "overrides": overrides, "left_out": left_out}
    result["rows"] = {}
    for name, settings in rows.items():
        log.info("%s", name)
        result["rows"][name] = measure(artifact_store, source, truth, settings)
        replace_text(table.with_suffix(".json"), json.dumps(result, indent=1) + "\n")
        replace_text(table, as_markdown(result))
    publish_markdown(table.read_text(), "ablations", f"What each part of {preset} is worth on {subject}")
    return table


def choose(full: Settings, only: Sequence[str]) -> tuple[dict[str, Settings], dict[str, str]]:
    """Return the settings of each row, the full method first, and why other ablations have no row. Raises InputError
    for unknown names, and for settings that no study accepts."""
    known = {path.stem: path for path in sorted(ABLATIONS.glob("*.yaml"))}
    unknown = sorted(set(only) - set(known))
    if unknown:
        raise InputError(f"--only {unknown[0]}: no such ablation; there are {', '.join(known)}")
    rows, left_out = {FULL: full}, {}
    for name in only or known:
        kind = pick(read_yaml(known[name]), "training.field.kind")
        if kind not in (None, full.training.field.kind):
            left_out[name] = f"the {full.training.field.kind} field has no such part"
        elif (settings := with_changes(full, known[name])) == full:
            left_out[name] = "off already"
        else:
            rows[name] = settings
    check_presets(rows.values())
    return rows, left_out


def measure(store: Store, source: Source, truth: Source, settings: Settings) -> dict[str, Any]:
    """Return a row: the scores of every split, and the seconds and device of its training; {"error": one line} if it
    fails."""
    recording = with_detections(store, ingest_recording(store, source, settings), settings)
    prepared = prepare_training(store, recording, settings)
    try:
        training = train(store, *prepared, settings.training)
        evaluation = evaluate(store, truth, *prepared, training, settings.evaluation)
    except Exception as error:  # it is a result that a method breaks without a part
        if is_of_the_machine(error):
            raise
        log.warning("%s: %s", type(error).__name__, error)
        return {"error": one_line(error)}
    metrics = json.loads((evaluation.root / "metrics.json").read_text())
    trained = json.loads((training.root / "report.json").read_text())
    return {key: trained[key] for key in ("seconds", "device")} | {
        key: metrics[key] for key in ("protocol", *results.SPLITS)
    }


def as_markdown(result: dict[str, Any]) -> str:
    """Format one row per run, then the ablations that were left out, then the protocol."""
    with_overrides = f" with {', '.join(result['overrides'])}" if result["overrides"] else ""
    titles = ["", *(title for title, _ in COLUMNS.values()), "training, s", "on"]
    lines = [f"# Ablations of {result['subject']}, preset `{result['preset']}`{with_overrides}", ""]
    lines += [results.CELL_LEGEND, ""]
    lines += table([titles, *([name, *_cells(row)] for name, row in result["rows"].items())])
    if result["left_out"]:
        lines += ["", "Left out:", "", *(f"- {name}: {reason}" for name, reason in result["left_out"].items())]
    found = [row for row in result["rows"].values() if "error" not in row]
    reasons = {reason: None for row in found for reason in results.missing_figures(row)}
    lines += ["", *(f"- {reason}" for reason in reasons)] if reasons else []
    protocols = {row["protocol"] for row in found}
    return "\n".join([*lines, "", *sorted(protocols), ""])


def _cells(row: dict[str, Any]) -> list[str]:
    if "error" in row:
        return [row["error"]]
    scores = [results.cell(row, key, form) for key, (_, form) in COLUMNS.items()]
    return [*scores, f"{row['seconds']:.0f}", row["device"]]
