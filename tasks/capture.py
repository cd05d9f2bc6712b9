"""The capture stage: the recording in one common layout."""

from pathlib import Path

from hnerf.capture.capture import Capture
from hnerf.capture.ingest import ingest as ingest_folder
from hnerf.capture.subset import subset
from hnerf.config import CaptureSettings
from hnerf.errors import InputError
from tasks.cage import run_caged
from tasks.source import Source, require_unchanged
from tasks.stage import stage
from tasks.store import Artifact


@stage("capture", version="22")
def ingest(out: Path, source: Source, settings: CaptureSettings) -> dict[str, float]:
    """Read a recording in any supported layout; undistort and normalise it."""
    try:
        run_caged(ingest_folder, source.root, settings, out, folder=source.root)
    except (InputError, FileNotFoundError):
        require_unchanged(source)  # a recording that is moved or replaced meanwhile looks damaged
        raise
    require_unchanged(source)
    capture = Capture.load(out)
    return {"cameras": len(capture.cameras), "frames": len(capture.frames)}


@stage("subset", version="4")
def subset_capture(
    out: Path,
    recording: Artifact,
    cameras: tuple[str, ...] | None,
    train_frames: tuple[int, ...] | None,
    novel_pose_frames: tuple[int, ...] | None,
) -> dict[str, float]:
    """Write a capture with only these training cameras and frames; None keeps all. All test cameras are kept."""
    subset(Capture.load(recording.root), out, cameras, train_frames, novel_pose_frames)
    kept = Capture.load(out)
    return {"cameras": len(kept.cameras), "frames": len(kept.frames)}
