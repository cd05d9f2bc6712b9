"""Stability flow: the same capture, degraded in one way at a time, to find where each method breaks."""

import contextlib
import json
import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from prefect import flow

from flows.arguments import StoreFolder
from flows.preparation import Prepared, check_presets, ingest_part, prepare_training
from flows.run_page import publish_markdown, shown_progress
from hnerf.avatar.finished import reason_without_novel_poses
from hnerf.capture.capture import Capture
from hnerf.config import Settings, load_settings, title_of
from hnerf.errors import InputError, NotApplicableError, one_line
from hnerf.evaluation.evaluate import reason_without_surface
from hnerf.evaluation.images import mean_of
from hnerf.evaluation.views import ANIMATED, NOVEL_VIEW, POSED, PRIMARY_SPLITS, TRACKED
from hnerf.files import embed_images, replace_text
from hnerf.study.degradations.catalogue import KINDS, Degradation, degrade_settings
from hnerf.study.stability.charts import curve_chart, matrix_chart
from hnerf.study.stability.plan import StabilityStudy, load_stability
from hnerf.study.stability.report import REFERENCE, as_markdown
from hnerf.study.stability.verdict import BROKEN, RunVerdict, judge, near_border
from tasks.evaluation import evaluate
from tasks.fit import fit
from tasks.policy import is_of_the_machine
from tasks.source import Source, read_capture
from tasks.stage import retried
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
@shown_progress()
def stability(
    capture: Path,
    study: str = "full",
    store: StoreFolder = Path("store"),
    methods: Sequence[str] = (),
    only: Sequence[str] = (),
) -> Path:
    """Run each method on a capture degraded in every way that a study names; return the table,
    `<store>/stability/<subject>-<study>.md`. It and the JSON next to it are rewritten after every run; charts are drawn
    when the flow ends, even if by an error.

    A failure is a result, and the other runs continue. A worker that was killed (LostWorkerError) ends the command, and
    the same command resumes.

    Args:
        capture: The recording's folder, or one video; relative to the repository.
        study: A name under configs/stability/, or a YAML file.
        store: Folder of results.
        methods: Presets instead of the study's; the table's name then ends in "-part".
        only: Names of degradations; the table's name then ends in "-part".
    """
    whole = load_stability(study)
    plan = whole.restricted_to(only)
    plan = plan.model_copy(update={"methods": tuple(dict.fromkeys(methods))}) if methods else plan
    presets = {name: load_settings(name, plan.overrides) for name in plan.methods}
    check_presets(presets.values())
    artifact_store = Store(store.resolve())
    source, truth = retried(read_capture)(capture, store)
    subject = Capture.load(ingest_part(artifact_store, source, plan.part, next(iter(presets.values()))).root).name
    table = artifact_store.root / "stability" / f"{subject}-{title_of(study)}{'' if plan == whole else '-part'}.md"
    artifact_store.claim_table(table, source.digest, source.root)
    result: Figures = {"subject": subject, "study": study, "plan": plan.model_dump(mode="json")}
    result |= {"left_out": plan.left_out(), "protocol": None, "runs": []}
    try:
        for run in _runs(artifact_store, source, truth, plan, presets):
            if "left_out" in run:
                if run["left_out"] not in result["left_out"]:  # every method and seed yields the same line
                    result["left_out"].append(run["left_out"])
                continue
            result["protocol"] = run.pop("protocol", None) or result["protocol"]
            result["runs"].append(run)
            _write_table(result, [], table)
    except BaseException:  # including Ctrl-C
        if result["runs"]:
            with contextlib.suppress(Exception):  # an error here would hide the one that ended the study
                _write_table(result, _draw_charts(result, table), table)
        raise
    _write_table(result, _draw_charts(result, table), table)
    publish_markdown(embed_images(table), "stability", f"Where methods break on {subject}")
    return table


def _runs(
    store: Store, source: Source, truth: Source, plan: StabilityStudy, presets: dict[str, Settings]
) -> Iterator[Figures]:
    """Yield a row for every run: its method, degradation, verdict and, if there are any, scores; or {"left_out": what
    and why}."""
    tried = [(kind, strength) for kind, strengths in plan.degradations.items() for strength in strengths]
    for method, preset in presets.items():
        recording = ingest_part(store, source, plan.part, preset)
        near = set()
        for seed in plan.seeds:
            for run in _runs_of_seed(method, Attempt.of_seed(store, recording, truth, preset, seed), tried):
                if run.get("near_border"):
                    near.add((run["kind"], run["strength"]))
                yield run
        for seed in plan.border_seeds if near else ():
            again = Attempt.of_seed(store, recording, truth, preset, seed)
            yield from _runs_of_seed(method, again, [at for at in tried if at in near])


def _runs_of_seed(method: str, as_recorded: "Attempt", tried: Sequence[tuple[str, float]]) -> Iterator[Figures]:
    """Yield the reference run and, unless it is broken, a run for each kind and strength."""
    seed = as_recorded.settings.training.seed
    log.info("%s, seed %d, as recorded", method, seed)
    good = as_recorded.outcome()
    row = {"method": method, "seed": seed}
    reference = row | {"kind": REFERENCE, "strength": None} | verdict_row(good, good)
    yield reference
    for kind, strength in tried if reference["verdict"] not in BROKEN else ():
        log.info("%s, seed %d, %s: %g", method, seed, KINDS[kind].label, strength)
        found = replace(as_recorded, degradation=Degradation(kind=kind, strength=strength, seed=seed)).outcome()
        if "left_out" in found:
            yield {"left_out": f"{KINDS[kind].label}, {strength:g}: {found['left_out']}"}
            continue
        yield row | {"kind": kind, "strength": strength} | verdict_row(found, good)


def verdict_row(found: Figures, good: Figures) -> Figures:
    """Return a run's verdict, whether it is near a border, and the mean scores over the images and surfaces that both
    runs have, None if there are none. "reference" holds those of the good run."""
    row: Figures = {}
    near = False
    if "error" in found:
        verdict = RunVerdict(*found["error"])
    elif "images" not in found:
        verdict = judge(None, {}, found["faults"])
    else:
        row, reference = means_in_common(found, good), means_in_common(good, found)
        verdict = judge(row, reference, found["faults"])
        near = near_border(row, reference, found["faults"])
        row |= {"reference": reference, "protocol": found["protocol"], "seconds": found["seconds"]}
    return row | {"verdict": verdict.verdict, "reason": verdict.reason, "near_border": near}


def means_in_common(one: Figures, other: Figures) -> Figures:
    """Return the means of one run's scores over the images and surfaces that the other run has as well, and their
    counts."""
    images = [score for view, score in one["images"].items() if view in other["images"]]
    surfaces = [chamfer_mm for frame, chamfer_mm in one["surfaces"].items() if frame in other["surfaces"]]
    means = {key: mean_of([score.get(key) for score in images]) for key in IMAGE_FIGURES}
    means["chamfer_mm"] = mean_of(surfaces)
    return means | {"images": len(images), "surfaces": len(surfaces)}


@dataclass(frozen=True)
class Attempt:
    """A training on a recording that is degraded in one way, or, without a degradation, as recorded. truth: the
    recording's ground truth."""

    store: Store
    recording: Artifact
    truth: Source
    settings: Settings
    degradation: Degradation | None = None

    @staticmethod
    def of_seed(store: Store, recording: Artifact, truth: Source, preset: Settings, seed: int) -> "Attempt":
        """Return the training of a preset, with this seed, on the recording as it is."""
        training = preset.training.model_copy(update={"seed": seed})
        return Attempt(store, recording, truth, preset.model_copy(update={"training": training}))

    @property
    def target(self) -> str | None:
        """Return what the degradation changes; None without a degradation."""
        return KINDS[self.degradation.kind].target if self.degradation else None

    def outcome(self) -> Figures:
        """Return the result of `measure`, or {"error": (verdict, reason)}: "refused" if bad input was reported before
        or by training, "failed" for any other error. Return {"left_out": reason} if the degradation does not apply to
        the capture."""
        at_bad_input = "refused"
        try:
            prepared, training_settings = self.prepare(), self.settings.training
            if self.degradation and self.target == "settings":
                training_settings = degrade_settings(training_settings, self.degradation)
            training = train(self.store, *prepared, training_settings)
            at_bad_input = "failed"
            return self.measure(prepared, training)
        except NotApplicableError as error:
            return {"left_out": str(error)}
        except Exception as error:  # any failure is a result of the study
            if is_of_the_machine(error):
                raise
            if isinstance(error, InputError):
                return {"error": (at_bad_input, str(error))}
            log.warning("%s: %s", type(error).__name__, error)
            return {"error": ("failed", one_line(error))}

    def prepare(self) -> Prepared:
        """Run the stages before training, with the degradation applied to its target."""
        store, settings, change = self.store, self.settings, self.degradation
        recording = self.recording
        if change and self.target == "capture":
            recording = degrade_capture(store, recording, change)
        recording, calibration, segmentation, body = prepare_training(store, recording, settings)
        if change and self.target == "clothing":
            recording = degrade_clothing(store, self.truth, recording, calibration, body, change)
            return prepare_training(store, recording, settings)
        if change and self.target == "masks":
            segmentation = degrade_masks(store, recording, calibration, segmentation, change)
            body = fit(store, recording, calibration, segmentation, settings.fit)
        if change and self.target == "fit":
            body = degrade_fit(store, body, change)
        return Prepared(recording, calibration, segmentation, body)

    def measure(self, prepared: Prepared, training: Artifact) -> Figures:
        """Return the faults of surfaces, the scores of each image, and the Chamfer distance of each surface that has
        ground truth.

        Scores are of novel poses, animated, or of training poses if the capture as recorded, or the method, has no
        novel ones. Extreme poses have only faults. A degraded fit is used for training only; novel poses are shown as
        in the good fit.
        """
        no_poses = reason_without_novel_poses(training.root)
        if self.degradation and self.target == "poses":
            if no_poses:
                raise NotApplicableError(no_poses)
            return {"faults": _faults(show_in_extreme_poses(self.store, training, self.degradation))}
        good_body = replace(self, degradation=None).prepare().body
        truth = read_capture(prepared.recording.root)[1] if self.target == "clothing" else self.truth
        shown = prepared._replace(body=good_body) if self.target == "fit" else prepared
        evaluation = evaluate(self.store, truth, *shown, training, self.settings.evaluation)
        metrics = json.loads((evaluation.root / "metrics.json").read_text())
        novel = Capture.load(self.recording.root).novel_pose_frames and not no_poses
        split = ANIMATED if novel else NOVEL_VIEW
        surfaces = (metrics[split]["geometry"] or {"per_surface": []})["per_surface"]
        unmeshed = [why for primary in PRIMARY_SPLITS if (why := reason_without_surface(metrics[primary]))]
        return {
            "images": _images(metrics, split),
            "surfaces": {surface["frame"]: surface["chamfer_mm"] for surface in surfaces},
            "faults": unmeshed + _faults(check_meshes(self.store, evaluation, good_body)),
            "protocol": metrics["protocol"],
            "seconds": json.loads((training.root / "report.json").read_text())["seconds"],
        }


def _images(metrics: Figures, split: str) -> dict[tuple[str, int], Figures]:
    """Return the scores of each image by camera and frame; for animated poses, also the PSNR of the posed and the
    tracked ones."""
    images = {(row["camera"], row["frame"]): dict(row) for row in metrics[split]["per_image"]}
    others = {"posed_psnr": POSED, "tracked_psnr": TRACKED} if split == ANIMATED else {}
    for key, other in others.items():
        for row in metrics[other]["per_image"]:
            images[row["camera"], row["frame"]][key] = row["psnr"]
    return images


def _faults(checked: Artifact) -> list[str]:
    """Return the faults of all surfaces."""
    surfaces = json.loads((checked.root / "surface.json").read_text())
    return [surface["fault"] for surface in surfaces.values() if surface["fault"]]


def _write_table(result: Figures, charts: list[str], table: Path) -> None:
    replace_text(table.with_suffix(".json"), json.dumps(result, indent=1) + "\n")
    replace_text(table, as_markdown(result, charts))


def _draw_charts(result: Figures, table: Path) -> list[str]:
    """Draw the charts for which there is data; return their file names."""
    paths = {key: table.with_name(f"{table.stem}-{key}.png") for key in ("matrix", "psnr", "chamfer_mm")}
    for path in paths.values():
        path.unlink(missing_ok=True)  # left by an earlier call
    matrix_chart(result, paths["matrix"])
    drawn = [key for key in ("psnr", "chamfer_mm") if curve_chart(result, key, paths[key])]
    return [paths[key].name for key in ("matrix", *drawn)]
