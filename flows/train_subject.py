"""From a capture folder to an avatar."""

from pathlib import Path

from prefect import flow

from flows.run_page import show
from hnerf.capture.capture import Capture
from hnerf.config import Settings, load_settings
from tasks.asset import export
from tasks.calibration import calibrate
from tasks.capture import ingest
from tasks.evaluation import evaluate
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
    overrides: settings like "training.steps=100".
    """
    settings = load_settings(preset, overrides or ())
    shelf = Store(store.resolve())
    source, truth = read_capture(capture, store)

    recording = ingest(shelf, source, settings.capture)
    subject = Capture.load(recording.root).name
    shelf.show(subject, recording)
    calibration = shelf.show(subject, calibrate(shelf, recording, settings.calibration))
    masks = shelf.show(subject, find_masks(shelf, recording, calibration, settings))
    body = shelf.show(subject, fit(shelf, recording, calibration, masks, settings.fit))
    model = shelf.show(subject, train(shelf, recording, calibration, masks, body, settings.training))
    report = evaluate(shelf, truth, recording, calibration, masks, body, model, settings.evaluation)
    shelf.show(subject, report)
    asset = export(shelf, recording, calibration, model, settings.asset)
    for artifact in (recording, calibration, masks, body, model, report, asset):
        shelf.show(subject, artifact)  # again: another run of this name may have come between
    show(_figures(subject, report, asset), "result", f"What came of {subject}")
    return shelf.subject_folder(subject)


def prepared(shelf: Store, recording: Artifact, settings: Settings) -> tuple[Artifact, Artifact, Artifact, Artifact]:
    """What training and evaluation are given of a recording: itself, calibration, masks and body."""
    calibration = calibrate(shelf, recording, settings.calibration)
    masks = find_masks(shelf, recording, calibration, settings)
    return recording, calibration, masks, fit(shelf, recording, calibration, masks, settings.fit)


def find_masks(shelf: Store, recording: Artifact, calibration: Artifact, settings: Settings) -> Artifact:
    """Segment; where that needs a body, fit one to keypoints first, and go round until the masks stand still."""
    if not needs_body(recording, settings.segmentation):
        return segment(shelf, recording, calibration, None, None, settings.segmentation)
    masks = None
    for _ in range(settings.segmentation.rounds):
        body = fit(shelf, recording, calibration, masks, settings.fit)
        masks = segment(shelf, recording, calibration, body, masks, settings.segmentation)
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
