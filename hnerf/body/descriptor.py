"""The body prior H: (x, theta, T, beta) -> (d, s), computed from posed body meshes.

`BodyMeshes.closest_points` finds the closest point with warp's bounding-volume hierarchy (CPU and CUDA). It takes the
sign from the winding number only where the surface normal leaves doubt and, with `exact_sign`, next to faces that are
buried where the body intersects itself.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from threading import Lock

import numpy as np
import torch
from torch import Tensor, nn

from hnerf.warp_import import wp

SURE_COSINE = 0.35  # of the angle between offset and normal; below it the winding number decides the sign
BESIDE_M = 1e-4  # distance in front of the surface at which the winding number tells whether it is buried


@dataclass(frozen=True)
class ClosestPoints:
    """Closest surface points: face (N,) long, -1 where nothing is within reach; barycentric (N, 3) of the closest
    point; sign (N,), -1 inside."""

    face: Tensor
    barycentric: Tensor
    sign: Tensor


@wp.kernel
def _closest_kernel(
    meshes: wp.array(dtype=wp.uint64),
    mesh_index: wp.array(dtype=wp.int32),
    points: wp.array(dtype=wp.vec3),
    normals: wp.array2d(dtype=wp.vec3),
    reach_m: float,
    doubtful: wp.array2d(dtype=wp.bool),
    face: wp.array(dtype=wp.int32),
    barycentric: wp.array(dtype=wp.vec3),
    sign: wp.array(dtype=float),
) -> None:
    i = wp.tid()
    m = mesh_index[i]
    query = wp.mesh_query_point_no_sign(meshes[m], points[i], reach_m)
    face[i] = -1
    sign[i] = 1.0
    if query.result:
        face[i] = query.face
        w = 1.0 - query.u - query.v
        barycentric[i] = wp.vec3(query.u, query.v, w)
        mesh = wp.mesh_get(meshes[m])
        a = mesh.indices[3 * query.face]
        b = mesh.indices[3 * query.face + 1]
        c = mesh.indices[3 * query.face + 2]
        normal = query.u * normals[m, a] + query.v * normals[m, b] + w * normals[m, c]
        offset = points[i] - wp.mesh_eval_position(meshes[m], query.face, query.u, query.v)
        along = wp.dot(offset, normal)
        sure = wp.abs(along) > SURE_COSINE * wp.length(offset) * wp.length(normal)
        if doubtful:
            sure = sure and not doubtful[m, query.face]
        if sure:
            sign[i] = wp.sign(along)
        else:
            sign[i] = wp.mesh_query_point_sign_winding_number(meshes[m], points[i], reach_m).sign


@wp.kernel
def _inside_kernel(mesh: wp.uint64, points: wp.array(dtype=wp.vec3), inside: wp.array(dtype=wp.bool)) -> None:
    """Find which points, close to the surface of a mesh, are inside."""
    i = wp.tid()
    inside[i] = wp.mesh_query_point_sign_winding_number(mesh, points[i], 2.0 * BESIDE_M).sign < 0.0


class BodyMeshes:
    """Posed copies of one body, one per frame, prepared for closest-point queries."""

    def __init__(self, vertices_m: Tensor, faces: Tensor):
        """Build the hierarchies of vertices_m (n, V, 3) with faces (F, 3)."""
        wp.init()
        self._threads = ThreadPoolExecutor(torch.get_num_threads())
        self._device = wp.device_from_torch(vertices_m.device)
        self._faces = faces
        indices = wp.from_torch(faces.to(torch.int32).flatten().contiguous())
        self._meshes = [
            wp.Mesh(points=points, indices=indices, support_winding_number=True) for points in self._to_warp(vertices_m)
        ]
        self._ids = wp.array([m.id for m in self._meshes], dtype=wp.uint64, device=self._device)
        self._coming: Tensor | None = None
        self._doubtful: Tensor | None = None
        self._refitting = Lock()

    def refit(self, vertices_m: Tensor) -> None:
        """Replace the vertices (n, V, 3) by similar ones; the hierarchies are refitted before the next query, not
        rebuilt."""
        self._coming = vertices_m

    def _refit(self) -> None:
        with self._refitting:  # queries come from several threads
            if self._coming is not None:
                for mesh, points in zip(self._meshes, self._to_warp(self._coming), strict=True):
                    mesh.points = points
                self._coming = self._doubtful = None

    def _doubtful_faces(self, points: int) -> Tensor:
        """Return which faces of each copy are buried where the body intersects itself, or touch a buried one, (n, F)
        bool. For so few points that the search would cost more than it saves, return all faces. A face is buried if a
        point just in front of its middle or of a corner is inside the body."""
        if points < len(self._faces):
            return torch.ones(len(self._meshes), len(self._faces), dtype=torch.bool, device=self._faces.device)
        with self._refitting:
            if self._doubtful is None:
                self._doubtful = torch.stack([self._touch_buried(k) for k in range(len(self._meshes))])
            return self._doubtful

    def _touch_buried(self, copy: int) -> Tensor:
        """Return the buried faces of one copy and those that touch them, (F,) bool."""
        mesh, faces, normals = self._meshes[copy], self._faces, self._normals[copy]
        vertices_m = wp.to_torch(mesh.points)
        outwards = nn.functional.normalize(torch.cat([normals, normals[faces].sum(1)]), dim=1)
        front_m = torch.cat([vertices_m, vertices_m[faces].mean(1)]) + BESIDE_M * outwards
        inside = torch.zeros(len(front_m), dtype=torch.bool, device=front_m.device)
        arguments = [mesh.id, wp.from_torch(front_m, dtype=wp.vec3), wp.from_torch(inside)]
        wp.launch(_inside_kernel, len(inside), arguments, device=self._device)
        buried_vertices, buried_middles = inside.split([len(vertices_m), len(faces)])
        touched = torch.zeros(len(vertices_m), dtype=torch.bool, device=inside.device)
        touched[faces[buried_middles | buried_vertices[faces].any(1)]] = True
        return touched[faces].any(1)

    def _to_warp(self, vertices_m: Tensor) -> list[wp.array]:
        """Return each copy's vertices as warp arrays, without copying, and compute the vertex normals that decide the
        sign."""
        vertices_m = vertices_m.detach().float().contiguous()
        self._normals = vertex_normals(vertices_m, self._faces)
        return [wp.from_torch(v, dtype=wp.vec3) for v in vertices_m]

    def closest_points(
        self, points_m: Tensor, mesh_index: Tensor, reach_m: float, exact_sign: bool = False
    ) -> ClosestPoints:
        """Return the closest surface point of mesh `mesh_index` (N,) to each of `points_m` (N, 3), if within
        `reach_m`."""
        self._refit()
        n, device = len(points_m), points_m.device
        doubtful = wp.from_torch(self._doubtful_faces(n)) if exact_sign else None
        mesh_index, points_m = mesh_index.to(torch.int32).contiguous(), points_m.detach().float().contiguous()
        face = torch.empty(n, dtype=torch.int32, device=device)
        barycentric = torch.zeros(n, 3, device=device)
        sign = torch.empty(n, device=device)

        def find(part: slice) -> None:
            wp.launch(
                _closest_kernel,
                len(face[part]),
                inputs=[
                    self._ids,
                    wp.from_torch(mesh_index[part]),
                    wp.from_torch(points_m[part], dtype=wp.vec3),
                    wp.from_torch(self._normals, dtype=wp.vec3),
                    reach_m,
                    doubtful,
                ],
                outputs=[
                    wp.from_torch(face[part]),
                    wp.from_torch(barycentric[part], dtype=wp.vec3),
                    wp.from_torch(sign[part]),
                ],
                device=self._device,
            )

        if device.type == "cuda":
            find(slice(n))
        else:  # on a CPU, warp itself uses a single thread
            size = max(1, -(-n // torch.get_num_threads()))
            list(self._threads.map(find, [slice(start, min(start + size, n)) for start in range(0, n, size)]))
        return ClosestPoints(face.long(), barycentric, sign)


def vertex_normals(vertices_m: Tensor, faces: Tensor) -> Tensor:
    """Return area-weighted unit normals of meshes (..., V, 3)."""
    a, b, c = (vertices_m[..., faces[:, k], :] for k in range(3))
    normals = torch.zeros_like(vertices_m)
    for k in range(3):
        normals.index_add_(-2, faces[:, k], torch.linalg.cross(b - a, c - a))
    return torch.nn.functional.normalize(normals, dim=-1)


def normals_of(vertices_m: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return `vertex_normals` of NumPy arrays."""
    return vertex_normals(torch.from_numpy(vertices_m), torch.from_numpy(faces)).numpy()
