"""Registration: the body model's own mesh, moved onto the surface of the field in the rest pose.

Topology, texture coordinates and joint weights stay those of the body model, the same for every subject. Step by step,
every vertex is matched with the closest point of the field's surface, and a thin plate (`plate.py`) takes the mesh
there, stiff at first, then more and more pliant: non-rigid iterative closest points (Amberg et al. 2007).
"""

from dataclasses import dataclass

import numpy as np
import trimesh

from hnerf.asset.plate import START_M, ThinPlate
from hnerf.asset.simplify import mesh_set
from hnerf.body.base_mesh import BaseMesh
from hnerf.body.descriptor import normals_of
from hnerf.geometry.mesh_queries import Surface

SMOOTHING_M = (0.06, 0.04, 0.028, 0.02, 0.014, 0.01, 0.007, 0.005)  # from a limb's width to the mesh's own edges
COSINES = 0.3, 0.7  # between the normals of matched points: from no trust to full trust
FARTHEST_M = 0.06  # typical of hair and loose clothes; a match much farther away is no match
RINGS = 2, 4  # of faces around crossing ones that are not trusted either: at first, and if faces still cross
LOOSEN_STEPS = 12
LOOSEN_M = 0.0005  # step by which faces that cross each other retreat into the body
LOOSEN_SMOOTHING_M = 0.002


@dataclass(frozen=True)
class Registration:
    """A registered mesh: vertices_m (V, 3); trust (V,) in [0, 1] in the match of each vertex; plate: of the body from
    which it was made."""

    vertices_m: np.ndarray
    trust: np.ndarray
    plate: ThinPlate


def register(body: BaseMesh, target: trimesh.Trimesh) -> Registration:
    """Move the body's mesh onto a closed surface around it, both in the rest pose.

    A match is trusted by the angle between its normals, and by its distance (Geman-McClure). A vertex in the middle of
    its limb is equally close to the limb's other side, so the scale is half the thickness there, FARTHEST_M at most.
    This leaves fingers as they are where the field has a mitten. Matches that make faces cross, as around the eyes, are
    not trusted, unless the body's own faces do, as at the toes: these are drawn into the body.
    """
    body_m, faces = body.rig.vertices_m.double().numpy(), body.rig.faces.numpy()
    plate, surface = ThinPlate.of(body_m, faces), Surface(target)
    scale_m = np.minimum(_thickness_m(body_m, faces) / 2, FARTHEST_M)
    moved_m, trust = body_m, np.zeros(len(body_m))
    matched_m, skin = body_m, faces[: body.skin_faces]
    for smoothing_m in SMOOTHING_M:
        matched_m, trust = _match(moved_m, faces, surface, scale_m)
        trust[body.hidden] = 0
        moved_m = body_m + plate.solver(trust, smoothing_m)(matched_m - body_m)
    own = skin[crossing_faces(body_m, skin)]
    for rings in RINGS:
        crossing = skin[crossing_faces(moved_m, skin)]
        if not len(crossing):
            break
        trust[np.setdiff1d(_around(crossing, faces, rings), _around(own, faces, rings))] = 0
        moved_m = body_m + plate.solver(trust, SMOOTHING_M[-1])(matched_m - body_m)
    return Registration(_loosened(moved_m, faces, body.skin_faces, plate), trust, plate)


def crossing_faces(vertices_m: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return which faces (F,) cross another one, bool."""
    meshes = mesh_set(vertices_m, faces)
    meshes.compute_selection_by_self_intersections_per_face()
    return meshes.current_mesh().face_selection_array()


def _match(
    vertices_m: np.ndarray, faces: np.ndarray, surface: Surface, scale_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the closest point of the surface to each vertex, (V, 3), and the trust in it, (V,)."""
    distance_m, face = surface.closest(vertices_m)
    closest_m = trimesh.triangles.closest_point(surface.mesh.triangles[face], vertices_m)
    cosine = (normals_of(vertices_m, faces) * surface.mesh.face_normals[face]).sum(1)
    aligned = ((cosine - COSINES[0]) / (COSINES[1] - COSINES[0])).clip(0, 1)
    return closest_m, aligned / (1 + (distance_m / scale_m) ** 2) ** 2


def _around(chosen: np.ndarray, faces: np.ndarray, rings: int) -> np.ndarray:
    """Return the corners of faces chosen (n, 3) out of faces (F, 3), and of some rings of faces around them, (m,)."""
    near = np.unique(chosen)
    for _ in range(rings):
        near = np.unique(faces[np.isin(faces, near).any(1)])
    return near


def _thickness_m(vertices_m: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return how far the inward normal of each vertex runs inside the mesh, (V,)."""
    inward = -normals_of(vertices_m, faces)
    surface = Surface.of(vertices_m, faces)
    hits = surface.cast(vertices_m + START_M * inward, inward)
    return np.where(hits.face >= 0, hits.distance_m, 0) + START_M


def _loosened(vertices_m: np.ndarray, faces: np.ndarray, skin_faces: int, plate: ThinPlate) -> np.ndarray:
    """Return the mesh with those faces of its skin that cross each other drawn into the body."""
    keep = plate.solver(np.ones(len(vertices_m)), LOOSEN_SMOOTHING_M)
    for _ in range(LOOSEN_STEPS):
        crossing = crossing_faces(vertices_m, faces[:skin_faces])
        if not crossing.any():
            break
        drawn_m = np.zeros_like(vertices_m)
        corners = np.unique(faces[:skin_faces][crossing])
        drawn_m[corners] = -LOOSEN_M * normals_of(vertices_m, faces)[corners]
        vertices_m = vertices_m + keep(drawn_m)
    return vertices_m
