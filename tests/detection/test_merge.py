"""Keypoints that a recording lacks are filled in from the network's detection of the same person."""

import numpy as np

from hnerf.detection.merge import fill_missing, nearest_person


def person(x: float, confidence: float) -> np.ndarray:
    """Return points on a line of 100 px, from (x, 0) to (x, 100)."""
    return np.column_stack([np.full(25, x), np.linspace(0, 100, 25), np.full(25, confidence)])


def test_missing_joints_are_filled_from_the_same_person() -> None:
    """The limit is 15 px for a height of 100 px."""
    own = person(0, 0.9)
    own[11] = 0
    merged = fill_missing(own[None], np.stack([person(40, 0.5), person(10, 0.6)]))
    assert merged.shape == (1, 25, 3)
    assert merged[0, 11].tolist() == person(10, 0.6)[11].tolist()
    assert merged[0, 10].tolist() == own[10].tolist()
    assert fill_missing(own[None], person(16, 0.6)[None])[0, 11].tolist() == [0, 0, 0]


def test_people_are_compared_at_keypoints_that_both_have() -> None:
    """The subject is 100 px tall and has three of five keypoints. Of three people, the first is 20 px off. The second
    is 10 px off at two keypoints, and far off at those that either of the two lacks. The third is not seen at all.
    Beyond 15 px it is another person."""
    subject = np.array([[0, 0, 1], [0, 100, 1], [30, 50, 1], [0, 0, 0], [0, 0, 0.0]])
    people = np.stack([subject + np.array([20, 0, 0]), subject + np.array([10, 0, 0]), 0 * subject])
    people[1, 2] = 500, 500, 0
    people[1, 3:] = 500, 500, 1
    people[0, 3:, 2] = 1
    assert nearest_person(subject, people) == 1
    people[1, :2, 0] = 14.9
    assert nearest_person(subject, people) == 1
    people[1, :2, 0] = 15.1
    assert nearest_person(subject, people) is None
    assert nearest_person(subject, people[2:]) is None


def test_without_recorded_keypoints_the_networks_person_is_used() -> None:
    assert fill_missing(np.zeros((1, 25, 3)), person(7, 0.6)[None]).tolist() == person(7, 0.6)[None].tolist()
