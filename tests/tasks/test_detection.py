"""When a network looks for people."""

from pathlib import Path

import pytest

from hnerf.capture.ingest import ingest
from hnerf.config import CaptureSettings, DetectionSettings
from tasks.detection import needs_detection
from tasks.store import Artifact
from tests.capture.recordings import write_easymocap


@pytest.mark.parametrize(
    ("source", "detected", "silent"),
    [(None, False, True), ("recording", False, False), ("network", True, True), ("both", True, True)],
)
def test_a_recording_with_keypoints_and_one_without(
    tmp_path: Path, source: str | None, detected: bool, silent: bool
) -> None:
    ingest(write_easymocap(tmp_path / "folder"), CaptureSettings(), tmp_path / "capture")
    recording = Artifact(stage="capture", root=tmp_path / "capture", files={})
    settings = DetectionSettings.model_validate({"source": source})
    assert needs_detection(recording, settings) is detected
    (tmp_path / "capture" / "keypoints.npz").unlink()
    assert needs_detection(recording, settings) is silent
