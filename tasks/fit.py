"""The fit stage: the posed body model."""

import logging
from pathlib import Path

from hnerf.body.face_fit import fit_face
from hnerf.body.fit import fit_body
from hnerf.capture.masks import Masks
from hnerf.config import FitSettings
from hnerf.models import FACE_LANDMARKS, has_model
from hnerf.progress import timed
from hnerf.results.files import write_result
from hnerf.results.preparation import FitReport
from tasks.calibration import calibrated_capture
from tasks.stage import stage
from tasks.store import Artifact

log = logging.getLogger("hnerf.fit")


@stage("fit", version="38", networks=(FACE_LANDMARKS,))
def fit(
    out: Path, recording: Artifact, calibration: Artifact, segmentation: Artifact | None, settings: FitSettings
) -> dict[str, float]:
    """Fit one body shape and one pose per frame to keypoints, and to contours if there are masks; then its face, if the
    network is installed. Return the seconds of each part; no file holds them, so that fitting the same body again gives
    the same artifact."""
    masks = Masks.load(segmentation.root) if segmentation else None
    capture = calibrated_capture(recording, calibration)
    body, report = fit_body(capture, masks, settings)
    seconds = report.pop("seconds")
    if masks and has_model(FACE_LANDMARKS):
        with timed("face", seconds, log):
            body = fit_face(capture, body)
    elif masks:
        log.info("face: stays the body model's: its network is not installed; run `hnerf models`")
    body.save(out)
    write_result(out / "report.json", FitReport, report)
    return seconds
