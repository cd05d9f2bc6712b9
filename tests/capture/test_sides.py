"""Left and right that single cameras exchange, in detections of a walking stick figure."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from hnerf.capture.sides import PARTS, put_sides_right
from hnerf.capture.subject import ranked_people
from tests.calibration.synthetic import detections, ring, turned, write_capture


def exchanged(keypoints: np.ndarray, images: list[tuple[int, int]], parts: tuple[int, ...] = (0, 1, 2)) -> np.ndarray:
    """Return a copy of keypoints (C, F, 25, 3) in which these images, (camera, frame), have parts exchanged."""
    found = keypoints.copy()
    for part in parts:
        for right, left in PARTS[part]:
            for camera, frame in images:
                found[camera, frame, [right, left]] = keypoints[camera, frame, [left, right]]
    return found


@pytest.mark.parametrize(
    ("cameras", "images"),
    [
        (4, [(1, 3), (1, 4), (1, 5), (2, 4), (3, 9)]),  # in frame 4, two contradict the other two
        (3, [(0, 5), (1, 5)]),  # most cameras are wrong
        (8, [(5, frame) for frame in range(12)]),  # one of many is always wrong
    ],
)
def test_exchanged_sides_are_put_right(cameras: int, images: list[tuple[int, int]]) -> None:
    rig = ring(cameras)
    seen = detections(rig, 2)
    found, where = put_sides_right(rig, exchanged(seen, images))
    np.testing.assert_array_equal(found[:, :, :15], seen[:, :, :15])
    assert {(c, f) for c, f in np.argwhere(where).tolist()} == set(images)


@pytest.mark.parametrize("part", [0, 1])
def test_arms_and_legs_are_exchanged_on_their_own(part: int) -> None:
    seen = detections(ring(4), 2)
    found, _ = put_sides_right(ring(4), exchanged(seen, [(2, 6)], (part,)))
    np.testing.assert_array_equal(found, seen)


def test_noise_outliers_and_unseen_points_exchange_nothing() -> None:
    """The person is about 450 px tall. Keypoints are 5 px off, one wrist by 200 px, and one camera sees nothing."""
    seen = detections(ring(4), 5)
    seen[1, :, 4, :2] += 200
    seen[2], seen[3, 5, 9:] = 0.0, 0.0
    found, where = put_sides_right(ring(4), seen)
    np.testing.assert_array_equal(found, seen)
    assert not where.any()


def test_cameras_that_disagree_about_more_than_sides_exchange_nothing() -> None:
    """Every camera is turned by 5 degrees, which is 30 cm at the person's distance, to the left and right in turn."""
    found, _ = put_sides_right(
        [turned(c, 5 * (-1) ** i) for i, c in enumerate(ring(4))], seen := detections(ring(4), 1)
    )
    np.testing.assert_array_equal(found, seen)


def test_one_camera_cannot_tell(tmp_path: Path) -> None:
    seen = exchanged(detections(ring(4), 1), [(0, 3)])
    capture = dataclasses.replace(write_capture(tmp_path, ring(4), seen), train_cameras=("c0",))
    person = ranked_people(capture)[0]
    np.testing.assert_array_equal(person.keypoints, seen[:1])
    assert person.exchanged == ()
