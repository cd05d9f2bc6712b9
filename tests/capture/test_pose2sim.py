"""BODY_25B to BODY_25, and the real capture in this layout."""

from pathlib import Path

import numpy as np
import pytest

from hnerf.capture.capture import Capture
from hnerf.capture.formats.pose2sim import Pose2Sim, body_25_from_25b, is_body_25
from hnerf.capture.ingest import ingest
from hnerf.config import CaptureSettings
from tests.shared_data import shared_capture

# Point i of BODY_25B lies at (i, 100 i) with confidence 0.5 + i / 100.
BODY_25B = np.stack([np.arange(25.0), 100 * np.arange(25.0), 0.5 + np.arange(25) / 100], -1)


def test_body_25b_order() -> None:
    """OpenPose: 0 nose, 1-4 eyes and ears (left first), 5-16 shoulders to ankles in pairs (left first), 17 upper neck,
    18 head top, 19-24 feet as in BODY_25."""
    body_25 = body_25_from_25b(BODY_25B)
    assert body_25[0, 0] == 0  # nose
    assert body_25[1].tolist() == pytest.approx([5.5, 550, 0.55])  # neck: middle of the shoulders
    assert body_25[2:8, 0].tolist() == [6, 8, 10, 5, 7, 9]  # right, left: shoulder, elbow, wrist
    assert body_25[8].tolist() == pytest.approx([11.5, 1150, 0.61])  # middle of the hips
    assert body_25[9:15, 0].tolist() == [12, 14, 16, 11, 13, 15]  # right, left: hip, knee, ankle
    assert body_25[15:19, 0].tolist() == [2, 1, 4, 3]  # right eye, left eye, right ear, left ear
    assert body_25[19:, 0].tolist() == [19, 20, 21, 22, 23, 24]


def test_a_mean_needs_both_points() -> None:
    one_shoulder = BODY_25B.copy()
    one_shoulder[6] = 0
    assert body_25_from_25b(one_shoulder)[1].tolist() == [0, 0, 0]
    assert body_25_from_25b(one_shoulder)[5, 0] == 5


@pytest.fixture(scope="module")
def balance(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    folder = shared_capture("pose2sim-balance")
    return ingest(folder, CaptureSettings(max_side_px=256), tmp_path_factory.mktemp("balance"))


def test_real_detections_become_body_25(balance: Capture) -> None:
    keypoints = balance.keypoints("cam03")
    assert keypoints is not None and is_body_25(keypoints)
    # He stands in portrait images: neck above hips above his standing leg's knee above its ankle, in every frame.
    person = keypoints[:, np.argmax(keypoints[..., 2].sum(-1).mean(0))]
    assert (np.diff(person[:, [1, 8, 13, 14], 1], axis=1) > 0).all()


def test_files_that_hold_body_25_already_are_left_alone(balance: Capture, tmp_path: Path) -> None:
    keypoints = balance.keypoints("cam03")
    assert keypoints is not None and np.array_equal(Pose2Sim(tmp_path).to_body_25(keypoints), keypoints)
    assert not is_body_25(np.tile(BODY_25B, (60, 1, 1)))  # a straight line of points is no BODY_25


def test_defects_of_the_real_capture_are_recorded(balance: Capture) -> None:
    assert balance.recorded_sizes_px["cam01"] == (1080, 1920) and balance.calibrated_sizes_px["cam01"] == (1088, 1920)
    assert balance.train_frames == tuple(range(48)) and balance.novel_pose_frames == tuple(range(48, 60))
    assert balance.fps == pytest.approx(60.0) and balance.up == "z"
    # Z is up: the cameras' own up directions cancel but for their common vertical part.
    upward = -np.mean([camera.R[1] for camera in balance.cameras.values()], axis=0)
    assert np.argmax(np.abs(upward)) == 2 and upward[2] > 0.8
