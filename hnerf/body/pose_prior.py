"""Priors on human poses: how far each joint turns from rest, where hinges stop, and smoothness in time.

A joint's rotation vector is measured along three axes of the rest body: flexion, twist about the bone, and sideways.
"""

import itertools
import math

import numpy as np
import torch
from torch import Tensor

from hnerf.body.articulation import Articulation, Pose
from hnerf.body.normal_equations import NormalEquations
from hnerf.capture.timing import median_step

# Standard deviations from rest in degrees: flexion, twist, sideways; chosen wide, to span everyday movement.
STD_DEG = {
    "upperleg01": (45, 20, 25),
    "lowerleg01": (60, 6, 4),
    "foot": (20, 10, 12),
    "spine05": (12, 8, 8),
    "spine03": (12, 8, 8),
    "spine01": (12, 8, 8),
    "clavicle": (10, 5, 10),
    "upperarm01": (60, 40, 60),
    "lowerarm01": (60, 30, 5),
    "wrist": (25, 25, 15),
    "neck01": (15, 15, 10),
    "head": (15, 15, 10),
}
OTHER_STD_DEG = (30, 30, 30)
HINGES = ("lowerleg01", "lowerarm01")  # joints that bend from straight to folded
FOLDED_DEG = 150.0  # of a hinge, from straight
FLEXION_DEG = {"upperarm01": (-170, 45), "upperleg01": (-130, 40)}  # limits forwards and backwards, from rest
MEAN_FLEXION_DEG = {"upperarm01": -10.0}  # arms are carried in front of the body
LIMIT_STD_DEG = 2.0  # of a turn beyond its limits

OUTLIER_SIGMAS = 3.0  # of an acceleration: a sudden movement or a cut


class PosePrior:
    """A Gaussian about the rest pose on every axis of every free joint, and one-sided limits on flexion."""

    def __init__(self, articulation: Articulation) -> None:
        self.articulation = articulation
        rig = articulation.rig
        names = [rig.joint_names[int(j)].split(".")[0] for j in articulation.joints[1:]]
        bones = _bone_directions(articulation)
        pairs = list(zip(bones[articulation.parents[1:]], bones[1:], strict=True))  # of each joint: bone above, own
        self.axes = torch.stack([_axes(*pair, name in HINGES) for pair, name in zip(pairs, names, strict=True)])
        std = torch.tensor([STD_DEG.get(name, OTHER_STD_DEG) for name in names], dtype=bones.dtype)
        self.sigma = torch.deg2rad(std)
        bend = torch.stack([torch.arccos((above @ own).clamp(-1, 1)) for above, own in pairs])
        hinge = torch.tensor([name in HINGES for name in names])
        span = torch.deg2rad(torch.tensor([FLEXION_DEG.get(name, (-180, 180)) for name in names], dtype=bones.dtype))
        low = torch.where(hinge, -bend, span[:, 0])
        high = torch.where(hinge, math.radians(FOLDED_DEG) - bend, span[:, 1])
        pad = torch.nn.functional.pad
        self.low, self.high = (pad(x[:, None], (0, 2), value=end) for x, end in ((low, -math.inf), (high, math.inf)))
        self.mean = torch.zeros_like(self.sigma)
        self.mean[:, 0] = torch.deg2rad(torch.tensor([MEAN_FLEXION_DEG.get(name, 0.0) for name in names]))

    def mean_pose(self) -> Tensor:
        """Return the most likely turns of the free joints, (M - 1, 3) axis-angle."""
        return torch.einsum("mac,ma->mc", self.axes, self.mean)

    def add(self, equations: NormalEquations, pose: Pose) -> float:
        """Add the prior to the normal equations and return its cost."""
        turns = pose.theta[:, self.articulation.joints[1:]]
        return add_turn_prior(equations, 6, self.axes, turns, self.mean, self.sigma, self.low, self.high)


def add_turn_prior(
    equations: NormalEquations, first: int, axes: Tensor, turns: Tensor, mean: Tensor, std: Tensor, low: Tensor,
    high: Tensor,
) -> float:  # fmt: skip
    """Add a Gaussian on turns (n, M, 3), the unknowns from `first` on, and one-sided limits to the normal equations;
    return the cost. axes (M, 3, 3): rows flexion, twist, sideways; mean, std, low, high (M, 3): about these axes, in
    radians."""
    local = torch.einsum("mac,nmc->nma", axes, turns)
    off, excess, limit = local - mean, local - local.clamp(low, high), math.radians(LIMIT_STD_DEG) ** -2
    pull = std**-2 * off + limit * excess
    weight = std**-2 + limit * (excess != 0)
    blocks = torch.einsum("mac,nma,mad->nmcd", axes, weight, axes)
    gradient = torch.einsum("mac,nma->nmc", axes, pull)
    for m in range(len(axes)):
        at = slice(first + 3 * m, first + 3 * m + 3)
        equations.frame_gradient[:, at] += gradient[:, m].numpy()
        equations.frame[0][:, at, at] += blocks[:, m].numpy()
    return 0.5 * float((off**2 / std**2).sum() + limit * (excess**2).sum())


def _bone_directions(articulation: Articulation) -> Tensor:
    """Return the unit direction (M, 3) of each moving joint's bone at rest: to its only moving child, or to the centre
    of the vertices it carries."""
    heads = articulation.rest_m
    directions = []
    for m in range(len(heads)):
        children = [c for c in range(1, len(heads)) if int(articulation.parents[c]) == m]
        carried = articulation.vertex_weights[:, m] > 0.5
        end = heads[children].mean(0) if len(children) == 1 else articulation.rig.vertices_m[carried].mean(0)
        directions.append((end - heads[m]) / (end - heads[m]).norm())
    return torch.stack(directions)


def _axes(above: Tensor, bone: Tensor, hinge: bool) -> Tensor:
    """Return the axes of a joint, rows flexion, twist, sideways. A hinge flexes in the plane of its two bones, other
    joints about the left-right axis."""
    return turn_axes(torch.linalg.cross(above, bone) if hinge else torch.tensor([1.0, 0, 0], dtype=bone.dtype), bone)


def turn_axes(flexion: Tensor, bone: Tensor) -> Tensor:
    """Return unit axes (3, 3) about which a joint turns, rows flexion, twist, sideways: flexion, of any length, is made
    perpendicular to the unit direction of the bone."""
    flexion = flexion - (flexion @ bone) * bone
    flexion = flexion / flexion.norm()
    return torch.stack([flexion, bone, torch.linalg.cross(flexion, bone)])


class Smoothness:
    """A prior on the acceleration of keypoints between neighbouring frames (zero velocity would hold back real
    movement).

    Geman-McClure weights release it at a sudden movement or a cut. It does not act from one run of frames to the next.
    """

    def __init__(self, runs: list[tuple[int, ...]], fps: float, sigma_mps2: np.ndarray) -> None:
        """Prepare the prior. runs: consecutive frame numbers; fps: frame rate of these numbers; sigma_mps2 (25,):
        standard deviations."""
        frames = [*itertools.chain(*runs)]
        starts = np.cumsum([0] + [len(run) for run in runs])
        triples = [np.arange(a, a + len(run) - 2) for a, run in zip(starts, runs, strict=False)]
        self.first = np.concatenate(triples)  # first row of each triple of consecutive frames, (T,)
        step, steps = median_step(frames), np.diff(frames)
        before, after = steps[self.first], steps[self.first + 1]
        # (3, T): factors that turn three positions into their acceleration in median steps: 1, -2, 1 if evenly spaced
        divisors = np.stack([before * (before + after), -before * after, after * (before + after)])
        self.difference = 2 * step**2 / divisors
        self.sigma_m = sigma_mps2 * step**2 / fps**2

    def add(self, equations: NormalEquations, keypoints_m: Tensor, jacobian: Tensor) -> float:
        """Add the prior to the normal equations and return its cost. keypoints_m (n, 25, 3), jacobian (n, 25, 3, U).

        The contribution of the shape to an acceleration is negligible, so shared unknowns are left alone.
        """
        if len(self.first) == 0:
            return 0.0
        x, j = keypoints_m.numpy(), jacobian.flatten(1, 2).numpy()
        at = [self.first + i for i in range(3)]
        by_triple = self.difference[..., None, None]
        second = by_triple[0] * x[at[0]] + by_triple[1] * x[at[1]] + by_triple[2] * x[at[2]]  # (T, 25, 3)
        squared = (second**2).sum(-1) / self.sigma_m**2
        falloff = 1 + squared / OUTLIER_SIGMAS**2
        weight = np.repeat((self.sigma_m * falloff) ** -2, 3, axis=1)  # (T, 75)
        pull = weight * second.reshape(len(second), -1)
        before = np.einsum("nuu->nu", equations.frame[0]).copy()
        for i, a in enumerate(by_triple):
            weighted = a * np.swapaxes(j[at[i]], 1, 2) * weight[:, None]  # (T, U, 75)
            equations.frame_gradient[at[i]] += a[..., 0] * np.einsum("tku,tk->tu", j[at[i]], pull)
            for k in range(3 - i):
                equations.frame[k][at[i]] += by_triple[i + k] * weighted @ j[at[i + k]]
        equations.coupling_diagonal += np.einsum("nuu->nu", equations.frame[0]) - before
        return 0.5 * float((squared / falloff).sum())
