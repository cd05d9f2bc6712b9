"""Stage 3: which pixels are the person."""

from pathlib import Path

from hnerf.body.fit_result import BodyFit
from hnerf.capture.capture import Capture
from hnerf.capture.masks import Masks, movement_px
from hnerf.config import SegmentationSettings
from hnerf.segmentation.segment import segment as segment_person
from tasks.calibration import calibrated
from tasks.stage import stage
from tasks.store import Artifact

MOVED = "moved_px"


@stage("segmentation", version="7")
def segment(
    out: Path,
    recording: Artifact,
    calibration: Artifact,
    rough_fit: Artifact | None,
    earlier: Artifact | None,
    settings: SegmentationSettings,
) -> dict[str, float]:
    """Masks of the person: given, learned, from clean plates, or else around a rough fit. How far their edges moved
    since an earlier round, and since the rounds before it, is in the report."""
    body = BodyFit.load(rough_fit.root) if rough_fit else None
    masks = segment_person(calibrated(recording, calibration), body, settings)
    if earlier is None:
        masks.save(out)
        return {}
    before = Masks.load(earlier.root)
    moved_px = movement_px(before, masks)
    masks.report[MOVED] = [*before.report.get(MOVED, []), round(moved_px, 3)]
    masks.save(out)
    return {MOVED: moved_px}


def settled(segmentation: Artifact, settings: SegmentationSettings) -> bool:
    """Whether this round hardly moved the masks' edges."""
    return segmentation.metrics.get(MOVED, float("inf")) < settings.still_px


def needs_body(recording: Artifact, settings: SegmentationSettings) -> bool:
    """Whether segmentation has to be shown where the body is: a camera has neither masks nor a clean plate, and there
    is no learned model and no network that detected people; or nothing was detected."""
    capture = Capture.load(recording.root)
    first = capture.train_frames[0]
    unmasked = (capture.background(c) is None and capture.given_mask(c, first) is None for c in capture.train_cameras)
    told = settings.model is not None or capture.was_looked_at
    return not capture.has_keypoints or (not told and any(unmasked))
