"""Anchors, boxes and non-maximum suppression of people; numbers worked out by hand."""

import numpy as np
import pytest

from hnerf.detection import person_detector
from hnerf.detection.person_detector import PersonDetector, anchors, decode_boxes, weighted_nms


def test_anchors_are_cell_centres_layer_by_layer() -> None:
    """28^2 x 2 + 14^2 x 2 + 7^2 x 6 = 2254 anchors, row by row; cells of 1/28 have two each."""
    at = anchors()
    assert at.shape == (2254, 2)
    assert at[0] == pytest.approx([0.5 / 28, 0.5 / 28]) and at[1] == pytest.approx(at[0])
    assert at[2] == pytest.approx([1.5 / 28, 0.5 / 28])
    assert at[56] == pytest.approx([0.5 / 28, 1.5 / 28])
    assert at[1568] == pytest.approx([0.5 / 14, 0.5 / 14])
    assert at[1960] == pytest.approx([0.5 / 7, 0.5 / 7]) and at[1965] == pytest.approx(at[1960])
    assert at[2253] == pytest.approx([6.5 / 7, 6.5 / 7])


def test_boxes_and_points_are_decoded_relative_to_anchors() -> None:
    """22.4 px are a tenth of the image. The centre is .5 + .1, .5 - .1 and the sides are .2 and .4. The first point is
    .5 + .2, .5, and the last one the anchor itself."""
    raw = np.array([[22.4, -22.4, 44.8, 89.6, 44.8, 0, 0, 0, 0, 0, 0, 0]])
    box = decode_boxes(raw, np.array([[0.5, 0.5]]))[0]
    assert box[:2] == pytest.approx(np.array([[0.5, 0.2], [0.7, 0.6]]))
    assert box[2] == pytest.approx([0.7, 0.5]) and box[5] == pytest.approx([0.5, 0.5])


def test_overlapping_boxes_are_averaged_by_score() -> None:
    """Boxes of side 2 at x = 0 and 0.8 have an intersection of 1.2 x 2 and a union of 5.6, so an IoU of .43. With
    scores .9 and .6, the mean is at 0.8 x .6 / 1.5 = .32. A box at 1.2 has an IoU of .25 with the first, and is another
    person."""

    def person(x: float) -> np.ndarray:
        return np.array([[x, 0], [x + 2, 2], *[[x, 1]] * 4])

    people = weighted_nms(np.array([person(0.8), person(1.2), person(0)]), np.array([0.6, 0.7, 0.9]))
    assert [found[0, 0] for found in people] == pytest.approx([0.32, 1.2])
    assert people[0][2] == pytest.approx([0.32, 1])
    assert weighted_nms(np.zeros((0, 6, 2)), np.zeros(0)) == []


def test_a_detected_person_is_placed_in_the_image(monkeypatch: pytest.MonkeyPatch) -> None:
    """The network sees pixels from -1 to 1 in a square of 400 px, 100 px of it above the image. The anchor in its
    middle has the hips a tenth of the square below it, and the top of the circle around the person a tenth above."""
    raw, logits, middle = np.zeros((2254, 12)), np.full((2254, 1), -9.0), 1960 + 6 * (3 * 7 + 3)
    raw[middle, 2:8], logits[middle] = [22.4, 22.4, 0, 22.4, 0, -22.4], 9

    def network(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        assert (image.min(), image.max()) == (-1, 1)
        return raw, logits

    monkeypatch.setattr(person_detector, "Network", lambda name: network)
    (found,) = PersonDetector()(np.full((200, 400, 3), 255, np.uint8))
    assert found.centre_px == pytest.approx([199.5, 139.5])
    assert found.side_px == pytest.approx(200) and found.angle == pytest.approx(0)
