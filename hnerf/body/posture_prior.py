"""Joints are likely to be turned as they mostly are: what is seen badly is told by the frames in which it is seen."""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from hnerf.body.articulation import Articulation, Pose
from hnerf.body.normal_equations import NormalEquations
from hnerf.body.robust import geman_mcclure
from hnerf.geometry.camera import Camera

WRISTS_DEG, OTHER_WRISTS_DEG = 5.0, 10.0  # how far a joint is usually off, and from where it is another posture
POSTURE_DEG, OTHER_POSTURE_DEG = 7.0, 14.0
STILLEST_DEG = 2.0  # nobody stands stiller, as far as a first fit can tell
ONE_POSTURE_DEG = 0.1  # spread of joints that stand still: next to none
ALL_SIDES = 0.5  # trust from which a posture is known well enough to be the only one
CHI_MEDIAN = 1.54  # of the length of a vector of three unit normals
TINY = 1e-6  # keeps the usual turn of what no frame is trusted to tell where it is


@dataclass(frozen=True)
class PosturePrior:
    """A joint is likely to be turned by `spread` about its median over a group of frames, and Geman-McClure lets
    another posture go from `other` on.

    groups: the frames' rows, each in one of them; trust (n, M - 1) by frame and free joint: 0 is none, 1 all; spread
    (n, M - 1) and other in radians.
    """

    groups: list[list[int]]
    trust: Tensor
    spread: Tensor
    other: float

    @staticmethod
    def of_hands(frames: int, articulation: Articulation) -> "PosturePrior":
        """Of the wrists alone, over all frames: no keypoint shows how they turn."""
        names = [articulation.rig.joint_names[joint] for joint in articulation.joints[1:].tolist()]
        trust = torch.tensor([name.startswith("wrist") for name in names], dtype=torch.float64)
        return PosturePrior.alike([list(range(frames))], trust.expand(frames, -1), WRISTS_DEG, OTHER_WRISTS_DEG)

    @staticmethod
    def of_one_view(groups: list[list[int]], pose: Pose, camera: Camera) -> "PosturePrior":
        """Of all joints, as far as the only camera sees the body from all sides in a group of frames: only then their
        medians are known in depth. One view hardly tells a limb bent towards it from one bent away. pose: as far as it
        is known, to tell how the body turns."""
        trust = torch.zeros(len(pose.root), len(Articulation(pose.rig).joints) - 1, dtype=pose.root.dtype)
        for rows in groups:
            trust[rows] = turning(pose.root[rows], camera)
        return PosturePrior.alike(groups, trust, POSTURE_DEG, OTHER_POSTURE_DEG)

    @staticmethod
    def alike(groups: list[list[int]], trust: Tensor, spread_deg: float, other_deg: float) -> "PosturePrior":
        """With the same spread for all joints and frames."""
        return PosturePrior(groups, trust, torch.full_like(trust, math.radians(spread_deg)), math.radians(other_deg))

    def learned(self, pose: Pose) -> "PosturePrior":
        """With each joint's spread as it is in a first fit: who stands still while turning may be held to it, who walks
        may not. Between 2 degrees and what was believed before."""
        length = self._off(pose.theta[:, Articulation(pose.rig).joints[1:]]).norm(dim=-1) / CHI_MEDIAN
        spread = self.spread.clone()
        for rows in self.groups:
            spread[rows] = length[rows].quantile(0.5, dim=0).clamp(min=math.radians(STILLEST_DEG)).minimum(spread[rows])
        return replace(self, spread=spread)

    def of_one_posture(self) -> "PosturePrior | None":
        """With next to no spread in groups of frames that see the body from all sides; None without such a group."""
        known = self.trust.amin(1, keepdim=True) > ALL_SIDES
        still = torch.where(known, math.radians(ONE_POSTURE_DEG), self.spread)
        return replace(self, spread=still) if known.any() else None

    def _off(self, turns: Tensor) -> Tensor:
        """From the medians, (n, M - 1, 3) radians."""
        off = torch.zeros_like(turns)
        for rows in self.groups:
            off[rows] = turns[rows] - turns[rows].quantile(0.5, dim=0)
        return off

    def unknowns(self, articulation: Articulation) -> int:
        """How many usual turns there are, shared unknowns of their own."""
        return len(self.groups) * (articulation.unknowns - 6)

    def add(self, equations: NormalEquations, articulation: Articulation, pose: Pose) -> float:
        """Returns the cost. Usual turns move together with the frames' own: they are the last shared unknowns, so that
        a step does not hold the frames to the medians from before it; after it the medians are taken anew."""
        off = self._off(pose.theta[:, articulation.joints[1:]])
        weight, cost = geman_mcclure(off.square().sum(-1) * self.trust, self.spread, self.other)
        weights = (weight * self.trust).repeat_interleave(3, 1).numpy()  # (n, 3 (M - 1))
        pull = weights * off.flatten(1).numpy()
        equations.frame_gradient[:, 6:] += pull
        at = np.arange(6, articulation.unknowns)
        equations.frame[0][:, at, at] += weights
        first = len(equations.shared) - self.unknowns(articulation)
        for group, rows in enumerate(self.groups):
            own = first + group * len(at) + np.arange(len(at))
            equations.border[np.array(rows)[:, None], at, own] -= weights[rows]
            equations.shared[own, own] += weights[rows].sum(0) + TINY
            equations.shared_gradient[own] -= pull[rows].sum(0)
        return float(cost.sum())


def turning(root: Tensor, camera: Camera) -> float:
    """How far a body turns before a camera, roots (n, 4, 4): 0 if it faces the camera in one way, 1 if from all sides
    alike. That is 1 - |mean of the unit directions to the camera|, level, as seen from the body."""
    towards = root[:, :3, :3].mT @ (torch.from_numpy(camera.centre_m) - root[:, :3, 3])[..., None]
    level = torch.nn.functional.normalize(towards[:, :2, 0], dim=-1)
    return float(1 - level.mean(0).norm())
