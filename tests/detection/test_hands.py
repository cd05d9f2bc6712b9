"""Where hands are searched for, and which points are kept; numbers worked out by hand."""

import itertools
import math
import threading
from pathlib import Path

import numpy as np
import pytest
import torch

from hnerf.capture.capture import Capture
from hnerf.capture.ingest import ingest
from hnerf.config import CaptureSettings
from hnerf.detection import hands
from hnerf.detection.hands import (
    HandNetwork,
    detect_hands,
    find_hands,
    forearm_region,
    given_hands,
    hand_region,
)
from hnerf.detection.region import Region
from tests.capture.recordings import CAMERAS, FRAMES, write_easymocap, write_keypoints

IMAGE = np.zeros((400, 400, 3), np.uint8)


def flat_hand(wrist: tuple[float, float]) -> np.ndarray:
    """Return a hand with fingers up: 40 px from wrist to knuckles, which span 30 px. Palm points reach 50 px high."""
    points = np.tile([*wrist, 0.9], (21, 1))
    for finger, x in zip((1, 5, 9, 13, 17), (-15, -15, 0, 15, 15), strict=True):
        for segment in range(4):
            points[finger + segment, :2] += x, -40 - 10 * segment
    return points


def person(left_wrist: tuple[float, float], right_wrist: tuple[float, float]) -> np.ndarray:
    """Return keypoints of a person with nose and ankle 300 px apart and elbows 40 px above the wrists."""
    keypoints = np.zeros((25, 3))
    keypoints[[0, 11]] = (200, 50, 1), (200, 350, 1)
    for (x, y), elbow, wrist in ((left_wrist, 6, 7), (right_wrist, 3, 4)):
        keypoints[[elbow, wrist]] = (x, y - 40, 1), (x, y, 1)
    return keypoints


def test_a_hand_is_searched_for_beyond_the_forearm() -> None:
    """For a forearm of 40 px pointing right, the region's centre is 18 px beyond the wrist, its side is 48 px and
    fingers point right. A forearm of 10 px, of a person of 300 px, counts as 30 px long for the side, which gives 36
    px."""
    region = forearm_region(np.array([100.0, 100]), np.array([140.0, 100]), 300.0)
    assert region.centre_px == pytest.approx([158, 100])
    assert region.side_px == pytest.approx(48) and region.angle == pytest.approx(math.pi / 2)
    assert forearm_region(np.array([100.0, 100]), np.array([110.0, 100]), 300.0).side_px == pytest.approx(36)


def test_the_next_region_is_around_the_palm() -> None:
    """The wrist is at (0, 0). Palm points reach up to 50 px, those of the thumb to 60, so the palm is 60 px high and 30
    px wide with its centre at (0, -30). The region is twice as large and shifted by 6 px upwards."""
    region = hand_region(flat_hand((0, 0))[:, :2])
    assert region.side_px == pytest.approx(120) and region.angle == pytest.approx(0)
    assert region.centre_px == pytest.approx([0, -36])
    upside_down = hand_region(-flat_hand((0, 0))[:, :2])
    assert abs(upside_down.angle) == pytest.approx(math.pi) and upside_down.centre_px == pytest.approx([0, 36])


def test_points_are_mapped_from_the_crop_to_the_image(monkeypatch: pytest.MonkeyPatch) -> None:
    """In a region of 448 px, a crop pixel is 2 px: (112, 112) is its centre, (0, 0) its corner. A white pixel is 1."""
    raw = np.full((21, 3), 112.0)
    raw[4] = 0, 0, 5
    monkeypatch.setattr(hands, "Network", lambda name: lambda image: [raw.ravel(), [0.7 * image.max()]])
    points = HandNetwork()(IMAGE + np.uint8(255), Region(np.array([300.0, 400.0]), 448.0, 0.0))
    assert points[0] == pytest.approx([300, 400, 0.7]) and points[4] == pytest.approx([76, 176, 0.7])


def test_hands_are_kept_only_near_a_visible_forearm() -> None:
    """The left hand comes first. A hand far from its wrist is dropped, and a hand whose forearm is not visible is not
    searched for."""
    keypoints = person((100, 200), (300, 200))
    found = find_hands(IMAGE, keypoints, lambda _, region: flat_hand((float(region.centre_px[0]), 205)))  # type: ignore[arg-type]
    assert found[:, 0, 0] == pytest.approx([100, 300], abs=8) and (found[..., 2] == 0.9).all()
    keypoints[3, 2] = 0
    found = find_hands(IMAGE, keypoints, lambda _, region: flat_hand((100, 205)))  # type: ignore[arg-type]
    assert found[0, 0, 2] == 0.9 and not found[1].any()
    found = find_hands(IMAGE, keypoints, lambda _, region: flat_hand((165, 205)))  # type: ignore[arg-type]
    assert not found.any()


def test_a_hand_found_for_both_arms_belongs_to_the_nearer_one() -> None:
    found = find_hands(IMAGE, person((190, 200), (210, 200)), lambda _, region: flat_hand((205, 205)))  # type: ignore[arg-type]
    assert not found[0].any() and found[1, 0, 2] == 0.9


def test_each_thread_has_its_own_network_and_hands_keep_the_order_of_images(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Points and confidences are the numbers of the images, from 0 to 9; a hand counts as found above .5."""
    ingest(write_easymocap(tmp_path / "folder"), CaptureSettings(), tmp_path / "capture")
    capture = Capture.load(tmp_path / "capture")
    numbers = np.arange(len(capture.train_cameras) * len(capture.frames)).reshape(len(capture.train_cameras), -1)
    people = {
        name: np.tile(row[:, None, None], (1, 25, 3)) for name, row in zip(capture.train_cameras, numbers, strict=True)
    }
    used: dict[object, set[int]] = {}

    def find(image: np.ndarray, keypoints: np.ndarray, network: HandNetwork) -> np.ndarray:
        used.setdefault(network._network, set()).add(threading.get_ident())
        return np.full((2, 21, 3), keypoints[0, 0])

    monkeypatch.setattr(torch, "get_num_threads", lambda: 3)
    monkeypatch.setattr(hands, "subject_keypoints", lambda recording: people)
    monkeypatch.setattr(hands, "has_model", lambda name: True)
    monkeypatch.setattr(hands, "Network", lambda name: object())
    monkeypatch.setattr(hands, "find_hands", find)
    assert detect_hands(capture, tmp_path / "out") == {"01": 0.8, "02": 1.0}
    assert max(map(len, used.values())) == 1
    written = Capture.load(tmp_path / "out")
    for name, row in zip(capture.train_cameras, numbers, strict=True):
        points, own = written.hands(name), written.keypoints(name)
        assert points is not None and points.shape == (5, 2, 21, 3) and points[:, 0, 0, 0].tolist() == row.tolist()
        assert own is not None and np.array_equal(own, capture.keypoints(name)) and capture.hands(name) is None


@pytest.mark.parametrize("installed", [True, False])
def test_hands_of_the_recordings_own_files_are_used_before_the_network(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, installed: bool
) -> None:
    """Files of camera 01 have hands in three of the five frames that show the subject, those of camera 02 in two. The
    subject comes second in each file, after a stranger with other hands; the network, which is searched for the
    subject's hands, finds hands at (1, 1)."""
    folder = write_easymocap(tmp_path / "folder")
    for camera, frame in itertools.product(CAMERAS, FRAMES):
        people = [np.tile([x, 5.0, 0.5], (25, 1)) for x in (3, 12)]
        shown = frame < {"01": 3, "02": 2}[camera]
        given = [(np.tile([x, frame, 0.75], (21, 1)), []) if shown else ([], []) for x in (4, 13)]
        write_keypoints(folder / "openpose" / camera / f"{frame:06d}_keypoints.json", people, given)
    capture = ingest(folder, CaptureSettings(), tmp_path / "capture")
    subject = np.tile([12.0, 5, 0.5], (5, 25, 1))
    monkeypatch.setattr(hands, "subject_keypoints", lambda recording: dict.fromkeys(CAMERAS, subject))
    monkeypatch.setattr(hands, "has_model", lambda name: installed)
    monkeypatch.setattr(hands, "Network", lambda name: object())
    monkeypatch.setattr(hands, "find_hands", lambda image, keypoints, network: np.ones((2, 21, 3)))
    shares = detect_hands(capture, tmp_path / "out")
    one, two = (Capture.load(tmp_path / "out").hands(name) for name in CAMERAS)
    assert one is not None and two is not None
    left = [[13, 0, 0.75], [13, 1, 0.75], [13, 2, 0.75], [0, 0, 0], [0, 0, 0]]
    assert one[:, 0, 20].tolist() == left and not one[:, 1].any()
    assert two[:, 0, 20].tolist() == ([[1, 1, 1]] * 5 if installed else [*left[:2], *[[0, 0, 0]] * 3])
    assert shares == {"01": 0.3, "02": 1.0 if installed else 0.2}


def test_a_person_whom_a_network_added_has_no_recorded_hands(tmp_path: Path) -> None:
    """In frame 2, keypoints are of a network's two people, of whom the subject is the second; the recording has one
    person's hands."""
    capture = ingest(write_easymocap(tmp_path / "folder"), CaptureSettings(), tmp_path / "capture")
    keypoints = np.zeros((5, 2, 25, 3))
    keypoints[:, 0], keypoints[2, :] = [12, 5, 0.5], [[[3, 5, 0.5]], [[12, 5, 0.5]]]
    np.savez(capture.root / "keypoints.npz", **{"01": keypoints})
    np.savez(capture.root / "given_hands.npz", **{"01": np.ones((5, 1, 2, 21, 3))})
    found = given_hands(capture, "01", np.tile([12.0, 5, 0.5], (5, 25, 1)))
    assert found[:, 0, 0, 0].tolist() == [1, 1, 0, 1, 1]


def test_given_hands_go_with_wrists_whose_sides_were_exchanged(tmp_path: Path) -> None:
    """In frame 3, the subject's wrists are those of the file with left and right exchanged."""
    capture = ingest(write_easymocap(tmp_path / "folder"), CaptureSettings(), tmp_path / "capture")
    keypoints = np.tile([12.0, 5, 0.5], (5, 1, 25, 1))
    keypoints[:, 0, [4, 7], 0] = 11, 13
    np.savez(capture.root / "keypoints.npz", **{"01": keypoints})
    hands = np.ones((5, 1, 2, 21, 3))
    hands[:, :, 1] = 2
    np.savez(capture.root / "given_hands.npz", **{"01": hands})
    subject = keypoints[:, 0].copy()
    subject[3, [4, 7]] = subject[3, [7, 4]]
    assert given_hands(capture, "01", subject)[:, :, 0, 0].tolist() == [[1, 2], [1, 2], [1, 2], [2, 1], [1, 2]]


def test_a_hand_is_searched_for_again_around_where_it_was_found() -> None:
    """The first region's side is 48 px, for a forearm of 40 px; the second's is twice the palm of 60 px."""
    sides_px = []

    def network(_: np.ndarray, region) -> np.ndarray:  # type: ignore[no-untyped-def]
        sides_px.append(region.side_px)
        return flat_hand((100, 205))

    keypoints = person((100, 200), (300, 200))
    keypoints[3, 2] = 0
    find_hands(IMAGE, keypoints, network)  # type: ignore[arg-type]
    assert sides_px == pytest.approx([48, 120])


def test_half_of_a_hands_direction_is_from_the_knuckles_beside_the_middle_finger() -> None:
    """The middle finger's knuckle is at (0, -40), the mean of its neighbours' at (40, -40): the hand points to (20,
    -40), turned by atan(1 / 2)."""
    points = flat_hand((0, 0))[:, :2]
    points[[5, 13], 0] = 30, 50
    assert hand_region(points).angle == pytest.approx(np.arctan(0.5))
