"""People are tracked from image to image and detected again when they are lost; with made-up networks."""

import numpy as np
import pytest

from hnerf.detection.landmarks import Person
from hnerf.detection.region import Region
from hnerf.detection.tracker import REDETECT_EVERY, track

SIDE_PX = 100.0


class Scene:
    """A scene whose images are the positions of people, rows (x, y). The landmark network sees a person within half a
    region's side."""

    def __init__(self) -> None:
        self.detections, self.landmarked = 0, 0

    def detector(self, image: np.ndarray) -> list[Region]:
        self.detections += 1
        return [Region(place + 5, SIDE_PX, 0.0) for place in image]

    def landmarks(self, image: np.ndarray, region: Region) -> Person | None:
        self.landmarked += 1
        near = [place for place in image if np.linalg.norm(place - region.centre_px) < SIDE_PX / 2]
        if not near:
            return None
        points = np.tile([*near[0], 1.0], (33, 1))
        return Person(points, np.zeros((33, 3)), np.zeros((256, 256)), region, Region(near[0], SIDE_PX, 0.0))


def places(people: list[Person]) -> list[float]:
    return [person.points_px[0, 0] for person in people]


def test_a_person_who_moves_little_is_tracked_without_new_detection() -> None:
    scene, images = Scene(), [np.array([[8.0 * i, 0.0]]) for i in range(REDETECT_EVERY)]
    found = [places(people) for people in track(images, scene.detector, scene.landmarks)]
    assert found == [[8.0 * i] for i in range(10)]
    assert scene.detections == 1 and scene.landmarked == len(images)


def test_a_lost_person_is_detected_again() -> None:
    scene, images = Scene(), [np.array([[0.0, 0.0]]), np.zeros((0, 2)), np.array([[500.0, 0.0]])]
    assert [places(people) for people in track(images, scene.detector, scene.landmarks)] == [[0.0], [], [500.0]]
    assert scene.detections == 3


def test_landmarks_are_found_twice_for_a_person_who_moves_far() -> None:
    """The person moves by 30 px of 100. The second pass, at the place found by the first, agrees with it."""
    scene, images = Scene(), [np.array([[0.0, 0.0]]), np.array([[30.0, 0.0]])]
    *_, people = track(images, scene.detector, scene.landmarks)
    assert scene.landmarked == 1 + 2
    assert people[0].region.centre_px == pytest.approx([30, 0])


def test_landmarks_of_a_person_who_is_always_elsewhere_are_found_three_times() -> None:
    scene = Scene()
    next(track([np.zeros((1, 2))], scene.detector, lambda _, at: scene.landmarks(at.centre_px[None] + 20, at)))
    assert scene.landmarked == 3


def test_a_person_who_enters_later_is_found_once_and_nobody_twice() -> None:
    """Landmarks are not searched for where the detector finds the first person again."""
    scene, both = Scene(), np.array([[100.0, 0.0], [300.0, 0.0]])
    images = [both[:1] if i < 3 else both for i in range(REDETECT_EVERY + 2)]
    counts = [len(people) for people in track(images, scene.detector, scene.landmarks)]
    assert counts == [1] * REDETECT_EVERY + [2, 2] and scene.landmarked == REDETECT_EVERY + 4


def test_detection_runs_in_every_image_while_a_person_is_missing() -> None:
    """Two people meet in the second image and part in the third: both are found again at once."""
    near, apart = np.array([[0.0, 0.0], [60.0, 0.0]]), np.array([[0.0, 0.0], [4.0, 0.0]])
    scene, images = Scene(), [near, apart, near]
    counts = [len(people) for people in track(images, scene.detector, scene.landmarks)]
    assert counts == [2, 1, 2] and scene.detections == 3


def test_landmarks_are_found_twice_for_a_person_of_another_size() -> None:
    """The person fills a region of 130 px, where the detector's has 100: 1.3 times as large, at the same place."""
    sides = []

    def landmarks(image: np.ndarray, region: Region) -> Person:
        sides.append(region.side_px)
        return Person(
            np.zeros((33, 3)), np.zeros((33, 3)), np.zeros((256, 256)), region, Region(np.zeros(2), 130.0, 0.0)
        )

    next(track([np.zeros((1, 2))], lambda _: [Region(np.zeros(2), 100.0, 0.0)], landmarks))
    assert sides == [100, 130]
