import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np
import pytest

from hnerf.body.anny import anny_rig
from hnerf.body.initial_root import kabsch, root_from_image, root_from_space
from hnerf.geometry.camera import Camera

RIG = anny_rig()
REST_M = (RIG.keypoint_weights @ RIG.vertices_m).double().numpy()
CAMERA = Camera("a", np.array([[500.0, 0, 255], [0, 500, 255], [0, 0, 1]]),
                np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), np.array([0, 0, 3.0]), 512, 512)  # fmt: skip


def turned(x_m: float, about_z: float) -> np.ndarray:
    transform = np.eye(4)
    transform[:3, :3] = cv2.Rodrigues(np.array([0.05, -0.1, about_z]))[0]
    transform[0, 3] = x_m
    return transform


def placed(root: np.ndarray) -> np.ndarray:
    return REST_M @ root[:3, :3].T + root[:3, 3]


def seen_by(camera: Camera, root: np.ndarray) -> np.ndarray:
    """Return keypoints (25, 3) of the placed body."""
    return np.column_stack([camera.project(placed(root))[0], np.ones(25)])


def assert_is(found: np.ndarray | None, root: np.ndarray, atol: float) -> None:
    assert found is not None
    np.testing.assert_allclose(found, root, atol=atol)


def test_kabsch_finds_a_quarter_turn() -> None:
    source = np.array([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]])
    target = source @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1.0]]) + (7, 8, 9)  # takes x to y, y to -x
    expected = np.array([[0, -1, 0, 7], [1, 0, 0, 8], [0, 0, 1, 9], [0, 0, 0, 1.0]])
    np.testing.assert_allclose(kabsch(source, target), expected, atol=1e-12)


def test_kabsch_never_mirrors() -> None:
    source = np.random.default_rng(0).normal(size=(5, 3))
    assert np.linalg.det(kabsch(source, source * (1, 1, -1))[:3, :3]) > 0


def test_shoulders_and_hips_determine_the_root_in_space() -> None:
    root = turned(2.0, 1.3)
    points = placed(root)
    points[4] = np.nan  # the wrist is not needed
    assert_is(root_from_space(REST_M, points), root, atol=1e-9)
    points[9] = np.nan  # nor is a hip, as long as the rest of head and trunk is known
    assert_is(root_from_space(REST_M, points), root, atol=1e-9)


def test_three_points_or_collinear_points_do_not_determine_the_root() -> None:
    for known in ([2, 5, 9], [0, 1, 2, 8], [1, 2, 5, 8, 9]):
        points = np.full((25, 3), np.nan)
        points[known] = REST_M[known]
        assert (root_from_space(REST_M, points) is None) == (len(known) == 3)
    on_a_line = np.arange(25)[:, None] * np.array([0.0, 0.0, 0.1])
    assert root_from_space(on_a_line, on_a_line) is None


def test_one_image_determines_the_root_and_the_facing_direction() -> None:
    for angle in (0.0, 1.5, 3.0, 4.5):
        root = turned(0.3, angle)
        assert_is(root_from_image(CAMERA, REST_M, seen_by(CAMERA, root)), root, atol=1e-4)
    assert root_from_image(CAMERA, REST_M, np.zeros((25, 3))) is None


def test_a_person_far_away_is_placed_and_keypoints_on_one_spot_are_not() -> None:
    """At 180 m the rays to head and trunk are less than 0.003 apart: SQPnP refuses them, as it does a single spot."""
    root = turned(0.3, 1.5)
    K = np.array([[30000.0, 0, 255], [0, 30000, 255], [0, 0, 1]])
    far = dataclasses.replace(CAMERA, K=K, t_m=np.array([0, 0, 180.0]))
    assert_is(root_from_image(far, REST_M, seen_by(far, root)), root, atol=1e-2)
    assert root_from_image(CAMERA, REST_M, np.full((25, 3), 100.0)) is None


@pytest.mark.parametrize("seen", [range(25), (0, 1, 2, 5, 8, 9, 12)])
def test_an_outlier_keypoint_does_not_change_the_root(seen: Sequence[int]) -> None:
    root = turned(0.3, 1.5)
    keypoints = seen_by(CAMERA, root)
    keypoints[[k for k in range(25) if k not in seen]] = 0
    keypoints[2, :2] += (150, -100)  # a shoulder that was detected on another person
    assert_is(root_from_image(CAMERA, REST_M, keypoints), root, atol=1e-4)
