"""A capture whose people are found by made-up networks."""

from pathlib import Path

import pytest

from hnerf.capture.capture import Capture
from hnerf.capture.ingest import ingest
from hnerf.config import CaptureSettings
from hnerf.detection import detect as module
from hnerf.detection import people
from tests.capture.recordings import write_easymocap
from tests.detection.made_up import MadeUp


@pytest.fixture
def recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Capture:
    """Return a capture with one training camera, 24 x 16 px, five frames and its own keypoints of confidence .5;
    replace the networks by made-up ones."""
    for name in ("PersonDetector", "LandmarkNetwork"):
        monkeypatch.setattr(module, name, MadeUp)
    monkeypatch.setattr(module, "model_file", lambda name: None)
    monkeypatch.setattr(people, "MIN_HEIGHT_PX", 0)
    MadeUp.seen = 0
    folder = write_easymocap(tmp_path / "folder")
    (folder / "capture.toml").write_text('[cameras]\ntrain = ["01"]\ntest = ["02"]\n')
    return ingest(folder, CaptureSettings(), tmp_path / "capture")
