import dataclasses

import cv2
import numpy as np

from hnerf.calibration.bundle import adjust, align
from tests.calibration.synthetic import ring, turned, walk_m


def test_align_recovers_a_turned_scaled_and_moved_rig() -> None:
    """Points x become 2 Q x + m with a turn Q by 100 degrees, so cameras have R Q^T and stand at 2 Q c + m."""
    turn = cv2.Rodrigues(np.deg2rad(100) * np.array([0.6, 0, 0.8]))[0]
    moved = []
    for camera in ring(4):
        R, centre_m = camera.R @ turn.T, 2 * turn @ camera.centre_m + [1.0, -2, 3]
        moved.append(dataclasses.replace(camera, R=R, t_m=-R @ centre_m))
    for back, camera in zip(align(moved, ring(4)), ring(4), strict=True):
        np.testing.assert_allclose(back.projection, camera.projection, atol=1e-9)


def test_adjust_recovers_a_turned_camera_with_skew() -> None:
    """With exact keypoints of a camera whose x grows by 0.06 y, only the turn of half a degree is corrected."""
    K = np.array([[1000.0, 60, 499.5], [0, 1000, 499.5], [0, 0, 1]])
    truth = [dataclasses.replace(camera, K=K) if camera.name == "c0" else camera for camera in ring(4)]
    seen = np.stack([camera.project(walk_m())[0] for camera in truth])
    keypoints = np.concatenate([seen, np.ones_like(seen[..., :1])], -1)
    found = adjust([turned(truth[0], 0.5), *truth[1:]], keypoints, ["c0"])[0]
    np.testing.assert_allclose(found.project(walk_m())[0], seen[0], atol=0.01)
