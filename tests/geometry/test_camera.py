import numpy as np

from hnerf.geometry.camera import Camera

QUARTER = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])  # world y is the camera's x, world x its -y
K = np.array([[100.0, 0, 50], [0, 200, 40], [0, 0, 1]])
CAMERA = Camera("1", K, QUARTER, np.array([1.0, 2.0, 3.0]), width_px=8, height_px=6)


def test_a_point_and_its_ray_by_hand() -> None:
    """(1, 2, 1) is at (2 + 1, -1 + 2, 1 + 3) in the camera's axes, so at pixel (100 x 3 / 4 + 50, 200 x 1 / 4 + 40).
    The camera stands at -R^T t = (2, -1, -3)."""
    point_m = np.array([1.0, 2.0, 1.0])
    xy, depth_m = CAMERA.project(point_m)
    np.testing.assert_allclose(xy, [125, 90])
    assert depth_m == 4
    origin_m, direction = CAMERA.rays(xy)
    np.testing.assert_allclose(origin_m, [2, -1, -3])
    np.testing.assert_allclose(direction, (point_m - origin_m) / np.sqrt(26))


def test_an_image_extends_half_a_pixel_beyond_its_outer_pixel_centres() -> None:
    """The centres of 8 x 6 pixels are at 0 to 7 and 0 to 5."""
    inside, outside = [[-0.5, -0.5], [7.5, 5.5], [3, 2]], [[-0.6, 2], [7.6, 2], [3, -0.6], [3, 5.6], [np.nan, 2]]
    assert CAMERA.holds(np.array(inside)).all() and not CAMERA.holds(np.array(outside)).any()


def test_resizing_keeps_points_in_the_same_part_of_the_image() -> None:
    """Pixel centres are at integers: of 8 x 6 pixels, at half the width and twice the height, x + 1/2 is halved and
    y + 1/2 doubled."""
    xy, _ = CAMERA.resized(4, 12).project(np.array([1.0, 2.0, 1.0]))
    np.testing.assert_allclose(xy, [125.5 / 2 - 0.5, 90.5 * 2 - 0.5])
