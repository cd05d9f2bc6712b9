"""Rotations between worlds with Z up (the body's, some captures') and with Y up (asset formats, BVH files)."""

import numpy as np

Y_UP_FROM_Z_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # (x, y, z) to (x, z, -y); -Y becomes Z, the front
Z_UP_FROM_Y_UP = np.ascontiguousarray(Y_UP_FROM_Z_UP.T)
CAMERA_FROM_Z_UP = Z_UP_FROM_Y_UP  # rotation of a level camera: x right, y down, z forward


def y_up_from(up: str) -> np.ndarray:
    """Return the rotation (3, 3) to Y up from a world whose vertical axis is `up`, "y" or "z"."""
    return {"z": Y_UP_FROM_Z_UP, "y": np.eye(3)}[up]
