"""The stages before training, which `train-subject` and the studies have in common."""

from collections.abc import Callable, Iterable
from shutil import which
from typing import NamedTuple

from hnerf.capture.capture import Capture
from hnerf.capture.ingest import lacks_calibration
from hnerf.config import Settings, require_named_files
from hnerf.errors import InputError
from hnerf.study.benchmark.plan import CapturePart
from tasks.calibration import calibrate
from tasks.cameras import find_cameras
from tasks.capture import ingest, subset_capture
from tasks.detection import detect, find_hands, needs_detection, needs_hands
from tasks.fit import fit
from tasks.limits import set_limits
from tasks.segmentation import converged, needs_body, segment
from tasks.source import GROUND_TRUTH, Source
from tasks.store import Artifact, Store


class Prepared(NamedTuple):
    """The results of earlier stages that training and evaluation take, in the order of these tasks' arguments."""

    recording: Artifact
    calibration: Artifact
    segmentation: Artifact
    body: Artifact


def check_presets(presets: Iterable[Settings]) -> None:
    """Raise InputError if a preset of a study names a file that is not there, or leaves a camera out: studies would
    train with it all the same."""
    for preset in presets:
        require_named_files(preset)
        if preset.evaluation.holdout is not None:
            raise InputError("evaluation.holdout: only `hnerf run` leaves cameras out; remove it")


def missing_cameras(store: Store, source: Source) -> Artifact | None:
    """Return clocks and cameras found from the person, if several cameras have no calibration; else None. Raises
    InputError if there is ground truth, which is in the world of a calibration."""
    if not lacks_calibration(source.root):
        return None
    if (source.root / GROUND_TRUTH).exists():
        raise InputError(f"{source.root / GROUND_TRUTH}: of no use without a calibration; add that, or remove this")
    return find_cameras(store, source, ("ffmpeg",) if which("ffmpeg") else ())


def ingest_recording(store: Store, source: Source, settings: Settings) -> Artifact:
    """Ingest a recording, with cameras found from the person if it has none. The limits of these settings apply here
    and afterwards."""
    set_limits(settings.limits)
    return ingest(store, source, settings.capture, missing_cameras(store, source))


def with_detections(store: Store, recorded: Artifact, settings: Settings) -> Artifact:
    """Return the recording with people detected by a network, if it needs that, and with points of the subject's
    hands, if they are wanted, and the recording has them or the network is installed."""
    recording = recorded
    if needs_detection(recorded, settings.detection):
        recording = detect(store, recorded, settings.detection)
    return find_hands(store, recording) if needs_hands(recording, settings.detection) else recording


def ingest_part(store: Store, source: Source, part: CapturePart, settings: Settings) -> Artifact:
    """Ingest the recording, or the part of it that a study uses."""
    recording = with_detections(store, ingest_recording(store, source, settings), settings)
    parts = part.select(Capture.load(recording.root))
    return recording if parts == (None, None, None) else subset_capture(store, recording, *parts)


def prepare_training(store: Store, recording: Artifact, settings: Settings) -> Prepared:
    """Run the stages before training on a recording."""
    return segment_and_fit(store, recording, calibrate(store, recording, settings.calibration), settings)


def segment_and_fit(
    store: Store,
    recording: Artifact,
    calibration: Artifact,
    settings: Settings,
    link: Callable[[Artifact], Artifact] = lambda made: made,
) -> Prepared:
    """Run the stages between calibration and training. link: called with each result as soon as it is there."""
    segmentation = link(segment_subject(store, recording, calibration, settings))
    body = link(fit(store, recording, calibration, segmentation, settings.fit))
    return Prepared(recording, calibration, segmentation, body)


def segment_subject(store: Store, recording: Artifact, calibration: Artifact, settings: Settings) -> Artifact:
    """Segment the person. If that needs a body, fit one to keypoints first, and alternate until the masks converge."""
    if not needs_body(recording, settings.segmentation):
        return segment(store, recording, calibration, None, None, settings.segmentation)
    segmentation = None
    for _ in range(settings.segmentation.rounds):
        body = fit(store, recording, calibration, segmentation, settings.fit)
        segmentation = segment(store, recording, calibration, body, segmentation, settings.segmentation)
        if converged(segmentation, settings.segmentation):
            break
    assert segmentation is not None  # there is at least one round
    return segmentation
