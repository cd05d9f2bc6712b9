"""The calibration stage: which cameras can be trusted."""

from pathlib import Path

from hnerf.calibration.calibrated import load_cameras
from hnerf.calibration.check import check_calibration
from hnerf.capture.capture import Capture
from hnerf.config import CalibrationSettings
from tasks.stage import stage
from tasks.store import Artifact


@stage("calibration", version="25")
def calibrate(out: Path, recording: Artifact, settings: CalibrationSettings) -> dict[str, float]:
    """Check the cameras against the images, and write the cameras to be used by later stages."""
    report = check_calibration(Capture.load(recording.root), settings)
    report.save(out)
    medians_px = [verdict.median_px for verdict in report.verdicts.values() if verdict.median_px is not None]
    return {"worst_median_px": max(medians_px)} if medians_px else {}


def calibrated_capture(recording: Artifact, calibration: Artifact) -> Capture:
    """Return the recording with the cameras that calibration kept."""
    return load_cameras(calibration.root, Capture.load(recording.root))
