"""Axes of the worlds that meet here: the body's and some captures' have Z up, asset formats and BVH files Y up."""

import numpy as np

Y_UP_FROM_Z_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # (x, y, z) to (x, z, -y); -Y becomes Z, the front
Z_UP_FROM_Y_UP = np.ascontiguousarray(Y_UP_FROM_Z_UP.T)
CAMERA_FROM_Z_UP = Z_UP_FROM_Y_UP  # of a level camera: x right, y down, z forward
