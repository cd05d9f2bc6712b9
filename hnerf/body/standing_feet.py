"""A prior that standing feet do not move, which keypoints and outlines of few cameras let wander from frame to
frame."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from hnerf.body.articulation import Articulation, Pose, with_offsets
from hnerf.body.ground import FEET
from hnerf.body.normal_equations import NormalEquations, geman_mcclure

WINDOW_S = 0.25  # on either side of a frame: where a foot's speed is measured
STANDING_MPS = 0.12  # of a toe or heel, below which it stands
STD_MPS, OUTLIER_MPS = 0.03, 0.2  # of its velocity from frame to frame, and of one that was taken for standing


@dataclass(frozen=True)
class StandingFeet:
    """A Gaussian on the velocity of standing toes and heels between neighbouring frames, with Geman-McClure weights.

    first (T,): the earlier row of each pair of neighbours; per_s (T,): one over the time between them; stands (T, 6)
    bool: the toes and heels, in the order of FEET, that stand in both.
    """

    first: np.ndarray
    per_s: Tensor
    stands: Tensor

    @classmethod
    def of_pose(cls, pose: Pose, runs: list[tuple[int, ...]], fps: float) -> "StandingFeet":
        """Find the toes and heels that stand in a pose. runs: consecutive frame numbers, between which feet may jump;
        fps: frame rate of these numbers.

        Height does not matter: feet that a treadmill carries, or that turn with the person, are down but move.
        """
        articulation = Articulation(pose.rig)
        keypoints = with_offsets(articulation.keypoints(), pose.offsets_m)
        feet_m = articulation.jacobian(keypoints, articulation.pose(pose))[0][:, FEET].numpy()
        first, per_s, stands, start = [], [], [], 0
        for run in runs:
            rows, at_s = np.arange(start, start + len(run)), np.array(run) / fps
            slow = _speeds_mps(feet_m[rows], at_s) < STANDING_MPS
            first.append(rows[:-1])
            per_s.append(1 / np.diff(at_s))
            stands.append(slow[:-1] & slow[1:])
            start += len(run)
        per_s_stands = (torch.from_numpy(np.concatenate(parts)) for parts in (per_s, stands))
        return cls(np.concatenate(first), *per_s_stands)

    def add(self, equations: NormalEquations, keypoints_m: Tensor, jacobian: Tensor) -> float:
        """Add the prior to the normal equations and return its cost. keypoints_m (n, 25, 3), jacobian (n, 25, 3, U).

        Shared unknowns are left alone: the shape hardly moves a foot from one frame to the next.
        """
        x, j = keypoints_m[:, FEET], jacobian[:, FEET].flatten(1, 2)  # (n, 6, 3), (n, 18, U)
        velocity = self.per_s[:, None, None] * (x[self.first + 1] - x[self.first])
        weight, cost = geman_mcclure(velocity.square().sum(-1), STD_MPS, OUTLIER_MPS)
        weight = (self.stands * weight).repeat_interleave(3, -1)[..., None]  # (T, 18, 1)
        pull = weight * velocity.flatten(1)[..., None]
        before, after = (sign * self.per_s[:, None, None] * j[self.first + k] for k, sign in ((0, -1), (1, 1)))
        for rows, by_frame in ((self.first, before), (self.first + 1, after)):
            block = (by_frame.mT @ (weight * by_frame)).numpy()
            equations.frame[0][rows] += block
            equations.coupling_diagonal[rows] += np.einsum("tuu->tu", block)
            equations.frame_gradient[rows] += (by_frame.mT @ pull)[..., 0].numpy()
        equations.frame[1][self.first] += (before.mT @ (weight * after)).numpy()
        return float((self.stands * cost).sum())


def _speeds_mps(points_m: np.ndarray, at_s: np.ndarray) -> np.ndarray:
    """Return the speeds (n, K) of points (n, K, 3) at instants (n,): of the straight line that fits best through their
    positions up to WINDOW_S before and after, and in the neighbouring frames."""
    speeds_mps = np.zeros(points_m.shape[:2])
    for t, now_s in enumerate(at_s):
        near = np.abs(at_s - now_s) <= WINDOW_S
        near[max(t - 1, 0) : t + 2] = True
        since_s = at_s[near] - at_s[near].mean()
        slopes = np.einsum("t,tkc->kc", since_s, points_m[near]) / max(since_s @ since_s, 1e-9)  # of a single frame: 0
        speeds_mps[t] = np.linalg.norm(slopes, axis=-1)
    return speeds_mps
