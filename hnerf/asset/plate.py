"""Smooth displacements of a mesh: a thin plate that bends towards wanted displacements and keeps air gaps open.

With displacements u (V, 3), wanted ones m (V, 3), trust w (V,) in them and vertex areas a (V,), the plate solves

    min  sum_i a_i (w_i |u_i - m_i|^2 + e |u_i|^2)  +  l^4 sum_i a_i |lap u|_i^2  +  sum_g a_g (s / g)^2 |u_i - u_j|^2

(Botsch and Sorkine 2008, "On Linear Variational Surface Deformation Methods"). Details shorter than l are smoothed
away. The last sum runs over pairs of points that face each other across a gap of width g, such as the sides of two
fingers: they move together, and do not meet.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csc_array, csr_array, diags_array
from scipy.sparse.linalg import splu

from hnerf.body.descriptor import normals_of
from hnerf.geometry.mesh_queries import Surface

GAP_M = 0.025  # wider gaps do not close
NARROWEST_M = 0.001  # gaps count as at least this wide
GAP_WEIGHT_M = 0.01  # s: a gap of this width is as stiff as a match
SKIN_WEIGHT = 1e-8  # e, which decides only where nothing else does
LEAST_COTANGENT = 1e-3  # keeps the Laplacian's weights positive in obtuse triangles
START_M = 1e-4  # distance from the surface at which rays across a gap start
LEAST_AREA_M2 = 1e-12


@dataclass(frozen=True)
class ThinPlate:
    """The energies of a mesh: area_m2 (V,), and bending and gaps as quadratic forms (V, V)."""

    area_m2: np.ndarray
    bending: csc_array
    gaps: csc_array

    @staticmethod
    def of(vertices_m: np.ndarray, faces: np.ndarray) -> "ThinPlate":
        """Return the plate that is at rest as a mesh (V, 3), (F, 3)."""
        area_m2, laplacian = cotangent_laplacian(vertices_m, faces)
        pairs, width_m = facing_pairs(vertices_m, faces)
        stiffness = (GAP_WEIGHT_M / width_m.clip(NARROWEST_M)) ** 2 * (np.abs(pairs) @ area_m2) / 2
        return ThinPlate(
            area_m2,
            csc_array(laplacian.T @ diags_array(1 / area_m2) @ laplacian),
            csc_array(pairs.T @ diags_array(stiffness) @ pairs),
        )

    def solver(self, trust: np.ndarray, smoothing_m: float) -> Callable[[np.ndarray], np.ndarray]:
        """Return a function that maps wanted displacements (V, K) to smooth ones, for a fixed trust (V,) in [0, 1]."""
        pulled = self.area_m2 * trust
        own = diags_array(pulled + SKIN_WEIGHT * self.area_m2)
        matrix = csc_array(own + smoothing_m**4 * self.bending + self.gaps)
        options = {"SymmetricMode": True}  # positive definite, so that no pivoting is needed
        factors = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
        return lambda wanted: factors.solve(pulled[:, None] * wanted)


def cotangent_laplacian(vertices_m: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, csr_array]:
    """Return the areas of the vertices, (V,), a third of each of their faces, and the Laplacian times these areas, (V,
    V), with positive diagonal (Pinkall and Polthier 1993)."""
    n = len(vertices_m)
    a, b, c = vertices_m[faces].swapaxes(0, 1)
    twice_m2 = np.linalg.norm(np.cross(b - a, c - a), axis=1).clip(LEAST_AREA_M2)
    area_m2 = np.bincount(faces.ravel(), np.repeat(twice_m2 / 6, 3), n)
    weights = csr_array((n, n))
    for k in range(3):
        i, j, opposite = (faces[:, (k + m) % 3] for m in range(3))
        sides = vertices_m[i] - vertices_m[opposite], vertices_m[j] - vertices_m[opposite]
        cotangent = (sides[0] * sides[1]).sum(1) / twice_m2 / 2
        weights = weights + csr_array((cotangent, (i, j)), (n, n)) + csr_array((cotangent, (j, i)), (n, n))
    weights.data = weights.data.clip(min=LEAST_COTANGENT)
    return area_m2, csr_array(diags_array(weights.sum(1)) - weights)


def facing_pairs(vertices_m: np.ndarray, faces: np.ndarray) -> tuple[csr_array, np.ndarray]:
    """Return the matrix (P, V) of differences between a vertex and the point that its outward normal hits across an air
    gap, and the widths (P,) of the gaps."""
    normals = normals_of(vertices_m, faces)
    surface = Surface.of(vertices_m, faces)
    hits = surface.cast(vertices_m + START_M * normals, normals)
    opposite = (surface.mesh.face_normals[hits.face] * normals).sum(1) < 0
    vertex = np.flatnonzero((hits.face >= 0) & (hits.distance_m < GAP_M) & opposite)
    pair = np.arange(len(vertex))
    column = np.column_stack([vertex, faces[hits.face[vertex]]])
    value = np.column_stack([np.ones(len(vertex)), -hits.barycentric[vertex]])
    differences = csr_array((value.ravel(), (np.repeat(pair, 4), column.ravel())), (len(pair), len(vertices_m)))
    return differences, hits.distance_m[vertex] + START_M
