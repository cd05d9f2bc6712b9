import cv2
import numpy as np
import pytest

from hnerf.capture.lens import Lens, distort_points, undistort_keypoints, undistort_points

K = np.array([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]])


def lens_of(distortion: list[float], K: np.ndarray = K, fisheye: bool = False) -> Lens:
    return Lens("a", K, np.array(distortion, float), np.eye(3), np.zeros(3), None, fisheye=fisheye)


def test_undistortion_keeps_missing_points_missing() -> None:
    """The lens images radius 1 at 1 + 0.1: pixel 50 + 110 is pixel 50 + 100 without distortion."""
    flat = undistort_points(np.array([[[160.0, 50], [np.nan, np.nan]]]), lens_of([0.1, 0, 0, 0]))
    assert flat[0, 0].tolist() == pytest.approx([150, 50], abs=0.01) and np.isnan(flat[0, 1]).all()
    assert undistort_points(np.zeros((0, 2)), lens_of([0.1, 0, 0, 0])).shape == (0, 2)


@pytest.mark.parametrize(("focal_px", "k1", "k2"), [(1100.0, -0.25, 0.05), (870.0, -0.25, 0), (1000.0, -0.2, 0)])
def test_undistortion_of_a_wide_lens_is_exact_in_the_corners(focal_px: float, k1: float, k2: float) -> None:
    K, distortion = np.array([[focal_px, 0, 960], [0, focal_px, 540], [0, 0, 1]]), np.array([k1, k2, 0, 0])
    straight = np.array([[220.5, 105], [1699.5, 975], [1700, 60], [960, 540], [200, 1000]])
    directions = np.c_[(straight - (960, 540)) / focal_px, np.ones(5)]
    bent = cv2.projectPoints(directions, np.zeros(3), np.zeros(3), K, distortion)[0][:, 0]
    np.testing.assert_allclose(undistort_points(bent, lens_of(distortion.tolist(), K)), straight, atol=0.01)


def test_a_rational_lens_is_undistorted_by_hand() -> None:
    """Radius 1 is imaged at (1 + 0.5) / (1 + 0.25) = 1.2: pixel 50 + 120 is 50 + 100. With k4 = 1, r is at r / (1 +
    r^2): 0.75 at 0.48, and none beyond 0.5; 0.6 is beyond that."""
    straight = undistort_points(np.array([[170.0, 50]]), lens_of([0.5, 0, 0, 0, 0, 0.25, 0, 0]))
    assert straight[0].tolist() == pytest.approx([150, 50], abs=0.01)
    near, beyond = undistort_points(np.array([[98.0, 50], [110, 50]]), lens_of([0, 0, 0, 0, 0, 1, 0, 0]))
    assert near.tolist() == pytest.approx([125, 50], abs=0.01) and np.isnan(beyond).all()


def test_keypoints_that_no_ray_reaches_are_missing() -> None:
    """The lens images radius r at r (1 - 0.3 r^2): 0.5 at 0.4625, and nothing beyond 0.703; 0.8 is beyond that."""
    found = undistort_keypoints(np.array([[96.25, 50, 0.9], [130, 50, 0.9]]), lens_of([-0.3, 0, 0, 0]))
    assert found[0].tolist() == pytest.approx([100, 50, 0.9], abs=0.01)
    assert found[1].tolist() == [0, 0, 0]


def test_an_equidistant_fisheye_images_a_ray_at_a_radius_proportional_to_its_angle() -> None:
    """A ray at 45 degrees, straight pixel 50 + 100, is at 50 + 100 pi / 4; one at 60 at 50 - 100 pi / 3. At 80 degrees,
    and from 90 on, where there is no pinhole pixel, pixels are missing: also less than 1 px beyond 90."""
    lens = lens_of([0, 0, 0, 0], fisheye=True)
    radii = 100 * np.deg2rad([45, 79, 81, 89.9, 90.1, 120, 200])
    straight = undistort_points(np.stack([50 + radii, np.full(7, 50.0)], -1), lens)
    assert straight[:2, 0].tolist() == pytest.approx([150, 50 + 100 * np.tan(np.deg2rad(79))])
    assert np.isnan(straight[2:]).all()
    assert distort_points(np.array([[50, 50 - 100 * np.sqrt(3)]]), lens)[0].tolist() == pytest.approx([50, -54.7198])


def test_fisheye_coefficients_by_hand() -> None:
    """1 radian is imaged at 1 - 0.1 + 0.04 - 0.02 + 0.01 = 0.93, along both axes, of which y has 200 px a unit."""
    lens = lens_of([-0.1, 0.04, -0.02, 0.01], np.array([[100.0, 0, 50], [0, 200, 40], [0, 0, 1]]), fisheye=True)
    bent = distort_points(50 + np.array([[100 * np.tan(1), -10], [0, 200 * np.tan(1) - 10]]), lens)
    np.testing.assert_allclose(bent, [[143, 40], [50, 226]])


def test_a_fisheye_is_undistorted_over_the_whole_image() -> None:
    """A GoPro's wide field of view, 118 degrees across and 149 along the diagonal of an image of 4:3."""
    K = np.array([[1350.0, 0, 1352], [0, 1349, 1014], [0, 0, 1]])
    lens = lens_of([0.045, -0.012, 0.009, -0.004], K, fisheye=True)
    bent = np.stack(np.meshgrid(np.linspace(0, 2703, 30), np.linspace(0, 2027, 30)), -1)
    straight = undistort_points(bent, lens)
    assert np.isfinite(straight).all() and np.abs(straight - bent).max() > 1000
    np.testing.assert_allclose(distort_points(straight.reshape(-1, 2), lens), bent.reshape(-1, 2), atol=1e-5)


def test_missing_points_of_a_fisheye_stay_missing() -> None:
    found = undistort_keypoints(np.array([[np.nan, 50, 0.9], [300, 50, 0.9]]), lens_of([0, 0, 0, 0], fisheye=True))
    assert found.tolist() == [[0, 0, 0], [0, 0, 0]]
