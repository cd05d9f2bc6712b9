import dataclasses

import numpy as np
import pytest

from hnerf.geometry.camera import Camera
from hnerf.geometry.silhouette import silhouette

# Focal length 10, principal point at the pixel (4, 4) of a 9 x 9 image: (x, y, 10) is seen at (4 + x, 4 + y).
CAMERA = Camera("c", np.array([[10.0, 0, 4], [0, 10, 4], [0, 0, 1]]), np.eye(3), np.zeros(3), 9, 9)
TRIANGLE_M = np.array([[0.0, 0, 10], [3, 0, 10], [0, 3, 10]])


def test_pixel_centres_in_a_triangle_by_hand() -> None:
    # Corners at the pixels (4, 4), (7, 4), (4, 7): rows of 4, 3, 2 and 1 pixel centres, edges included.
    expected = np.zeros((9, 9), bool)
    for row, count in enumerate((4, 3, 2, 1)):
        expected[4 + row, 4 : 4 + count] = True
    np.testing.assert_array_equal(silhouette(CAMERA, TRIANGLE_M, np.array([[0, 1, 2]])), expected)
    np.testing.assert_array_equal(silhouette(CAMERA, TRIANGLE_M, np.array([[0, 2, 1]])), expected)


def test_a_triangle_between_pixel_centres_covers_nothing() -> None:
    between_m = 0.1 * TRIANGLE_M + [0.3, 0.3, 9]  # corners at (4.3, 4.3) to (4.6, 4.6)
    assert not silhouette(CAMERA, between_m, np.array([[0, 1, 2]])).any()


def test_a_triangle_that_reaches_behind_the_camera_is_left_out() -> None:
    behind_m = np.array([[0.0, 0, -1], [3, 0, 10], [0, 3, 10]])
    assert not silhouette(CAMERA, behind_m, np.array([[0, 1, 2]])).any()


def test_triangles_larger_than_the_image_cover_it() -> None:
    assert silhouette(CAMERA, TRIANGLE_M * [1e4, 1e4, 1] - [1e4, 1e4, 0], np.array([[0, 1, 2]])).all()


@pytest.mark.parametrize(("width_px", "height_px"), [(9, 5), (5, 9)])
def test_an_image_is_covered_up_to_its_own_edges(width_px: int, height_px: int) -> None:
    """A triangle beyond the last column and row of an image that is wider than high, or higher than wide."""
    camera = dataclasses.replace(CAMERA, width_px=width_px, height_px=height_px)
    covered = silhouette(camera, TRIANGLE_M * [10, 10, 1], np.array([[0, 1, 2]]))
    expected = np.zeros((height_px, width_px), bool)
    expected[4:, 4:] = True
    np.testing.assert_array_equal(covered, expected)
