"""What the training photographs tell about the light: colours of the surface's vertices, each at many normals."""

from collections.abc import Mapping
from itertools import product

import numpy as np

from hnerf.asset.light import Shading
from hnerf.asset.photographs import COSINE_POWER, EDGE_SLOPE, FAR_M, SeenSurface, sampled
from hnerf.asset.srgb import to_linear
from hnerf.avatar.avatar import Gains
from hnerf.capture.capture import Capture
from hnerf.geometry.camera import Camera
from hnerf.geometry.rays import cast
from hnerf.side_by_side import side_by_side

HIDDEN_M = 0.01  # a surface farther in front of a vertex hides it
ASIDE_PX = 2  # if the surface ends or jumps so near a vertex, it is on an outline, whose pixels mix two surfaces


def photographed_shading(capture: Capture, gains: Gains, surfaces: Mapping[int, SeenSurface]) -> Shading:
    """Return the colours of all visible vertices in the training photographs of the frames in `surfaces`, weighted by
    the fourth power of the cosine to the normal. The cameras' gains are divided out."""

    def seen_in(view: tuple[int, str]) -> tuple[np.ndarray, ...]:
        frame, name = view
        camera, surface, gain = capture.cameras[name], surfaces[frame], gains.get(name, (1.0, 1.0, 1.0))
        vertex, cosine, pixels_px = visible_vertices(camera, surface)
        colours = to_linear(sampled(capture.image(name, frame), pixels_px) / gain)
        return vertex, surface.normals[vertex], colours, cosine**COSINE_POWER

    seen = side_by_side(seen_in, product(surfaces, capture.train_cameras))
    return Shading(*(np.concatenate(parts) for parts in zip(*seen, strict=True)))


def visible_vertices(camera: Camera, surface: SeenSurface) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return which vertices (M,) a camera sees away from outlines, the cosines of its view to their normals (M,), and
    their pixels (M, 2)."""
    view_m = camera.centre_m - surface.vertices_m
    distance_m = np.linalg.norm(view_m, axis=1)
    cosine = (view_m * surface.normals).sum(1) / distance_m
    pixels_px, ahead_m = camera.project(surface.vertices_m)
    inside = ((pixels_px >= 0) & (pixels_px <= [camera.width_px - 1, camera.height_px - 1])).all(1)
    vertex = np.flatnonzero(inside & (cosine > 0) & (ahead_m > 0))  # what is behind would be seen mirrored

    def depth_m(aside_px: tuple[int, int]) -> np.ndarray:
        hits = cast(surface.mesh, *camera.rays(pixels_px[vertex] + np.array(aside_px)))
        return np.where(hits.face >= 0, hits.distance_m, FAR_M)

    vertex = vertex[depth_m((0, 0)) > distance_m[vertex] - HIDDEN_M]
    around_m = np.stack([depth_m(aside) for aside in ((ASIDE_PX, 0), (-ASIDE_PX, 0), (0, ASIDE_PX), (0, -ASIDE_PX))])
    width_m = 2 * ASIDE_PX * distance_m[vertex] / camera.K[0, 0]
    vertex = vertex[np.ptp(around_m, 0) < EDGE_SLOPE * width_m]
    return vertex, cosine[vertex], pixels_px[vertex]
