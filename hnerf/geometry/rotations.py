"""Interpolation between rotations."""

import numpy as np
from scipy.spatial.transform import Rotation


def slerp(start: Rotation, end: Rotation, share: np.ndarray) -> Rotation:
    """Interpolate n pairs of rotations at shares (n,) of the way, at constant angular velocity (Shoemake 1985)."""
    return start * Rotation.from_rotvec((start.inv() * end).as_rotvec() * share[:, None])
