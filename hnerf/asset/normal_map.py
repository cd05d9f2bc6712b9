"""A tangent-space normal map: the wrinkles of the field's surface that are too fine for the mesh's faces."""

import numpy as np
import torch

from hnerf.asset.registration import COSINES
from hnerf.asset.tangents import frames_at, unit, uv_tangents
from hnerf.asset.texture import Texels, UvLayout, rasterise, texture_image
from hnerf.asset.topologies import AssetMesh
from hnerf.avatar.avatar import Avatar
from hnerf.avatar.surface import move_onto_surface, normals_and_distances
from hnerf.body.descriptor import normals_of
from hnerf.body.rig import Rig

STEP_M = 0.002  # for finite differences of the signed distance
OFF_SURFACE_M = 0.005  # farther from the field's surface, its gradient says nothing about the mesh


def normal_map(avatar: Avatar, mesh: AssetMesh, layout: UvLayout, side_px: int) -> np.ndarray:
    """Return the normal map of a mesh in the rest pose, (side_px, side_px, 3) uint8, of components (n + 1) / 2 in the
    frames of `tangents.py`: red along u, green along v (up), as in glTF and USD.

    It is flat on eyeballs and in cavities, where the mesh is off the field's surface, and where the field's gradient
    and the mesh's normal disagree, for example where the field merges the fingers into a mitten.
    """
    texels, rig = rasterise(layout, side_px), mesh.rig
    points_m, faces = rig.vertices_m.double().numpy(), rig.faces.numpy()
    normals = normals_of(points_m, faces)
    frames = frames_at(texels, normals, faces, layout, uv_tangents(points_m, normals, faces, layout))
    smooth = unit(frames.normal)
    gradient, distance_m = _field_normals(avatar, rig, texels)
    cosine = (gradient * smooth).sum(1)
    trust = ((cosine - COSINES[0]) / (COSINES[1] - COSINES[0])).clip(0, 1)
    trust *= (1 - np.abs(distance_m) / OFF_SURFACE_M).clip(0, 1)
    if mesh.base is not None:
        trust *= 1 - (mesh.base.hidden[faces[texels.face]] * texels.barycentric).sum(1)
    components = frames.components(smooth + trust[:, None] * (gradient - smooth))
    return texture_image(texels, (components + 1) / 2, side_px)


@torch.no_grad()
def _field_normals(avatar: Avatar, rig: Rig, texels: Texels) -> tuple[np.ndarray, np.ndarray]:
    """Return the field's normal at each texel, (N, 3), and its distance there, (N,), in the rest pose, after the mesh
    has moved onto the field's surface."""
    device = avatar.body.rig.vertices_m.device
    theta, root = avatar.body.theta.new_zeros(len(rig.joints_m), 3), torch.eye(4).to(avatar.body.theta)
    faces = rig.faces.to(device)
    surface_m, _ = move_onto_surface(avatar, rig.vertices_m.to(device), faces, theta, root)
    face, barycentric = (torch.from_numpy(values).to(device) for values in (texels.face, texels.barycentric))
    points_m = (surface_m[faces[face]] * barycentric[..., None]).sum(1)
    normals, distances_m = normals_and_distances(avatar, points_m, theta, root, STEP_M)
    return normals.double().cpu().numpy(), distances_m.double().cpu().numpy()
