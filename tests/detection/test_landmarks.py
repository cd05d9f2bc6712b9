"""From a landmark network's outputs to keypoints in the image and metres along the camera's axes; numbers worked out by
hand."""

import math

import numpy as np
import pytest

from hnerf.detection import landmarks
from hnerf.detection.landmarks import LandmarkNetwork, refine_by_heatmap
from hnerf.detection.region import Region

SURE = 60.0  # a logit of practically 1
WHITE = np.full((800, 600, 3), 255, np.uint8)


def answers(presence: float = 0.9) -> list[np.ndarray]:
    """Return network outputs with every point at the centre of the crop, except the right wrist (16) at (64, 192), the
    middle of the hips (33) at (128, 160) and the top of the circle (34) at (128, 96). The right wrist is 0.3 m to the
    right and 0.2 m up, with visibility .5. The left wrist (15) is inside the image with probability .5. Heatmaps are
    empty."""
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
    """Return a network that finds a person only in images scaled to at most 1."""
    monkeypatch.setattr(landmarks, "Network", lambda name: lambda image: answers(0.9 if image.max() == 1 else 0.0))
    return LandmarkNetwork("heavy")


def test_points_are_mapped_from_the_crop_to_the_image(network: LandmarkNetwork) -> None:
    """In a region of 512 px around (300, 400), a crop pixel is 2 px. The wrist is 64 crop pixels left of the centre and
    64 below it, at (172, 528). The next region is around (300, 464), 2.5 x 128 px wide."""
    person = network(WHITE, Region(np.array([300.0, 400.0]), 512.0, 0.0))
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
    """A turn by 90 degrees clockwise takes left to up and down to left: 128 px up and 128 px left of the centre. (0.3,
    -0.2) becomes (0.2, 0.3)."""
    person = network(WHITE, Region(np.array([300.0, 400.0]), 512.0, math.pi / 2))
    assert person is not None
    assert person.points_px[16, :2] == pytest.approx([172, 272])
    assert person.points_m[16] == pytest.approx([0.2, 0.3, 0.1])
    assert person.next.angle == pytest.approx(math.pi / 2)


def test_low_presence_means_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(landmarks, "Network", lambda name: lambda image: answers(presence=0.4))
    assert LandmarkNetwork("lite")(np.zeros((8, 8, 3), np.uint8), Region(np.zeros(2), 8.0, 0.0)) is None


def test_points_are_refined_to_the_mean_of_the_nearby_heatmap() -> None:
    """A heatmap cell is 4 px. Values of .6 at (12, 10) and .2 at (12, 14), in the window around (12, 11), have their
    mean at (12, 11), which is (48, 44) px. A point is not moved by values below .5, nor by values more than three cells
    away, nor if it is outside the crop. A value exactly three cells away, at (15, 11), moves it."""
    heat = np.zeros((64, 64, 5))
    heat[10, 12, 0], heat[14, 12, 0], heat[10, 30, 0] = 0.6, 0.2, 0.9
    heat[10, 12, 1] = 0.4
    heat[10, 16, 2] = 0.9
    heat[11, 15, 4] = 0.9
    places = np.array([[50.0, 46.0], [50, 46], [50, 46], [-3, 46], [50, 46]])
    moved = refine_by_heatmap(places, heat)
    assert moved.tolist() == [pytest.approx([48, 44]), [50, 46], [50, 46], [-3, 46], pytest.approx([60, 44])]
