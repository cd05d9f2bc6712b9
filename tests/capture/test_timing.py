import json
from pathlib import Path

import numpy as np
import pytest

from hnerf.capture.capture import LANDMARKS, Capture, write_image
from hnerf.capture.given_poses import GivenPoses
from hnerf.capture.timing import nearest_frame, nearest_rows, resample
from hnerf.geometry.camera import Camera


def people_at(*x_px: float) -> np.ndarray:
    """Return people (people, 2, 3) of two keypoints 100 px apart, one below the other."""
    return np.array([[[x, 0, 0.8], [x, 100, 0.8]] for x in x_px])


def test_nearest_frame_by_hand() -> None:
    assert [nearest_frame(10, offset) for offset in (-0.6, -0.4, 0.4, 0.5, 2.7)] == [9, 10, 10, 11, 13]
    assert [nearest_frame(20, offset, 10) for offset in (-4.1, -6.0, 5.0, 27.0)] == [20, 10, 30, 50]  # 0, 10, 20, ...


def test_keypoints_between_frames_by_hand() -> None:
    moving = np.stack([people_at(10 * frame) for frame in range(4)])
    found = resample(moving, range(4), np.array([1.25, 2.0, 3.4, 3.6, -0.6]))
    # Linear between frames; beyond the ends, the last value for half a step, then nobody.
    np.testing.assert_allclose(found[:3, 0, 0], [[12.5, 0, 0.8], [20, 0, 0.8], [30, 0, 0.8]])
    assert not found[3:].any()
    strided = resample(moving, (0, 5, 10, 15), np.array([2.0, 17.0, 18.0]))
    assert strided[:, 0, 0].tolist() == [[4, 0, 0.8], [30, 0, 0.8], [0, 0, 0]]


def test_keypoints_are_not_interpolated_across_a_gap() -> None:
    frames = (0, 1, 2, 10, 11)
    moving = np.stack([people_at(10 * frame) for frame in frames])
    found = resample(moving, frames, np.array([2.3, 6.0, 9.6, 10.5]))
    assert found[:, 0, 0, 0].tolist() == [20, 0, 100, 105]


def test_a_keypoint_seen_in_one_frame_only_is_taken_from_it() -> None:
    pair = np.stack([people_at(0), people_at(10)])
    pair[1, 0, 1] = 0
    found = resample(pair, (0, 1), np.array([0.25, 0.75]))
    assert found[0, 0].tolist() == [[2.5, 0, 0.8], [0, 100, 0.8]]
    assert found[1, 0].tolist() == [[7.5, 0, 0.8], [0, 0, 0]]


def test_people_are_matched_between_frames_in_any_order() -> None:
    swapped = np.stack([people_at(0, 500), people_at(510, 10)])
    assert resample(swapped, (0, 1), np.array([0.4]))[0, :, 0, 0].tolist() == [4, 504]


def test_the_known_row_nearest_in_time_is_found_and_the_earlier_one_of_two() -> None:
    assert nearest_rows([0, 3], [0, 8, 9, 10]) == [0, 3, 3, 3]  # row 1 is nearer to row 0, but not in time
    assert nearest_rows([0, 2], [0, 1, 2]) == [0, 0, 2]


def test_hands_keep_their_order_however_far_they_move() -> None:
    """Hands cross; the second frame lacks one of their points."""
    crossing = np.stack([people_at(0, 100), people_at(100, 0)])
    crossing[1, 1, 1] = 0
    found = resample(crossing, (0, 1), np.array([0.25]), in_order=True)
    assert found[0].tolist() == [[[25, 0, 0.8], [25, 100, 0.8]], [[75, 0, 0.8], [100, 100, 0.8]]]


def test_a_synchronised_capture_reads_the_nearest_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    camera = Camera("a", np.eye(3), np.eye(3), np.zeros(3), 4, 4)
    for frame in range(6):
        for folder, value in (("images", 40 * frame), ("masks", 255 * (frame == 4))):
            write_image(tmp_path / folder / "a" / f"{frame:06d}.png", np.full((4, 4), value, np.uint8))
    np.savez(tmp_path / "keypoints.npz", a=np.stack([people_at(10 * frame) for frame in range(6)]))
    np.savez(tmp_path / "hands.npz", a=np.stack([people_at(0, 90 * frame) for frame in range(6)]))
    size = {"a": (4, 4)}
    capture = Capture("x", tmp_path, {"a": camera}, ("a",), (), (0, 1, 2, 3), (4, 5), 30.0, "z", size, size)

    shifted = capture.synchronised({"a": 1.75})  # instants 0 .. 3 lie nearest to frames 2 .. 5; 4 and 5 are beyond
    assert (shifted.train_frames, shifted.novel_pose_frames) == ((0, 1, 2, 3), ())
    with monkeypatch.context() as patched:  # without a search of the folder, whose time grows with the recording
        patched.delattr(Path, "glob")
        assert shifted.image("a", 1).max() == 120
    assert [shifted.given_mask("a", frame).all() for frame in shifted.frames] == [False, False, True, False]  # type: ignore[union-attr]
    found = shifted.keypoints("a")
    assert found is not None
    np.testing.assert_allclose(found[:, 0, 0, 0], [17.5, 27.5, 37.5, 47.5])

    hands = shifted.hands("a")  # the right hand moves by nearly its own length per frame
    assert hands is not None
    np.testing.assert_allclose(hands[:, :, 0, 0], [[0, x] for x in (157.5, 247.5, 337.5, 427.5)])

    shifted.save()
    assert json.loads((tmp_path / "capture.json").read_text())["frame_offsets"] == {"a": 1.75}
    again = Capture.load(tmp_path)
    assert (again.frame_offsets, again.stored_frames, again.frames) == ({"a": 1.75}, (0, 1, 2, 3, 4, 5), (0, 1, 2, 3))


def test_poses_and_landmarks_of_a_synchronised_capture_stay_with_their_instants(tmp_path: Path) -> None:
    """Camera a is two frames early, to the nearest frame: instants 2 to 5 are its frames 0 to 3. Poses are of
    instants."""
    camera, size = Camera("a", np.eye(3), np.eye(3), np.zeros(3), 4, 4), {"a": (4, 4)}
    capture = Capture("x", tmp_path, {"a": camera}, ("a",), (), tuple(range(6)), (), 30.0, "z", size, size)
    poses = GivenPoses.unknown(6)
    poses.theta[:], poses.root[:] = 0, 0
    poses.theta[:, 0, 0] = range(6)
    poses.save(tmp_path / "poses.npz")
    (tmp_path / LANDMARKS).mkdir()
    np.savez(tmp_path / LANDMARKS / "a.npz", points_px=np.arange(6), points_m=np.arange(6) / 10)
    shifted = capture.synchronised({"a": -1.75})
    given, landmarks = shifted.given_poses(), shifted.landmarks("a")
    assert shifted.frames == (2, 3, 4, 5)
    assert given is not None and given.theta[:, 0, 0].tolist() == [2, 3, 4, 5]
    assert landmarks is not None and [found.tolist() for found in landmarks] == [[0, 1, 2, 3], [0, 0.1, 0.2, 0.3]]
