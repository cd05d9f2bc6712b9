"""Stage 1: what was recorded, in one layout."""

from pathlib import Path

from hnerf.capture.ingest import ingest as ingest_folder
from hnerf.config import CaptureSettings
from tasks.source import Source
from tasks.stage import stage


@stage("capture", version="7")
def ingest(out: Path, source: Source, settings: CaptureSettings) -> dict[str, float]:
    """Read a recording in whatever layout it has; undistort and normalise it."""
    capture = ingest_folder(source.root, settings, out)
    return {"cameras": len(capture.cameras), "frames": len(capture.frames)}
