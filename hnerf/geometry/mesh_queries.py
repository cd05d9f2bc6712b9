"""Queries of a triangle mesh with warp's bounding-volume hierarchy: closest points, inside or outside, and ray hits."""

# mypy: disable-error-code="no-untyped-def"

import numpy as np
import trimesh

from hnerf.geometry.rays import RayHits, cast, to_vec3_array
from hnerf.warp_import import wp

REACH_M = 1.0e5  # beyond any distance queried; warp takes no longer with it than with a few metres
RAY_START_M = 2.0e-3  # escape rays start this far off the surface, so that they do not hit it at once
BLOCKS = (8, 4, 2, 1)  # nodes along a side of the blocks that `Surface.occupancy` tests


@wp.kernel
def _closest_kernel(
    mesh: wp.uint64, points: wp.array(dtype=wp.vec3), distance: wp.array(dtype=float), face: wp.array(dtype=int)
):
    i = wp.tid()
    query = wp.mesh_query_point_no_sign(mesh, points[i], REACH_M)
    distance[i] = wp.length(points[i] - wp.mesh_eval_position(mesh, query.face, query.u, query.v))
    face[i] = query.face


@wp.kernel
def _near_kernel(mesh: wp.uint64, points: wp.array(dtype=wp.vec3), reach_m: float, near: wp.array(dtype=int)):
    i = wp.tid()
    if wp.mesh_query_point_no_sign(mesh, points[i], reach_m).result:
        near[i] = 1


@wp.kernel
def _inside_kernel(mesh: wp.uint64, points: wp.array(dtype=wp.vec3), inside: wp.array(dtype=int)):
    i = wp.tid()
    query = wp.mesh_query_point_sign_winding_number(mesh, points[i], REACH_M)
    if query.result and query.sign < 0.0:
        inside[i] = 1


@wp.kernel
def _escape_kernel(
    mesh: wp.uint64, points: wp.array(dtype=wp.vec3), directions: wp.array(dtype=wp.vec3), escapes: wp.array(dtype=int)
):
    i = wp.tid()
    for k in range(directions.shape[0]):
        start = points[i] + directions[k] * RAY_START_M
        if not wp.mesh_query_ray(mesh, start, directions[k], REACH_M).result:
            escapes[i] = 1
            return


class Surface:
    """A triangle mesh prepared for queries. Points and directions are (N, 3), metres."""

    def __init__(self, mesh: trimesh.Trimesh):
        self.mesh = mesh
        self._warp_mesh = wp.Mesh(
            points=to_vec3_array(mesh.vertices),
            indices=wp.array(np.asarray(mesh.faces, np.int32).ravel(), dtype=int),
            support_winding_number=True,
        )

    @classmethod
    def of(cls, vertices_m: np.ndarray, faces: np.ndarray) -> "Surface":
        """Prepare the mesh of vertices (V, 3) and faces (F, 3), unchanged."""
        return cls(trimesh.Trimesh(vertices_m, faces, process=False))

    def closest(self, points_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the distance in metres from each point to the surface, (N,), and the nearest face, (N,)."""
        n = len(points_m)
        distance, face = wp.zeros(n, dtype=float), wp.zeros(n, dtype=int)
        wp.launch(_closest_kernel, n, [self._warp_mesh.id, to_vec3_array(points_m), distance, face])
        return distance.numpy(), face.numpy()

    def inside(self, points_m: np.ndarray) -> np.ndarray:
        """Return whether each point is inside the mesh, (N,) bool: its winding number is over one half (Jacobson et al.
        2013)."""
        return self._flags(_inside_kernel, points_m)

    def escapes(self, points_m: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return whether a ray along any of the directions (K, 3) leaves each point without meeting the surface, (N,)
        bool."""
        return self._flags(_escape_kernel, points_m, to_vec3_array(directions))

    def cast(self, origins_m: np.ndarray, directions: np.ndarray) -> RayHits:
        """Return the first hits of rays; origins_m is (N, 3), or (3,) if all rays share one."""
        return cast(self._warp_mesh, origins_m, directions)

    def near(self, points_m: np.ndarray, reach_m: float) -> np.ndarray:
        """Return whether the surface comes within `reach_m` of each point, (N,) bool."""
        return self._flags(_near_kernel, points_m, reach_m)

    def occupancy(self, lower_m: np.ndarray, upper_m: np.ndarray, nodes: int) -> np.ndarray:
        """Return `inside` at the nodes^3 grid points of a box, bool. `nodes` is a multiple of the coarsest block.

        A block takes the value of its centre if the whole surface is farther from the centre than the block's corners
        are; other blocks are split. (The inside of an open mesh also changes away from its surface, where the winding
        number closes a hole; there, too, a block takes the value of its centre.)
        """
        step_m = (upper_m - lower_m) / (nodes - 1)
        occupied = np.zeros((nodes // BLOCKS[0],) * 3, bool)
        blocks = _cube(nodes // BLOCKS[0])
        for side in BLOCKS[:-1]:
            middles_m = lower_m + (blocks * side + (side - 1) / 2) * step_m
            to_split = self.near(middles_m, (side - 1) / 2 * float(np.linalg.norm(step_m)))
            occupied[tuple(blocks[~to_split].T)] = self.inside(middles_m[~to_split])
            occupied = occupied.repeat(2, 0).repeat(2, 1).repeat(2, 2)
            blocks = ((blocks[to_split] * 2)[:, None] + _cube(2)).reshape(-1, 3)
        occupied[tuple(blocks.T)] = self.inside(lower_m + blocks * step_m)
        return occupied

    def _flags(self, kernel: wp.Kernel, points_m: np.ndarray, *more: wp.array | float) -> np.ndarray:
        """Return the flag that a kernel sets for each point, (N,) bool. more: further inputs of the kernel."""
        flags = wp.zeros(len(points_m), dtype=int)
        wp.launch(kernel, len(points_m), [self._warp_mesh.id, to_vec3_array(points_m), *more, flags])
        return flags.numpy() > 0


def _cube(side: int) -> np.ndarray:
    """Return the integer points of [0, side)^3, (side^3, 3)."""
    return np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), -1).reshape(-1, 3)
