"""Stage 4: the body model, posed."""

import json
from pathlib import Path

from hnerf.body.fit import fit_body
from hnerf.capture.masks import Masks
from hnerf.config import FitSettings
from tasks.calibration import calibrated
from tasks.stage import stage
from tasks.store import Artifact


@stage("fit", version="13")
def fit(
    out: Path, recording: Artifact, calibration: Artifact, segmentation: Artifact | None, settings: FitSettings
) -> dict[str, float]:
    """One shape and a pose a frame, from keypoints, and from contours where there are masks. The figures are seconds of
    each part; no file has them, so that the same body made again is the same artifact."""
    masks = Masks.load(segmentation.root) if segmentation else None
    body, report = fit_body(calibrated(recording, calibration), masks, settings)
    seconds: dict[str, float] = report.pop("seconds")
    body.save(out)
    (out / "report.json").write_text(json.dumps(report, indent=1))
    return seconds
