"""Fit of a clothed body to the outlines: cloth and hair stand away from each vertex by an offset, the same in all
frames.

A naked body never fits its masks: each frame's pose drifts towards what sleeves and hair add, in a different way in
every pose. What the outlines of all frames have in common is therefore estimated along with the poses, as offsets along
the vertex normals; the remaining residuals pull the body in both directions.
"""

import logging
from dataclasses import replace
from itertools import chain

import numpy as np
from scipy.sparse import csc_array, csr_array, diags_array
from scipy.sparse.csgraph import laplacian
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree

from hnerf.body.articulation import Articulation, Pose
from hnerf.body.contour_fit import DAMPING, ContourResiduals, Outline, add_residuals, rim_in_image, rms_mm
from hnerf.body.descriptor import normals_of
from hnerf.body.keypoint_fit import Problem
from hnerf.geometry.camera import Camera
from hnerf.progress import tracked
from hnerf.side_by_side import side_by_side

log = logging.getLogger("hnerf.fit")

CLOTHED_STEPS = 6
MIN_FRAMES = 8  # with fewer, pose errors look like clothes
MIN_NORMAL_COSINE = 0.7  # between the outlines' normals where points may match
MAX_MATCH_M = 0.04  # between matched points
EDGE_STD_M, OUTLIER_M = 0.006, 0.02  # standard deviation of a mask's edge about the clothed body, and outliers
SMOOTHNESS_WEIGHT, SKIN_WEIGHT = 2.0, 0.02  # in matches: for equal offsets at neighbours, and for a zero offset


def refine_with_clothing(problem: Problem, pose: Pose, edges: list[list[Outline | None]], threads: int) -> Pose:
    """Refine a pose by Gauss-Newton steps on outlines and keypoints of a clothed body.

    Each step first renews the matches and solves for the cloth offsets. edges: by frame and camera, None without a
    mask; threads: number of frames to process in parallel. The pose is returned unchanged with one camera, which hardly
    distinguishes clothes from a body that is nearer, and with few frames.
    """
    if len(problem.observations.cameras) == 1 or sum(any(row) for row in edges) < MIN_FRAMES:
        return pose
    cloth_offset_m = np.zeros(len(pose.rig.vertices_m))
    for step in tracked(range(CLOTHED_STEPS), "clothes", CLOTHED_STEPS):
        pose, cloth_offset_m, before_mm = _clothed_step(problem, pose, edges, cloth_offset_m, threads)
        log.info("clothes, step %d of %d: %.1f mm rms", step + 1, CLOTHED_STEPS, before_mm)
    return pose


def _clothed_step(
    problem: Problem, pose: Pose, edges: list[list[Outline | None]], before_m: np.ndarray, threads: int
) -> tuple[Pose, np.ndarray, float]:
    """Return the pose after one step, the cloth offsets (V,) metres, and the residuals before the step (root mean
    square, mm). before_m: the offsets of the previous step."""
    faces = pose.rig.faces.numpy()
    articulation = Articulation(pose.rig)
    skin = articulation.skin(pose)

    def match_frame(t: int) -> list[tuple[int, ContourResiduals]]:
        vertices_m = articulation.surface(skin, t).numpy()
        normals = normals_of(vertices_m, faces)
        clothed_m = vertices_m + before_m[:, None] * normals
        views = zip(problem.observations.cameras, problem.scale_m, edges[t], strict=True)
        return [(t, match_clothed(c, e, float(s[t]), clothed_m, normals, faces)) for c, s, e in views if e is not None]

    found = [*chain.from_iterable(side_by_side(match_frame, range(len(edges)), threads=threads))]
    cloth_offset_m = solve_cloth_offset(before_m, [rows for _, rows in found], faces)
    found = [(t, _with_more_cloth(rows, cloth_offset_m - before_m)) for t, rows in found]
    _, equations = problem.assemble(pose)
    for t, rows in found:
        add_residuals(equations, articulation, skin, t, replace(rows, weight=rows.weight / EDGE_STD_M**2))
    pose = problem.apply_step(pose, equations, DAMPING)
    return pose, cloth_offset_m, rms_mm([rows.residual_m for _, rows in found])


def match_clothed(
    camera: Camera, edge: Outline, scale_m: float, vertices_m: np.ndarray, normals: np.ndarray, faces: np.ndarray
) -> ContourResiduals:
    """Match every point of a mask's contour to the nearest rim vertex of the clothed body.

    Residuals are negative where the body is too small; weights fall off from 1 (Geman-McClure). scale_m: metres a pixel
    spans; vertices_m and normals (V, 3).
    """
    rim, uv, by_x, normals_2d = rim_in_image(camera, vertices_m, normals, faces)
    if len(rim) == 0 or len(edge.points_px) == 0:
        return ContourResiduals(np.zeros(0, int), np.zeros((0, 3)), np.zeros(0), np.zeros(0))
    distance_px, nearest = cKDTree(uv).query(edge.points_px)
    aligned = (normals_2d[nearest] * edge.normals).sum(1) > MIN_NORMAL_COSINE
    keep = aligned & (distance_px * scale_m < MAX_MATCH_M)
    at, outwards = nearest[keep], edge.normals[keep]
    residual_m = ((uv[at] - edge.points_px[keep]) * outwards).sum(1) * scale_m
    return ContourResiduals(
        rim[at], np.einsum("ri,ric->rc", outwards, by_x[at]) * scale_m, residual_m, _geman_mcclure_weight(residual_m)
    )


def solve_cloth_offset(cloth_offset_m: np.ndarray, found: list[ContourResiduals], faces: np.ndarray) -> np.ndarray:
    """Return the distance of the clothes from each vertex, (V,) metres, given the previous distance and the residuals
    of matches made with it: least squares, smooth over the body, and nearly zero where nothing is seen."""
    ids, residual_m, weight = (
        np.concatenate([getattr(rows, name) for rows in found]) for name in ("vertices", "residual_m", "weight")
    )
    seen = np.bincount(ids, weight, len(cloth_offset_m))
    pulled = np.bincount(ids, weight * residual_m, len(cloth_offset_m))
    matrix = diags_array(seen + SKIN_WEIGHT) + SMOOTHNESS_WEIGHT * _vertex_laplacian(faces, len(cloth_offset_m))
    return spsolve(csc_array(matrix), seen * cloth_offset_m - pulled)


def _with_more_cloth(rows: ContourResiduals, more_m: np.ndarray) -> ContourResiduals:
    """Return the same matches for clothes that stand farther away by more_m (V,)."""
    residual_m = rows.residual_m + more_m[rows.vertices]
    return replace(rows, residual_m=residual_m, weight=_geman_mcclure_weight(residual_m))


def _geman_mcclure_weight(residual_m: np.ndarray) -> np.ndarray:
    """Return the weight of each residual."""
    return 1 / (1 + (residual_m / OUTLIER_M) ** 2) ** 2


def _vertex_laplacian(faces: np.ndarray, vertices: int) -> csr_array:
    """Return the graph Laplacian of the mesh's edges, (V, V)."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    joined = csr_array((np.ones(len(edges)), tuple(edges.T)), (vertices, vertices))
    return laplacian(((joined + joined.T) > 0).astype(float))
