"""Where each method breaks: the same capture, made worse in one way at a time."""

import contextlib
import json
import logging
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from prefect import flow

from flows.run_page import publish_markdown
from flows.train_subject import prepared
from hnerf.capture.capture import Capture
from hnerf.config import Settings, load_settings
from hnerf.errors import InputError, NotApplicableError, one_line
from hnerf.evaluation.columns import reason_without_novel_poses
from hnerf.evaluation.views import ANIMATED, NOVEL_VIEW, POSED, TRACKED
from hnerf.files import replace_text, with_pictures
from hnerf.study.degradations.catalogue import KINDS, Degradation, degrade_settings
from hnerf.study.stability.charts import curve_chart, matrix_chart
from hnerf.study.stability.plan import StabilityStudy, load_stability
from hnerf.study.stability.report import REFERENCE, as_markdown
from hnerf.study.stability.verdict import BROKEN, RunVerdict, judge, near_border
from tasks.capture import ingest, subset_capture
from tasks.evaluation import evaluate
from tasks.fit import fit
from tasks.policy import is_retryable
from tasks.source import Source, read_capture
from tasks.store import Artifact, Store
from tasks.study import (
    check_meshes,
    degrade_capture,
    degrade_clothing,
    degrade_fit,
    degrade_masks,
    show_in_extreme_poses,
)
from tasks.training import train

log = logging.getLogger("hnerf.stability")

Figures = dict[str, Any]
IMAGE_FIGURES = ("psnr", "ssim", "empty_psnr", "posed_psnr", "tracked_psnr")


@flow(name="stability", flow_run_name="{capture}")
def stability(
    capture: Path,
    study: str = "full",
    store: Path = Path("store"),
    methods: Sequence[str] = (),
    only: Sequence[str] = (),
) -> Path:
    """Run each method on a capture made worse in every way that a study names; returns the table,
    `<store>/stability/<subject>-<study>.md`, which has JSON beside it, both written anew after every run, and charts
    when it ends, however it ends.

    study: a name under configs/stability/ or a YAML file; methods: presets in place of the study's; only: names of
    degradations, whose table's name ends in "-part". A failure is a result and the rest go on; a worker that was killed
    (LostWorkerError) ends the command, and the same command goes on from there.
    """
    plan = load_stability(study).restricted_to(only)
    plan = plan.model_copy(update={"methods": tuple(methods)}) if methods else plan
    presets = {name: load_settings(name, plan.overrides) for name in plan.methods}
    artifact_store = Store(store.resolve())
    source, truth = read_capture(capture, store)
    subject = Capture.load(recorded(artifact_store, source, plan, next(iter(presets.values()))).root).name
    table = artifact_store.root / "stability" / f"{subject}-{Path(study).stem}{'-part' if only else ''}.md"
    table.parent.mkdir(parents=True, exist_ok=True)
    result: Figures = {"subject": subject, "study": study, "plan": plan.model_dump(mode="json")}
    result |= {"left_out": plan.left_out(), "protocol": None, "runs": []}
    try:
        for run in _runs(artifact_store, source, truth, plan, presets):
            if "left_out" in run:
                if run["left_out"] not in result["left_out"]:  # every method and seed says so
                    result["left_out"].append(run["left_out"])
                continue
            result["protocol"] = run.pop("protocol", None) or result["protocol"]
            result["runs"].append(run)
            _tell(result, [], table)
    except BaseException:  # Ctrl-C, too
        if result["runs"]:
            with contextlib.suppress(Exception):  # which would hide what ended the study
                _tell(result, _draw(result, table), table)
        raise
    _tell(result, _draw(result, table), table)
    publish_markdown(with_pictures(table), "stability", f"Where methods break on {subject}")
    return table


def _runs(
    store: Store, source: Source, truth: Source, plan: StabilityStudy, presets: dict[str, Settings]
) -> Iterator[Figures]:
    """Every run's row: its method, degradation and verdict, and figures where there are any; or {"left_out": what and
    why}."""
    tried = [(kind, strength) for kind, strengths in plan.degradations.items() for strength in strengths]
    for method, preset in presets.items():
        recording = recorded(store, source, plan, preset)
        near = set()
        for seed in plan.seeds:
            for run in _runs_of_seed(store, recording, truth, method, preset, seed, tried):
                if run.get("near_border"):
                    near.add((run["kind"], run["strength"]))
                yield run
        for seed in plan.border_seeds if near else ():
            yield from _runs_of_seed(store, recording, truth, method, preset, seed, [at for at in tried if at in near])


def _runs_of_seed(
    store: Store,
    recording: Artifact,
    truth: Source,
    method: str,
    preset: Settings,
    seed: int,
    tried: Sequence[tuple[str, float]],
) -> Iterator[Figures]:
    """The run to compare with, and, unless that broke, a run for each kind and strength."""
    settings = preset.model_copy(update={"training": preset.training.model_copy(update={"seed": seed})})
    log.info("%s, seed %d, as recorded", method, seed)
    good = attempt(store, recording, truth, settings, None)
    row = {"method": method, "seed": seed}
    reference = row | {"kind": REFERENCE, "strength": None} | judged(good, good)
    yield reference
    for kind, strength in tried if reference["verdict"] not in BROKEN else ():
        log.info("%s, seed %d, %s: %g", method, seed, KINDS[kind].label, strength)
        found = attempt(store, recording, truth, settings, Degradation(kind=kind, strength=strength, seed=seed))
        if "left_out" in found:
            yield {"left_out": f"{KINDS[kind].label}, {strength:g}: {found['left_out']}"}
            continue
        yield row | {"kind": kind, "strength": strength} | judged(found, good)


def recorded(store: Store, source: Source, plan: StabilityStudy, settings: Settings) -> Artifact:
    """The recording, or that part of it which stands for all."""
    recording = ingest(store, source, settings.capture)
    parts = plan.part.select(Capture.load(recording.root))
    return recording if parts == (None, None, None) else subset_capture(store, recording, *parts)


def judged(found: Figures, good: Figures) -> Figures:
    """RunVerdict, whether it is near a border, and means over the images and surfaces that both runs have, None where
    there are none; those of the good run as "reference"."""
    row: Figures = {}
    near = False
    if "error" in found:
        verdict = RunVerdict(*found["error"])
    elif "images" not in found:
        verdict = judge(None, {}, found["faults"])
    else:
        row, reference = in_common(found, good), in_common(good, found)
        verdict = judge(row, reference, found["faults"])
        near = near_border(row, reference, found["faults"])
        row |= {"reference": reference, "protocol": found["protocol"], "seconds": found["seconds"]}
    return row | {"verdict": verdict.verdict, "reason": verdict.reason, "near_border": near}


def in_common(one: Figures, other: Figures) -> Figures:
    """Means of one run's figures over the images and surfaces that the other has as well, and how many these are."""
    images = [score for view, score in one["images"].items() if view in other["images"]]
    surfaces = [chamfer_mm for frame, chamfer_mm in one["surfaces"].items() if frame in other["surfaces"]]
    known = {key: [s[key] for s in images if s.get(key) is not None] for key in IMAGE_FIGURES}
    means = {key: float(np.mean(values)) if values else None for key, values in known.items()}
    means["chamfer_mm"] = float(np.mean(surfaces)) if surfaces else None
    return means | {"images": len(images), "surfaces": len(surfaces)}


def attempt(
    store: Store, recording: Artifact, truth: Source, settings: Settings, degradation: Degradation | None
) -> Figures:
    """What `measure` found, or {"error": (verdict, reason)}: bad input that was told before or by training is refused,
    anything else that went wrong has failed; or {"left_out": reason} where the capture does not allow it to be
    tried."""
    at_bad_input = "refused"
    try:
        stages = prepare(store, recording, truth, settings, degradation)
        training = settings.training
        if degradation and KINDS[degradation.kind].target == "settings":
            training = degrade_settings(training, degradation)
        model = train(store, *stages, training)
        at_bad_input = "failed"
        return measure(store, recording, truth, settings, degradation, stages, model)
    except NotApplicableError as error:
        return {"left_out": str(error)}
    except InputError as error:
        return {"error": (at_bad_input, str(error))}
    except Exception as error:  # whatever breaks is what the study is after
        if is_retryable(error):
            raise  # a full disk, a lost share, a killed worker
        log.warning("%s: %s", type(error).__name__, error)
        return {"error": ("failed", one_line(error))}


def prepare(
    store: Store, recording: Artifact, truth: Source, settings: Settings, degradation: Degradation | None
) -> tuple[Artifact, Artifact, Artifact, Artifact]:
    """Capture, calibration, masks and body, made worse at the degradation's place."""
    target = KINDS[degradation.kind].target if degradation else None
    if degradation and target == "capture":
        recording = degrade_capture(store, recording, degradation)
    recording, calibration, masks, body = prepared(store, recording, settings)
    if degradation and target == "clothing":
        recording = degrade_clothing(store, truth, recording, calibration, body, degradation)
        return prepared(store, recording, settings)
    if degradation and target == "masks":
        masks = degrade_masks(store, recording, calibration, masks, degradation)
        body = fit(store, recording, calibration, masks, settings.fit)
    if degradation and target == "fit":
        body = degrade_fit(store, body, degradation)
    return recording, calibration, masks, body


def measure(
    store: Store,
    recording: Artifact,
    truth: Source,
    settings: Settings,
    degradation: Degradation | None,
    stages: tuple[Artifact, Artifact, Artifact, Artifact],
    model: Artifact,
) -> Figures:
    """Faults of surfaces; figures of each image and the Chamfer distance of each surface against the truth, as far as
    there is one, of novel poses, animated, or of training poses where the capture as recorded or the method has no
    others. Of extreme poses faults alone. A fit that was made worse is trained on; novel poses are shown as the good
    one has them."""
    no_poses = reason_without_novel_poses(model.root)
    if degradation and KINDS[degradation.kind].target == "poses":
        if no_poses:
            raise NotApplicableError(no_poses)
        return {"faults": _faults(show_in_extreme_poses(store, model, degradation))}
    *_, good_body = prepare(store, recording, truth, settings, None)
    if degradation and KINDS[degradation.kind].target == "clothing":
        _, truth = read_capture(stages[0].root)
    recorded, calibration, masks, body = stages
    if degradation and KINDS[degradation.kind].target == "fit":
        body = good_body
    report = evaluate(store, truth, recorded, calibration, masks, body, model, settings.evaluation)
    metrics = json.loads((report.root / "metrics.json").read_text())
    novel = Capture.load(recording.root).novel_pose_frames and not no_poses
    split = ANIMATED if novel else NOVEL_VIEW
    surfaces = (metrics[split]["geometry"] or {"per_surface": []})["per_surface"]
    return {
        "images": _images(metrics, split),
        "surfaces": {surface["frame"]: surface["chamfer_mm"] for surface in surfaces},
        "faults": _faults(check_meshes(store, report, good_body)),
        "protocol": metrics["protocol"],
        "seconds": json.loads((model.root / "report.json").read_text())["seconds"],
    }


def _images(metrics: Figures, split: str) -> dict[tuple[str, int], Figures]:
    """Figures of each image by camera and frame; of animated poses also what they have posed and tracked."""
    images = {(row["camera"], row["frame"]): dict(row) for row in metrics[split]["per_image"]}
    others = {"posed_psnr": POSED, "tracked_psnr": TRACKED} if split == ANIMATED else {}
    for key, other in others.items():
        for row in metrics[other]["per_image"]:
            images[row["camera"], row["frame"]][key] = row["psnr"]
    return images


def _faults(checked: Artifact) -> list[str]:
    """Of all surfaces."""
    surfaces = json.loads((checked.root / "surface.json").read_text())
    return [surface["fault"] for surface in surfaces.values() if surface["fault"]]


def _tell(result: Figures, charts: list[str], table: Path) -> None:
    replace_text(table.with_suffix(".json"), json.dumps(result, indent=1) + "\n")
    replace_text(table, as_markdown(result, charts))


def _draw(result: Figures, table: Path) -> list[str]:
    """Names of the charts that there is something to draw for."""
    paths = {key: table.with_name(f"{table.stem}-{key}.png") for key in ("matrix", "psnr", "chamfer_mm")}
    for path in paths.values():
        path.unlink(missing_ok=True)  # of an earlier call
    matrix_chart(result, paths["matrix"])
    drawn = [key for key in ("psnr", "chamfer_mm") if curve_chart(result, key, paths[key])]
    return [paths[key].name for key in ("matrix", *drawn)]
