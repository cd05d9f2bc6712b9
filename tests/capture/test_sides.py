"""Left and right that single cameras exchange, in detections of a walking stick figure."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from hnerf.capture.sides import PARTS, put_sides_right
from hnerf.capture.subject import ranked_people
from tests.calibration.synthetic import FRAMES, detections, ring, turned, write_capture


def exchanged(keypoints: np.ndarray, images: list[tuple[int, int]], parts: tuple[int, ...] = (0, 1)) -> np.ndarray:
    """Return a copy of keypoints (C, F, 25, 3) in which these images, (camera, frame), have parts exchanged."""
    found = keypoints.copy()
    for part in parts:
        for right, left in PARTS[part]:
            for camera, frame in images:
                found[camera, frame, [right, left]] = keypoints[camera, frame, [left, right]]
    return found


TIMES_S = np.arange(FRAMES) / 30


@pytest.mark.parametrize(
    ("cameras", "images"),
    [
        (4, [(1, 0), (2, 0), (1, 3), (1, 4), (1, 5), (2, 4), (3, 9)]),  # in frames 0 and 4, two against two
        (3, [(0, 5), (2, 7)]),
        (8, [(5, frame) for frame in range(FRAMES)]),  # one of many is always wrong
    ],
)
def test_exchanged_sides_are_put_right(cameras: int, images: list[tuple[int, int]]) -> None:
    seen = detections(ring(cameras), 2)
    found, where = put_sides_right(ring(cameras), exchanged(seen, images), TIMES_S)
    np.testing.assert_array_equal(found, seen)
    assert {(c, f) for c, f in np.argwhere(where).tolist()} == set(images)


def test_most_cameras_decide_although_the_person_has_turned_around() -> None:
    """Frame 6 shows the person half a turn after frame 5."""
    turned_around = detections(ring(4), 2)[:, [0, 1, 2, 3, 4, 5, 11]]
    found, _ = put_sides_right(ring(4), exchanged(turned_around, [(1, 6)]), TIMES_S[:7])
    np.testing.assert_array_equal(found, turned_around)


def test_nothing_is_exchanged_if_half_of_the_cameras_contradict_and_no_frame_is_near() -> None:
    """At two frames a second, the next is half a second away."""
    seen = exchanged(detections(ring(4), 2), [(1, 4), (2, 4)])
    found, where = put_sides_right(ring(4), seen, np.arange(FRAMES) / 2)
    np.testing.assert_array_equal(found, seen)
    assert not where.any()


@pytest.mark.parametrize("part", [0, 1])
def test_arms_and_legs_are_exchanged_on_their_own(part: int) -> None:
    seen = detections(ring(4), 2)
    found, _ = put_sides_right(ring(4), exchanged(seen, [(2, 6)], (part,)), TIMES_S)
    np.testing.assert_array_equal(found, seen)


def test_noise_outliers_and_unseen_points_exchange_nothing() -> None:
    """The person is about 450 px tall. Keypoints are 5 px off, one wrist by 200 px, and one camera sees nothing."""
    seen = detections(ring(4), 5)
    seen[1, :, 4, :2] += 200
    seen[2], seen[3, 5, 9:] = 0.0, 0.0
    found, where = put_sides_right(ring(4), seen, TIMES_S)
    np.testing.assert_array_equal(found, seen)
    assert not where.any()


@pytest.mark.parametrize("blind", [(), (1, 3)])
def test_a_side_that_is_hidden_exchanges_nothing(blind: tuple[int, ...]) -> None:
    """Exchanging one of two views of a single arm would leave nothing to contradict."""
    seen = detections(ring(4), 15)
    seen[:, :, [right for part in PARTS for right, _ in part]] = 0.0
    seen[list(blind)] = 0.0
    assert not put_sides_right(ring(4), seen, TIMES_S)[1].any()


def test_cameras_that_disagree_about_more_than_sides_exchange_nothing() -> None:
    """Every camera is turned by 5 degrees, which is 30 cm at the person's distance, to the left and right in turn."""
    seen, wrong = detections(ring(4), 1), [turned(c, 5 * (-1) ** i) for i, c in enumerate(ring(4))]
    found, _ = put_sides_right(wrong, seen, TIMES_S)
    np.testing.assert_array_equal(found, seen)


def test_one_camera_cannot_tell(tmp_path: Path) -> None:
    seen = exchanged(detections(ring(4), 1), [(0, 3)])
    capture = dataclasses.replace(write_capture(tmp_path, ring(4), seen), train_cameras=("c0",))
    person = ranked_people(capture)[0]
    np.testing.assert_array_equal(person.keypoints, seen[:1])
    assert person.exchanged == ()
