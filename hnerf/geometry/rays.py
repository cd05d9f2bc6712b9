"""Where rays meet a mesh, by warp's bounding-volume hierarchy."""

# mypy: disable-error-code="no-untyped-def"

from dataclasses import dataclass

import numpy as np
import warp as wp

wp.config.log_level = wp.LOG_ERROR

REACH_M = 1.0e3


@wp.kernel
def _cast_kernel(
    mesh: wp.uint64,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    face: wp.array(dtype=int),
    barycentric: wp.array(dtype=wp.vec3),
    distance: wp.array(dtype=float),
):
    i = wp.tid()
    hit = wp.mesh_query_ray(mesh, origins[i], directions[i], REACH_M)
    face[i] = -1
    if hit.result:
        face[i] = hit.face
        barycentric[i] = wp.vec3(hit.u, hit.v, 1.0 - hit.u - hit.v)
        distance[i] = hit.t


@dataclass(frozen=True)
class RayHits:
    """face (N,), -1 where a ray meets nothing; barycentric (N, 3) and distance_m (N,) of the hit."""

    face: np.ndarray
    barycentric: np.ndarray
    distance_m: np.ndarray

    def interpolate(self, per_vertex: np.ndarray, faces: np.ndarray) -> np.ndarray:
        """Values at vertices (V, C) to values at those rays that hit, (M, C)."""
        met = self.face >= 0
        return np.einsum("nk,nkc->nc", self.barycentric[met], per_vertex[faces[self.face[met]]])


def cast(mesh: wp.Mesh, origins_m: np.ndarray, directions: np.ndarray) -> RayHits:
    """First hits of rays along unit directions (N, 3), from an origin each or from one (3,), on the mesh's device."""
    n, device = len(directions), mesh.device
    face, distance = wp.zeros(n, dtype=int, device=device), wp.zeros(n, dtype=float, device=device)
    barycentric = wp.zeros(n, dtype=wp.vec3, device=device)
    rays = [vectors(rows, device) for rows in (np.broadcast_to(origins_m, directions.shape), directions)]
    wp.launch(_cast_kernel, n, [mesh.id, *rays, face, barycentric, distance], device=device)
    return RayHits(face.numpy(), barycentric.numpy(), distance.numpy())


def vectors(rows: np.ndarray, device: wp.Device | str | None = None) -> wp.array:
    """(N, 3) for warp."""
    return wp.array(np.ascontiguousarray(rows, np.float32), dtype=wp.vec3, device=device)
