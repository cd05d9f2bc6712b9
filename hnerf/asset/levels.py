"""Levels of detail: the asset's mesh with fewer faces, on the same texture and with the same skin."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pymeshlab
import trimesh

from hnerf.asset.simplify import collapse_edges
from hnerf.asset.texture import UvLayout

FACES_A_SEAM_EDGE = 1.5  # at least: charts whose outlines are kept get broken with fewer


@dataclass(frozen=True)
class Level:
    """A mesh on some or all of the avatar's vertices. vertices (W,): their indices, by which it has their skin, blend
    shapes and normals; faces (F, 3): of these W; layout: texture coordinates of the faces' corners."""

    vertices: np.ndarray
    faces: np.ndarray
    layout: UvLayout


def levels_of(points_m: np.ndarray, faces: np.ndarray, layout: UvLayout, face_counts: Sequence[int]) -> list[Level]:
    """Return a mesh (V, 3), (F, 3) and its decimations to each count of faces, largest first. Left out are counts that
    the mesh does not exceed, and those so small that nothing but the charts' outlines would be left."""
    edges = np.sort(trimesh.geometry.faces_to_edges(layout.face_uvs), axis=1)
    fewest = FACES_A_SEAM_EDGE * len(trimesh.grouping.group_rows(edges, require_count=1))
    counts = sorted({count for count in face_counts if fewest <= count < len(faces)}, reverse=True)
    whole = Level(np.arange(len(points_m)), faces, layout)
    return [whole, *(_decimated(points_m, whole, count) for count in counts)]


def _decimated(points_m: np.ndarray, whole: Level, face_count: int) -> Level:
    """Return the mesh after collapses of edges to one of their ends. It is cut open for that at the charts' outlines,
    which stay as they are, so that the level has no cracks."""
    uvs, face_uvs = np.unique(whole.layout.face_uvs, return_inverse=True)
    face_uvs = face_uvs.reshape(-1, 3)
    vertex_of_uv = np.zeros(len(uvs), np.int64)
    vertex_of_uv[face_uvs] = whole.faces
    meshes = pymeshlab.MeshSet()
    numbered = np.arange(len(uvs), dtype=np.float64)
    meshes.add_mesh(pymeshlab.Mesh(points_m[vertex_of_uv], face_uvs, v_scalar_array=numbered))
    collapse_edges(meshes, face_count, onto_ends=True)
    meshes.meshing_remove_unreferenced_vertices()
    mesh = meshes.current_mesh()
    kept, corners = mesh.vertex_scalar_array().astype(np.int64), mesh.face_matrix().astype(np.int64)
    vertices, faces = np.unique(vertex_of_uv[kept][corners], return_inverse=True)
    return Level(vertices, faces.reshape(-1, 3), UvLayout(whole.layout.uvs[uvs[kept]], corners))
