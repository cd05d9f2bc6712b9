"""Conditions under which hands are looked for."""

import dataclasses
from pathlib import Path

import pytest

from hnerf.capture.capture import Capture
from hnerf.capture.ingest import ingest
from hnerf.config import CaptureSettings, DetectionSettings
from hnerf.models import HAND_LANDMARKS
from tasks.hands import needs_hands
from tasks.store import Artifact
from tests.capture.recordings import write_easymocap


def test_hands_need_a_network_keypoints_and_leave(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HNERF_MODELS", str(tmp_path / "models"))
    ingest(write_easymocap(tmp_path / "folder"), CaptureSettings(), tmp_path / "capture")
    recording = Artifact(stage="capture", root=tmp_path / "capture", files={})
    assert not needs_hands(recording, DetectionSettings())
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / HAND_LANDMARKS).touch()
    assert needs_hands(recording, DetectionSettings())
    assert not needs_hands(recording, DetectionSettings(hands="none"))
    capture = Capture.load(tmp_path / "capture")
    dataclasses.replace(capture, train_cameras=capture.train_cameras[:1]).save()
    assert not needs_hands(recording, DetectionSettings())
    capture.save()
    (tmp_path / "capture" / "keypoints.npz").unlink()
    assert not needs_hands(recording, DetectionSettings())
