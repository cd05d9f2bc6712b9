import dataclasses
from pathlib import Path

import pytest

from hnerf.capture.capture import Capture, SubjectPoint
from hnerf.capture.given_poses import GivenPoses
from hnerf.capture.subject import subject_keypoints
from hnerf.capture.subset import subset
from hnerf.errors import InputError
from tests.calibration.synthetic import ring
from tests.capture.test_subject import recorded, share_right, staying, walking
from tests.study.recording import write_landmarks, write_recording


def test_a_subset_has_the_files_of_the_chosen_cameras_and_frames(tmp_path: Path) -> None:
    subset(write_recording(tmp_path / "all"), tmp_path / "few", ("02",), (6, 2), (10,))
    few = Capture.load(tmp_path / "few")
    assert (few.train_cameras, few.test_cameras, tuple(few.cameras)) == (("02",), ("03",), ("02", "03"))
    assert (few.train_frames, few.novel_pose_frames, few.frames) == ((2, 6), (10,), (2, 6, 10))
    keypoints = few.keypoints("02")
    assert keypoints is not None
    assert keypoints[:, 0, 1, 0].tolist() == [2, 6, 10]
    assert few.image("02", 6)[0, 0].tolist() == [106, 106, 106]
    stored = sorted(str(p.relative_to(few.root)) for p in few.root.rglob("*.png"))
    names = [f"{camera}/{frame:06d}.png" for camera in ("02", "03") for frame in (2, 6, 10)]
    pictures = [f"{folder}/{name}" for folder in ("images", "masks") for name in names]
    assert stored == ["background/02.png", "background/03.png", *pictures]


def test_landmarks_stay_with_their_frames(tmp_path: Path) -> None:
    capture = write_recording(tmp_path / "all")
    write_landmarks(capture, "02")
    subset(capture, tmp_path / "few", ("02",), (6, 2), (10,))
    few = Capture.load(tmp_path / "few")
    landmarks = few.landmarks("02")
    assert landmarks is not None
    assert [points[:, 0, 0, 0].tolist() for points in landmarks] == [[2, 6, 10], [0.2, 0.6, 1.0]]
    assert few.landmarks("03") is None  # no network looked for any


def test_given_poses_stay_with_their_frames(tmp_path: Path) -> None:
    capture = write_recording(tmp_path / "all")
    poses = GivenPoses.unknown(5)
    poses.theta[:], poses.root[:] = 0, 0
    poses.theta[:, 0, 0] = poses.root[:, 0, 0] = capture.frames
    poses.save(capture.root / "poses.npz")
    subset(capture, tmp_path / "few", train_frames=(6, 2), novel_pose_frames=(10,))
    few = Capture.load(tmp_path / "few").given_poses()
    assert few is not None
    assert few.theta[:, 0, 0].tolist() == few.root[:, 0, 0].tolist() == [2, 6, 10]


def test_a_subject_named_in_a_camera_left_out_is_named_in_another(tmp_path: Path) -> None:
    people_m = staying((0, -0.6)), staying((0, 0.6))
    capture, each = recorded(tmp_path / "all", ring(3), *people_m)
    x, y, _ = each[1]["c1"][7, 0]
    capture = dataclasses.replace(capture, subject_point=SubjectPoint((x, y), "c1", 7))
    subset(capture, tmp_path / "few", ("c0", "c2"))
    few = Capture.load(tmp_path / "few")
    assert few.subject_point is not None and few.subject_point.camera == "c0"
    assert share_right(subject_keypoints(few), {name: each[1][name] for name in ("c0", "c2")}) == 1
    subset(capture, tmp_path / "kept", ("c1", "c2"))
    assert Capture.load(tmp_path / "kept").subject_point == capture.subject_point


def test_a_subject_named_in_a_frame_left_out_is_named_in_another(tmp_path: Path) -> None:
    """In the frames that are left, two people have changed places: the other one is nearest to the point."""
    people_m = walking((-1.2, -0.3), (1.2, -0.3)), walking((1.2, 0.3), (-1.2, 0.3))
    capture, each = recorded(tmp_path / "all", ring(3), *people_m)
    x, y, _ = each[0]["c1"][0, 0]
    capture = dataclasses.replace(capture, subject_point=SubjectPoint((x, y), "c1", 0))
    subset(capture, tmp_path / "few", train_frames=tuple(range(22, 30)), novel_pose_frames=())
    late = {name: seen[22:] for name, seen in each[0].items()}
    assert share_right(subject_keypoints(Capture.load(tmp_path / "few")), late) == 1


def test_none_keeps_everything(tmp_path: Path) -> None:
    capture = write_recording(tmp_path / "all")
    subset(capture, tmp_path / "same")
    folders = capture.root, tmp_path / "same"
    before, after = ({p.relative_to(root): p.read_bytes() for p in root.rglob("*.png")} for root in folders)
    assert before == after
    assert len(before) == 2 * 3 * 5 + 3
    assert (tmp_path / "same" / "capture.json").read_text() == (capture.root / "capture.json").read_text()


def test_a_missing_camera_or_frame_is_refused(tmp_path: Path) -> None:
    capture = write_recording(tmp_path / "all")
    with pytest.raises(InputError, match="ada: no training camera 03; there are 01, 02"):
        subset(capture, tmp_path / "a", ("03",))
    with pytest.raises(InputError, match="ada: no training frame 8; there are 2, 4, 6"):
        subset(capture, tmp_path / "b", train_frames=(8,))
    with pytest.raises(InputError, match="no training camera or frame would be left"):
        subset(capture, tmp_path / "c", train_frames=())
