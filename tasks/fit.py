"""The fit stage: the posed body model."""

from pathlib import Path

from hnerf.body.fit import fit_body
from hnerf.capture.masks import Masks
from hnerf.config import FitSettings
from hnerf.results import FitReport, write_result
from tasks.calibration import calibrated_capture
from tasks.stage import stage
from tasks.store import Artifact


@stage("fit", version="31")
def fit(
    out: Path, recording: Artifact, calibration: Artifact, segmentation: Artifact | None, settings: FitSettings
) -> dict[str, float]:
    """Fit one body shape and one pose per frame to keypoints, and to contours if there are masks. Return the seconds of
    each part; no file holds them, so that fitting the same body again gives the same artifact."""
    masks = Masks.load(segmentation.root) if segmentation else None
    body, report = fit_body(calibrated_capture(recording, calibration), masks, settings)
    seconds = report.pop("seconds")
    body.save(out)
    write_result(out / "report.json", FitReport, report)
    return seconds
