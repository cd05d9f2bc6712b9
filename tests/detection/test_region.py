"""The image region that a network sees, and the mapping of its outputs to the image; numbers worked out by hand."""

import math

import numpy as np
import pytest

from hnerf.detection.region import Region, image_region, region_around


def test_a_letterbox_contains_the_whole_image() -> None:
    """An image of 40 x 20 px gives a square of 40 px around (19.5, 9.5). In a crop of 80 px, the crop's corner is at
    (-0.5, -10.5) in the image, and a crop pixel is half an image pixel."""
    shown = image_region((40, 20))
    assert shown.centre_px.tolist() == [19.5, 9.5] and shown.side_px == 40
    assert shown.from_crop(80) == pytest.approx(np.array([[0.5, 0, -0.5], [0, 0.5, -10.5]]))
    crop = shown.crop(np.full((20, 40, 3), 200, np.uint8), 40)
    assert (crop[:10] == 0).all() and (crop[10:30] == 200).all() and (crop[30:] == 0).all()


def test_a_turned_region_shows_a_lying_person_upright() -> None:
    """The region is turned by 90 degrees clockwise about (10, 10): the crop's right is down in the image, its down is
    left."""
    region = Region(np.array([10.0, 10.0]), 8.0, math.pi / 2)
    assert region.from_crop(4) == pytest.approx(np.array([[0, -2, 14], [2, 0, 6]]))
    assert region.from_crop(4) @ [4, 1, 1] == pytest.approx([12, 14])
    assert region.to_camera_axes(np.array([1.0, 2.0, 3.0])) == pytest.approx([-2, 1, 3])


def test_cropped_pixels_match_the_coordinate_mapping() -> None:
    """One pixel is lit at (5, 3). With pixel centres at integers, the region's corner is at (1.5, 0.5), so it becomes
    the crop's pixel (3, 2), centred at (3.5, 2.5)."""
    image = np.zeros((12, 12, 3), np.uint8)
    image[3, 5] = 255
    region = Region(np.array([5.5, 4.5]), 8.0, 0.0)
    crop = region.crop(image, 8)
    assert np.argwhere(crop[..., 0]).tolist() == [[2, 3]]
    assert region.from_crop(8) @ [3.5, 2.5, 1] == pytest.approx([5, 3])
    back = region.paste(crop[..., 0].astype(np.float32), (12, 12))
    assert np.argwhere(back).tolist() == [[3, 5]] and back[3, 5] == 255


def test_large_images_are_averaged_without_a_shift() -> None:
    """At a quarter of the size, stripes of single pixels become grey, and an edge at x = 31.5 stays in the middle."""
    image = np.zeros((64, 64, 3), np.uint8)
    image[:, ::2] = 200
    assert np.abs(image_region((64, 64)).crop(image, 16).astype(int) - 100).max() <= 1
    image[:, :32], image[:, 32:] = 0, 200
    crop = image_region((64, 64)).crop(image, 16)
    assert (crop[:, :8] == 0).all() and (crop[:, 8:] == 200).all()


def test_a_region_from_hips_and_crown() -> None:
    """With the hips at (50, 60) and the circle's top at (50, 20), the side is 2.5 x 40 px and the person upright. With
    the top at (90, 60), the person lies, turned clockwise by 90 degrees."""
    upright, lying = (region_around(np.array([50.0, 60.0]), np.array(end)) for end in ([50.0, 20.0], [90.0, 60.0]))
    assert upright.side_px == 100 and upright.angle == pytest.approx(0)
    assert lying.side_px == 100 and lying.angle == pytest.approx(math.pi / 2)
