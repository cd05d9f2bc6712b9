import numpy as np

from hnerf.geometry.camera import Camera
from hnerf.geometry.triangulation import _best_pair, solve_points, triangulate
from tests.calibration.synthetic import detections, ring, walk_m


def test_two_cameras_by_hand() -> None:
    # Focal length 100, principal point (50, 50); b stands 1 m to the right of a. The point (0.5, 0.2, 2) lies at
    # (50 + 100 * .25, 50 + 100 * .1) = (75, 60) in a, and at (50 - 100 * .25, 60) = (25, 60) in b.
    K = np.array([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]])
    a = Camera("a", K, np.eye(3), np.zeros(3), 100, 100)
    b = Camera("b", K, np.eye(3), np.array([-1.0, 0, 0]), 100, 100)
    keypoints = np.array([[[75, 60, 0.9]], [[25, 60, 0.9]]])
    points_m, residuals_px, inliers = triangulate([a, b], keypoints)
    np.testing.assert_allclose(points_m, [[0.5, 0.2, 2]], atol=1e-9)
    np.testing.assert_allclose(residuals_px, 0, atol=1e-7)
    assert inliers.all()


def test_residual_by_hand() -> None:
    # Rows that disagree by 2 px cannot meet in 3-D: with equal confidence each view misses by 1 px, vertically.
    K = np.array([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]])
    cameras = [Camera("", K, np.eye(3), np.array([-x, 0, 0]), 100, 100) for x in (0.0, 1.0)]
    keypoints = np.array([[[75, 59, 0.9]], [[25, 61, 0.9]]])
    points_m, residuals_px, _ = triangulate(cameras, keypoints)
    np.testing.assert_allclose(residuals_px, 1, atol=1e-3)
    np.testing.assert_allclose(points_m[0], [0.5, 0.2, 2], atol=4e-3)


def test_points_minimise_pixel_errors_wherever_the_world_origin_is() -> None:
    """Cameras 1 m and 4 m in front of the point see it at x = 0 and x = 17 mm; a third one at its side determines the
    depth. Least squares in pixels weight the two by 1 and 1/16, so x = 17 / 16 / (1 + 1 / 16) = 1 mm."""
    aside = np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])  # looks along x
    poses = [(np.eye(3), [0.0, 0, 9]), (np.eye(3), [0.0, 0, 6]), (aside, [-1.0, 0, 10])]
    projections = np.stack([np.diag([100.0, 100, 1]) @ R @ np.c_[np.eye(3), -np.array(centre)] for R, centre in poses])
    keypoints = np.array([[[0, 0, 1]], [[100 * 0.017 / 4, 0, 1]], [[0, 0, 1]]])
    np.testing.assert_allclose(solve_points(projections, keypoints, np.ones((3, 1))), [[0.001, 0, 10]], atol=2e-4)


def test_a_pair_of_more_confident_views_wins_over_one_in_larger_images() -> None:
    """Two views with a focal length of 100 px see a point 4 m ahead; two of 200 px, with a tenth of the confidence, see
    it 0.1 m off. The first pair's point is 5 px off in the other two views: a cost of 2 x 0.1 x 5 = 1. The second
    pair's is 2.5 px off in the first two: a cost of 2 x 1 x 2.5 = 5."""
    projections = np.stack([
        np.diag([focal, focal, 1]) @ np.c_[np.eye(3), [-x_m, 0, 0]]
        for x_m, focal in ((-1, 100.0), (1, 100.0), (-2, 200.0), (2, 200.0))
    ])  # fmt: skip
    keypoints = np.array([[[25, 0, 1]], [[-25, 0, 1]], [[100, 5, 0.1]], [[-100, 5, 0.1]]])
    points_m, in_pair = _best_pair(projections, keypoints, keypoints[..., 2])
    np.testing.assert_allclose(points_m, [[0, 0, 4]], atol=1e-6)
    assert in_pair[:, 0].tolist() == [True, True, False, False]


def test_an_outlier_view_is_left_out_and_its_residual_reported() -> None:
    cameras = ring(4)
    keypoints = detections(cameras, noise_px=0)
    keypoints[2, 0, 0, :2] += [30, 40]
    points_m, residuals_px, inliers = triangulate(cameras, keypoints)
    np.testing.assert_allclose(points_m[0], walk_m()[0], atol=1e-6)
    np.testing.assert_allclose(residuals_px[:, 0, 0], [0, 0, 50, 0], atol=1e-3)
    assert inliers[:, 0, 0].tolist() == [True, True, False, True]


def test_unseen_points_are_nan() -> None:
    cameras = ring(3)
    keypoints = np.stack([np.append(c.project(np.zeros((2, 3)))[0], [[0.8], [0.8]], 1) for c in cameras])
    keypoints[1:, 0, 2] = 0  # the first point in one view only
    keypoints[0, 1, 2] = 0  # the second in two
    points_m, residuals_px, _ = triangulate(cameras, keypoints)
    assert np.isnan(points_m[0]).all()
    assert np.isnan(residuals_px[:, 0]).all()
    np.testing.assert_allclose(points_m[1], 0, atol=1e-6)
    assert np.isnan(residuals_px[0, 1])


def test_noise_averages_out() -> None:
    # 2 px at 3.5 m and 1000 px focal length is 7 mm across a ray; four views bring the error under 10 mm.
    cameras = ring(4)
    points_m, _, _ = triangulate(cameras, detections(cameras, noise_px=2))
    assert np.median(np.linalg.norm(points_m - walk_m(), axis=-1)) < 0.010
