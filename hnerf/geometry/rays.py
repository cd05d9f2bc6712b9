"""Ray casting on triangle meshes with warp's bounding-volume hierarchy."""

# mypy: disable-error-code="no-untyped-def"

from dataclasses import dataclass

import numpy as np

from hnerf.warp_import import wp

REACH_M = 1.0e3  # beyond any surface that a ray can meet


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
    """The first hits of N rays: face (N,), -1 where a ray meets nothing; barycentric (N, 3) and distance_m (N,) of the
    hit."""

    face: np.ndarray
    barycentric: np.ndarray
    distance_m: np.ndarray

    def interpolate(self, per_vertex: np.ndarray, faces: np.ndarray) -> np.ndarray:
        """Interpolate per-vertex values (V, C) at the hits; (M, C), one row for each ray that hits."""
        hit = self.face >= 0
        return np.einsum("nk,nkc->nc", self.barycentric[hit], per_vertex[faces[self.face[hit]]])


def mesh_on_cpu(vertices_m: np.ndarray, faces: np.ndarray) -> wp.Mesh:
    """Return a triangle mesh (V, 3), (F, 3) for ray casting on the CPU."""
    corners = wp.array(faces.astype(np.int32).ravel(), dtype=wp.int32, device="cpu")
    return wp.Mesh(to_vec3_array(vertices_m, "cpu"), corners)


def cast(mesh: wp.Mesh, origins_m: np.ndarray, directions: np.ndarray) -> RayHits:
    """Return the first hits of rays along unit directions (N, 3), computed on the mesh's device; origins_m is (N, 3),
    or (3,) if all rays share one."""
    n, device = len(directions), mesh.device
    face, distance = wp.zeros(n, dtype=int, device=device), wp.zeros(n, dtype=float, device=device)
    barycentric = wp.zeros(n, dtype=wp.vec3, device=device)
    rays = [to_vec3_array(rows, device) for rows in (np.broadcast_to(origins_m, directions.shape), directions)]
    wp.launch(_cast_kernel, n, [mesh.id, *rays, face, barycentric, distance], device=device)
    return RayHits(face.numpy(), barycentric.numpy(), distance.numpy())


def to_vec3_array(rows: np.ndarray, device: wp.Device | str | None = None) -> wp.array:
    """Convert rows (N, 3) to a warp array of vec3."""
    return wp.array(np.ascontiguousarray(rows, np.float32), dtype=wp.vec3, device=device)
