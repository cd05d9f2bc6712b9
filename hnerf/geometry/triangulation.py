"""Robust triangulation of points seen by several cameras, and reprojection errors."""

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float

from hnerf.geometry.camera import Camera

CHUNK = 1 << 14  # points triangulated at once, to bound memory
MIN_INLIER_PX = 3.0
DAMPING = 1e-12  # share of the normal equations' trace: keeps them solvable for parallel rays, which then meet far away


def triangulate(
    cameras: Sequence[Camera], keypoints: Float[np.ndarray, "C *S 3"]
) -> tuple[Float[np.ndarray, "*S 3"], Float[np.ndarray, "C ..."], Bool[np.ndarray, "C ..."]]:
    """Triangulate points from several views, excluding outlier views.

    keypoints: x_px, y_px, confidence (0: unseen). For each point, every pair of views is solved linearly; the solution
    nearest to all views (confidence-weighted L1) decides which views are inliers. The inliers are then solved together
    by the iteratively re-weighted linear method (Hartley and Sturm 1997). An inlier is nearer than 4 times the median
    distance of the views that took no part in a pair's solution, a median that grows with noise and calibration error.

    Returns points_m (NaN with fewer than two inlier views), residuals_px (NaN where unseen or without a point) and
    inliers.
    """
    shape, keypoints = keypoints.shape[:-1], keypoints.reshape(len(cameras), -1, 3)
    projections, confidence = np.stack([camera.projection for camera in cameras]), confidence_of(keypoints)
    parts = [slice(i, i + CHUNK) for i in range(0, max(1, keypoints.shape[1]), CHUNK)]
    best = [_best_pair(projections, keypoints[:, part], confidence[:, part]) for part in parts]
    pair_points, in_pair = np.concatenate([p for p, _ in best]), np.concatenate([members for _, members in best], 1)
    distances = reprojection_px(projections, pair_points, keypoints)
    third_views_px = distances[(confidence > 0) & ~in_pair & np.isfinite(distances)]
    inlier_px = max(MIN_INLIER_PX, 4 * float(np.median(third_views_px))) if third_views_px.size else np.inf
    inliers = (confidence > 0) & (distances < inlier_px)
    points_m = solve_points(projections, keypoints, confidence * inliers)
    residuals_px = reprojection_px(projections, points_m, keypoints)
    inliers &= np.isfinite(residuals_px)
    lost = inliers.sum(0) < 2
    points_m[lost], residuals_px[:, lost], inliers[:, lost] = np.nan, np.nan, False
    residuals_px[confidence == 0] = np.nan
    return points_m.reshape(*shape[1:], 3), residuals_px.reshape(shape), inliers.reshape(shape)


def confidence_of(keypoints: Float[np.ndarray, "*S 3"]) -> Float[np.ndarray, "*S"]:
    """Return the confidence of keypoints; 0 where any of the three numbers is not finite."""
    return np.where(np.isfinite(keypoints).all(-1), keypoints[..., 2], 0.0)


def _best_pair(projections: np.ndarray, keypoints: np.ndarray, confidence: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return for each point the two-view solution nearest to all views, (K, 3), and which views it used, (C, K)
    bool."""
    cameras, count = confidence.shape
    best_cost = np.full(count, np.inf)
    points_m = np.full((count, 3), np.nan)
    members = np.zeros((cameras, count), bool)
    for both in map(list, combinations(range(cameras), 2)):
        in_pair = np.zeros((cameras, 1), bool)
        in_pair[both] = True
        candidate_m = solve_points(projections[both], keypoints[both], confidence[both])
        distance_px = reprojection_px(projections, candidate_m, keypoints)
        cost = np.where(confidence > 0, confidence * np.nan_to_num(distance_px, nan=1e6), 0).sum(0)
        better = (confidence[both] > 0).all(0) & (cost < best_cost)
        best_cost[better], points_m[better], members[:, better] = cost[better], candidate_m[better], in_pair
    return points_m, members


def solve_points(
    projections: Float[np.ndarray, "C 3 4"], keypoints: Float[np.ndarray, "C K 3"], weights: Float[np.ndarray, "C K"]
) -> Float[np.ndarray, "K 3"]:
    """Triangulate linearly with weights, re-weighted once by depth so that pixel distances are minimised.

    Returns points in metres, NaN with fewer than two views. Hartley and Sturm 1997, section 5.2, "Iterative-LS":
    inhomogeneous normal equations, whose solution does not depend on the choice of origin.
    """
    rows = projections[:, None, 2:] * np.nan_to_num(keypoints)[..., :2, None] - projections[:, None, :2]  # (C, K, 2, 4)
    # Includes the principal point, so lenses that differ in it get different weights: 0.3 % more error next to a
    # quarter crop.
    focal = np.linalg.norm(projections[:, :2, :3], axis=-1).mean(1)
    outer = np.einsum("ckia,ckib->ckab", rows, rows) / focal[:, None, None, None] ** 2
    scale = np.where(weights > 0, np.sqrt(weights), 0)
    enough = (weights > 0).sum(0) >= 2
    points_m = np.full((keypoints.shape[1], 3), np.nan)
    for _ in range(2):
        normal = np.einsum("ckab,ck->kab", outer, scale**2)[enough]
        damping = DAMPING * np.trace(normal[:, :3, :3], axis1=1, axis2=2)[:, None, None] * np.eye(3)
        points_m[enough] = -np.linalg.solve(normal[:, :3, :3] + damping, normal[:, :3, 3:])[..., 0]
        depth = np.abs(projections[:, 2, :3] @ points_m.T + projections[:, 2, 3:])
        scale = np.where(enough, np.sqrt(weights.clip(0)) / depth.clip(1e-9), 0)
    return points_m


def reprojection_px(
    projections: Float[np.ndarray, "C 3 4"], points_m: Float[np.ndarray, "K 3"], keypoints: Float[np.ndarray, "C K 3"]
) -> Float[np.ndarray, "C K"]:
    """Return the distance in pixels between projected points and keypoints; NaN behind a camera."""
    x = np.einsum("cij,kj->cki", projections, np.concatenate([points_m, np.ones_like(points_m[:, :1])], 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.linalg.norm(x[..., :2] / x[..., 2:] - keypoints[..., :2], axis=-1)
        return np.where(x[..., 2] > 0, distance, np.nan)
