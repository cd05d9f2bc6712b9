import numpy as np
import pytest

from hnerf.asset.quads import polygon_corners

SQUARES = np.array([[0, 1, 2], [2, 3, 0], [1, 4, 2], [4, 5, 2]])  # two squares, cut along different diagonals


def test_triangle_pairs_become_quads_that_start_on_the_diagonal() -> None:
    corners = polygon_corners(SQUARES)
    np.testing.assert_array_equal(SQUARES.ravel()[corners], [[2, 3, 0, 1], [4, 5, 2, 1]])
    np.testing.assert_array_equal(corners, [[2, 4, 0, 1], [7, 10, 8, 6]])


@pytest.mark.parametrize(
    "faces",
    [SQUARES[:3], SQUARES[[0, 2, 1, 3]], np.array([[0, 1, 2], [2, 0, 3]])],
    ids=["odd number", "halves not consecutive", "reversed winding"],
)
def test_triangles_that_form_no_quads_stay_triangles(faces: np.ndarray) -> None:
    np.testing.assert_array_equal(polygon_corners(faces), np.arange(faces.size).reshape(-1, 3))
