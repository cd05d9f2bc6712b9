"""The real capture in the Pose2Sim layout."""

import logging
import shutil
from pathlib import Path

import numpy as np
import pytest

from hnerf.capture.capture import Capture
from hnerf.capture.formats.export import write_cameras
from hnerf.capture.formats.pose2sim import Pose2Sim
from hnerf.capture.ingest import exported_lenses, ingest
from hnerf.capture.keypoint_sets import is_body_25
from hnerf.config import CaptureSettings
from tests.capture import recordings as rec
from tests.shared_data import shared_capture


@pytest.fixture(scope="module")
def balance(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """Return the capture with one in eight of its 60 frames; the last fifth of the 60 is for novel poses."""
    folder = shared_capture("pose2sim-balance")
    return ingest(folder, CaptureSettings(max_side_px=256, max_frames=6), tmp_path_factory.mktemp("balance"))


def test_real_detections_become_body_25(balance: Capture) -> None:
    keypoints = balance.keypoints("cam03")
    assert keypoints is not None and is_body_25(keypoints)
    # The person is upright in every frame: neck above hips, hips above the standing leg's knee, knee above its ankle.
    person = keypoints[:, np.argmax(keypoints[..., 2].sum(-1).mean(0))]
    assert (np.diff(person[:, [1, 8, 13, 14], 1], axis=1) > 0).all()


def test_defects_of_the_real_capture_are_recorded(balance: Capture) -> None:
    assert balance.recorded_sizes_px["cam01"] == (1080, 1920) and balance.calibrated_sizes_px["cam01"] == (1088, 1920)
    assert balance.train_frames == tuple(range(0, 48, 8)) and balance.novel_pose_frames == (48, 56)
    assert balance.fps == pytest.approx(60.0) and balance.up == "z"
    # Z is up: the cameras' own up directions cancel but for their common vertical part.
    upward = -np.mean([camera.R[1] for camera in balance.cameras.values()], axis=0)
    assert np.argmax(np.abs(upward)) == 2 and upward[2] > 0.8


def test_both_narrow_videos_are_matched_by_their_bars(balance: Capture) -> None:
    assert set(balance.picture_areas_px) == {"cam01", "cam02"}
    for area in balance.picture_areas_px.values():
        assert (area.left, area.width) == (0, 1080)
        assert area.top == pytest.approx(7, abs=0.1)
        assert area.height == pytest.approx(1920 * 1080 / 1088, abs=0.1)


def test_keypoints_and_videos_of_uncalibrated_cameras_get_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = rec.write_pose2sim(tmp_path / "film")
    with caplog.at_level(logging.WARNING, "hnerf.capture"):
        ingest(folder, CaptureSettings(), tmp_path / "out")
        assert not caplog.messages
        (folder / "pose" / "cam01_json").rename(folder / "pose" / "cam01")
        rec.write_video(folder / "videos" / "cam09.mp4", 10)
        ingest(folder, CaptureSettings(), tmp_path / "again")
    assert caplog.messages == [
        f"{folder}/{found} not in the calibration, and not read; rename or remove them"
        for found in ("videos: 'cam09'", "pose: 'cam01'")
    ]


def test_cameras_are_the_tables_with_a_matrix_and_called_as_these_unless_named(tmp_path: Path) -> None:
    """As Pose2Sim reads files that Caliscope and others wrote."""
    folder = rec.write_pose2sim(tmp_path / "walker")
    file = folder / "calibration" / "Calib.toml"
    text = file.read_text().replace('[cam02]\nname = "cam02"\n', "[second]\n")
    file.write_text(f"CreationDate = 2023-03-31T09:56:43\n{text}\n[capture_volume]\nstage = 1\n[charuco]\nrows = 5\n")
    assert list(Pose2Sim(folder).lenses()) == ["cam01", "second"]


def test_keypoint_files_are_sorted_by_the_numbers_in_their_names(tmp_path: Path) -> None:
    """Digits of other scripts count as letters."""
    folder = tmp_path / "pose" / "a_json"
    folder.mkdir(parents=True)
    for name in ("walk1_10", "walk1_9", "walk_\u0663", "\u0663"):
        (folder / f"{name}.json").touch()
    files = Pose2Sim(tmp_path).keypoint_files("a")
    assert [file.path.stem for file in files.values()] == ["walk1_9", "walk1_10", "walk_\u0663", "\u0663"]


def test_keypoint_files_are_matched_to_numbered_images(tmp_path: Path) -> None:
    """There are images 3 to 12 with masks, and ten keypoint files that are numbered differently."""
    folder = rec.write_pose2sim(tmp_path / "walker")
    for written in ("videos", "pose"):
        shutil.rmtree(folder / written)
    for camera in rec.CAMERAS:
        for frame in range(3, 13):
            rec.write_image(folder / "images" / f"cam{camera}" / f"{frame}.png", np.full((48, 64, 3), 9, np.uint8))
            rec.write_image(folder / "masks" / f"cam{camera}" / f"{frame}.png", np.full((48, 64), 255, np.uint8))
            person = np.tile([10.0 + frame, 20, 0.5], (25, 1))
            rec.write_keypoints(folder / "pose" / f"cam{camera}_json" / f"k_{frame - 3}.json", [person])
    found = ingest(folder, CaptureSettings(), tmp_path / "out")
    keypoints = found.keypoints("cam01")
    assert keypoints is not None and found.frames == tuple(range(3, 13))
    assert keypoints[:, 0, 0, 0].tolist() == [10.0 + frame for frame in found.frames]
    assert found.has_given_mask("cam01", 3)


def test_keypoints_are_kept_if_another_calibration_takes_precedence(tmp_path: Path) -> None:
    folder = rec.write_pose2sim(tmp_path / "walker")
    for camera in rec.CAMERAS:
        for frame in range(10):
            person = np.tile([10.0 + frame, 20, 0.5], (25, 1))
            rec.write_keypoints(folder / "pose" / f"cam{camera}_json" / f"cam{camera}_{frame:06d}.json", [person])
    before = ingest(folder, CaptureSettings(), tmp_path / "before")
    write_cameras(folder, exported_lenses(folder), "easymocap")
    after = ingest(folder, CaptureSettings(), tmp_path / "after")
    found = [capture.keypoints("cam01") for capture in (before, after)]
    assert found[1] is not None and np.array_equal(*found)
