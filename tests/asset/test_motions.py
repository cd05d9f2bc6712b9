import numpy as np
import torch
from scipy.spatial.transform import Rotation

from hnerf.asset.motions import Motion, ground_transforms, motion_of, resampled
from hnerf.body.fit_result import BodyFit
from hnerf.geometry.axes import Y_UP_FROM_Z_UP
from tests.asset.figure import bending_body


def turning(fps: float, codes: list[float], degrees: list[float]) -> Motion:
    """Return a motion of one joint that turns about x and moves 1 m along y per degree."""
    turns = Rotation.from_euler("x", np.array(degrees)[:, None], degrees=True).as_matrix()[:, None]
    origins_m = np.array([[0, degree, 0] for degree in degrees], float)
    return Motion(fps, np.array(codes), turns, origins_m, np.array(degrees)[:, None] / 100)


def test_resampling_interpolates_rotations_and_positions() -> None:
    """At 10 frames a second, codes 5 and 6 are at 0.5 and 0.6 s, which are codes 15 to 18 at 30 a second."""
    found = resampled(turning(10.0, [5, 6], [10, 70]), 30)
    np.testing.assert_array_equal(found.codes, [15, 16, 17, 18])
    angles = Rotation.from_matrix(found.turns[:, 0]).as_euler("xyz", degrees=True)
    np.testing.assert_allclose(angles[:, 0], [10, 30, 50, 70])
    np.testing.assert_allclose(found.origins_m[:, 1], [10, 30, 50, 70])
    np.testing.assert_allclose(found.shape_weights[:, 0], [0.1, 0.3, 0.5, 0.7])


def test_resampling_stays_within_the_motions_time_range() -> None:
    """From 0.28 to 0.42 s there are codes 7, 8, 9 and 10 at 24 frames a second."""
    np.testing.assert_array_equal(resampled(turning(50.0, [14, 21], [0, 7]), 24).codes, [7, 8, 9, 10])


def test_poses_are_held_across_long_gaps() -> None:
    """From 0.7 to 1.5 s, codes 16.8 to 36 at 24 a second, the first of two poses is held. Before, there are 100 degrees
    a second, 50 in 12 codes; after, 120 in 0.1 s, 50 a code. The last pose may stand alone, too."""
    found = resampled(turning(10.0, [0, 7, 15, 16], [0, 70, 200, 320]), 24).origins_m[:, 1]
    np.testing.assert_allclose(found[[0, 12, 16]], [0, 50, 200 / 3])
    np.testing.assert_array_equal(found[17:36], 70)
    np.testing.assert_allclose(found[36:], [200, 250, 300])
    np.testing.assert_array_equal(resampled(turning(10.0, [0, 20], [0, 90]), 10).origins_m[:, 1], 20 * [0] + [90])


def test_a_single_pose_is_one_frame() -> None:
    found = resampled(turning(10.0, [3], [20]), 24)  # code 7.2 at 24 a second
    np.testing.assert_array_equal(found.codes, [7])
    np.testing.assert_allclose(found.origins_m[:, 1], [20])


def test_the_root_follows_position_and_heading_but_not_the_tilt() -> None:
    """The pelvis is tilted forwards by 20 degrees and then turned by 50 degrees about the vertical."""
    heading, tilt = (Rotation.from_euler(axis, angle, degrees=True) for axis, angle in (("y", 50), ("x", 20)))
    pelvis = np.eye(4)[None].copy()
    pelvis[0, :3, :3], pelvis[0, :3, 3] = (heading * tilt).as_matrix(), [1, 0.9, -2]
    found = ground_transforms(pelvis, 0.1)[0]
    np.testing.assert_allclose(found[:3, 3], [1, 0.1, -2])
    np.testing.assert_allclose(found[:3, :3], heading.as_matrix(), atol=1e-12)


def test_the_root_does_not_spin_in_a_tilted_somersault() -> None:
    """After a turn by an angle a about an axis 10 degrees off the horizontal, the twist is 2 atan(sin 10 tan a/2): 33.5
    degrees at 120 and -33.5 at 240, but a full turn around 180 in between. Interpolated linearly, it is 0 half-way."""
    angles, axis = np.radians(np.arange(0, 361, 12)), np.array([np.cos(np.radians(10)), np.sin(np.radians(10)), 0])
    pelvis = np.tile(np.eye(4), (len(angles), 1, 1))
    pelvis[:, :3, :3] = Rotation.from_rotvec(angles[:, None] * axis).as_matrix()
    twists = np.degrees(2 * np.arctan(np.sin(np.radians(10)) * np.tan(angles / 2)))
    twists[10:21] = np.linspace(33.48, -33.48, 11)
    found = Rotation.from_matrix(ground_transforms(pelvis, 0)[:, :3, :3])
    np.testing.assert_allclose(found.as_rotvec(degrees=True)[:, 1], twists, atol=0.01)


def test_the_root_of_a_motion_that_stays_upside_down_keeps_its_twist() -> None:
    pelvis = np.eye(4)[None].copy()
    pelvis[0, :3, :3] = Rotation.from_euler("yx", [50, 170], degrees=True).as_matrix()
    found = Rotation.from_matrix(ground_transforms(pelvis, 0)[:, :3, :3])
    np.testing.assert_allclose(found.as_rotvec(degrees=True), [[0, 50, 0]], atol=1e-6)


def test_the_first_joint_combines_world_rotation_with_its_own() -> None:
    """The first joint turns by a quarter about z, and then the body is tipped by a quarter turn about x of a world with
    Y up. The body's left, +X, goes to the world's Z; its front, -Y, to X."""
    body = bending_body()
    theta, root = torch.zeros(1, 2, 3), torch.eye(4)[None].clone()
    theta[0, 0, 2] = np.pi / 2
    root[0, :3, :3] = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # takes y to z and z to -y
    found = motion_of(BodyFit(body.rig, (3,), theta, root), 10.0, np.zeros((1, 0)), np.eye(3)).turns[0, 0]
    left, front = (Y_UP_FROM_Z_UP @ axis for axis in ([1.0, 0, 0], [0, -1.0, 0]))
    np.testing.assert_allclose([found @ left, found @ front], [[0, 0, 1], [1, 0, 0]], atol=1e-6)


def test_child_joints_move_with_their_parents() -> None:
    """A quarter turn about x takes a child joint from 1 m above its parent to 1 m in front."""
    motion = turning(1.0, [0], [90])
    both = Motion(1.0, motion.codes, np.concatenate([motion.turns, np.eye(3)[None, None]], 1), np.zeros((1, 3)),
                  motion.shape_weights)  # fmt: skip
    found = both.transforms(np.array([-1, 0]), np.array([[0.0, 0, 0], [0, 1, 0]]))
    np.testing.assert_allclose(found[0, 1, :3, 3], [0, 0, 1], atol=1e-12)
