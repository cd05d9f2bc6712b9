"""Rendering by ray casting: a mesh lit by a dome of soft lights in a room, and its shadow on the floor."""

# mypy: disable-error-code="misc, no-untyped-def"

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from hnerf.geometry.camera import Camera
from hnerf.geometry.rays import RayHits, cast, to_vec3_array
from hnerf.synthetic.appearance import person_colour, room_colour
from hnerf.warp_import import wp

SUPERSAMPLES = 3  # per side of a pixel; odd, so that one ray goes through its centre
KEY_DIRECTION = np.array([0.5, -0.6, 0.75])  # to the brightest part of the dome
LIGHTS, BRIGHTNESS = 20, 1.25
SHADOW_HALF_SIDE_M, SHADOW_CELLS = 1.6, 80


@wp.kernel
def _visibility_kernel(
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    visible: wp.array2d(dtype=wp.float32),
):
    i, k = wp.tid()
    if not wp.mesh_query_ray_anyhit(mesh, points[i], directions[k], 10.0):
        visible[i, k] = 1.0


def visibility(mesh: wp.Mesh, points_m: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return 1 where a point (N, 3) sees infinity along a direction (K, 3) past a mesh on the CPU, else 0: (N, K)."""
    visible = wp.zeros((len(points_m), len(directions)), dtype=wp.float32, device="cpu")
    inputs = [mesh.id, to_vec3_array(points_m, "cpu"), to_vec3_array(directions, "cpu"), visible]
    wp.launch(_visibility_kernel, visible.shape, inputs, device="cpu")
    return visible.numpy()


def dome_lights() -> tuple[np.ndarray, np.ndarray]:
    """Return directions (K, 3) spread over the dome (a Fibonacci spiral) and their strength (K,), brightest near
    KEY_DIRECTION.

    They are scaled so that an unshadowed upward surface has irradiance BRIGHTNESS.
    """
    k = np.arange(LIGHTS) + 0.5
    up = 1 - 1.25 * k / LIGHTS  # a little light comes from below, reflected by the floor
    around = np.pi * (1 + np.sqrt(5)) * k
    flat = np.sqrt(1 - up**2)
    directions = np.stack([flat * np.cos(around), flat * np.sin(around), up], -1)
    key = np.clip(directions @ KEY_DIRECTION / np.linalg.norm(KEY_DIRECTION), 0, 1)
    strength = np.where(up > 0, 0.9 + 2.2 * key**3, 0.5)
    return directions, BRIGHTNESS * strength / (strength * np.clip(up, 0, 1)).sum()


def irradiance(normals: np.ndarray, visible: np.ndarray, lights: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Return the sum over lights of strength x cosine x visibility (N, K), for normals (N, 3): (N,)."""
    directions, strength = lights
    return (np.clip(normals @ directions.T, 0, None) * visible) @ strength


class Renderable(Protocol):
    """A surface for `render_person`: rays can be cast at it, and it has colours in [0, 1] at the hits."""

    @property
    def vertices_m(self) -> np.ndarray: ...

    def cast(self, origin_m: np.ndarray, directions: np.ndarray) -> RayHits: ...

    def colours(self, hits: RayHits) -> np.ndarray: ...


@dataclass(frozen=True)
class ShadedPerson:
    """A posed, lit person. vertex_attributes (V, 9): the inputs of `person_colour` (3 rest_m, 5 depths_m), and the
    irradiance."""

    vertices_m: np.ndarray
    faces: np.ndarray
    mesh: wp.Mesh
    vertex_attributes: np.ndarray
    face_m: np.ndarray

    def cast(self, origin_m: np.ndarray, directions: np.ndarray) -> RayHits:
        """Return the first hits of rays from one origin (3,) along unit directions (N, 3)."""
        return cast(self.mesh, origin_m, directions)

    def colours(self, hits: RayHits) -> np.ndarray:
        """Return lit colours in [0, 1] of those rays that hit, (M, 3)."""
        values = hits.interpolate(self.vertex_attributes, self.faces)
        return (person_colour(self.face_m, values[:, :3], values[:, 3:-1]) * values[:, -1:]).clip(0, 1)


def render_person(person: Renderable, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Render a person on black; return the image (H, W, 3), with edge pixels weighted by coverage, the coverage (H, W),
    and whether a pixel's centre ray hits, (H, W) bool."""
    rgb = np.zeros((camera.height_px, camera.width_px, 3))
    coverage, mask = np.zeros(rgb.shape[:2]), np.zeros(rgb.shape[:2], bool)
    seen_px, _ = camera.project(person.vertices_m)
    low = np.floor(seen_px.min(0) - 1).astype(int).clip(0, camera.size_px)
    high = np.ceil(seen_px.max(0) + 2).astype(int).clip(0, camera.size_px)
    window = np.s_[low[1] : high[1], low[0] : high[0]]
    pixels = camera.pixels_px[window]
    for offset in subpixel_offsets_px():
        _, directions = camera.rays(pixels + offset)
        hits = person.cast(camera.centre_m, directions.reshape(-1, 3))
        here = (hits.face >= 0).reshape(pixels.shape[:2])
        rgb[window][here] += person.colours(hits) / SUPERSAMPLES**2
        coverage[window] += here / SUPERSAMPLES**2
        if not offset.any():
            mask[window] = here
    return rgb, coverage, mask


def floor_shadow(mesh: wp.Mesh, centre_m: np.ndarray, lights: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Return the share of its light that reaches the floor around a point, on a grid (cells, cells) over x and y."""
    line = np.linspace(-SHADOW_HALF_SIDE_M, SHADOW_HALF_SIDE_M, SHADOW_CELLS)
    x, y = np.meshgrid(line, line, indexing="ij")
    points = np.stack([x + centre_m[0], y + centre_m[1], np.full_like(x, 1e-3)], -1).reshape(-1, 3)
    above = lights[0][:, 2] > 0
    visible = visibility(mesh, points, lights[0][above])
    weights = lights[0][above, 2] * lights[1][above]
    return gaussian_filter((visible @ (weights / weights.sum())).reshape(SHADOW_CELLS, SHADOW_CELLS), 1.5)


@dataclass(frozen=True)
class RoomView:
    """A camera's empty room: plate (H, W, 3) in [0, 1], and the point that each pixel's centre ray meets, room_m (H, W,
    3)."""

    camera: Camera
    plate: np.ndarray
    room_m: np.ndarray

    @staticmethod
    def of(camera: Camera) -> "RoomView":
        """Render the room with the same supersampling as the person."""
        pixels = camera.pixels_px.reshape(-1, 2)
        plate = np.zeros((len(pixels), 3))
        for offset in subpixel_offsets_px():
            colour, hit = room_colour(*camera.rays(pixels + offset))
            plate += colour / SUPERSAMPLES**2
            if not offset.any():
                centre_hit = hit
        shape = (camera.height_px, camera.width_px, 3)
        return RoomView(camera, plate.clip(0, 1).reshape(shape), centre_hit.reshape(shape))

    def shadowed(self, shadow: np.ndarray, centre_m: np.ndarray) -> np.ndarray:
        """Return the plate with a person's shadow (see `floor_shadow`) on the floor, (H, W, 3)."""
        cells_per_m = (SHADOW_CELLS - 1) / (2 * SHADOW_HALF_SIDE_M)
        cells = (self.room_m[..., :2] - centre_m[:2] + SHADOW_HALF_SIDE_M) * cells_per_m
        arriving = map_coordinates(shadow, np.moveaxis(cells, -1, 0), order=1, mode="nearest")
        return self.plate * np.where(self.room_m[..., 2] < 1e-6, arriving, 1.0)[..., None]


def subpixel_offsets_px() -> np.ndarray:
    """Return sample positions around a pixel's centre, (SUPERSAMPLES^2, 2)."""
    line = (np.arange(SUPERSAMPLES) - SUPERSAMPLES // 2) / SUPERSAMPLES
    return np.stack(np.meshgrid(line, line), -1).reshape(-1, 2)
