"""What the training photographs tell of the light: colours of the surface's vertices, at many normals each."""

from collections.abc import Mapping
from itertools import product

import numpy as np

from hnerf.asset.light import Shading
from hnerf.asset.photographs import COSINE_POWER, sampled
from hnerf.asset.srgb import to_linear
from hnerf.avatar.avatar import Gains
from hnerf.body.descriptor import normals_of
from hnerf.capture.capture import Capture
from hnerf.geometry.camera import Camera
from hnerf.geometry.rays import cast, mesh_on_cpu

HIDDEN_M = 0.01  # in front of a vertex, another surface hides it


def photographed_shading(
    capture: Capture, gains: Gains, surfaces_m: Mapping[int, np.ndarray], faces: np.ndarray
) -> Shading:
    """Return the colours of all vertices in the training photographs of some frames, weighted by the fourth power of
    the cosine to the normal. surfaces_m: vertices (V, 3) in the world by frame; gains of cameras are divided out."""
    seen = []
    for frame, name in product(surfaces_m, capture.train_cameras):
        camera, gain = capture.cameras[name], gains.get(name, (1.0, 1.0, 1.0))
        normals = normals_of(surfaces_m[frame], faces)
        vertex, cosine = visible_vertices(camera, surfaces_m[frame], faces, normals)
        pixels_px, _ = camera.project(surfaces_m[frame][vertex])
        colours = to_linear(sampled(capture.image(name, frame), pixels_px) / gain)
        seen.append((vertex, normals[vertex], colours, cosine**COSINE_POWER))
    return Shading(*(np.concatenate(parts) for parts in zip(*seen, strict=True)))


def visible_vertices(
    camera: Camera, vertices_m: np.ndarray, faces: np.ndarray, normals: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return which vertices (M,) a camera sees, and the cosines of its view to their normals (M,)."""
    from_camera = vertices_m - camera.centre_m
    distance_m = np.linalg.norm(from_camera, axis=1)
    cosine = -(from_camera * normals).sum(1) / distance_m
    column, row = camera.project(vertices_m)[0].T
    inside = (column >= 0) & (row >= 0) & (column <= camera.width_px - 1) & (row <= camera.height_px - 1)
    facing = np.flatnonzero(inside & (cosine > 0))
    directions = from_camera[facing] / distance_m[facing, None]
    hits = cast(mesh_on_cpu(vertices_m, faces), camera.centre_m, directions)
    clear = (hits.face < 0) | (hits.distance_m > distance_m[facing] - HIDDEN_M)
    return facing[clear], cosine[facing[clear]]
