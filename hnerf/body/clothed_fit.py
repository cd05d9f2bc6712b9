"""Outlines against the clothed body: how far clothes and hair stand away from each vertex, the same in all frames.

A naked body never fits its masks: each frame's pose moves towards what sleeves and hair add, another way in every
pose. What outlines of all frames have in common is therefore learned beside the poses, along the vertices' normals;
what is left pulls a body both ways.
"""

import logging
from dataclasses import replace

import numpy as np
from scipy.sparse import csc_array, csr_array, diags_array
from scipy.sparse.csgraph import laplacian
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree

from hnerf.body.articulation import Articulation, Pose
from hnerf.body.contour_fit import DAMPING, Outline, Rows, add_rows, rim_in_image
from hnerf.body.descriptor import normals_of
from hnerf.body.keypoint_fit import Problem
from hnerf.geometry.camera import Camera

log = logging.getLogger("hnerf.fit")

STEPS = 6
LEAST_FRAMES = 8  # with fewer, what a pose gets wrong looks like clothes
SAME_WAY = 0.7  # cosine between the outlines' normals from which points may match
FARTHEST_M = 0.04  # between points that match
SPREAD_M, FADES_M = 0.006, 0.02  # of a mask's edge about the clothed body, and where its pull fades
SMOOTH, THIN = 2.0, 0.02  # weights, in matches, of neighbours wearing the same and of wearing nothing


def refine_clothed(problem: Problem, pose: Pose, edges: list[list[Outline | None]]) -> Pose:
    """Gauss-Newton steps on outlines and keypoints, matched anew and the clothes solved for before each. edges: by
    frame and camera, None without a mask. With one camera, which hardly tells clothes from nearness, or few frames the
    pose stays as it is."""
    if len(problem.seen.cameras) == 1 or sum(any(row) for row in edges) < LEAST_FRAMES:
        return pose
    faces = pose.rig.faces.numpy()
    away_m = np.zeros(len(pose.rig.vertices_m))
    for step in range(STEPS):
        articulation = Articulation(pose.rig)
        joints = articulation.pose(pose)
        found = []
        for t, row in enumerate(edges):
            vertices_m = articulation.surface(joints, t).numpy()
            normals = normals_of(vertices_m, faces)
            worn_m = vertices_m + away_m[:, None] * normals
            views = zip(problem.seen.cameras, problem.scale_m, row, strict=True)
            found += [(t, match(c, e, float(s[t]), worn_m, normals, faces)) for c, s, e in views if e is not None]
        before_m, away_m = away_m, clothes(away_m, [rows for _, rows in found], faces)
        found = [(t, _worn(rows, away_m - before_m)) for t, rows in found]
        _, equations = problem.assemble(pose, problem.in_images)
        for t, rows in found:
            add_rows(equations, articulation, joints, t, replace(rows, weight=rows.weight / SPREAD_M**2))
        pose = problem.moved(pose, equations, DAMPING)
        left_mm = 1e3 * np.concatenate([rows.residual_m for _, rows in found])
        log.info("clothes, step %d of %d: %.1f mm rms", step + 1, STEPS, np.sqrt((left_mm**2).mean()))
    return pose


def match(
    camera: Camera, edge: Outline, scale_m: float, vertices_m: np.ndarray, normals: np.ndarray, faces: np.ndarray
) -> Rows:
    """Every point of a mask's contour to the nearest rim vertex of the clothed body, negative where this is too small;
    weights fall from 1 (Geman-McClure). scale_m: metres a pixel spans; vertices_m and normals (V, 3)."""
    rim, uv, by_x, flat = rim_in_image(camera, vertices_m, normals, faces)
    if len(rim) == 0 or len(edge.points_px) == 0:
        return Rows(np.zeros(0, int), np.zeros((0, 3)), np.zeros(0), np.zeros(0))
    apart_px, nearest = cKDTree(uv).query(edge.points_px)
    same_way = (flat[nearest] * edge.normals).sum(1) > SAME_WAY
    keep = same_way & (apart_px * scale_m < FARTHEST_M)
    at, outwards = nearest[keep], edge.normals[keep]
    residual_m = ((uv[at] - edge.points_px[keep]) * outwards).sum(1) * scale_m
    return Rows(rim[at], np.einsum("ri,ric->rc", outwards, by_x[at]) * scale_m, residual_m, _faded(residual_m))


def clothes(away_m: np.ndarray, found: list[Rows], faces: np.ndarray) -> np.ndarray:
    """How far clothes stand away from vertices (V,), from how far matches are off those of before, `away_m`: least
    squares with smoothness over the body, and nothing where nothing is seen."""
    ids, residual_m, weight = (
        np.concatenate([getattr(rows, name) for rows in found]) for name in ("vertices", "residual_m", "weight")
    )
    seen = np.bincount(ids, weight, len(away_m))
    pulled = np.bincount(ids, weight * residual_m, len(away_m))
    matrix = diags_array(seen + THIN) + SMOOTH * _neighbours(faces, len(away_m))
    solved: np.ndarray = spsolve(csc_array(matrix), seen * away_m - pulled)
    return solved


def _worn(rows: Rows, more_m: np.ndarray) -> Rows:
    """The same matches with clothes that stand farther away by more_m (V,)."""
    residual_m = rows.residual_m + more_m[rows.vertices]
    return replace(rows, residual_m=residual_m, weight=_faded(residual_m))


def _faded(residual_m: np.ndarray) -> np.ndarray:
    geman_mcclure: np.ndarray = 1 / (1 + (residual_m / FADES_M) ** 2) ** 2
    return geman_mcclure


def _neighbours(faces: np.ndarray, vertices: int) -> csr_array:
    """The graph's Laplacian (V, V)."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    joined = csr_array((np.ones(len(edges)), tuple(edges.T)), (vertices, vertices))
    return laplacian(((joined + joined.T) > 0).astype(float))
