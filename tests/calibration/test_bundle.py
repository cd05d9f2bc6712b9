import dataclasses

import cv2
import numpy as np

from hnerf.calibration.bundle import align
from tests.calibration.synthetic import ring


def test_a_rig_that_was_turned_scaled_and_moved_comes_back() -> None:
    """Points x become 2 Q x + m with a turn Q by 100 degrees, so cameras have R Q^T and stand at 2 Q c + m."""
    turn = cv2.Rodrigues(np.deg2rad(100) * np.array([0.6, 0, 0.8]))[0]
    moved = []
    for camera in ring(4):
        R, centre_m = camera.R @ turn.T, 2 * turn @ camera.centre_m + [1.0, -2, 3]
        moved.append(dataclasses.replace(camera, R=R, t_m=-R @ centre_m))
    for back, camera in zip(align(moved, ring(4)), ring(4), strict=True):
        np.testing.assert_allclose(back.projection, camera.projection, atol=1e-9)
