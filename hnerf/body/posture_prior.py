"""A prior on each joint's turn: close to its median over frames, so that what one frame shows badly is determined by
the frames that show it well."""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from hnerf.body.articulation import Articulation, Pose
from hnerf.body.normal_equations import NormalEquations, geman_mcclure
from hnerf.body.pose_prior import PosePrior
from hnerf.geometry.camera import Camera

# Standard deviation of a joint's turn, and deviation that means another posture.
WRIST_STD_DEG, WRIST_OUTLIER_DEG = 5.0, 15.0
TWISTED, TWIST_STD_DEG, TWIST_OUTLIER_DEG = ("upperarm01", "lowerarm01", "upperleg01"), 10.0, 40.0  # about their bones
POSTURE_STD_DEG, POSTURE_OUTLIER_DEG = 7.0, 14.0
MIN_STD_DEG = 2.0  # a first fit cannot show smaller ones
SINGLE_POSTURE_STD_DEG = 0.1  # of joints that stand still
KNOWN_TRUST = 0.5  # trust above which a posture is known well enough to be the only one
CHI_MEDIAN = 1.54  # median length of a vector of three standard normal variables
REGULARISATION = 1e-6  # keeps median turns where they are if no frame is trusted


@dataclass(frozen=True)
class PosturePrior:
    """A Gaussian on each joint's turn about its median over a group of frames; Geman-McClure weights release frames
    with another posture.

    groups: rows of frames, each in one group; trust (n, M - 1) by frame and free joint: 0 is none, 1 is full; std (n, M
    - 1) and outlier (M - 1,) in radians; held (M - 1, 3, 3): projects a deviation onto the axes that are held.
    """

    groups: list[list[int]]
    trust: Tensor
    std: Tensor
    outlier: Tensor
    held: Tensor

    @staticmethod
    def of_twists(frames: int, articulation: Articulation) -> "PosturePrior":
        """Return a prior on wrists and on the twist of arms and thighs, over all frames.

        The body's keypoints hardly show how a straight limb twists, and not at all how a hand turns; in images of a few
        hundred pixels, a network gets the turn of a hand wrong in single frames.
        """
        names = [articulation.rig.joint_names[joint].split(".")[0] for joint in articulation.joints[1:].tolist()]
        wrists, twisted = (torch.tensor([name in held for name in names]) for held in (("wrist",), TWISTED))
        prior = PosturePrior.uniform(
            [list(range(frames))], (wrists | twisted).expand(frames, -1).double(), WRIST_STD_DEG, WRIST_OUTLIER_DEG
        )
        prior.std[:, twisted] = math.radians(TWIST_STD_DEG)
        prior.outlier[twisted] = math.radians(TWIST_OUTLIER_DEG)
        bones = PosePrior(articulation).axes[twisted, 1]
        prior.held[twisted] = bones[:, :, None] * bones[:, None]
        return prior

    @staticmethod
    def of_single_view(groups: list[list[int]], pose: Pose, camera: Camera) -> "PosturePrior":
        """Return a prior on all joints, trusted as far as the only camera sees the body from all sides in a group of
        frames.

        Only then are the medians known in depth: one view hardly distinguishes a limb bent towards it from one bent
        away. pose: the pose known so far, which tells how the body turns.
        """
        trust = torch.zeros(len(pose.root), len(Articulation(pose.rig).joints) - 1, dtype=pose.root.dtype)
        for rows in groups:
            trust[rows] = view_direction_variance(pose.root[rows], camera)
        return PosturePrior.uniform(groups, trust, POSTURE_STD_DEG, POSTURE_OUTLIER_DEG)

    @staticmethod
    def uniform(groups: list[list[int]], trust: Tensor, std_deg: float, outlier_deg: float) -> "PosturePrior":
        """Return a prior with the same standard deviation for all joints and frames."""
        std, outlier = torch.full_like(trust, std_deg).deg2rad(), torch.full_like(trust[0], outlier_deg).deg2rad()
        return PosturePrior(groups, trust, std, outlier, torch.eye(3, dtype=trust.dtype).repeat(len(outlier), 1, 1))

    def with_learned_std(self, pose: Pose) -> "PosturePrior":
        """Return the prior with each joint's standard deviation as found in a first fit, between 2 degrees and the
        current one: a person who stands still while turning is held to it, one who walks is not."""
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

    @property
    def single_posture(self) -> Tensor:
        """Return the frames that are held to a single posture, (n,) bool."""
        return self.std.amax(1) <= math.radians(SINGLE_POSTURE_STD_DEG)

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
        the frames to the medians from before it; after it, the medians are recomputed.
        """
        off = self._deviations(pose.theta[:, articulation.joints[1:]])
        off = (self.held @ off[..., None])[..., 0]
        weight, cost = geman_mcclure(off.square().sum(-1) * self.trust, self.std, self.outlier)
        weight *= self.trust
        pull, size = (weight[..., None] * off).flatten(1).numpy(), 3 * len(self.held)
        matrix, at = off.new_zeros(len(off), len(self.held), 3, len(self.held), 3), torch.arange(len(self.held))
        matrix[:, at, :, at] = weight.T[..., None, None] * self.held[:, None]  # a block on the diagonal for each joint
        weights = matrix.reshape(len(off), size, size).numpy()
        equations.frame_gradient[:, 6:] += pull
        equations.frame[0][:, 6:, 6:] += weights
        first = len(equations.shared) - self.unknowns(articulation)
        for group, rows in enumerate(self.groups):
            own = slice(first + group * size, first + (group + 1) * size)
            equations.border[rows, 6:, own] -= weights[rows]
            equations.shared[own, own] += weights[rows].sum(0) + REGULARISATION * np.eye(size)
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
