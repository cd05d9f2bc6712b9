"""The background behind the pixels at a mask's edge."""

import numpy as np
import pytest

from hnerf.segmentation.edge import shaded_plate


def test_the_plate_at_an_edge_is_as_dark_as_the_image_next_to_it():
    """A bright person covers the left of a plate of level 100; the right lies in a shadow of level 50."""
    plate = np.full((40, 60, 3), 100, np.uint8)
    mask = np.zeros((40, 60), bool)
    mask[:, :30] = True
    image = np.where(mask[..., None], 200, 50).astype(np.uint8).repeat(3, -1)
    shaded = shaded_plate(mask, image, plate)
    assert shaded[20, 29:32] == pytest.approx(np.full((3, 3), 50), abs=0.5)  # the edge is between 29 and 30
    assert shaded[20, 0] == pytest.approx(100)  # nothing near it shows the ground


def test_a_mask_that_ends_within_the_person_leaves_the_plate_unshaded():
    """A grey person stands in front of a varied wall in shadow. If the mask is 4 px too small, the person is just
    outside it, with a brightness that no shadow on the wall explains. With the right mask, the wall is just outside."""
    plate = np.random.default_rng(0).integers(20, 256, (60, 60, 1)).astype(np.uint8).repeat(3, -1)
    person, small = np.zeros((2, 60, 60), bool)
    person[10:50, 10:50], small[14:46, 14:46] = True, True
    image = np.where(person[..., None], np.uint8(90), plate // 2)
    assert np.array_equal(shaded_plate(small, image, plate), plate)
    assert shaded_plate(person, image, plate)[30, 52] == pytest.approx(plate[30, 52] / 2, abs=1)
