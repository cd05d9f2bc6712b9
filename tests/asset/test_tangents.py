import numpy as np
import pytest

from hnerf.asset.tangents import Frames, corner_angles, frames_at, uv_tangents
from hnerf.asset.texture import Texels, UvLayout
from hnerf.body.descriptor import normals_of

SQUARE_M = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
HALVES = np.array([[0, 1, 2], [0, 2, 3]])
UP = np.tile([0.0, 0, 1], (4, 1))


def layout(*uvs: tuple[float, float]) -> UvLayout:
    return UvLayout(np.array(uvs), HALVES)


@pytest.mark.parametrize(
    ("uvs", "tangent"),
    [
        (((0, 0), (1, 0), (1, 1), (0, 1)), (1, 0, 0, 1)),  # u along x, v along y
        (((0, 0), (0, 1), (-1, 1), (-1, 0)), (0, -1, 0, 1)),  # a quarter turn: u decreases along y
        (((1, 0), (0, 0), (0, 1), (1, 1)), (-1, 0, 0, -1)),  # mirrored: N x T is -y, and v rises along y
    ],
)
def test_tangents_of_a_square(uvs: tuple[tuple[float, float], ...], tangent: tuple[float, ...]) -> None:
    found = uv_tangents(SQUARE_M, UP, HALVES, layout(*uvs))
    np.testing.assert_allclose(found, np.tile(tangent, (4, 1)), atol=1e-12)


def test_a_tangent_is_at_right_angles_to_the_normal() -> None:
    lean = np.tile([0.6, 0, 0.8], (4, 1))
    # x minus its component along the normal: (1, 0, 0) - 0.6 (0.6, 0, 0.8) = (0.64, 0, -0.48), of length 0.8.
    found = uv_tangents(SQUARE_M, lean, HALVES, layout((0, 0), (1, 0), (1, 1), (0, 1)))
    np.testing.assert_allclose(found, np.tile([0.8, 0, -0.6, 1], (4, 1)), atol=1e-12)


@pytest.mark.parametrize(("second", "rising", "side"), [([[1, 0], [0, 1]], (1, 1), 1), ([[0, 1], [1, 0]], (-1, 1), -1)])
def test_tangents_average_faces_weighted_by_their_angles(
    second: list[list[float]], rising: tuple[float, float], side: float
) -> None:
    """At the origin, u rises along x in the first face, of 45 degrees. In the second, of 90 degrees, it rises along x +
    y, or, mirrored, along y - x; as the greater angle, this one decides the mirroring."""
    points_m = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [-1, 1, 0]])
    shared = UvLayout(np.array([[0.0, 0], [1, 0], [1, 1], *second]), np.array([[0, 1, 2], [0, 3, 4]]))
    expected = np.array([1, 0]) + 2 * np.array(rising) / 2**0.5
    found = uv_tangents(points_m, UP, HALVES, shared)[0]
    np.testing.assert_allclose(found, [*expected / np.linalg.norm(expected), 0, side], atol=1e-12)


def test_texture_coordinates_without_area_still_get_a_unit_tangent() -> None:
    found = uv_tangents(SQUARE_M, UP, HALVES, layout((0, 0), (0, 0), (0, 0), (0, 0)))
    np.testing.assert_allclose(np.linalg.norm(found[:, :3], axis=1), 1)
    np.testing.assert_allclose(found[:, 2], 0, atol=1e-12)


def test_components_of_a_direction() -> None:
    frame = Frames(*(np.array([axis]) for axis in ([0.0, 0, 2], [0.0, 3, 1], [-4.0, 0, 0])))
    # x T + y B + z N with x = 1, y = -1, z = 2 is (4, 3, 5).
    expected = np.array([[1, -1, 2]]) / 6**0.5
    np.testing.assert_allclose(frame.components(np.array([[4.0, 3, 5]])), expected, atol=1e-12)


def test_tangent_frames_inside_a_mirrored_face() -> None:
    mirrored = layout((1, 0), (0, 0), (0, 1), (1, 1))
    texels = Texels(*np.zeros((3, 1), int), np.full((1, 3), 1 / 3))
    normals = normals_of(SQUARE_M, HALVES)
    frame = frames_at(texels, normals, HALVES, mirrored, uv_tangents(SQUARE_M, normals, HALVES, mirrored))
    axes = [frame.normal[0], frame.tangent[0], frame.bitangent[0]]
    np.testing.assert_allclose(axes, [[0, 0, 1], [-1, 0, 0], [0, 1, 0]], atol=1e-6)


def test_angles_of_a_right_triangle() -> None:
    triangle = np.array([[[0.0, 0, 0], [1, 0, 0], [0, 3**0.5, 0]]])
    np.testing.assert_allclose(np.degrees(corner_angles(triangle)), [[90, 60, 30]])
