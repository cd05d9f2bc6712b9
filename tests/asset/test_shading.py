"""What photographs show of a square's corners."""

import numpy as np

from hnerf.asset.shading import photographed_shading, visible_vertices
from hnerf.asset.srgb import to_linear
from hnerf.body.descriptor import normals_of
from tests.asset.test_photographs import FACES, camera, capture, square


def test_corners_have_the_photographs_colour_in_linear_light() -> None:
    """Corners at (+-0.4, +-0.4) m, 2 m away, have the cosine 2 / sqrt(4.32) to the view; 102 of 255 over a gain of 2 is
    0.2."""
    found = photographed_shading(
        capture({"front": 102}, [camera()]),
        {"front": (2.0, 2.0, 2.0)},
        {0: square(0.4, 0.0), 1: square(0.4, 0.0)},
        FACES,
    )
    assert found.point.tolist() == [0, 1, 2, 3] * 2
    np.testing.assert_allclose(found.normals, np.broadcast_to([0, 0, -1], (8, 3)), atol=1e-6)
    np.testing.assert_allclose(found.colours, to_linear(np.full((8, 3), 0.2)))
    np.testing.assert_allclose(found.weights, (2 / np.sqrt(4.32)) ** 4, rtol=1e-6)


def test_hidden_averted_and_cut_off_corners_are_not_seen() -> None:
    """Behind a smaller square, from behind, and 2 m off a view 1 m to either side."""
    vertices_m = np.concatenate([square(0.2, 0.0), square(0.4, -0.3)])
    both = np.concatenate([FACES, FACES + 4])
    assert visible_vertices(camera(), vertices_m, both, normals_of(vertices_m, both))[0].tolist() == [4, 5, 6, 7]
    hidden_m = np.concatenate([square(0.2, 0.0), square(0.2, 0.3)])
    assert visible_vertices(camera(), hidden_m, both, normals_of(hidden_m, both))[0].tolist() == [0, 1, 2, 3]
    away = FACES[:, ::-1].copy()
    assert len(visible_vertices(camera(), square(0.2, 0.0), away, normals_of(square(0.2, 0.0), away))[0]) == 0
    aside_m = square(0.2, 0.0) + np.array([2.0, 0, 0])
    assert len(visible_vertices(camera(), aside_m, FACES, normals_of(aside_m, FACES))[0]) == 0
