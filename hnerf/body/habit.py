"""Joints are likely to be turned as they mostly are: what is seen badly is told by the frames in which it is seen."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from hnerf.body.articulation import Articulation, Pose
from hnerf.body.normal_equations import NormalEquations
from hnerf.body.robust import faded
from hnerf.capture.camera import Camera

HABIT_DEG = 7.0
FADES_DEG = 14.0  # from where the pull fades: another posture
HANDS = 2.0  # trust in the turn of the wrists, which only outlines tell: 5 degrees


@dataclass(frozen=True)
class Habit:
    """A joint is likely to be turned by 7 degrees about its median over a group of frames, and Geman-McClure lets
    another posture go.

    groups: the frames' rows, each in one of them; trust (n, M - 1) by frame and free joint: 0 is none, 4 half the
    angle.
    """

    groups: list[list[int]]
    trust: Tensor

    @staticmethod
    def of_hands(frames: int, articulation: Articulation) -> "Habit":
        """Of the wrists alone, over all frames: no keypoint shows how they turn."""
        names = [articulation.rig.joint_names[joint] for joint in articulation.joints[1:].tolist()]
        trust = torch.tensor([HANDS * name.startswith("wrist") for name in names], dtype=torch.float64)
        return Habit([list(range(frames))], trust.expand(frames, -1))

    @staticmethod
    def of_one_view(groups: list[list[int]], pose: Pose, camera: Camera) -> "Habit":
        """Of all joints, as far as the only camera sees the body from all sides in a group of frames: only then their
        medians are known in depth. One view hardly tells a limb bent towards it from one bent away. pose: as far as it
        is known, to tell how the body turns."""
        trust = torch.zeros(len(pose.root), len(Articulation(pose.rig).joints) - 1, dtype=pose.root.dtype)
        for rows in groups:
            trust[rows] = turning(pose.root[rows], camera)
        return Habit(groups, trust)

    def add(self, equations: NormalEquations, articulation: Articulation, pose: Pose) -> float:
        """Returns the cost. The median's own derivative is left out."""
        turns = pose.theta[:, articulation.joints[1:]]  # (n, M - 1, 3)
        usual = torch.zeros_like(turns)
        for rows in self.groups:
            usual[rows] = turns[rows].quantile(0.5, dim=0)
        off = turns - usual
        squared = off.square().sum(-1) * self.trust
        weight, cost = faded(squared, math.radians(HABIT_DEG), math.radians(FADES_DEG))
        weight = weight * self.trust
        equations.frame_gradient[:, 6:] += (weight[..., None] * off).flatten(1).numpy()
        at = np.arange(6, articulation.unknowns)
        equations.frame[0][:, at, at] += weight.repeat_interleave(3, 1).numpy()
        return float(cost.sum())


def turning(root: Tensor, camera: Camera) -> float:
    """How far a body turns before a camera, roots (n, 4, 4): 0 if it faces the camera in one way, 1 if from all sides
    alike. That is 1 - |mean of the unit directions to the camera|, level, as seen from the body."""
    towards = root[:, :3, :3].mT @ (torch.from_numpy(camera.centre_m) - root[:, :3, 3])[..., None]
    level = torch.nn.functional.normalize(towards[:, :2, 0], dim=-1)
    return float(1 - level.mean(0).norm())
