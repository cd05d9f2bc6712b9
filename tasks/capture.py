"""The capture stage: the recording in one common layout."""

from pathlib import Path

from hnerf.capture.capture import Capture
from hnerf.capture.formats.from_person import FromPerson
from hnerf.capture.ingest import ingest as ingest_folder
from hnerf.capture.subset import subset
from hnerf.config import CaptureSettings
from tasks.cage import read_source
from tasks.source import Source
from tasks.stage import stage
from tasks.store import Artifact


@stage("capture", version="25")
def ingest(out: Path, source: Source, settings: CaptureSettings, cameras: Artifact | None = None) -> dict[str, float]:
    """Read a recording in any supported layout; undistort and normalise it. cameras: those found from the person, if
    it has no calibration."""
    layout = FromPerson(source.root, cameras.root) if cameras else None
    read_source(source, ingest_folder, source.root, settings, out, layout)
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
