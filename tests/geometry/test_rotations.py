import numpy as np
from scipy.spatial.transform import Rotation

from hnerf.geometry.rotations import slerp


def test_slerp_by_a_third_of_a_right_angle_turns_thirty_degrees() -> None:
    start = Rotation.from_rotvec([[0, 0, 20], [0, 0, 20]], degrees=True)
    end = Rotation.from_rotvec([[0, 0, 110], [0, 0, 110]], degrees=True)
    between = slerp(start, end, np.array([0.0, 1 / 3]))
    np.testing.assert_allclose(between.as_euler("xyz", degrees=True), [[0, 0, 20], [0, 0, 50]], atol=1e-9)


def test_slerp_turns_about_the_axes_of_the_start() -> None:
    """Half-way from a quarter turn about x to the same, followed by a half turn about the body's own z."""
    start = Rotation.from_rotvec([[90, 0, 0]], degrees=True)
    own_turn = Rotation.from_rotvec([[0, 0, 180]], degrees=True)
    between = slerp(start, start * own_turn, np.array([0.5]))
    # z of the body is -y of the world, so that x turns to z.
    np.testing.assert_allclose(between.apply([1.0, 0, 0]), [[0, 0, 1]], atol=1e-9)
