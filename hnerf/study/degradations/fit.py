"""Degradations of the body fit, and poses far from the recorded ones."""

import dataclasses
import math

import numpy as np
import torch
from torch import Tensor

from hnerf.body.fit_result import BodyFit


def add_pose_noise(body: BodyFit, angle_deg: float, rng: np.random.Generator) -> BodyFit:
    """Add random vectors to the rotation vectors of all free joints in all frames. `angle_deg` is the root mean square
    of their lengths and, for straight joints, of the rotations."""
    return dataclasses.replace(body, theta=body.theta + _rotation_noise(body, len(body.frames), angle_deg, rng))


def change_shape(body: BodyFit, distance_mm: float, rng: np.random.Generator) -> BodyFit:
    """Move the shape values in a random direction, so far that vertices at rest move by `distance_mm` (root mean
    square)."""
    rig = body.rig
    direction = torch.from_numpy(rng.normal(size=len(rig.beta))).to(rig.beta)
    moved_m = rig.shaped(rig.beta + direction)[0] - rig.vertices_m
    step = distance_mm / 1e3 / float(moved_m.square().sum(-1).mean().sqrt())
    return dataclasses.replace(body, rig=rig.reshaped(rig.beta + step * direction))


def extreme_poses(body: BodyFit, angle_deg: float, count: int, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """Return poses far from those of the body's frames: theta (count, J, 3) and root (count, 4, 4).

    Frames are drawn at random, and every free joint is rotated as in `add_pose_noise`.
    """
    rows = torch.from_numpy(rng.integers(len(body.frames), size=count))
    return body.theta[rows] + _rotation_noise(body, count, angle_deg, rng), body.root[rows]


def _rotation_noise(body: BodyFit, count: int, angle_deg: float, rng: np.random.Generator) -> Tensor:
    """Return random rotation vectors (count, J, 3) in radians, zero at the root joint and at locked joints."""
    turns = rng.normal(0, math.radians(angle_deg) / math.sqrt(3), (count, *body.theta.shape[1:]))
    moves = body.rig.free & (body.rig.parents >= 0)
    return torch.from_numpy(turns).to(body.theta) * moves[:, None]
