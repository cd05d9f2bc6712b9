"""The segmentation stage: which pixels are the person."""

from pathlib import Path

from hnerf.body.fit_result import BodyFit
from hnerf.capture.capture import Capture
from hnerf.capture.masks import Masks, movement_px
from hnerf.config import SegmentationSettings
from hnerf.segmentation.segment import segment as segment_person
from tasks.calibration import calibrated_capture
from tasks.stage import stage
from tasks.store import Artifact

EDGE_MOVEMENT = "moved_px"


@stage("segmentation", version="17")
def segment(
    out: Path,
    recording: Artifact,
    calibration: Artifact,
    rough_fit: Artifact | None,
    earlier: Artifact | None,
    settings: SegmentationSettings,
) -> dict[str, float]:
    """Write masks of the person: given ones, or from a learned model, from clean plates, or around a rough fit. The
    report holds how far their edges moved in each round."""
    body = BodyFit.load(rough_fit.root) if rough_fit else None
    masks = segment_person(calibrated_capture(recording, calibration), body, settings)
    if earlier is None:
        masks.save(out)
        return {}
    before = Masks.load(earlier.root)
    moved_px = movement_px(before, masks)
    masks.report[EDGE_MOVEMENT] = [*before.report.get(EDGE_MOVEMENT, []), round(moved_px, 3)]
    masks.save(out)
    return {EDGE_MOVEMENT: moved_px}


def converged(segmentation: Artifact, settings: SegmentationSettings) -> bool:
    """Return whether this round hardly moved the edges of the masks."""
    return segmentation.metrics.get(EDGE_MOVEMENT, float("inf")) < settings.still_px


def needs_body(recording: Artifact, settings: SegmentationSettings) -> bool:
    """Return whether segmentation needs a fitted body. It does if there are no keypoints, or if some camera has neither
    masks nor a clean plate and there is neither a learned model nor a network that detected people."""
    capture = Capture.load(recording.root)
    first = capture.train_frames[0]
    unmasked = (capture.background(c) is None and capture.given_mask(c, first) is None for c in capture.train_cameras)
    by_network = settings.model is not None or capture.has_person_masks
    return not capture.has_keypoints or (not by_network and any(unmasked))
