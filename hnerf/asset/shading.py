"""What the training photographs tell of the light: colours of the surface's vertices, at many normals each."""

from collections.abc import Mapping
from itertools import product

import numpy as np

from hnerf.asset.light import Shading
from hnerf.asset.photographs import COSINE_POWER, EDGE_SLOPE, FAR_M, sampled
from hnerf.asset.srgb import to_linear
from hnerf.avatar.avatar import Gains
from hnerf.body.descriptor import normals_of
from hnerf.capture.capture import Capture
from hnerf.geometry.camera import Camera
from hnerf.geometry.rays import cast, mesh_on_cpu

HIDDEN_M = 0.01  # in front of a vertex, another surface hides it
ASIDE_PX = 2  # a vertex beside which the surface ends or jumps is on an outline, whose pixels mix two surfaces


def photographed_shading(
    capture: Capture, gains: Gains, surfaces_m: Mapping[int, np.ndarray], faces: np.ndarray
) -> Shading:
    """Return the colours of all vertices in the training photographs of some frames, weighted by the fourth power of
    the cosine to the normal. surfaces_m: vertices (V, 3) in the world by frame; gains of cameras are divided out."""
    seen = []
    for frame, name in product(surfaces_m, capture.train_cameras):
        camera, gain = capture.cameras[name], gains.get(name, (1.0, 1.0, 1.0))
        normals = normals_of(surfaces_m[frame], faces)
        vertex, cosine, pixels_px = visible_vertices(camera, surfaces_m[frame], faces, normals)
        colours = to_linear(sampled(capture.image(name, frame), pixels_px) / gain)
        seen.append((vertex, normals[vertex], colours, cosine**COSINE_POWER))
    return Shading(*(np.concatenate(parts) for parts in zip(*seen, strict=True)))


def visible_vertices(
    camera: Camera, vertices_m: np.ndarray, faces: np.ndarray, normals: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return which vertices (M,) a camera sees away from outlines, the cosines of its view to their normals (M,), and
    their pixels (M, 2)."""
    view_m = camera.centre_m - vertices_m
    distance_m = np.linalg.norm(view_m, axis=1)
    cosine = (view_m * normals).sum(1) / distance_m
    pixels_px, ahead_m = camera.project(vertices_m)
    inside = ((pixels_px >= 0) & (pixels_px <= [camera.width_px - 1, camera.height_px - 1])).all(1)
    vertex = np.flatnonzero(inside & (cosine > 0) & (ahead_m > 0))  # what is behind would be seen mirrored
    mesh = mesh_on_cpu(vertices_m, faces)

    def depth_m(aside_px: tuple[int, int]) -> np.ndarray:
        hits = cast(mesh, *camera.rays(pixels_px[vertex] + np.array(aside_px)))
        return np.where(hits.face >= 0, hits.distance_m, FAR_M)

    vertex = vertex[depth_m((0, 0)) > distance_m[vertex] - HIDDEN_M]
    around_m = np.stack([depth_m(aside) for aside in ((ASIDE_PX, 0), (-ASIDE_PX, 0), (0, ASIDE_PX), (0, -ASIDE_PX))])
    width_m = 2 * ASIDE_PX * distance_m[vertex] / camera.K[0, 0]
    vertex = vertex[np.ptp(around_m, 0) < EDGE_SLOPE * width_m]
    return vertex, cosine[vertex], pixels_px[vertex]
