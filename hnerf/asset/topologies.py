"""The two meshes that an asset can have: the body model's own, registered, and the field's own, captured."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
import trimesh

from hnerf.asset.correctives import as_they_are
from hnerf.asset.registration import SMOOTHING_M, crossing_faces, register
from hnerf.asset.rig_transfer import clothed_rig, strongest, with_surface, with_vertices
from hnerf.asset.simplify import simplify
from hnerf.asset.texture import UvLayout, unwrap
from hnerf.body.base_mesh import BaseMesh, base_mesh
from hnerf.body.rig import Rig

HALVINGS = 10


@dataclass(frozen=True)
class AssetMesh:
    """A mesh in the rest pose: its rig; settle: smooths the displacements (V, 3) of a single frame; skin_faces: how
    many of the first faces are closed skin; base: the body's mesh whose topology it has, if any."""

    rig: Rig
    settle: Callable[[np.ndarray], np.ndarray]
    skin_faces: int
    base: BaseMesh | None

    @cached_property
    def trimesh(self) -> trimesh.Trimesh:
        """Return the whole mesh."""
        return trimesh.Trimesh(self.rig.vertices_m.numpy(), self.rig.faces.numpy(), process=False)

    @property
    def cavities(self) -> np.ndarray:
        """Return which vertices line mouth and nose, (V,) bool."""
        return np.zeros(len(self.rig.vertices_m), bool) if self.base is None else self.base.cavities

    @property
    def face_units_m(self) -> dict[str, np.ndarray]:
        """Return how expressions move the vertices, (V, 3), by name."""
        return {} if self.base is None else self.base.face_units_m

    @property
    def physiques_m(self) -> dict[str, np.ndarray]:
        """Return how other physiques move the vertices, (V, 3), by name."""
        return {} if self.base is None else self.base.physiques_m

    def moved(self, offsets_m: np.ndarray) -> "AssetMesh":
        """Return the mesh with its vertices moved by offsets_m (V, 3); by half of that, a quarter and so on where faces
        of its skin would cross others."""
        rest_m, skin = self.rig.vertices_m.numpy(), self.rig.faces.numpy()[: self.skin_faces]
        share = np.ones((len(rest_m), 1), np.float32)
        for _ in range(HALVINGS):
            crossing = crossing_faces(rest_m + share * offsets_m, skin)
            if not crossing.any():
                break
            share[np.unique(skin[crossing])] /= 2
        vertices_m = torch.from_numpy(rest_m + share * offsets_m)
        return dataclasses.replace(self, rig=with_vertices(self.rig, vertices_m))

    def layout(self, texture_px: int) -> UvLayout:
        """Return the texture coordinates: the body model's if it has some, else charts of the body at its shape.
        Without a body's mesh, return charts of this mesh."""
        if self.base is None:
            return unwrap(self.trimesh.vertices, self.trimesh.faces, texture_px)
        if self.base.uvs is None or self.base.face_uvs is None:
            return unwrap(self.base.rig.vertices_m.numpy(), self.base.rig.faces.numpy(), texture_px)
        return UvLayout(self.base.uvs, self.base.face_uvs)


def registered_mesh(rig: Rig, dense: trimesh.Trimesh) -> AssetMesh:
    """Return the body model's mesh moved onto the field's surface in the rest pose, with the body model's strongest
    joint weights. Only the joints of the eyes move."""
    base = base_mesh(rig)
    found = register(base, dense)
    moved = with_vertices(base.rig, torch.from_numpy(found.vertices_m).float())
    shown = with_surface(moved, moved.vertices_m, moved.faces, *strongest(moved.dense_weights))
    return AssetMesh(shown, found.plate.solver(found.trust, SMOOTHING_M[-1]), base.skin_faces, base)


def captured_mesh(rig: Rig, dense: trimesh.Trimesh, faces: int) -> AssetMesh:
    """Return the field's surface decimated to at most `faces` triangles, with joint weights from the body beneath."""
    surface = simplify(dense, faces)
    return AssetMesh(clothed_rig(rig, surface), as_they_are, len(surface.faces), None)
