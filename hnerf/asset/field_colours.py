"""The field's colour at each texel. Where the field has no surface, such as on a finger that it lacks, the colour of
the skin around."""

import logging

import numpy as np
import torch
from scipy.sparse import csc_array, diags_array
from scipy.sparse.linalg import splu
from torch import Tensor

from hnerf.asset.plate import cotangent_laplacian
from hnerf.asset.texture import Texels
from hnerf.avatar.avatar import Avatar
from hnerf.avatar.surface import move_onto_surface
from hnerf.body.fit_result import BodyFit
from hnerf.body.rig import Rig, pose_vertices

OFF_SURFACE_M = 0.005  # farther from the field's surface, no camera has seen the field's colour
PINNED = 1e3  # weight of a known colour; the Laplacian's weights are about 1
LOOSE = 1e-9  # weight of the mean colour, for parts where no colour is known

log = logging.getLogger("hnerf.asset")


@torch.no_grad()
def field_colours(avatar: Avatar, clothed: BodyFit, texels: Texels, cavities: np.ndarray) -> np.ndarray:
    """Return the field's colour at each texel, (N, 3): its radiance along the inward normal, the median over the poses
    of `clothed`.

    Poses of the capture keep the field's conditioning within what it was trained on; the median rejects a pose in which
    that spot touches another limb. A texel that lies off the field's surface in all poses takes the colour of the mesh
    around it. So do the cavities (V,) bool, where the field has no surface.
    """
    seen, outer = [], ~torch.from_numpy(cavities)
    for frame, theta, root in zip(clothed.frames, clothed.theta, clothed.root, strict=True):
        log.info("texture: %d texels in the pose of frame %d", len(texels.face), frame)
        seen.append(_colours_in_pose(avatar, clothed.rig, texels, theta, root, outer).numpy())
    return filled(median_of_seen(np.stack(seen)), texels, clothed.rig)


def median_of_seen(colours: np.ndarray) -> np.ndarray:
    """Return the median over poses of colours (P, N, 3), ignoring NaN; NaN if all are NaN."""
    ordered = np.sort(colours, axis=0)  # NaN last
    seen = (~np.isnan(colours[..., 0])).sum(0)
    row = np.arange(len(seen))
    middle = [ordered[(k // 2).clip(0, len(colours) - 1), row] for k in (seen - 1, seen)]
    return np.mean(middle, axis=0)


def filled(colours: np.ndarray, texels: Texels, rig: Rig) -> np.ndarray:
    """Return colours (N, 3) with NaN replaced: known colours are averaged at the mesh's vertices and spread over it
    harmonically (lap c = 0)."""
    unknown = np.isnan(colours[:, 0])
    if not unknown.any() or unknown.all():
        return np.nan_to_num(colours)
    faces, vertices_m = rig.faces.numpy(), rig.vertices_m.double().numpy()
    corners, share = faces[texels.face], texels.barycentric.astype(np.float64)
    at, by = corners[~unknown], share[~unknown]
    weight = np.bincount(at.ravel(), by.ravel(), len(vertices_m))
    total = [np.bincount(at.ravel(), (by * c[:, None]).ravel(), len(vertices_m)) for c in colours[~unknown].T]
    pin = np.where(weight > 0, PINNED, 0)
    known = np.stack(total, 1) / weight.clip(1e-12)[:, None]
    matrix = cotangent_laplacian(vertices_m, faces)[1] + diags_array(pin + LOOSE)
    spread = splu(csc_array(matrix)).solve(pin[:, None] * known + LOOSE * colours[~unknown].mean(0))
    result = colours.copy()
    result[unknown] = texels.interpolate(spread, faces, unknown)
    return result


def _colours_in_pose(avatar: Avatar, rig: Rig, texels: Texels, theta: Tensor, root: Tensor, outer: Tensor) -> Tensor:
    """Return the radiance at each texel of the surface posed by theta (J, 3) and root (4, 4), (N, 3) on the CPU; NaN
    off the field's surface, and on faces with a vertex that is not `outer` (V,)."""
    device = avatar.body.rig.vertices_m.device
    vertices_m, faces = pose_vertices(rig, theta, root).to(device), rig.faces.to(device)
    theta, root = theta.to(device), root.to(device)
    surface_m, normals = move_onto_surface(avatar, vertices_m, faces, theta, root)  # skinning only approximates it
    on_surface = outer.to(device) & (avatar.signed_distance(surface_m, theta, root).abs() <= OFF_SURFACE_M)
    face, barycentric = (torch.from_numpy(values).to(device) for values in (texels.face, texels.barycentric))
    shown = torch.nonzero(on_surface[faces].all(1)[face])[:, 0]
    corners, weights = faces[face[shown]], barycentric[shown, :, None]
    points_m = (surface_m[corners] * weights).sum(1)
    inward = -torch.nn.functional.normalize((normals[corners] * weights).sum(1), dim=1)
    colours = torch.full((len(face), 3), torch.nan)
    colours[shown.cpu()] = avatar.colour(points_m, inward, theta, root).cpu()
    return colours
