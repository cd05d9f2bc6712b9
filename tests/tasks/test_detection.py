"""When networks are used to detect people and their hands."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from hnerf.capture.capture import Capture
from hnerf.capture.given_poses import GivenPoses
from hnerf.capture.ingest import ingest
from hnerf.config import CaptureSettings, DetectionSettings, SegmentationSettings
from hnerf.models import HAND_LANDMARKS, POSE_DETECTOR
from tasks.detection import needs_detection, needs_hands
from tasks.segmentation import needs_body
from tasks.store import Artifact
from tests.capture.recordings import write_easymocap
from tests.segmentation.scene import write_likely, write_masks, write_scene


@pytest.mark.parametrize(
    ("source", "detected", "silent"),
    [(None, False, True), ("recording", False, False), ("network", True, True), ("both", True, True)],
)
def test_detection_depends_on_the_setting_and_the_recordings_keypoints(
    tmp_path: Path, source: str | None, detected: bool, silent: bool
) -> None:
    ingest(write_easymocap(tmp_path / "folder"), CaptureSettings(), tmp_path / "capture")
    recording = Artifact(stage="capture", root=tmp_path / "capture", files={})
    settings = DetectionSettings.model_validate({"source": source})
    assert needs_detection(recording, settings) is detected
    (tmp_path / "capture" / "keypoints.npz").unlink()
    assert needs_detection(recording, settings) is silent


def test_detected_people_make_a_rough_fit_unnecessary(tmp_path: Path) -> None:
    capture, truth = write_scene(tmp_path, 1, plate=False)
    capture.save()
    recording = Artifact(stage="capture", root=capture.root, files={})
    assert needs_body(recording, SegmentationSettings())
    write_likely(capture, truth)
    assert not needs_body(recording, SegmentationSettings())


def test_a_single_camera_needs_detection_for_the_depth_of_limbs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HNERF_MODELS", str(tmp_path))
    capture = Capture.load(ingest(write_easymocap(tmp_path / "folder"), CaptureSettings(), tmp_path / "capture").root)
    dataclasses.replace(capture, train_cameras=capture.train_cameras[:1]).save()
    recording = Artifact(stage="capture", root=tmp_path / "capture", files={})
    assert not needs_detection(recording, DetectionSettings())
    (tmp_path / POSE_DETECTOR).touch()
    assert needs_detection(recording, DetectionSettings())
    assert not needs_detection(recording, DetectionSettings(source="recording"))
    capture.save()
    assert not needs_detection(recording, DetectionSettings())


def test_hand_detection_needs_hands_or_a_network_keypoints_two_cameras_and_the_setting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HNERF_MODELS", str(tmp_path / "models"))
    ingest(write_easymocap(tmp_path / "folder"), CaptureSettings(), tmp_path / "capture")
    recording = Artifact(stage="capture", root=tmp_path / "capture", files={})
    assert not needs_hands(recording, DetectionSettings())
    np.savez(tmp_path / "capture" / "given_hands.npz")
    assert needs_hands(recording, DetectionSettings()) and not needs_hands(recording, DetectionSettings(hands="none"))
    (tmp_path / "capture" / "given_hands.npz").unlink()
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


def test_given_poses_take_the_place_of_detection(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a pose for every frame, neither a single camera nor missing keypoints need the network."""
    monkeypatch.setenv("HNERF_MODELS", str(tmp_path))
    (tmp_path / POSE_DETECTOR).touch()
    capture = ingest(write_easymocap(tmp_path / "folder"), CaptureSettings(), tmp_path / "capture")
    dataclasses.replace(capture, train_cameras=capture.train_cameras[:1]).save()
    recording = Artifact(stage="capture", root=capture.root, files={})
    poses = GivenPoses.unknown(len(capture.frames))
    poses.theta[:], poses.root[:] = 0, 0
    poses.save(capture.root / "poses.npz")
    assert not needs_detection(recording, DetectionSettings())
    (capture.root / "keypoints.npz").unlink()
    assert not needs_detection(recording, DetectionSettings())
    assert needs_detection(recording, DetectionSettings(source="both"))


def test_a_rough_fit_is_needed_if_one_camera_lacks_mask_and_plate_or_without_keypoints(tmp_path: Path) -> None:
    capture, truth = write_scene(tmp_path, 2)
    capture.save()
    recording, settings = Artifact(stage="capture", root=capture.root, files={}), SegmentationSettings()
    assert not needs_body(recording, settings)
    (tmp_path / "background" / "c1.png").unlink()
    assert needs_body(recording, settings)
    assert not needs_body(recording, SegmentationSettings(model=tmp_path / "seg.onnx"))
    write_masks(capture, {view: mask for view, mask in truth.items() if view[0] == "c1"})
    assert not needs_body(recording, settings)
    (tmp_path / "keypoints.npz").unlink()
    assert needs_body(recording, settings)
