"""Fit of pose and shape to keypoints: in space where they triangulate, then in the images."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from hnerf.body.articulation import Articulation, Points, Pose, with_offsets
from hnerf.body.balance import Balance
from hnerf.body.body_model import BodyModel
from hnerf.body.fit_result import BodyFit
from hnerf.body.ground import Ground
from hnerf.body.hand_points import PalmTerm
from hnerf.body.limb_depths import LimbDepths
from hnerf.body.normal_equations import NormalEquations, geman_mcclure
from hnerf.body.observations import Observations
from hnerf.body.pose_prior import PosePrior, Smoothness
from hnerf.body.posture_prior import PosturePrior
from hnerf.body.reprojection import NEAR_M, DataTerm, reprojection_term
from hnerf.body.standing_feet import StandingFeet
from hnerf.config import FitSettings
from hnerf.geometry.camera import Camera

ROOT = np.arange(6)  # the root's unknowns among those of a frame
ROOT_INFORMATION = 1e-6  # keeps a root where it is if nothing else determines it


@dataclass(frozen=True)
class Problem:
    """The least-squares problem of a fit: observations and priors, from which it assembles normal equations at a pose.
    The model has the prior on its shape; the settings have those on offsets and stature, and the errors of keypoints.

    Shared unknowns: beta (B,), then the keypoint offsets (75,), then the median turns of the posture prior. scale_m (C,
    n): metres a pixel spans at the person, held fixed, since residuals would otherwise shrink as the body comes nearer.
    in_space: whether the body is fitted to triangulated keypoints, not to those in the images. balance, ground: used
    with one camera only; posture_prior: None as long as no posture is known; palm: None without hand points;
    limb_depths: None unless the only camera has metric landmarks.
    """

    observations: Observations
    scale_m: Tensor
    model: BodyModel
    settings: FitSettings
    smoothness: Smoothness
    in_space: bool = False
    balance: Balance | None = None
    ground: Ground | None = None
    posture_prior: PosturePrior | None = None
    palm: PalmTerm | None = None
    limb_depths: LimbDepths | None = None
    standing_feet: StandingFeet | None = None

    def assemble(self, pose: Pose) -> tuple[float, NormalEquations]:
        """Return the cost and the normal equations of the keypoints and of all priors."""
        articulation = Articulation(pose.rig)
        points = with_offsets(articulation.keypoints(), pose.offsets_m)
        joints = articulation.pose(pose)
        x, by_frame, by_shape = articulation.jacobian(points, joints)
        by_shared = torch.cat([by_shape, _offset_jacobian(points, joints.rotations)], -1)
        matrix, pull, cost = self._space_term(x) if self.in_space else self._image_term(x)
        posture_unknowns = self.posture_prior.unknowns(articulation) if self.posture_prior else 0
        equations = NormalEquations(len(x), articulation.unknowns, by_shared.shape[-1] + posture_unknowns)
        equations.frame[0][:, ROOT, ROOT] += ROOT_INFORMATION
        equations.add_points(matrix, pull, by_frame, by_shared)
        cost += self._add_shape_prior(equations, pose)
        cost += PosePrior(articulation).add(equations, pose)
        cost += self.smoothness.add(equations, x, by_frame)
        if self.standing_feet:
            cost += self.standing_feet.add(equations, x, by_frame)
        if self.balance:
            cost += self.balance.add(equations, x, by_frame)
        if self.ground:
            cost += self.ground.add(equations, pose, x, by_frame, by_shared)
        if self.limb_depths:
            cost += self.limb_depths.add(equations, x, by_frame, by_shared)
        if self.palm:
            cost += self.palm.add(equations, articulation, joints, self.scale_m)
        if self.posture_prior:
            cost += self.posture_prior.add(equations, articulation, pose)
        return cost, equations

    def _add_shape_prior(self, equations: NormalEquations, pose: Pose) -> float:
        """Add Gaussians on the shape, on the keypoint offsets, and on the stature, which determines monocular depth;
        return the cost."""
        model, settings, rig = self.model, self.settings, pose.rig
        offsets = pose.offsets_m.flatten()
        values = torch.cat([rig.beta - model.mean, offsets])
        precision = torch.cat([model.std, torch.full_like(offsets, settings.offset_m)]) ** -2
        top, bottom = rig.vertices_m[:, 2].argmax(), rig.vertices_m[:, 2].argmin()
        excess = float(rig.vertices_m[top, 2] - rig.vertices_m[bottom, 2] - settings.stature_m) / settings.stature_std_m
        by_beta = ((rig.shape_basis[:, top, 2] - rig.shape_basis[:, bottom, 2]) / settings.stature_std_m).numpy()
        shape = slice(0, len(by_beta))
        at = np.arange(len(values))
        equations.shared[at, at] += precision.numpy()
        equations.shared[shape, shape] += np.outer(by_beta, by_beta)
        equations.shared_gradient[at] += (precision * values).numpy()
        equations.shared_gradient[shape] += excess * by_beta
        return 0.5 * float((precision * values**2).sum()) + 0.5 * excess**2

    def _space_term(self, x: Tensor) -> DataTerm:
        """Return the data term of triangulated keypoints; robust as in `_image_term`."""
        known = self.observations.space_m.isfinite().all(-1)
        residual = torch.where(known[..., None], x - self.observations.space_m.nan_to_num(), 0.0)
        squared, trust, eye = residual.square().sum(-1), known.to(x.dtype), torch.eye(3, dtype=x.dtype)
        weight, cost = geman_mcclure(squared, self.settings.keypoint_m, self.settings.keypoint_outlier_m)
        weight = trust * weight
        return weight[..., None, None] * eye, weight[..., None] * residual, float((trust * cost).sum())

    def _image_term(self, x: Tensor) -> DataTerm:
        """Return the data term of reprojected keypoints, with pixel residuals converted to metres."""
        return reprojection_term(
            self.observations, self.scale_m, x, self.settings.keypoint_m, self.settings.keypoint_outlier_m
        )

    def apply_step(self, pose: Pose, equations: NormalEquations, damping: float) -> Pose:
        """Return the pose after a damped Gauss-Newton step, with its rig linearised again."""
        beta = pose.rig.beta
        unbounded = torch.full((len(equations.shared) - len(beta),), torch.inf)
        low = torch.cat([self.model.low - beta, -unbounded]).numpy()
        high = torch.cat([self.model.high - beta, unbounded]).numpy()
        frame, shared = (torch.from_numpy(part) for part in equations.step(damping, low, high))
        change, offsets, _ = shared.tensor_split([len(beta), len(beta) + pose.offsets_m.numel()])
        moved = Articulation(pose.rig).apply_step(pose, frame)
        return replace(moved, rig=self.model.rig(beta + change), offsets_m=pose.offsets_m + offsets.reshape(-1, 3))


def levenberg_marquardt(problem: Problem, pose: Pose, steps: int) -> Pose:
    """Minimise until a nearly undamped step lowers the cost by less than about a thousandth (Marquardt 1963)."""
    damping = 1e-2
    cost, equations = problem.assemble(pose)
    for _ in range(steps):
        trial = problem.apply_step(pose, equations, damping)
        trial_cost, trial_equations = problem.assemble(trial)
        if trial_cost >= cost:
            damping *= 5
            continue
        done = cost - trial_cost < 1e-3 * (cost + len(pose.theta)) and damping <= 1e-3
        pose, cost, equations = trial, trial_cost, trial_equations
        damping = max(damping / 5, 1e-6)
        if done:
            break
    return pose


def metres_per_pixel(cameras: tuple[Camera, ...], body: Pose | BodyFit) -> Tensor:
    """Return the length that a pixel spans at the body's root, (C, n) metres, float64."""
    centre = body.root.double() @ torch.cat([body.rig.joints_m[0].double(), torch.ones(1, dtype=torch.float64)])
    depth = [centre[:, :3] @ torch.from_numpy(c.R[2]) + float(c.t_m[2]) for c in cameras]
    return torch.stack(
        [d.clamp(min=NEAR_M) / float(c.K[[0, 1], [0, 1]].mean()) for c, d in zip(cameras, depth, strict=True)]
    )


def _offset_jacobian(points: Points, rotations: Tensor) -> Tensor:
    """Return how each keypoint moves with its own offset on the rest body, (n, 25, 3, 75)."""
    turned = torch.einsum("km,nmcd->nkcd", points.weights, rotations)
    count = len(points.weights)
    out = torch.zeros(*turned.shape[:3], count, 3, dtype=turned.dtype)
    out[:, torch.arange(count), :, torch.arange(count)] = turned.transpose(0, 1)
    return out.flatten(-2)
