"""What one camera leaves open and what is likely of it: people stand over their feet, and keep their posture.

An image hardly tells a body that leans towards its camera from an upright one that is smaller, nor a limb bent towards
it from one bent away. Several cameras see this, so it is asked of one camera only.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from hnerf.body.articulation import Articulation, Pose
from hnerf.body.normal_equations import NormalEquations
from hnerf.capture.camera import Camera

BALANCE_M = 0.05
HABIT_DEG = 7.0
BALANCE_FADES, HABIT_FADES = 3.0, 2.0  # standard deviations from which the pull fades: a step, another posture

# Shares of the body's mass (Winter 2009, table 4.1), half at either end of a segment, arms at the elbows: BODY_25
# keypoint and share.
TRUNK = {1: 0.289, 8: 0.289}  # head and trunk: neck and middle of the hips
ARMS = {3: 0.05, 6: 0.05}  # elbows
THIGHS = {9: 0.05, 12: 0.05, 10: 0.05, 13: 0.05}  # hips and knees
SHANKS = {10: 0.0305, 13: 0.0305, 11: 0.0305, 14: 0.0305}  # knees and ankles, with the feet
SUPPORT = {11: 0.5, 14: 0.5}  # ankles: where keypoints put the trunk's middle line, it stands above them


def centre_of_mass_over_feet() -> Tensor:
    """Coefficients (25,) of the keypoints, which sum to 0: the centre of mass less the middle of the ankles."""
    shares = torch.zeros(25, dtype=torch.float64)
    for segment in (TRUNK, ARMS, THIGHS, SHANKS):
        for keypoint, share in segment.items():
            shares[keypoint] += share
    shares /= shares.sum()
    for keypoint, share in SUPPORT.items():
        shares[keypoint] -= share
    return shares


class Balance:
    """The centre of mass is above the middle of the ankles, give or take 5 cm either way, except when it is not:
    Geman-McClure lets a step or a jump go."""

    def __init__(self, up: int) -> None:
        """up: index of the world's vertical axis."""
        self.level = [axis for axis in range(3) if axis != up]
        self.shares = centre_of_mass_over_feet()

    def add(self, equations: NormalEquations, keypoints_m: Tensor, jacobian: Tensor) -> float:
        """keypoints_m (n, 25, 3), jacobian (n, 25, 3, U); returns the cost. Shared unknowns are left alone: nobody
        keeps the balance by another shape."""
        off, by_frame = (
            torch.einsum("k,nkc...->nc...", self.shares, t)[:, self.level] for t in (keypoints_m, jacobian)
        )
        weight, cost = faded(off.square().sum(-1), BALANCE_M, BALANCE_FADES)
        weighted = weight[:, None, None] * by_frame
        equations.frame[0] += (weighted.mT @ by_frame).numpy()
        equations.frame_gradient += torch.einsum("ncu,nc->nu", weighted, off).numpy()
        return cost


class Habit:
    """A joint is likely to be turned as it mostly is: by 7 degrees about its median over a group of frames, and
    Geman-McClure lets another posture go. It counts as far as the camera sees the body from all sides in that group, as
    only then the median is known in depth."""

    def __init__(self, groups: list[list[int]], pose: Pose, camera: Camera) -> None:
        """groups: the frames' rows, each in one of them; pose: as far as it is known, to tell how the body turns."""
        self.groups = groups
        self.trust = torch.zeros(len(pose.root), dtype=pose.root.dtype)
        for rows in groups:
            self.trust[rows] = turning(pose.root[rows], camera)

    def add(self, equations: NormalEquations, articulation: Articulation, pose: Pose) -> float:
        """Returns the cost. The median's own derivative is left out."""
        turns = pose.theta[:, articulation.joints[1:]]  # (n, M - 1, 3)
        usual = torch.zeros_like(turns)
        for rows in self.groups:
            usual[rows] = turns[rows].quantile(0.5, dim=0)
        off, trust = turns - usual, self.trust[:, None]
        weight, cost = faded(off.square().sum(-1) * trust, math.radians(HABIT_DEG), HABIT_FADES)
        weight = weight * trust
        equations.frame_gradient[:, 6:] += (weight[..., None] * off).flatten(1).numpy()
        at = np.arange(6, articulation.unknowns)
        equations.frame[0][:, at, at] += weight.repeat_interleave(3, 1).numpy()
        return cost


def turning(root: Tensor, camera: Camera) -> float:
    """How far a body turns before a camera, roots (n, 4, 4): 0 if it faces the camera in one way, 1 if from all sides
    alike. That is 1 - |mean of the unit directions to the camera|, level, as seen from the body."""
    towards = root[:, :3, :3].mT @ (torch.from_numpy(camera.centre_m) - root[:, :3, 3])[..., None]
    level = torch.nn.functional.normalize(towards[:, :2, 0], dim=-1)
    return float(1 - level.mean(0).norm())


@dataclass(frozen=True)
class OneView:
    """habit: None as long as no posture is known."""

    balance: Balance
    habit: Habit | None = None

    def add(
        self, equations: NormalEquations, articulation: Articulation, pose: Pose, keypoints_m: Tensor, jacobian: Tensor
    ) -> float:
        """Keypoints of the pose and their derivatives as for `Balance`; returns the cost."""
        cost = self.balance.add(equations, keypoints_m, jacobian)
        return cost + (self.habit.add(equations, articulation, pose) if self.habit else 0.0)


def faded(squared: Tensor, sigma: float, sigmas: float) -> tuple[Tensor, float]:
    """Geman-McClure (1987): weights of the re-weighted least squares for squared residuals, and the cost."""
    fade = 1 + squared / (sigma * sigmas) ** 2
    return (sigma * fade) ** -2, 0.5 * float((squared / sigma**2 / fade).sum())
