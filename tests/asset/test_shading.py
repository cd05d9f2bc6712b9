"""Shading that photographs show at the vertices of flat grids in front of a camera."""

import numpy as np

from hnerf.asset.photographs import SeenSurface
from hnerf.asset.shading import photographed_shading, visible_vertices
from hnerf.asset.srgb import to_linear
from hnerf.geometry.camera import Camera
from tests.asset.test_photographs import camera, capture

CORNERS = np.array([[3 * row + column + k for k in (0, 3, 4, 1)] for row in (0, 1) for column in (0, 1)])
FACES = CORNERS[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)  # seen from the front, towards -z
MIDDLE = 4


def grid(half_m: float, z_m: float, x_m: float = 0.0) -> np.ndarray:
    """Return the vertices of an upright square centred at (x, 0, z), in three rows of three."""
    steps_m = half_m * np.arange(-1.0, 2)
    return np.array([[x_m + x, y, z_m] for y in steps_m for x in steps_m])


def seen(view: Camera, vertices_m: np.ndarray, faces: np.ndarray) -> list[int]:
    return visible_vertices(view, SeenSurface.of(vertices_m, faces))[0].tolist()


def test_shading_holds_the_photographs_colour_in_linear_light() -> None:
    """Only the middle vertex is used; all others are on the outline. It is 0.4 m off the axis and 2 m away, so its
    cosine to the view is 2 / sqrt(4.16). Its colour is 102 of 255 over a gain of 2, which is 0.2."""
    found = photographed_shading(
        capture({"front": 102}, [camera()]),
        {"front": (2.0, 2.0, 2.0)},
        dict.fromkeys((0, 1), SeenSurface.of(grid(0.3, 0.0, 0.4), FACES)),
    )
    assert found.point.tolist() == [MIDDLE, MIDDLE]
    np.testing.assert_allclose(found.normals, [[0, 0, -1]] * 2, atol=1e-6)
    np.testing.assert_allclose(found.colours, to_linear(np.full((2, 3), 0.2)))
    np.testing.assert_allclose(found.weights, (2 / np.sqrt(4.16)) ** 4, rtol=1e-6)


def test_vertices_are_visible_unless_occluded_or_near_an_outline() -> None:
    """A nearer grid is in front of the middle of the other one, or next to it: closer than two pixels, and farther."""
    both = np.concatenate([FACES, FACES + 9])
    assert seen(camera(), np.concatenate([grid(0.4, 0.0), grid(0.2, -0.5)]), both) == [9 + MIDDLE]
    beside_m = grid(0.1, -0.5, 0.11)  # its edge is at 0.01 m, 0.67 px from the middle of the other
    assert seen(camera(), np.concatenate([grid(0.4, 0.0), beside_m]), both) == [9 + MIDDLE]
    aside_m = grid(0.1, -0.5, 0.2)  # at 0.1 m, 6.7 px
    assert seen(camera(), np.concatenate([grid(0.4, 0.0), aside_m]), both) == [MIDDLE, 9 + MIDDLE]


def test_vertices_facing_away_or_outside_the_image_are_not_visible() -> None:
    assert seen(camera(), grid(0.2, 0.0), FACES) == [MIDDLE]
    assert seen(camera(), grid(0.2, 0.0), FACES[:, ::-1].copy()) == []
    assert seen(camera(), grid(0.2, 0.0, 1.1), FACES) == []  # the image ends 1 m off the axis
    assert seen(camera(), grid(0.2, -4.0), FACES[:, ::-1].copy()) == []  # behind the camera, facing it
