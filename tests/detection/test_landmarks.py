"""From a landmark network's outputs to keypoints in the image and metres along the camera's axes; numbers by hand."""

import math

import numpy as np
import pytest

from hnerf.detection import landmarks
from hnerf.detection.landmarks import LandmarkNetwork, refine_by_heatmap
from hnerf.detection.region import Region

SURE = 60.0  # a logit


def answers(presence: float = 0.9) -> list[np.ndarray]:
    """Every point in the middle of the crop but the right wrist (16) at (64, 192); hips' middle (33) at (128, 160), the
    circle's top (34) at (128, 96). The wrist is 0.3 m to the right, 0.2 m up, and visible
    by .5; the left one (15) is in the image by .5; no heat."""
    points = np.tile([128.0, 128, 0, SURE, SURE], (39, 1))
    points[16] = 64, 192, 0, 0, SURE
    points[15, 4] = 0
    points[33, :2], points[34, :2] = (128, 160), (128, 96)
    metric = np.zeros((39, 3))
    metric[16] = 0.3, -0.2, 0.1
    mask, heat = np.full((256, 256, 1), -SURE), np.full((64, 64, 39), -SURE)
    return [points.ravel(), np.array([presence]), mask, heat, metric.ravel()]


@pytest.fixture
def network(monkeypatch: pytest.MonkeyPatch) -> LandmarkNetwork:
    monkeypatch.setattr(landmarks, "Network", lambda name: lambda image: answers())
    return LandmarkNetwork("heavy")


def test_points_are_carried_from_the_crop_into_the_image(network: LandmarkNetwork) -> None:
    """A region of 512 px around (300, 400), so 2 px a crop's pixel: the wrist is 64 crop pixels left of the middle and
    64 below it, at (172, 528). The next region is around (300, 464), 2.5 x 128 px wide."""
    person = network(np.zeros((800, 600, 3), np.uint8), Region(np.array([300.0, 400.0]), 512.0, 0.0))
    assert person is not None
    assert person.points_px.shape == (33, 3)
    assert person.points_px[16] == pytest.approx([172, 528, 0.5])
    assert person.points_px[15, 2] == pytest.approx(0.5)
    assert person.points_px[0] == pytest.approx([300, 400, 1])
    assert person.points_m[16] == pytest.approx([0.3, -0.2, 0.1])
    assert person.next.centre_px == pytest.approx([300, 464])
    assert person.next.side_px == pytest.approx(320) and person.next.angle == pytest.approx(0)
    assert person.mask.max() < 1e-6


def test_a_turned_region_turns_points_and_metres(network: LandmarkNetwork) -> None:
    """By 90 degrees clockwise left becomes up and down left: 128 px up and 128 px left of the middle; (0.3, -0.2)
    becomes (0.2, 0.3)."""
    person = network(np.zeros((800, 600, 3), np.uint8), Region(np.array([300.0, 400.0]), 512.0, math.pi / 2))
    assert person is not None
    assert person.points_px[16, :2] == pytest.approx([172, 272])
    assert person.points_m[16] == pytest.approx([0.2, 0.3, 0.1])
    assert person.next.angle == pytest.approx(math.pi / 2)


def test_nobody_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(landmarks, "Network", lambda name: lambda image: answers(presence=0.4))
    assert LandmarkNetwork("lite")(np.zeros((8, 8, 3), np.uint8), Region(np.zeros(2), 8.0, 0.0)) is None


def test_points_move_to_the_mean_of_the_heat_around_them() -> None:
    """A cell is 4 px. Heat of .6 at (12, 10) and .2 at (12, 14) in the window of (12, 11): the mean is (12, 11), at
    (48, 44) px. Heat below .5 moves nothing, nor does heat beyond three cells, nor any outside of the crop; at
    three cells, (15, 11), it does."""
    heat = np.zeros((64, 64, 5))
    heat[10, 12, 0], heat[14, 12, 0], heat[10, 30, 0] = 0.6, 0.2, 0.9
    heat[10, 12, 1] = 0.4
    heat[10, 16, 2] = 0.9
    heat[11, 15, 4] = 0.9
    places = np.array([[50.0, 46.0], [50, 46], [50, 46], [-3, 46], [50, 46]])
    moved = refine_by_heatmap(places, heat)
    assert moved.tolist() == [pytest.approx([48, 44]), [50, 46], [50, 46], [-3, 46], pytest.approx([60, 44])]
