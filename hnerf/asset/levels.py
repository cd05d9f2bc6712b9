"""Levels of detail: the asset's mesh with fewer faces, on the same texture and with the same skin."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import trimesh

from hnerf.asset.simplify import collapse_edges, mesh_set
from hnerf.asset.texture import UvLayout

MOVED_M = 0.002  # vertices that an expression moves farther are decimated least: people look at them
FACES_PER_SEAM_EDGE = 1.5  # at least: with fewer faces, charts break, since their seams are kept
NUMBER = "number"  # of a vertex before decimation

log = logging.getLogger("hnerf.asset")


@dataclass(frozen=True)
class Level:
    """A mesh on some or all of the avatar's vertices. vertices (W,): their indices, from which it takes their skin,
    blend shapes and normals; faces (F, 3): indices into these W; layout: texture coordinates of the faces' corners."""

    vertices: np.ndarray
    faces: np.ndarray
    layout: UvLayout


def levels_of(
    points_m: np.ndarray,
    faces: np.ndarray,
    layout: UvLayout,
    face_counts: Sequence[int],
    expressions_m: Mapping[str, np.ndarray],
) -> list[Level]:
    """Return a mesh (V, 3), (F, 3) and its decimations to each count of triangles, largest first. Counts that the mesh
    does not exceed are left out. So are, with a warning, counts so small that hardly any faces would be left between
    the charts' seams. expressions_m (V, 3), by name: what they move is decimated least."""
    moves = np.zeros(len(points_m), bool)
    for moved_m in expressions_m.values():
        moves |= np.linalg.norm(moved_m, axis=1) > MOVED_M
    whole, seams = Level(np.arange(len(points_m)), faces, layout), len(seam_edges(layout.face_uvs))
    found = [whole]
    for count in sorted({count for count in face_counts if count < len(faces)}, reverse=True):
        if count < FACES_PER_SEAM_EDGE * seams:
            log.warning(
                "level of detail of %d triangles left out: the texture's seams alone have %d edges", count, seams
            )
        else:
            found.append(_decimated(points_m, whole, count, moves))
    return found


def seam_edges(face_uvs: np.ndarray) -> np.ndarray:
    """Return the edges (n, 2) at which the charts of faces (F, 3) end, as rows of texture coordinates."""
    edges = np.sort(trimesh.geometry.faces_to_edges(face_uvs), axis=1)
    return edges[trimesh.grouping.group_rows(edges, require_count=1)]


def _decimated(points_m: np.ndarray, whole: Level, face_count: int, moves: np.ndarray) -> Level:
    """Return the mesh decimated by collapsing edges to one of their ends, least at the vertices that move (V,). The
    charts' seams are kept: the mesh is cut open along them, and its parts still fit together afterwards."""
    uvs, face_uvs = np.unique(whole.layout.face_uvs, return_inverse=True)
    face_uvs = face_uvs.reshape(-1, 3)
    vertex_of_uv = np.zeros(len(uvs), np.int64)
    vertex_of_uv[face_uvs] = whole.faces
    weights = moves[vertex_of_uv].astype(np.float64)
    meshes = mesh_set(points_m[vertex_of_uv], face_uvs, v_scalar_array=weights)
    meshes.current_mesh().add_vertex_custom_scalar_attribute(np.arange(len(uvs), dtype=np.float64), NUMBER)
    collapse_edges(meshes, face_count, onto_ends=True, weighted=bool(np.ptp(weights)))
    meshes.meshing_remove_unreferenced_vertices()
    mesh = meshes.current_mesh()
    kept = mesh.vertex_custom_scalar_attribute_array(NUMBER).astype(np.int64)
    corners = mesh.face_matrix().astype(np.int64)
    vertices, faces = np.unique(vertex_of_uv[kept][corners], return_inverse=True)
    return Level(vertices, faces.reshape(-1, 3), UvLayout(whole.layout.uvs[uvs[kept]], corners))
