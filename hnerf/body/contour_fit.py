"""Fit of the body's outline to the masks' outlines, camera by camera.

There are two kinds of match, both point to line (Chen and Medioni 1992, in the image): every point of the mask's
contour pulls the nearest rim vertex of the projected body, and every rim vertex outside the mask is pushed back in. A
body belongs inside its clothes, so the second is strict, while the first is loose and robust: cloth and hair stand away
from the skin. Where a mask lacks a limb, vertices far outside push no harder than those a little outside (Huber 1964),
and none do around a keypoint that a camera's masks often lack: otherwise that limb would shrink.
"""

import logging
import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree
from skimage.measure import find_contours

from hnerf.body.articulation import Articulation, Pose, PosedSkin
from hnerf.body.descriptor import normals_of
from hnerf.body.keypoint_fit import Problem
from hnerf.body.normal_equations import NormalEquations
from hnerf.body.reprojection import project
from hnerf.config import FitSettings
from hnerf.geometry.camera import Camera
from hnerf.geometry.silhouette import silhouette
from hnerf.progress import tracked
from hnerf.side_by_side import side_by_side

log = logging.getLogger("hnerf.fit")

MASK_BLUR_PX = 0.7  # smooths the pixel steps of a mask's edge
MAX_RIM_COSINE = 0.35  # |cosine| between normal and view below which a vertex is on the rim
RIM_DEPTH_PX = 2.5  # greatest depth of rim vertices inside the body's silhouette
MIN_NORMAL_COSINE = 0.5  # between the outlines' normals above which points may match
GROUND_STD_M = 0.01  # of the height of a frame's lowest vertex above the ground
GROUND_OUTLIER_M = 0.15  # height of a body that does not stand on the ground
MAX_SOLE_M = 0.05  # between the skin and the ground
LACKED_CONFIDENCE, LACKED_M = 0.5, 0.02  # of a keypoint that a mask lacks, and how far outside the mask it is
LACKED_SHARE = 1 / 3  # of a camera's masks: fewer may lack a keypoint by its own errors
LACKED_REACH_M = 0.3  # of the part that the mask lacks around it: from the wrist to the fingertips or the elbow
BORDER_PX = 2.0  # margin at the image border, where every mask ends
UNDERSIDE_M = 0.015  # height above the lowest vertex up to which others may touch the ground
HUBER = 1.345  # standard deviations beyond which residuals push no harder; 95 % efficient on Gaussian noise
DIVERGED = 1.5  # residuals relative to the least so far, from which on steps lead away
DAMPING = 1e-4  # more would hold back depth and scale, which one camera's outlines hardly determine


@dataclass(frozen=True)
class Outline:
    """The edge of a mask: points (N, 2) px, outward normals (N, 2); size_px of the mask; the signed distance to it,
    negative inside, at each stride-th row and column."""

    points_px: np.ndarray
    normals: np.ndarray
    size_px: tuple[int, int]
    distance_px: np.ndarray
    stride: int = 1

    def distance_at(self, points_px: np.ndarray) -> np.ndarray:
        """Return the signed distance (N,) px of points (N, 2); outside the image, that of the nearest pixel."""
        return np.asarray(map_coordinates(self.distance_px, points_px.T[::-1] / self.stride, order=1, mode="nearest"))


@dataclass(frozen=True)
class ContourResiduals:
    """Linear residuals of one frame: residual_m + gradient . (movement of vertex), with weights in 1 / m^2."""

    vertices: np.ndarray
    gradient: np.ndarray
    residual_m: np.ndarray
    weight: np.ndarray


def outline(mask: np.ndarray, spacing_px: float, stride: int = 1) -> Outline:
    """Return the edge of a mask (H, W) bool, sampled about every spacing_px, and distances at every stride-th pixel."""
    soft = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), MASK_BLUR_PX)
    lines = [_resampled(line, spacing_px) for line in find_contours(soft, 0.5)]  # (row, column)
    points = np.concatenate(lines) if lines else np.zeros((0, 2))
    slope = np.stack([map_coordinates(g, points.T, order=1) for g in np.gradient(soft)], -1)
    normals = -slope / np.linalg.norm(slope, axis=1, keepdims=True).clip(1e-9)
    inside, outside = (cv2.distanceTransform(m.astype(np.uint8), cv2.DIST_L2, 5) for m in (mask, ~mask))
    distance_px = np.where(mask, 0.5 - inside, outside - 0.5)[::stride, ::stride].copy()
    return Outline(points[:, ::-1], normals[:, ::-1], mask.shape[::-1], distance_px, stride)


def _resampled(line: np.ndarray, spacing_px: float) -> np.ndarray:
    """Return points at even spacing along a polyline (N, 2)."""
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    at = np.arange(0, along[-1], spacing_px)
    return np.stack([np.interp(at, along, line[:, k]) for k in range(2)], 1)


def match(
    camera: Camera, edge: Outline, lacked_px: np.ndarray, scale_m: float, vertices_m: np.ndarray, normals: np.ndarray,
    faces: np.ndarray, settings: FitSettings,
) -> ContourResiduals:  # fmt: skip
    """Return the residuals of one camera and frame. lacked_px (N, 2): keypoints that the mask lacks; scale_m: metres a
    pixel spans; vertices_m and normals (V, 3)."""
    rim, uv, by_x, normals_2d = rim_in_image(camera, vertices_m, normals, faces)
    contained = _contain(edge, uv, settings.spacing_m / scale_m, lacked_px, LACKED_REACH_M / scale_m)
    pairs = [_cover(edge, uv, normals_2d), contained]
    ids, direction, residual_px = (np.concatenate(parts) for parts in zip(*pairs, strict=True))
    gradient = np.einsum("ri,ric->rc", direction, by_x[ids]) * scale_m
    residual_m = residual_px * scale_m
    ids = rim[ids]
    loose = settings.outside_m**-2 / (1 + (residual_m / settings.clothing_m) ** 2) ** 2  # Geman-McClure
    strict = settings.inside_m**-2 * np.minimum(1, HUBER * settings.inside_m / np.abs(residual_m).clip(1e-9))
    return ContourResiduals(ids, gradient, residual_m, np.where(residual_m > 0, strict, loose))


def rim_in_image(
    camera: Camera, vertices_m: np.ndarray, normals: np.ndarray, faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the vertices (N,) on the body's outline, their pixels (N, 2), the derivatives of the pixels with respect
    to the vertices (N, 2, 3) px per metre, and the unit normals in the image (N, 2)."""
    rim = _rim(camera, vertices_m, normals, faces)
    uv, by_x = (t.numpy() for t in project(camera, torch.from_numpy(vertices_m[rim])))
    normals_2d = normals[rim] @ camera.R[:2].T
    normals_2d /= np.linalg.norm(normals_2d, axis=1, keepdims=True).clip(1e-9)
    return rim, uv, by_x, normals_2d


def _rim(camera: Camera, vertices_m: np.ndarray, normals: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the vertices (N,) on the body's outline in the image: seen edge-on, and near the border of its
    silhouette."""
    view = vertices_m - camera.centre_m
    edge_on = np.abs((view * normals).sum(1)) < MAX_RIM_COSINE * np.linalg.norm(view, axis=1)
    rim = np.flatnonzero(edge_on & normals.any(1))  # vertices of no face, inside anny's caps, have no normal
    covered = silhouette(camera, vertices_m, faces).astype(np.uint8)
    depth_px = cv2.distanceTransform(np.pad(covered, 1), cv2.DIST_L2, 5)[1:-1, 1:-1]
    deep = map_coordinates(depth_px, camera.project(vertices_m[rim])[0].T[::-1], order=0, mode="nearest")
    return rim[deep <= RIM_DEPTH_PX]


def _cover(edge: Outline, rim_px: np.ndarray, rim_normals: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Match points of the mask's contour to the nearest rim vertex: its index, the direction (N, 2), the signed
    distance px (negative: the body is too small)."""
    if len(rim_px) == 0 or len(edge.points_px) == 0:
        return np.zeros(0, int), np.zeros((0, 2)), np.zeros(0)
    nearest = cKDTree(rim_px).query(edge.points_px)[1]
    signed = ((rim_px[nearest] - edge.points_px) * edge.normals).sum(1)
    keep = ((rim_normals[nearest] * edge.normals).sum(1) > MIN_NORMAL_COSINE) & (signed < 0)
    return nearest[keep], edge.normals[keep], signed[keep]


def lacked_keypoints(keypoints: np.ndarray, scale_m: np.ndarray, edges: list[Outline | None]) -> list[np.ndarray]:
    """Return the keypoints (N, 2) px that each of a camera's masks lacks, although they are surely seen; only those
    that many of its masks lack. keypoints (n, 25, 3): x_px, y_px, confidence; scale_m (n,): metres a pixel spans."""
    seen = keypoints[..., 2] > LACKED_CONFIDENCE
    lacked = np.zeros_like(seen)
    for t, edge in enumerate(edges):
        if edge is not None:
            lacked[t, seen[t]] = edge.distance_at(keypoints[t, seen[t], :2]) * scale_m[t] > LACKED_M
    often = lacked.sum(0) >= LACKED_SHARE * sum(edge is not None for edge in edges)
    return [points[rows & often, :2] for points, rows in zip(keypoints, lacked, strict=True)]


def _contain(
    edge: Outline, rim_px: np.ndarray, spacing_px: float, lacked_px: np.ndarray, reach_px: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Match rim vertices outside the mask, at most one per cell, to its edge: index, direction (N, 2), distance px
    (positive). Those within reach_px of keypoints that the mask lacks (N, 2) are left out."""
    width, height = edge.size_px
    seen = np.flatnonzero(((rim_px >= 0) & (rim_px <= (width - 1, height - 1))).all(1))
    column, row = np.floor(rim_px[seen] / spacing_px).astype(np.int64).T
    first = seen[np.unique(row * width + column, return_index=True)[1]]
    at_px = rim_px[first]
    distance = edge.distance_at(at_px)
    slope = np.stack([edge.distance_at(at_px + step) - edge.distance_at(at_px - step) for step in np.eye(2)], -1)
    slope /= np.linalg.norm(slope, axis=1, keepdims=True).clip(1e-9)
    out = (distance > 0) & (cKDTree(lacked_px).query(at_px)[0] > reach_px)
    return first[out], slope[out], distance[out]


def refine_with_outlines(
    problem: Problem, pose: Pose, edges: list[list[Outline | None]], ground: int | None, threads: int
) -> Pose:
    """Refine a pose by Gauss-Newton steps on outlines and keypoints, renewing the matches before each step.

    edges: by frame and camera, None without a mask; ground: the world's vertical axis if a single camera sees a person
    standing at height 0, else None; threads: number of frames to process in parallel. Returns the best pose so far when
    a step diverges, as with one camera, whose outlines hardly determine depth.
    """
    sole_m, steps, seen = 0.0, problem.settings.contour_steps, problem.observations
    lacked_px = [
        lacked_keypoints(seen.keypoints(c), problem.scale_m[c].numpy(), [row[c] for row in edges])
        for c in range(len(seen.cameras))
    ]
    best, least_mm = pose, math.inf
    for step in tracked(range(steps), "outlines", steps):
        stepped, sole_m, before_mm = _outline_step(problem, pose, edges, lacked_px, ground, sole_m, threads)
        log.info("outlines, step %d of %d: %.1f mm rms", step + 1, steps, before_mm)
        if before_mm > DIVERGED * least_mm:
            return best
        best, least_mm = (pose, before_mm) if before_mm < least_mm else (best, least_mm)
        pose = stepped
    return pose


def _outline_step(
    problem: Problem, pose: Pose, edges: list[list[Outline | None]], lacked_px: list[list[np.ndarray]],
    ground: int | None, sole_m: float, threads: int,
) -> tuple[Pose, float, float]:  # fmt: skip
    """Return the pose after one step, the median height of the skin above the ground, and the residuals before the step
    (root mean square, mm). lacked_px: by camera and frame; sole_m: that height from the previous step."""
    faces, cameras = pose.rig.faces.numpy(), problem.observations.cameras
    articulation = Articulation(pose.rig)
    skin = articulation.skin(pose)
    _, equations = problem.assemble(pose)

    def match_frame(t: int) -> tuple[list[ContourResiduals], list[float]]:
        vertices_m = articulation.surface(skin, t).numpy()
        normals = normals_of(vertices_m, faces)
        found = [
            match(camera, edge, lacked[t], float(scale_m[t]), vertices_m, normals, faces, problem.settings)
            for camera, scale_m, edge, lacked in zip(cameras, problem.scale_m, edges[t], lacked_px, strict=True)
            if edge is not None
        ]
        if ground is None:
            return found, []
        soles_m = [_sole_m(cameras[0], e, float(problem.scale_m[0, t]), vertices_m, ground) for e in edges[t] if e]
        return [*found, _ground_contact(vertices_m, ground, sole_m)], [m for m in soles_m if m is not None]

    residuals_m, soles_m = [np.zeros(0)], []
    for t, (found, found_m) in enumerate(side_by_side(match_frame, range(len(edges)), threads=threads)):
        soles_m += found_m
        for rows in found:
            add_residuals(equations, articulation, skin, t, rows)
            residuals_m.append(rows.residual_m)
    pose = problem.apply_step(pose, equations, DAMPING)
    return pose, float(np.median(soles_m)) if soles_m else 0.0, rms_mm(residuals_m)


def rms_mm(residuals_m: list[np.ndarray]) -> float:
    """Return the root mean square, in millimetres, of residuals in metres."""
    return 1e3 * float(np.sqrt((np.concatenate(residuals_m) ** 2).mean()))


def _ground_contact(vertices_m: np.ndarray, up: int, sole_m: float) -> ContourResiduals:
    """Return the residual of the lowest vertex against a sole on the ground at height 0, where calibrations usually put
    it: with one camera this determines the depth.

    Geman-McClure weights release it where the body is in the air.
    """
    lowest = int(vertices_m[:, up].argmin())
    height_m = vertices_m[lowest, up] - sole_m
    weight = GROUND_STD_M**-2 / (1 + (height_m / GROUND_OUTLIER_M) ** 2) ** 2
    return ContourResiduals(np.array([lowest]), np.eye(3)[[up]], np.array([height_m]), np.array([weight]))


def _sole_m(camera: Camera, edge: Outline, scale_m: float, vertices_m: np.ndarray, up: int) -> float | None:
    """Return the thickness of the sole: how far the mask extends below the skin of the foot, at the vertex that is
    lowest in the image among those that may touch the ground. None if the image ends before the foot does."""
    height_m = vertices_m[:, up]
    pixels = camera.project(vertices_m[height_m < height_m.min() + UNDERSIDE_M])[0]
    lowest = pixels[(pixels @ -camera.R[:2, up]).argmax()]
    if not ((lowest > BORDER_PX) & (lowest < np.array(camera.size_px) - 1 - BORDER_PX)).all():
        return None
    inside_px = -edge.distance_at(lowest[None])[0]
    return float(np.clip(inside_px * scale_m, 0, MAX_SOLE_M))


def add_residuals(
    equations: NormalEquations, articulation: Articulation, skin: PosedSkin, frame: int, rows: ContourResiduals
) -> None:
    """Add a frame's residuals to the normal equations."""
    ids, directions = torch.from_numpy(rows.vertices), torch.from_numpy(rows.gradient)
    j, s = (part.numpy() for part in articulation.directional_jacobian(ids, directions, skin, frame))
    shape = slice(0, s.shape[1])
    weighted_j, weighted_s = j * rows.weight[:, None], s * rows.weight[:, None]
    equations.frame[0][frame] += weighted_j.T @ j
    equations.border[frame, :, shape] += weighted_j.T @ s
    equations.shared[shape, shape] += weighted_s.T @ s
    equations.frame_gradient[frame] += weighted_j.T @ rows.residual_m
    equations.shared_gradient[shape] += weighted_s.T @ rows.residual_m
