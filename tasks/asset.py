"""Stage 7: the rigged, textured, animated avatar."""

from pathlib import Path

from hnerf.asset.export import export_asset
from hnerf.config import AssetSettings
from tasks.calibration import calibrated
from tasks.stage import stage
from tasks.store import Artifact
from tasks.training import trained


@stage("asset", version="2")
def export(
    out: Path, recording: Artifact, calibration: Artifact, training: Artifact, settings: AssetSettings
) -> dict[str, float]:
    """USD and glTF files of the trained person."""
    export_asset(calibrated(recording, calibration), trained(training), settings, out)
    return {}
