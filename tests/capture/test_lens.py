import cv2
import numpy as np
import pytest

from hnerf.capture.lens import undistort_keypoints, undistort_points


def test_undistortion_keeps_missing_points_missing() -> None:
    """The lens images radius 1 at 1 + 0.1: pixel 50 + 110 is pixel 50 + 100 without distortion."""
    K = np.array([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]])
    flat = undistort_points(np.array([[[160.0, 50], [np.nan, np.nan]]]), K, np.array([0.1, 0, 0, 0]))
    assert flat[0, 0].tolist() == pytest.approx([150, 50], abs=0.01) and np.isnan(flat[0, 1]).all()
    assert undistort_points(np.zeros((0, 2)), K, np.array([0.1, 0, 0, 0])).shape == (0, 2)


@pytest.mark.parametrize(("focal_px", "k1", "k2"), [(1100.0, -0.25, 0.05), (870.0, -0.25, 0), (1000.0, -0.2, 0)])
def test_undistortion_of_a_wide_lens_is_exact_in_the_corners(focal_px: float, k1: float, k2: float) -> None:
    K, distortion = np.array([[focal_px, 0, 960], [0, focal_px, 540], [0, 0, 1]]), np.array([k1, k2, 0, 0])
    straight = np.array([[220.5, 105], [1699.5, 975], [1700, 60], [960, 540], [200, 1000]])
    directions = np.c_[(straight - (960, 540)) / focal_px, np.ones(5)]
    bent = cv2.projectPoints(directions, np.zeros(3), np.zeros(3), K, distortion)[0][:, 0]
    np.testing.assert_allclose(undistort_points(bent, K, distortion), straight, atol=0.01)


def test_a_rational_lens_is_undistorted_by_hand() -> None:
    """Radius 1 is imaged at (1 + 0.5) / (1 + 0.25) = 1.2: pixel 50 + 120 is 50 + 100. With k4 = 1, r is at r / (1 +
    r^2): 0.75 at 0.48, and none beyond 0.5; 0.6 is beyond that."""
    K = np.array([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]])
    straight = undistort_points(np.array([[170.0, 50]]), K, np.array([0.5, 0, 0, 0, 0, 0.25, 0, 0]))
    assert straight[0].tolist() == pytest.approx([150, 50], abs=0.01)
    near, beyond = undistort_points(np.array([[98.0, 50], [110, 50]]), K, np.array([0.0, 0, 0, 0, 0, 1, 0, 0]))
    assert near.tolist() == pytest.approx([125, 50], abs=0.01) and np.isnan(beyond).all()


def test_keypoints_that_no_ray_reaches_are_missing() -> None:
    """The lens images radius r at r (1 - 0.3 r^2): 0.5 at 0.4625, and nothing beyond 0.703; 0.8 is beyond that."""
    K = np.array([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]])
    found = undistort_keypoints(np.array([[96.25, 50, 0.9], [130, 50, 0.9]]), K, np.array([-0.3, 0, 0, 0]))
    assert found[0].tolist() == pytest.approx([100, 50, 0.9], abs=0.01)
    assert found[1].tolist() == [0, 0, 0]
