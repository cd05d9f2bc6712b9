"""Scores of a reconstructed surface against the true one: Chamfer distance, normal consistency, and volume overlap.

The Chamfer distance is from samples to the surface (not to its samples). Only what can be seen from outside is sampled:
clothes hide inner layers that no camera could observe.
"""

from typing import Any

import numpy as np
import trimesh

from hnerf.geometry.mesh_queries import Surface

SAMPLES = 40_000  # per surface, before hidden ones are dropped
ESCAPE_DIRECTIONS = 48  # a sample is seen from outside if a ray along one of them escapes
OCCUPANCY_NODES = 128  # along each side of the common box
BOX_MARGIN_M = 0.02  # of the common box around both surfaces


def score_geometry(
    predicted: trimesh.Trimesh,
    truth: trimesh.Trimesh,
    rng: np.random.Generator,
    samples: int = SAMPLES,
    nodes: int = OCCUPANCY_NODES,
) -> dict[str, Any]:
    """Score one mesh against another, both in world metres (docs/method.md, "Evaluation protocol"). The scores are
    those of hnerf.results.SurfaceScores."""
    surfaces = Surface(predicted), Surface(truth)
    (points_p, normals_p), (points_t, normals_t) = (outer_samples(s, samples, rng) for s in surfaces)
    distance_p, face_t = surfaces[1].closest(points_p)
    distance_t, face_p = surfaces[0].closest(points_t)
    agreement_p = np.abs((normals_p * truth.face_normals[face_t]).sum(1))
    agreement_t = np.abs((normals_t * predicted.face_normals[face_p]).sum(1))
    lower_m = np.minimum(points_p.min(0), points_t.min(0)) - BOX_MARGIN_M
    upper_m = np.maximum(points_p.max(0), points_t.max(0)) + BOX_MARGIN_M
    return {
        "chamfer_l2_e3": 1e3 * float((distance_p**2).mean() + (distance_t**2).mean()) / 2,
        "chamfer_mm": 1e3 * float(distance_p.mean() + distance_t.mean()) / 2,
        "normal_consistency": float(agreement_p.mean() + agreement_t.mean()) / 2,
        "iou": volume_overlap(*surfaces, lower_m, upper_m, nodes),
        "watertight": bool(predicted.is_watertight),
    }


def outer_samples(surface: Surface, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Sample points (n, 3) and face normals (n, 3), n <= count, uniformly by area over what can be seen from
    outside."""
    points_m, faces = trimesh.sample.sample_surface(surface.mesh, count, seed=int(rng.integers(1 << 30)))
    directions = rng.normal(size=(ESCAPE_DIRECTIONS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    seen = surface.escapes(points_m, directions)
    return points_m[seen], surface.mesh.face_normals[faces][seen]


def volume_overlap(a: Surface, b: Surface, lower_m: np.ndarray, upper_m: np.ndarray, nodes: int) -> float:
    """Return the intersection over union of two volumes, counted on a common grid of nodes^3 over a box."""
    in_a, in_b = (surface.occupancy(lower_m, upper_m, nodes) for surface in (a, b))
    return float((in_a & in_b).sum() / max(1, (in_a | in_b).sum()))
