"""Repair and decimation of the marching-cubes surface."""

from typing import TYPE_CHECKING

import numpy as np
import trimesh

if TYPE_CHECKING:
    import pymeshlab


def simplify(surface: trimesh.Trimesh, faces: int) -> trimesh.Trimesh:
    """Return the surface repaired and decimated to at most `faces` triangles."""
    meshes = mesh_set(surface.vertices, surface.faces)
    _repair(meshes)
    if meshes.current_mesh().face_number() > faces:
        collapse_edges(meshes, faces, onto_ends=False)
        _repair(meshes)
    meshes.meshing_remove_unreferenced_vertices()
    mesh = meshes.current_mesh()
    return trimesh.Trimesh(mesh.vertex_matrix(), mesh.face_matrix(), process=False)


def mesh_set(vertices_m: np.ndarray, faces: np.ndarray, **values: np.ndarray) -> "pymeshlab.MeshSet":
    """Return a mesh (V, 3), (F, 3) as MeshLab's. values: further arguments of pymeshlab.Mesh.

    pymeshlab is imported only here: a process that imports it outside its main thread after torch aborts at its exit,
    and that is how Prefect imports a flow to run its hooks.
    """
    import pymeshlab

    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(vertices_m, faces, **values))
    return meshes


def collapse_edges(meshes: "pymeshlab.MeshSet", faces: int, onto_ends: bool, weighted: bool = False) -> None:
    """Collapse edges of the current mesh until it has at most `faces` triangles (quadrics, Garland and Heckbert 1997).
    Edges collapse to their best point or, with onto_ends, to one of their ends. The latter keeps every edge of an open
    mesh's boundary. weighted: errors count more where the vertices' scalars are larger. MeshLab maps their range to its
    own, so they must differ.
    """
    meshes.meshing_decimation_quadric_edge_collapse(  # arguments that are not given keep the values of the last call
        targetfacenum=faces,
        preservetopology=True,
        preservenormal=True,
        preserveboundary=onto_ends,
        optimalplacement=not onto_ends,
        qualityweight=weighted,
        autoclean=not onto_ends,  # it merges vertices at the same place, as on both sides of a cut
    )


def _repair(meshes: "pymeshlab.MeshSet") -> None:
    meshes.meshing_remove_null_faces()
    meshes.meshing_remove_duplicate_faces()
    meshes.meshing_repair_non_manifold_edges()
    meshes.meshing_repair_non_manifold_vertices()
    meshes.meshing_close_holes(newfaceselected=False)  # or later filters would only act on the selection
