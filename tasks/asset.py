"""The asset stage: the rigged, textured, animated avatar."""

from pathlib import Path

from hnerf.asset.export import export_asset
from hnerf.avatar.trained import load_avatar
from hnerf.capture.masks import Masks
from hnerf.config import AssetSettings
from hnerf.models import THREE_SHA256
from tasks.calibration import calibrated_capture
from tasks.stage import stage
from tasks.store import Artifact


@stage("asset", version="43", networks=tuple(THREE_SHA256))
def export(
    out: Path,
    recording: Artifact,
    calibration: Artifact,
    segmentation: Artifact,
    training: Artifact,
    settings: AssetSettings,
) -> dict[str, float]:
    """Export the trained person to USD and glTF files."""
    capture = calibrated_capture(recording, calibration)
    masks = Masks.load(segmentation.root)
    export_asset(capture, masks, load_avatar(training.root), settings, out, recording.digest)
    return {}
