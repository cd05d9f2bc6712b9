"""From a capture folder to an avatar."""

from pathlib import Path

from prefect import flow

from flows.run_page import publish_markdown
from hnerf.capture.capture import Capture
from hnerf.capture.ingest import recorded_cameras
from hnerf.config import Settings, load_settings
from hnerf.evaluation.holdout import held_out_cameras
from tasks.asset import export
from tasks.calibration import calibrate, calibrated
from tasks.capture import ingest, subset_capture
from tasks.evaluation import evaluate, evaluate_held_out
from tasks.fit import fit
from tasks.segmentation import needs_body, segment, settled
from tasks.source import read_capture
from tasks.store import Artifact, Store
from tasks.training import train


@flow(name="train-subject", flow_run_name="{capture}")
def train_subject(
    capture: Path, preset: str = "fast", store: Path = Path("store"), overrides: list[str] | None = None
) -> Path:
    """Train one person and export the avatar; returns the folder that links to each stage's result.

    capture: the recording's folder; preset: a name under configs/ or a YAML file; store: where artifacts are kept;
    overrides: settings like "training.steps=100". Where `evaluation.holdout` names a camera, a second field is trained
    without it, or one without each camera in turn.
    """
    settings = load_settings(preset, overrides or ())
    artifact_store = Store(store.resolve())
    source, truth = read_capture(capture, store)
    if settings.evaluation.holdout:
        recorded = recorded_cameras(source.root)
        held_out_cameras(recorded.train, recorded.test, settings.evaluation.holdout)  # refused before any work

    recording = ingest(artifact_store, source, settings.capture)
    subject = Capture.load(recording.root).name
    artifact_store.link_latest(subject, recording)
    calibration = artifact_store.link_latest(subject, calibrate(artifact_store, recording, settings.calibration))
    left_out = left_out_cameras(recording, calibration, settings)
    masks = artifact_store.link_latest(subject, find_masks(artifact_store, recording, calibration, settings))
    body = artifact_store.link_latest(subject, fit(artifact_store, recording, calibration, masks, settings.fit))
    model = artifact_store.link_latest(
        subject, train(artifact_store, recording, calibration, masks, body, settings.training)
    )
    held_out = tuple(without(camera, artifact_store, recording, calibration, masks, settings) for camera in left_out)
    report = evaluate(artifact_store, truth, recording, calibration, masks, body, model, settings.evaluation, held_out)
    artifact_store.link_latest(subject, report)
    asset = export(artifact_store, recording, calibration, model, settings.asset)
    for artifact in (recording, calibration, masks, body, model, report, asset):
        artifact_store.link_latest(subject, artifact)  # again: another run of this name may have come between
    publish_markdown(_figures(subject, report, asset), "result", f"What came of {subject}")
    return artifact_store.subject_folder(subject)


def prepared(store: Store, recording: Artifact, settings: Settings) -> tuple[Artifact, Artifact, Artifact, Artifact]:
    """What training and evaluation are given of a recording: itself, calibration, masks and body."""
    return fitted(store, recording, calibrate(store, recording, settings.calibration), settings)


def fitted(
    store: Store, recording: Artifact, calibration: Artifact, settings: Settings
) -> tuple[Artifact, Artifact, Artifact, Artifact]:
    """The same of a recording whose cameras were calibrated."""
    masks = find_masks(store, recording, calibration, settings)
    return recording, calibration, masks, fit(store, recording, calibration, masks, settings.fit)


def left_out_cameras(recording: Artifact, calibration: Artifact, settings: Settings) -> tuple[str, ...]:
    """Of the cameras that calibration left those that a field is to be trained without."""
    if settings.evaluation.holdout is None:
        return ()
    used = calibrated(recording, calibration)
    return held_out_cameras(used.train_cameras, used.test_cameras, settings.evaluation.holdout)


def without(
    camera: str, store: Store, recording: Artifact, calibration: Artifact, masks: Artifact, settings: Settings
) -> Artifact:
    """Masks, body and field made anew without a camera, scored on it and its `masks`; where cameras stand is known from
    all of them."""
    others = tuple(name for name in calibrated(recording, calibration).train_cameras if name != camera)
    stages = fitted(store, subset_capture(store, recording, others, None, None), calibration, settings)
    model = train(store, *stages, settings.training)
    scored = settings.evaluation.model_copy(update={"holdout": camera})  # whether it is one of several or not
    return evaluate_held_out(store, recording, calibration, masks, stages[-1], model, scored)


def find_masks(store: Store, recording: Artifact, calibration: Artifact, settings: Settings) -> Artifact:
    """Segment; where that needs a body, fit one to keypoints first, and go round until the masks stand still."""
    if not needs_body(recording, settings.segmentation):
        return segment(store, recording, calibration, None, None, settings.segmentation)
    masks = None
    for _ in range(settings.segmentation.rounds):
        body = fit(store, recording, calibration, masks, settings.fit)
        masks = segment(store, recording, calibration, body, masks, settings.segmentation)
        if settled(masks, settings.segmentation):
            break
    assert masks is not None  # there is a round at least
    return masks


def _figures(subject: str, report: Artifact, asset: Artifact) -> str:
    """Figures and places."""
    lines = [f"# {subject}", "", "| figure | value |", "|---|---|"]
    lines += [f"| {name} | {value:.4g} |" for name, value in report.metrics.items()]
    lines += ["", f"Report: `{report.root / 'report.html'}`", f"Asset: `{asset.root / 'avatar.usdz'}`"]
    return "\n".join(lines)
