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

# Shares of the body's mass (Winter 2009, table 4.1), each segment's half at either end: BODY_25 keypoint and share.
TRUNK = {1: 0.289, 8: 0.289}  # head and trunk: neck and middle of the hips
ARMS = {3: 0.05, 6: 0.05}  # elbows
THIGHS = {9: 0.05, 12: 0.05, 10: 0.05, 13: 0.05}  # hips and knees
SHANKS = {10: 0.0305, 13: 0.0305, 11: 0.0305, 14: 0.0305}  # knees and ankles, with the feet
SUPPORT = {19: 0.25, 21: 0.25, 22: 0.25, 24: 0.25}  # big toes and heels


def centre_of_mass_over_feet() -> Tensor:
    """Coefficients (25,) of the keypoints, which sum to 0: the centre of mass less the middle of the feet."""
    shares = torch.zeros(25, dtype=torch.float64)
    for segment in (TRUNK, ARMS, THIGHS, SHANKS):
        for keypoint, share in segment.items():
            shares[keypoint] += share
    shares /= shares.sum()
    for keypoint, share in SUPPORT.items():
        shares[keypoint] -= share
    return shares


class Balance:
    """The centre of mass is above the middle of the feet, give or take 5 cm either way, except when it is not:
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
    """A joint is likely to be turned as it mostly is: by 7 degrees about its median over a run of frames, and
    Geman-McClure lets another posture go. It counts as far as the camera sees the body from all sides in that run, as
    only then the median is known in depth: by 1 - |mean of the directions to the camera, seen from the body|."""

    def __init__(self, runs: list[tuple[int, ...]], camera: Camera) -> None:
        self.lengths = [len(run) for run in runs]
        self.centre_m = torch.from_numpy(camera.centre_m)

    def add(self, equations: NormalEquations, articulation: Articulation, pose: Pose) -> float:
        """Returns the cost. The median's own derivative is left out."""
        turns = pose.theta[:, articulation.joints[1:]]  # (n, M - 1, 3)
        parts = turns.split(self.lengths)
        off = turns - torch.cat([part.median(0, keepdim=True).values.expand_as(part) for part in parts])
        trust = self.turning(pose)
        squared = off.square().sum(-1) * trust[:, None]
        weight, cost = faded(squared, math.radians(HABIT_DEG), HABIT_FADES)
        weight = weight * trust[:, None]
        equations.frame_gradient[:, 6:] += (weight[..., None] * off).flatten(1).numpy()
        at = np.arange(6, articulation.unknowns)
        equations.frame[0][:, at, at] += weight.repeat_interleave(3, 1).numpy()
        return cost

    def turning(self, pose: Pose) -> Tensor:
        """How far the body turns in the run of each frame, (n,): 0 where it faces the camera in one way, 1 where from
        all sides alike."""
        towards = pose.root[:, :3, :3].mT @ (self.centre_m - pose.root[:, :3, 3])[..., None]
        views = torch.nn.functional.normalize(towards[..., 0], dim=-1).split(self.lengths)
        return torch.cat([(1 - view.mean(0).norm()).expand(len(view)) for view in views])


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
