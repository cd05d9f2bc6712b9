"""Motions of an exported skeleton: the body model's poses in stage axes, resampled and with the root on the ground."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from hnerf.body.fit_result import BodyFit
from hnerf.body.rig import rotation_from_axis_angle
from hnerf.geometry.axes import Y_UP_FROM_Z_UP
from hnerf.geometry.rotations import slerp

LONGEST_S = 0.7  # between poses farther apart, what happened is a guess
LEAST_TWIST = 0.5  # length of a quaternion's twist part: cos(60), when the up axis swings by 120 degrees


@dataclass(frozen=True)
class Motion:
    """Poses of the body model at instants, in stage axes. fps: of the time codes; codes (n,): seconds times fps.

    turns (n, S, 3, 3): rotation of each joint relative to its parent; orientations at rest are the identity; origins_m
    (n, 3): position of the first joint; shape_weights (n, K): of corrective blend shapes.
    """

    fps: float
    codes: np.ndarray
    turns: np.ndarray
    origins_m: np.ndarray
    shape_weights: np.ndarray

    @property
    def seconds(self) -> np.ndarray:
        """Return the instants, (n,)."""
        return self.codes / self.fps

    def transforms(self, parents: np.ndarray, positions_m: np.ndarray, rows: slice = slice(None)) -> np.ndarray:
        """Return the joints' transforms in the stage at some rows of the instants, (n, S, 4, 4), for a body at rest at
        positions_m (S, 3)."""
        turns = self.turns[rows]
        found = np.tile(np.eye(4), (len(turns), len(parents), 1, 1))
        found[:, 0, :3, :3], found[:, 0, :3, 3] = turns[:, 0], self.origins_m[rows]
        for j, parent in enumerate(parents[1:], 1):
            found[:, j, :3, :3] = found[:, parent, :3, :3] @ turns[:, j]
            moved_m = found[:, parent, :3, :3] @ (positions_m[j] - positions_m[parent])
            found[:, j, :3, 3] = found[:, parent, :3, 3] + moved_m
        return found


def motion_of(body: BodyFit, fps: float, shape_weights: np.ndarray, stage_from_world: np.ndarray) -> Motion:
    """Return the motion of a body, with its frame numbers as time codes.

    The body frame is Z up, whatever the world's axes. With W stage from world, B stage from body and T world from body,
    the first joint turns by W T R B^-1, and the others by B R B^-1.
    """
    root, theta = body.root.double(), body.theta.double()
    turns = Y_UP_FROM_Z_UP @ rotation_from_axis_angle(theta).numpy() @ Y_UP_FROM_Z_UP.T
    turns[:, 0] = stage_from_world @ root[:, :3, :3].numpy() @ Y_UP_FROM_Z_UP.T @ turns[:, 0]
    origins_m = (root[:, :3, :3] @ body.rig.joints_m[0].double() + root[:, :3, 3]).numpy() @ stage_from_world.T
    return Motion(fps, np.array(body.frames, float), turns, origins_m, shape_weights)


def is_dense(seconds: np.ndarray) -> bool:
    """Return whether poses at instants (n,), in order, are near enough to be interpolated, on average."""
    return bool(np.ptp(seconds) <= LONGEST_S * (len(seconds) - 1) + 1e-6)


def resampled(motion: Motion, fps: float) -> Motion:
    """Return the motion at all whole time codes of another rate within its range; if there is none, at the nearest.

    Rotations are interpolated at constant angular velocity, positions and weights linearly. Between poses more than
    LONGEST_S apart, the earlier one is held.
    """
    first, last = motion.seconds[[0, -1]] * fps
    codes = np.arange(int(np.ceil(first - 1e-6)), int(np.floor(last + 1e-6)) + 1).astype(float)
    codes = codes if len(codes) else np.array([float(round(first))])
    at_s = np.clip(codes / fps, *motion.seconds[[0, -1]])
    before = np.clip(np.searchsorted(motion.seconds, at_s, "right") - 1, 0, max(len(motion.codes) - 2, 0))
    after = np.minimum(before + 1, len(motion.codes) - 1)
    span_s = np.maximum(motion.seconds[after] - motion.seconds[before], 1e-9)
    share = (at_s - motion.seconds[before]) / span_s
    share = np.where(span_s > LONGEST_S + 1e-6, np.floor(share + 1e-6), share)
    n, joints = len(codes), motion.turns.shape[1]
    start, end = (Rotation.from_matrix(motion.turns[rows].reshape(-1, 3, 3)) for rows in (before, after))
    turns = slerp(start, end, np.repeat(share, joints)).as_matrix().reshape(n, joints, 3, 3)
    origins_m, weights = (
        values[before] + share[:, None] * (values[after] - values[before])
        for values in (motion.origins_m, motion.shape_weights)
    )
    return Motion(fps, codes, turns, origins_m, weights)


def ground_transforms(pelvis: np.ndarray, floor_m: float) -> np.ndarray:
    """Return the root's transforms (n, 4, 4): on the floor below the pelvis (n, 4, 4), with the same heading.

    The heading is the twist about Y of the pelvis' rotation from rest (swing-twist decomposition, Dobrowolski 2015). It
    is undefined when the pelvis is upside down, and on the way there, in a somersault, it turns full circle. In such
    poses it is interpolated.
    """
    _, y, _, w = Rotation.from_matrix(pelvis[:, :3, :3]).as_quat().T
    headings, known, rows = 2 * np.arctan2(y, w), np.hypot(y, w) >= LEAST_TWIST, np.arange(len(pelvis))
    if known.any():
        headings[~known] = np.interp(rows[~known], rows[known], np.unwrap(headings[known]))
    ground = np.tile(np.eye(4), (len(pelvis), 1, 1))
    ground[:, :3, :3] = Rotation.from_euler("y", headings[:, None]).as_matrix()
    ground[:, :3, 3] = np.stack([pelvis[:, 0, 3], np.full(len(pelvis), floor_m), pelvis[:, 2, 3]], 1)
    return ground


def continuous_quaternions(quaternions: np.ndarray) -> np.ndarray:
    """Return quaternions (n, J, 4), each with the sign that puts it in the same hemisphere as in the previous frame."""
    quaternions = quaternions.copy()
    same_side = (quaternions[1:] * quaternions[:-1]).sum(-1, keepdims=True) >= 0
    quaternions[1:] *= np.cumprod(np.where(same_side, 1, -1), axis=0)
    return quaternions
