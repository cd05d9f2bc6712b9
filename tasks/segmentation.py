"""Stage 3: which pixels are the person."""

from pathlib import Path

from hnerf.body.fit_result import BodyFit
from hnerf.capture.capture import Capture
from hnerf.config import SegmentationSettings
from hnerf.segmentation.segment import segment as segment_person
from tasks.calibration import calibrated
from tasks.stage import stage
from tasks.store import Artifact


@stage("segmentation", version="1")
def segment(
    out: Path, recording: Artifact, calibration: Artifact, rough_fit: Artifact | None, settings: SegmentationSettings
) -> dict[str, float]:
    """Masks of the person: given, from clean plates, or else around a rough fit."""
    body = BodyFit.load(rough_fit.root) if rough_fit else None
    segment_person(calibrated(recording, calibration), body, settings).save(out)
    return {}


def needs_body(recording: Artifact) -> bool:
    """Whether a camera has neither masks nor a clean plate, so that segmentation has to be shown where the body is."""
    capture = Capture.load(recording.root)
    first = capture.train_frames[0]
    return any(capture.background(c) is None and capture.given_mask(c, first) is None for c in capture.train_cameras)
