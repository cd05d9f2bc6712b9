"""Check of a reconstructed surface: whether it is closed and about as large as the body inside it."""

from dataclasses import dataclass

import numpy as np
import trimesh
from torch import Tensor

from hnerf.avatar.avatar import Avatar
from hnerf.avatar.surface import surface_in_pose
from hnerf.body.rig import pose_vertices
from hnerf.errors import InputError

CELLS = 128  # on the longest side: enough to resolve a hole of a finger's width
# Shares of the body's own. Clothes and hair add up to half of its volume; hats or held objects add some height. A
# person without legs loses a third of the volume and half of the length; a mere shell or limb loses more.
VOLUME_RANGE = 0.7, 1.8
LENGTH_RANGE = 0.8, 1.25


@dataclass(frozen=True)
class SurfaceCheck:
    """The result of a check. fault: what is wrong with the surface, in one line, or None; volume and length (the
    longest side of the bounding box): as shares of the body's, None if there is no surface."""

    fault: str | None
    volume: float | None = None
    length: float | None = None


def check_surface(mesh: trimesh.Trimesh, body_m: np.ndarray, faces: np.ndarray) -> SurfaceCheck:
    """Compare a surface, the largest component of a mesh, with the posed body: vertices (V, 3) and faces (F, 3)."""
    body = trimesh.Trimesh(body_m, faces, process=False)
    volume, length = float(mesh.volume / body.volume), float(mesh.extents.max() / body.extents.max())
    fault = None if mesh.is_watertight else "surface is not watertight"
    for name, value, (low, high) in (("volume", volume, VOLUME_RANGE), ("length", length, LENGTH_RANGE)):
        if not low <= value <= high:
            fault = fault or f"surface has {value:.2f} of the body's {name}"
    return SurfaceCheck(fault, volume, length)


def check_pose(avatar: Avatar, theta: Tensor, root: Tensor) -> SurfaceCheck:
    """Check the avatar's surface in a pose theta (J, 3), root (4, 4)."""
    try:
        mesh = surface_in_pose(avatar, theta, root, CELLS)
    except InputError as error:
        return SurfaceCheck(str(error))
    body_m = pose_vertices(avatar.body.rig, theta, root)
    return check_surface(mesh, body_m.cpu().numpy(), avatar.body.rig.faces.cpu().numpy())
