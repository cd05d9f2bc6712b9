"""Main flow: from a capture folder to an avatar."""

import logging
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import NamedTuple

from prefect import flow
from prefect.client.schemas.objects import FlowRun, State

from flows.arguments import StoreFolder
from flows.preparation import missing_cameras, segment_and_fit, with_detections
from flows.run_page import embedded, publish_link, publish_markdown, shown_progress
from hnerf.avatar.finished import reason_without_novel_poses
from hnerf.capture.capture import Capture
from hnerf.config import Settings, load_settings, require_named_files
from hnerf.errors import InputError, one_line
from hnerf.evaluation.holdout import held_out_cameras
from hnerf.tables import table
from tasks.asset import export
from tasks.calibration import calibrate, calibrated_capture
from tasks.capture import ingest, subset_capture
from tasks.evaluation import evaluate, evaluate_held_out
from tasks.ledger import forget, release
from tasks.limits import StalledError, set_limits
from tasks.policy import EXPECTED, is_of_the_machine
from tasks.quarantine import MACHINE, clear, note_run
from tasks.remote import fetched, remote_capture
from tasks.source import GoneError, Source, path_or_url, read_capture
from tasks.stage import retried
from tasks.store import OPTIONAL, Artifact, Store
from tasks.training import train

log = logging.getLogger("hnerf.train")


class Trained(NamedTuple):
    """The results of a run. subject: the folder that links to the latest result of each stage, which may come from
    another run; report, asset: this run's own files; there is no asset if the field cannot be posed."""

    subject: Path
    report: Path
    asset: Path | None


@flow(name="train-subject", flow_run_name="{capture}")
def train_subject(
    capture: Path | str, preset: str = "fast", store: StoreFolder = Path("store"), overrides: list[str] | None = None
) -> Trained:
    """Train one person and export the avatar; return where the results are.

    If `evaluation.holdout` names a camera, a second field is trained without it; with "each", one without each camera
    in turn.

    Args:
        capture: The capture folder or one video, relative to the checkout; or the URL of a folder in a bucket.
        preset: A preset of configs/ (fast, demo, paper, ...), or a YAML file.
        store: Folder of results.
        overrides: Settings that differ from the preset, like training.steps=2000; `hnerf settings` lists all.
    """
    with shown_progress():
        try:
            return train_avatar(capture, preset, store, overrides or ())
        except GoneError:  # the capture may be started again from wherever it is now
            forget(store.resolve(), path_or_url(capture))
            raise


def train_avatar(capture: Path | str, preset: str, store: Path, overrides: Sequence[str]) -> Trained:
    """Run all stages on a capture, and show the results on the page of the run."""
    settings = load_settings(preset, overrides)
    require_named_files(settings)
    set_limits(settings.limits)
    artifact_store = Store(store.resolve())
    capture = path_or_url(capture)
    folder = capture if isinstance(capture, Path) else fetched(artifact_store, retried(remote_capture)(capture))
    source, truth = retried(read_capture)(folder, store)
    subject, made = ingested(artifact_store, source, capture, settings)
    recording = made[-1]
    skipped = OPTIONAL - {one.stage for one in made}
    link = partial(artifact_store.link_latest, subject)
    calibration = link(calibrate(artifact_store, recording, settings.calibration))
    left_out = calibrated_held_out_cameras(recording, calibration, settings)
    prepared = segment_and_fit(artifact_store, recording, calibration, settings, link)
    training = link(train(artifact_store, *prepared, settings.training))
    held_out = tuple(evaluate_without_camera(camera, artifact_store, *prepared[:3], settings) for camera in left_out)
    evaluation = link(evaluate(artifact_store, truth, *prepared, training, settings.evaluation, held_out))
    results, asset = [*made, *prepared[1:], training, evaluation], None
    if reason := reason_without_novel_poses(training.root):
        log.warning("no asset: %s", reason)
    else:
        results.append(export(artifact_store, *prepared[:3], training, settings.asset))
        asset = results[-1].root / "avatar.usdz"
    # Again: another run of this name may have relinked them.
    artifact_store.unlink_latest(subject, skipped)
    for artifact in results:
        link(artifact)
    trained = Trained(artifact_store.subject_folder(subject), evaluation.root / "report.html", asset)
    pictures = embedded(_key_pictures(calibration, evaluation))
    page = f"{_figures(subject, evaluation, training, trained)}\n\n{pictures}\n"
    publish_markdown(page, "result", f"Result for {subject}")
    publish_link(trained.report, "report", f"Report on {subject}")
    return trained


def ingested(store: Store, source: Source, capture: Path | str, settings: Settings) -> tuple[str, tuple[Artifact, ...]]:
    """Ingest a recording, detect people as needed, and link the results to the subject; unlink those of an earlier run
    that used other stages. Return the subject's name and the results; later stages read the last one."""
    cameras = missing_cameras(store, source)
    recorded = ingest(store, source, settings.capture, cameras)
    normalised = Capture.load(recorded.root)
    held_out_cameras(normalised.train_cameras, normalised.test_cameras, settings.evaluation.holdout)
    subject = normalised.name
    store.claim(subject, source.digest, capture if isinstance(capture, str) else source.root)
    if cameras:
        store.link_latest(subject, cameras)
    else:
        store.unlink_latest(subject, {"cameras"})
    store.link_latest(subject, recorded)
    recording = with_detections(store, recorded, settings)
    store.unlink_latest(subject, OPTIONAL - {"cameras", recording.stage})
    store.link_latest(subject, recording)
    return subject, (cameras, recorded, recording) if cameras else (recorded, recording)


@train_subject.on_failure
def note_failure(flow: object, flow_run: FlowRun, state: State[Trained]) -> None:
    """Write the reason into the watched folder, if the capture was started from there. If the machine is to blame,
    release the capture, so that it may be started again; a stage that stalled would only stall again for hours."""
    capture, store = path_or_url(flow_run.parameters["capture"]), Path(flow_run.parameters.get("store", "store"))
    error = state.result(raise_on_failure=False)
    if isinstance(error, Exception):
        why = str(error) if isinstance(error, EXPECTED) else f"{type(error).__name__}: {one_line(error)}"
        why = f"{why} (flow run {flow_run.name}, {flow_run.id})"
        if is_of_the_machine(error, capture) and not isinstance(error, StalledError):
            note_run(capture, store, f"failed: {why}", MACHINE)
            with suppress(OSError):  # of a full disk
                release(store, capture, str(flow_run.id))
        else:
            note_run(capture, store, f"{'refused' if isinstance(error, InputError) else 'failed'}: {why}")


@train_subject.on_completion
def clear_note(flow: object, flow_run: FlowRun, state: State[Trained]) -> None:
    """Remove the note of an earlier run."""
    clear(path_or_url(flow_run.parameters["capture"]))


def calibrated_held_out_cameras(recording: Artifact, calibration: Artifact, settings: Settings) -> tuple[str, ...]:
    """Return the cameras to hold out in turn, among those that calibration kept."""
    if settings.evaluation.holdout is None:
        return ()
    used = calibrated_capture(recording, calibration)
    return held_out_cameras(used.train_cameras, used.test_cameras, settings.evaluation.holdout)


def evaluate_without_camera(
    camera: str, store: Store, recording: Artifact, calibration: Artifact, segmentation: Artifact, settings: Settings
) -> Artifact:
    """Segment, fit and train without a camera, and score the result on that camera, under its masks of `segmentation`.
    The calibration uses all cameras."""
    others = tuple(name for name in calibrated_capture(recording, calibration).train_cameras if name != camera)
    prepared = segment_and_fit(store, subset_capture(store, recording, others, None, None), calibration, settings)
    training = train(store, *prepared, settings.training)
    scored = (recording, calibration, segmentation, prepared.body, training)
    return evaluate_held_out(store, *scored, camera, settings.evaluation)


def _key_pictures(calibration: Artifact, evaluation: Artifact) -> list[tuple[str, Path]]:
    """Return the first rendering of each split, and the image of the cameras, with captions."""
    renders = evaluation.root / "renders"
    firsts = [(split.name, min(split.glob("*/*.png"), default=None)) for split in sorted(renders.glob("*"))]
    shown = [(name.replace("_", " "), path) for name, path in firsts if path]
    cameras = calibration.root / "cameras.png"
    return shown + ([("cameras", cameras)] if cameras.is_file() else [])


def _figures(subject: str, evaluation: Artifact, training: Artifact, trained: Trained) -> str:
    """Format the scores, the cost, and the paths of the report and the asset."""
    figures = evaluation.metrics | {f"training {name}": value for name, value in training.metrics.items()}
    rows = [["figure", "value"], *([name, f"{value:.4g}"] for name, value in figures.items())]
    lines = [f"# {subject}", "", *table(rows), "", f"Report: `{trained.report}`", f"Asset: `{trained.asset or 'none'}`"]
    return "\n".join(lines)
