"""A prior on each joint's turn: close to its median over frames, so that what one frame shows badly is determined by
the frames that show it well."""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from hnerf.body.articulation import Articulation, Pose
from hnerf.body.normal_equations import NormalEquations
from hnerf.body.robust import geman_mcclure
from hnerf.geometry.camera import Camera

WRIST_STD_DEG, WRIST_OUTLIER_DEG = 5.0, 10.0  # std of a joint's turn, and deviation of another posture
POSTURE_STD_DEG, POSTURE_OUTLIER_DEG = 7.0, 14.0
MIN_STD_DEG = 2.0  # a first fit cannot show smaller ones
SINGLE_POSTURE_STD_DEG = 0.1  # of joints that stand still
KNOWN_TRUST = 0.5  # above it a posture is known well enough to be the only one
CHI_MEDIAN = 1.54  # median length of a vector of three standard normal variables
REGULARISATION = 1e-6  # keeps median turns where they are if no frame is trusted


@dataclass(frozen=True)
class PosturePrior:
    """A Gaussian on each joint's turn about its median over a group of frames; Geman-McClure weights let another
    posture go.

    groups: the frames' rows, each in one of them; trust (n, M - 1) by frame and free joint: 0 is none, 1 is full; std
    (n, M - 1) and outlier in radians.
    """

    groups: list[list[int]]
    trust: Tensor
    std: Tensor
    outlier: float

    @staticmethod
    def of_wrists(frames: int, articulation: Articulation, seen: Tensor | None = None) -> "PosturePrior":
        """Return a prior on the wrists alone, over all frames: no keypoint of the body shows how they turn. seen (n,
        2): how surely the points of the left and of the right hand do."""
        names = [articulation.rig.joint_names[joint] for joint in articulation.joints[1:].tolist()]
        trust = torch.zeros(frames, len(names), dtype=torch.float64)
        for hand, side in enumerate("LR"):
            wrists = [m for m, name in enumerate(names) if name == f"wrist.{side}"]
            trust[:, wrists] = 1.0 if seen is None else 1 - seen[:, hand, None]
        return PosturePrior.uniform([list(range(frames))], trust, WRIST_STD_DEG, WRIST_OUTLIER_DEG)

    @staticmethod
    def of_single_view(groups: list[list[int]], pose: Pose, camera: Camera) -> "PosturePrior":
        """Return a prior on all joints, trusted as far as the only camera sees the body from all sides in a group of
        frames.

        Only then are the medians known in depth: one view hardly distinguishes a limb bent towards it from one bent
        away. pose: as far as it is known, to tell how the body turns.
        """
        trust = torch.zeros(len(pose.root), len(Articulation(pose.rig).joints) - 1, dtype=pose.root.dtype)
        for rows in groups:
            trust[rows] = view_direction_variance(pose.root[rows], camera)
        return PosturePrior.uniform(groups, trust, POSTURE_STD_DEG, POSTURE_OUTLIER_DEG)

    @staticmethod
    def uniform(groups: list[list[int]], trust: Tensor, std_deg: float, outlier_deg: float) -> "PosturePrior":
        """Return a prior with the same standard deviation for all joints and frames."""
        return PosturePrior(groups, trust, torch.full_like(trust, math.radians(std_deg)), math.radians(outlier_deg))

    def with_learned_std(self, pose: Pose) -> "PosturePrior":
        """Return the prior with each joint's standard deviation as found in a first fit, between 2 degrees and the
        present one: a person who stands still while turning is held to it, one who walks is not."""
        length = self._deviations(pose.theta[:, Articulation(pose.rig).joints[1:]]).norm(dim=-1) / CHI_MEDIAN
        std = self.std.clone()
        for rows in self.groups:
            std[rows] = length[rows].quantile(0.5, dim=0).clamp(min=math.radians(MIN_STD_DEG)).minimum(std[rows])
        return replace(self, std=std)

    def as_single_posture(self) -> "PosturePrior | None":
        """Return the prior with a standard deviation near zero in groups of frames that see the body from all sides;
        None without such a group."""
        known = self.trust.amin(1, keepdim=True) > KNOWN_TRUST
        held = torch.where(known, math.radians(SINGLE_POSTURE_STD_DEG), self.std)
        return replace(self, std=held) if known.any() else None

    def _deviations(self, turns: Tensor) -> Tensor:
        """Return deviations of the turns from their medians, (n, M - 1, 3) radians."""
        off = torch.zeros_like(turns)
        for rows in self.groups:
            off[rows] = turns[rows] - turns[rows].quantile(0.5, dim=0)
        return off

    def unknowns(self, articulation: Articulation) -> int:
        """Return how many median turns there are; each is a shared unknown."""
        return len(self.groups) * (articulation.unknowns - 6)

    def add(self, equations: NormalEquations, articulation: Articulation, pose: Pose) -> float:
        """Add the prior to the normal equations and return its cost.

        The medians are the last shared unknowns and move together with the frames' turns, so that a step does not hold
        the frames to the medians from before it; after it the medians are computed anew.
        """
        off = self._deviations(pose.theta[:, articulation.joints[1:]])
        weight, cost = geman_mcclure(off.square().sum(-1) * self.trust, self.std, self.outlier)
        weights = (weight * self.trust).repeat_interleave(3, 1).numpy()  # (n, 3 (M - 1))
        pull = weights * off.flatten(1).numpy()
        equations.frame_gradient[:, 6:] += pull
        at = np.arange(6, articulation.unknowns)
        equations.frame[0][:, at, at] += weights
        first = len(equations.shared) - self.unknowns(articulation)
        for group, rows in enumerate(self.groups):
            own = first + group * len(at) + np.arange(len(at))
            equations.border[np.array(rows)[:, None], at, own] -= weights[rows]
            equations.shared[own, own] += weights[rows].sum(0) + REGULARISATION
            equations.shared_gradient[own] -= pull[rows].sum(0)
        return float(cost.sum())


def view_direction_variance(root: Tensor, camera: Camera) -> float:
    """Return the circular variance of the direction to the camera as seen from the body, with roots (n, 4, 4).

    It is 1 - |mean of the unit horizontal directions|: 0 if the camera always sees the same side of the body, 1 if it
    sees all sides alike.
    """
    towards = root[:, :3, :3].mT @ (torch.from_numpy(camera.centre_m) - root[:, :3, 3])[..., None]
    level = torch.nn.functional.normalize(towards[:, :2, 0], dim=-1)
    return float(1 - level.mean(0).norm())
