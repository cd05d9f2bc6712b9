"""Fit of the fingers to hand points, with the body held fixed. Fingers stay close to their medians over the frames that
show the hand; if few frames show it, it is relaxed in the others."""

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from hnerf.body.articulation import Articulation, Pose
from hnerf.body.hand_points import OUTLIER_M, POINT_STD_M, SEEN, SIDES, finger_joints, hand_points, moved_onto_palm
from hnerf.body.normal_equations import NormalEquations, geman_mcclure
from hnerf.body.pose_prior import add_turn_prior, turn_axes
from hnerf.body.reprojection import Views, reprojection_term
from hnerf.body.rig import Rig
from hnerf.capture.timing import median_step

# By segment, from the palm: flexion of a relaxed hand, and standard deviations of flexion, twist and spread, all in
# degrees and chosen wide. Limits on bending count from straight fingers, limits on spreading, to either side, from
# rest. Of the joints, only a thumb's first one twists.
RELAXED_DEG = (20.0, 25.0, 15.0)
STD_DEG = ((25.0, 2.0, 12.0), (25.0, 2.0, 2.0), (15.0, 2.0, 2.0))
THUMB_RELAXED_DEG = (5.0, 10.0, 10.0)
THUMB_STD_DEG = ((15.0, 10.0, 15.0), (15.0, 2.0, 5.0), (20.0, 2.0, 2.0))
LIMITS_DEG = (-10.0, 100.0)
SPREAD_LIMITS_DEG, THUMB_SPREAD_LIMITS_DEG = (20.0, 5.0, 5.0), (35.0, 5.0, 5.0)
RATE_DEG_S = 200.0  # standard deviation of a finger joint's speed: a fist closes in a third of a second
# The outlier distance of each step: wide at first, because a fist is a decimetre from a relaxed hand, then as for the
# palm. The last steps also hold each joint close to its median over the frames that show the hand.
STEPS_M, MEDIAN_STEPS, DAMPING = (0.2, 0.2, 0.2, 0.2, *12 * (OUTLIER_M,)), 6, 1e-4
MEDIAN_STD_DEG, MEDIAN_OUTLIER_DEG = 5.0, 20.0  # std about the median, and deviation that means another gesture
MIN_MEDIAN_FRAMES = 3


@dataclass(frozen=True)
class FingerPrior:
    """Priors on the 30 finger joints. axes (30, 3, 3): rows flexion, twist and spread; mean (30,): mean flexion from
    rest; low, high and std (30, 3); all in radians."""

    axes: Tensor
    mean: Tensor
    low: Tensor
    high: Tensor
    std: Tensor

    @staticmethod
    def of(rig: Rig) -> "FingerPrior":
        """Return the priors for a rig. Angles count from straight fingers, so the bend at rest is subtracted."""
        axes, bends = [], []
        hands_m = rig.joints_m[[rig.joint_names.index(name) for name in finger_joints()]].view(2, 5, 3, 3)
        for side, fingers_m in zip(SIDES, hands_m, strict=True):
            wrist_m = rig.joints_m[rig.joint_names.index(f"wrist.{side}")]
            normal = torch.linalg.cross(fingers_m[1, 0] - wrist_m, fingers_m[4, 0] - wrist_m)
            palmwards = normal if side == "R" else -normal  # the direction in which fingers bend
            for finger, chain_m in enumerate(fingers_m):
                bones = [bone / bone.norm() for bone in chain_m.diff(dim=0, prepend=wrist_m[None])]
                for above, bone in itertools.pairwise([*bones, bones[-1]]):
                    axes.append(turn_axes(normal if finger == 0 else torch.linalg.cross(bone, palmwards), bone))
                    bends.append(torch.linalg.cross(above, bone) @ axes[-1][0] if finger > 0 else bone.new_zeros(()))
        relaxed = torch.tensor([*THUMB_RELAXED_DEG, *4 * RELAXED_DEG] * 2, dtype=rig.joints_m.dtype)
        std = torch.tensor([*THUMB_STD_DEG, *4 * STD_DEG] * 2, dtype=relaxed.dtype)
        bend = torch.stack(bends).asin()
        spread = torch.deg2rad(torch.tensor([*THUMB_SPREAD_LIMITS_DEG, *4 * SPREAD_LIMITS_DEG] * 2, dtype=std.dtype))
        low, high = (
            torch.stack([math.radians(limit) - bend, torch.full_like(bend, sign * math.inf), sign * spread], 1)
            for limit, sign in zip(LIMITS_DEG, (-1, 1), strict=True)
        )
        return FingerPrior(torch.stack(axes), torch.deg2rad(relaxed) - bend, low, high, torch.deg2rad(std))

    def relaxed(self) -> Tensor:
        """Return the turns of a relaxed hand, (30, 3) axis-angle."""
        return self.mean[:, None] * self.axes[:, 0]

    def add(self, equations: NormalEquations, turns: Tensor) -> float:
        """Add the priors on turns (n, 30, 3) to the normal equations, whose unknowns they are; return the cost."""
        mean = torch.nn.functional.pad(self.mean[:, None], (0, 2))
        return add_turn_prior(equations, 0, self.axes, turns, mean, self.std, self.low, self.high)


def add_persistence(
    equations: NormalEquations, turns: Tensor, following: np.ndarray, std: float, steps: np.ndarray
) -> float:
    """Add a Gaussian on the change of turns (n, 30, 3) from one frame to the next, and return its cost. following (F,):
    rows whose next row is the next frame, `steps` (F,) later; std: standard deviation of an angle's change in one step,
    in radians."""
    weight = std**-2 * steps[:, None] ** -2.0
    change = (turns[following + 1] - turns[following]).flatten(1).numpy()
    at = np.arange(change.shape[1])
    for rows, sign in ((following, -1), (following + 1, 1)):
        equations.frame_gradient[rows] += sign * weight * change
        equations.frame[0][rows[:, None], at, at] += weight
        equations.coupling_diagonal[rows] += weight
    equations.frame[1][following[:, None], at, at] -= weight
    return 0.5 * float((weight * change**2).sum())


def add_median_prior(equations: NormalEquations, turns: Tensor, shown: Tensor) -> float:
    """Add a robust prior that keeps turns (n, 30, 3) close to their medians over the frames that show their hand, shown
    (n, 2) bool, and return its cost: the network's errors on small fingers change from frame to frame. A hand that few
    frames show gets no such prior."""
    cost = 0.0
    for hand, seen in enumerate(shown.T):
        if seen.sum() < MIN_MEDIAN_FRAMES:
            continue
        joints, at = slice(15 * hand, 15 * hand + 15), np.arange(45 * hand, 45 * hand + 45)
        off = turns[:, joints] - turns[seen, joints].quantile(0.5, dim=0)
        std, outlier = math.radians(MEDIAN_STD_DEG), math.radians(MEDIAN_OUTLIER_DEG)
        weight, costs = geman_mcclure(off.square().sum(-1), std, outlier)
        equations.frame_gradient[:, at] += (weight[..., None] * off).flatten(1).numpy()
        equations.frame[0][:, at, at] += weight.repeat_interleave(3, 1).numpy()
        cost += float(costs.sum())
    return cost


def fit_fingers(pose: Pose, views: Views, scale_m: Tensor, runs: list[tuple[int, ...]], seconds: float) -> Pose:
    """Return the pose with fingers fitted to hand points (C, n, 42) relative to their palm, everything else held fixed.

    scale_m (C, n): metres a pixel spans; runs: consecutive frames; seconds: duration of their median step.
    """
    rig = pose.rig
    fingers = [rig.joint_names.index(name) for name in finger_joints()]
    wrists = [rig.joint_names.index(f"wrist.{side}") for side in SIDES]
    free = torch.zeros_like(rig.free)
    free[[*fingers, *wrists]] = True
    articulation = Articulation(replace(rig, free=free))
    slots = torch.searchsorted(articulation.joints, torch.tensor(fingers))
    unknowns = (3 + 3 * slots[:, None] + torch.arange(3)).flatten()
    points, prior = hand_points(articulation), FingerPrior.of(rig)
    ends = np.cumsum([len(run) for run in runs])
    following = np.setdiff1d(np.arange(ends[-1]), ends - 1)
    frames = [*itertools.chain(*runs)]
    steps = np.diff(frames)[following] / median_step(frames)
    theta = pose.theta.clone()
    if not (theta[:, fingers] != 0).any():
        theta[:, fingers] = prior.relaxed()
    views = moved_onto_palm(views, articulation.jacobian(points, articulation.pose(pose))[0])
    shown = (views.confidence.unflatten(-1, (2, -1)).amax(-1) > SEEN).any(0)
    for number, outlier_m in enumerate(STEPS_M):
        x, by_frame, _ = articulation.jacobian(points, articulation.pose(replace(pose, theta=theta)))
        matrix, pull, _ = reprojection_term(views, scale_m, x, POINT_STD_M, outlier_m)
        equations = NormalEquations(len(theta), len(unknowns), 0)
        equations.add_points(matrix, pull, by_frame[..., unknowns], x.new_zeros(*x.shape, 0))
        prior.add(equations, theta[:, fingers])
        add_persistence(equations, theta[:, fingers], following, math.radians(RATE_DEG_S) * seconds, steps)
        if number >= len(STEPS_M) - MEDIAN_STEPS:
            add_median_prior(equations, theta[:, fingers], shown)
        step, _ = equations.step(DAMPING, np.zeros(0), np.zeros(0))
        theta[:, fingers] += torch.from_numpy(step).unflatten(-1, (-1, 3))
    return replace(pose, theta=theta)
