"""Benchmark flow: methods trained on the same data, scored during training, timed, and charted."""

import json
import logging
from pathlib import Path
from typing import Annotated, Any

from prefect import flow
from pydantic import Field

from flows.arguments import StoreFolder
from flows.preparation import Prepared, check_presets, ingest_part, ingest_recording, prepare_training
from flows.run_page import publish_markdown, shown_progress
from hnerf.capture.capture import Capture
from hnerf.config import Settings, title_of
from hnerf.errors import InputError, one_line
from hnerf.evaluation.ground_truth import truth_of
from hnerf.files import embed_images
from hnerf.study.benchmark.convergence import is_flat, training_limits_s
from hnerf.study.benchmark.plan import BenchmarkStudy, Variant, load_study
from hnerf.study.benchmark.publish import publish, table_path
from tasks.benchmark import score_end_of_training, score_training
from tasks.calibration import calibrated_capture
from tasks.policy import is_of_the_machine
from tasks.source import GROUND_TRUTH, Source, read_capture
from tasks.stage import retried
from tasks.store import Store
from tasks.training import train

log = logging.getLogger("hnerf.benchmark")


@flow(name="benchmark", flow_run_name="{capture}-{study}")
@shown_progress()
def benchmark(
    capture: Path,
    study: str = "dynamic",
    methods: list[str] | None = None,
    seconds: Annotated[float, Field(gt=0)] | None = None,
    store: StoreFolder = Path("store"),
) -> Path:
    """Train and score every method of a study on every variant; return `<store>/benchmark/<subject>-<study>.md`. CSV,
    JSON and charts are next to it; all are rewritten after every training.

    If a method fails, its row says why and the others continue. A worker that was killed ends the flow, and the same
    call resumes the training that was interrupted.

    Args:
        capture: The recording's folder, or one video; relative to the repository.
        study: A name under configs/benchmark/, or a YAML file.
        methods: Methods of the study, or presets, instead of all; the table's name then ends in "-part".
        seconds: Time limit of every training, instead of the study's; the table's name then ends in "-part".
        store: Folder of results.
    """
    whole = load_study(study)
    plan = whole.restricted_to(methods or [], seconds)
    presets = [plan.settings(name) for name in plan.methods]  # invalid presets are refused first
    check_presets(presets)
    artifact_store = Store(store.resolve())
    source, truth = retried(read_capture)(capture, store)
    recorded = Capture.load(ingest_recording(artifact_store, source, presets[0]).root)
    if plan.until_flat and not (recorded.test_cameras and truth_of(truth.root, recorded).has_masks):
        raise InputError(
            f"{recorded.name}: no image can be scored, so no curve can become flat; add test cameras with masks, or "
            f"{GROUND_TRUTH}/masks, or choose another study"
        )
    part = plan != whole.restricted_to([], None)
    result, table = empty_result(plan, title_of(study), part, recorded), None
    artifact_store.claim_table(table_path(result, artifact_store.root), source.digest, source.root)
    for title, entry in result["variants"].items():
        variant = plan.variants[title]
        for name in () if "left_out" in entry else variant.methods or plan.methods:
            log.info("%s: %s", title, name)
            entry["methods"][name] = measure(artifact_store, source, truth, variant, plan, name)
            table = publish(result, artifact_store.root)  # an earlier call's files stay until the first result
    table = table or publish(result, artifact_store.root)  # if every variant is left out
    publish_markdown(embed_images(table), "benchmark", f"Speed against accuracy: {table.stem}")
    return table


def empty_result(plan: BenchmarkStudy, study: str, part: bool, recorded: Capture) -> dict[str, Any]:
    """Return a result without scores, in the format of hnerf/study/benchmark/results.py."""
    described = plan.model_dump(include={"title", "notes", "claims", "seconds", "until_flat", "sweep", "methods"})
    variants = {title: describe_variant(variant, recorded) for title, variant in plan.variants.items()}
    named = {"subject": recorded.name, "study": study, "part": part}
    return named | described | {"own": plan.own_methods(), "variants": variants}


def describe_variant(variant: Variant, recorded: Capture) -> dict[str, Any]:
    """Return how many cameras and frames a variant trains on, or, if the capture has too few, why it is left out."""
    try:
        cameras, frames, _ = variant.select(recorded)
    except InputError as error:
        return {"left_out": str(error)}
    counts = {"cameras": len(cameras or recorded.train_cameras), "frames": len(frames or recorded.train_frames)}
    return counts | {"methods": {}}


def measure(
    store: Store, source: Source, truth: Source, variant: Variant, plan: BenchmarkStudy, method: str
) -> dict[str, Any]:
    """Return a method's scores on a variant and the folder of their files in the store; {"error": one line} if it
    fails."""
    try:
        settings, more = plan.settings(method), dict[str, Any]()
        recording = ingest_part(store, source, variant, settings)
        prepared = prepare_training(store, recording, settings)
        if plan.until_flat:
            settings, more = train_until_flat(store, truth, prepared, plan, method)
        training = train(store, *prepared, settings.training)
        scores = score_training(store, truth, recording, prepared.calibration, prepared.body, training, plan.scoring)
    except Exception as error:  # one method's failure must not end the others
        if is_of_the_machine(error):
            raise
        log.warning("%s: %s", type(error).__name__, error)
        return {"error": one_line(error)}
    found: dict[str, Any] = json.loads((scores.root / "scores.json").read_text())
    taken = calibrated_capture(recording, prepared.calibration)
    counts = {"cameras": len(taken.train_cameras), "frames": len(taken.train_frames)}
    return found | more | {"trained_on": counts, "folder": str(scores.root.relative_to(store.root))}


def train_until_flat(
    store: Store, truth: Source, prepared: Prepared, plan: BenchmarkStudy, method: str
) -> tuple[Settings, dict[str, Any]]:
    """Train for longer and longer. Return the settings of the last training, the curve of all trainings, and why there
    is no longer one. A training that fails adds no point, since it may be too short for a surface; if the longest
    fails, its error is raised."""
    assert plan.seconds is not None
    recording, calibration, _, body = prepared
    points: list[dict[str, Any]] = []
    limits_s = training_limits_s(plan.seconds)
    for limit_s in limits_s:
        settings, ended = plan.settings(method, limit_s), "limit"
        try:
            training = train(store, *prepared, settings.training)
            point = score_end_of_training(store, truth, recording, calibration, body, training, plan.scoring)
        except Exception as error:
            if is_of_the_machine(error) or limit_s == limits_s[-1]:  # the longest would only be trained again
                raise
            log.warning("after %g s: %s", limit_s, one_line(error))
            continue
        found = json.loads((point.root / "scores.json").read_text())
        points += found["curve"]
        if found["training"]["field_seconds"] < limit_s:
            ended = "steps"
        elif is_flat([(row["seconds"], row["psnr"]) for row in points if row["psnr"] is not None]):
            ended = "flat"
        if ended != "limit":
            break
    return settings, {"curve": points, "ended": ended}
