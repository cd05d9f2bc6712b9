"""Pose and shape from keypoints: in space where they triangulate, then in the images."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from hnerf.body.articulation import Articulation, Points, Pose, with_offsets
from hnerf.body.balance import Balance
from hnerf.body.normal_equations import NormalEquations
from hnerf.body.observations import Observations
from hnerf.body.pose_prior import PosePrior, Smoothness
from hnerf.body.posture_prior import PosturePrior
from hnerf.body.rig import Rig
from hnerf.body.robust import geman_mcclure
from hnerf.geometry.camera import Camera

ROOT, UNSEEN = np.arange(6), 1e-6  # information on a root of which nothing else is known: it stays where it was put
NEAR_M = 0.1  # nothing nearer is in a camera's picture


@dataclass(frozen=True)
class FitPriors:
    """Known before looking: standard deviations in metres; the shape's mean, spread and range, each (B,)."""

    keypoint_m: float
    keypoint_outlier_m: float
    offset_m: float
    stature_m: float
    stature_std_m: float
    beta_mean: Tensor
    beta_spread: Tensor
    beta_low: Tensor
    beta_high: Tensor


Information = tuple[
    Tensor, Tensor, float
]  # of each keypoint: matrices (n, 25, 3, 3), gradients (n, 25, 3), and the cost


@dataclass(frozen=True)
class Problem:
    """What was seen and what is likely; assembles the normal equations at a pose. Shared unknowns: beta (B,), then the
    offsets (75,), then what is usual by the habit. scale_m (C, n) metres a pixel spans at the person: held fixed, or
    coming nearer would pay. balance: with one camera only; habit: None as long as no posture is known."""

    seen: Observations
    scale_m: Tensor
    likely: FitPriors
    smoothness: Smoothness
    reshape: Callable[[Tensor], Rig]
    balance: Balance | None = None
    habit: PosturePrior | None = None

    def assemble(self, pose: Pose, inform: Callable[[Tensor], Information]) -> tuple[float, NormalEquations]:
        """Cost and normal equations of the keypoints, as `inform` weighs them, and of all that is likely."""
        articulation = Articulation(pose.rig)
        points = with_offsets(articulation.keypoints(), pose.offsets_m)
        joints = articulation.pose(pose)
        x, by_frame, by_shape = articulation.jacobian(points, joints)
        by_shared = torch.cat([by_shape, _offset_jacobian(points, joints.rotations)], -1)
        matrix, pull, cost = inform(x)
        own = by_shared.shape[-1]
        habits = self.habit.unknowns(articulation) if self.habit else 0
        equations = NormalEquations(len(x), articulation.unknowns, own + habits)
        equations.frame[0][:, ROOT, ROOT] += UNSEEN
        weighted = (matrix @ by_frame).flatten(1, 2)
        frame, shared, gradient = by_frame.flatten(1, 2), by_shared.flatten(1, 2), pull.flatten(1)[..., None]
        equations.frame[0] += (frame.mT @ weighted).numpy()
        equations.border[..., :own] += (weighted.mT @ shared).numpy()
        equations.shared[:own, :own] += ((matrix @ by_shared).flatten(0, 2).mT @ by_shared.flatten(0, 2)).numpy()
        equations.frame_gradient += (frame.mT @ gradient)[..., 0].numpy()
        equations.shared_gradient[:own] += (shared.mT @ gradient)[..., 0].sum(0).numpy()
        cost += self._add_shape_prior(equations, pose)
        cost += PosePrior(articulation).add(equations, pose)
        cost += self.smoothness.add(equations, x, by_frame)
        if self.balance:
            cost += self.balance.add(equations, x, by_frame)
        if self.habit:
            cost += self.habit.add(equations, articulation, pose)
        return cost, equations

    def _add_shape_prior(self, equations: NormalEquations, pose: Pose) -> float:
        """Gaussians on the shape, on the keypoints' offsets, and on the stature, which monocular depth hangs on."""
        likely, rig = self.likely, pose.rig
        offsets = pose.offsets_m.flatten()
        values = torch.cat([rig.beta - likely.beta_mean, offsets])
        precision = torch.cat([likely.beta_spread, torch.full_like(offsets, likely.offset_m)]) ** -2
        top, bottom = rig.vertices_m[:, 2].argmax(), rig.vertices_m[:, 2].argmin()
        excess = float(rig.vertices_m[top, 2] - rig.vertices_m[bottom, 2] - likely.stature_m) / likely.stature_std_m
        by_beta = ((rig.shape_basis[:, top, 2] - rig.shape_basis[:, bottom, 2]) / likely.stature_std_m).numpy()
        shape = slice(0, len(by_beta))
        at = np.arange(len(values))
        equations.shared[at, at] += precision.numpy()
        equations.shared[shape, shape] += np.outer(by_beta, by_beta)
        equations.shared_gradient[at] += (precision * values).numpy()
        equations.shared_gradient[shape] += excess * by_beta
        return 0.5 * float((precision * values**2).sum()) + 0.5 * excess**2

    def in_space(self, x: Tensor) -> Information:
        """Information of triangulated keypoints; robust as in `in_images`."""
        known = self.seen.space_m.isfinite().all(-1)
        residual = torch.where(known[..., None], x - self.seen.space_m.nan_to_num(), 0.0)
        weight, cost = self._robust(residual.square().sum(-1), known.to(x.dtype))
        eye = torch.eye(3, dtype=x.dtype)
        return weight[..., None, None] * eye, weight[..., None] * residual, cost

    def in_images(self, x: Tensor) -> Information:
        """Information of reprojected keypoints, their pixels turned into metres."""
        matrix = torch.zeros(*x.shape, 3, dtype=x.dtype)
        pull, cost = torch.zeros_like(x), 0.0
        views = zip(self.seen.cameras, self.scale_m, self.seen.pixels, self.seen.confidence, strict=True)
        for camera, scale_m, pixels, confidence in views:
            uv, by_x = project(camera, x)
            residual = (uv - pixels) * scale_m[:, None, None]
            by_x = by_x * scale_m[:, None, None, None]
            weight, part = self._robust(residual.square().sum(-1), confidence.square())
            matrix += torch.einsum("nk,nkic,nkid->nkcd", weight, by_x, by_x)
            pull += torch.einsum("nk,nkic,nki->nkc", weight, by_x, residual)
            cost += part
        return matrix, pull, cost

    def _robust(self, squared: Tensor, trust: Tensor) -> tuple[Tensor, float]:
        """Weights, and the cost."""
        weight, cost = geman_mcclure(squared, self.likely.keypoint_m, self.likely.keypoint_outlier_m)
        return trust * weight, float((trust * cost).sum())

    def moved(self, pose: Pose, equations: NormalEquations, damping: float) -> Pose:
        """The pose after a damped Gauss-Newton step, its rig linearised anew."""
        beta = pose.rig.beta
        unbounded = torch.full((len(equations.shared) - len(beta),), torch.inf)
        low = torch.cat([self.likely.beta_low - beta, -unbounded]).numpy()
        high = torch.cat([self.likely.beta_high - beta, unbounded]).numpy()
        frame, shared = (torch.from_numpy(part) for part in equations.step(damping, low, high))
        change, offsets, _ = shared.tensor_split([len(beta), len(beta) + pose.offsets_m.numel()])
        moved = Articulation(pose.rig).moved(pose, frame)
        return replace(moved, rig=self.reshape(beta + change), offsets_m=pose.offsets_m + offsets.reshape(-1, 3))


def levenberg_marquardt(problem: Problem, pose: Pose, inform: Callable[[Tensor], Information], steps: int) -> Pose:
    """Minimise until a nearly undamped step lowers the cost by a thousandth or so (Marquardt 1963)."""
    damping = 1e-2
    cost, equations = problem.assemble(pose, inform)
    for _ in range(steps):
        trial = problem.moved(pose, equations, damping)
        trial_cost, trial_equations = problem.assemble(trial, inform)
        if trial_cost >= cost:
            damping *= 5
            continue
        done = cost - trial_cost < 1e-3 * (cost + len(pose.theta)) and damping <= 1e-3
        pose, cost, equations = trial, trial_cost, trial_equations
        damping = max(damping / 5, 1e-6)
        if done:
            break
    return pose


def project(camera: Camera, x: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels (..., 2) and their derivative by the world position (..., 2, 3)."""
    projection = torch.from_numpy(camera.projection)
    h = x @ projection[:, :3].T + projection[:, 3]
    depth = h[..., 2:].clamp(min=NEAR_M)
    uv = h[..., :2] / depth
    return uv, (projection[:2, :3] - uv[..., None] * projection[2, :3]) / depth[..., None]


def metres_per_pixel(cameras: tuple[Camera, ...], pose: Pose) -> Tensor:
    """What a pixel spans at the body's root, (C, n)."""
    centre = pose.root @ torch.cat([pose.rig.joints_m[0], torch.ones(1, dtype=pose.root.dtype)])
    depth = [centre[:, :3] @ torch.from_numpy(c.R[2]) + float(c.t_m[2]) for c in cameras]
    return torch.stack(
        [d.clamp(min=NEAR_M) / float(c.K[[0, 1], [0, 1]].mean()) for c, d in zip(cameras, depth, strict=True)]
    )


def _offset_jacobian(points: Points, rotations: Tensor) -> Tensor:
    """(n, 25, 3, 75): how each keypoint moves with its own offset on the resting body."""
    turned = torch.einsum("km,nmcd->nkcd", points.weights, rotations)
    count = len(points.weights)
    out = torch.zeros(*turned.shape[:3], count, 3, dtype=turned.dtype)
    out[:, torch.arange(count), :, torch.arange(count)] = turned.transpose(0, 1)
    return out.flatten(-2)
