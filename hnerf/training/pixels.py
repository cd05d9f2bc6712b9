"""Every training pixel that the person can reach, ready to be drawn as rays."""

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from hnerf.capture.camera import Camera

AT_EDGES = 1 / 3  # of the rays: half of the error is there, most of it in hands and feet, which are little else
NEAREST_PERCENT = 1  # of the vertices: a finger alone does not widen the reach of all others
FARTHEST_PX = 1e5  # from the image's corner: more is not asked of what fills polygons

Reached = Callable[[Camera, np.ndarray], np.ndarray]
"""Which pixels (H, W) of a camera can show anything of a body with vertices (V, 3)."""


@dataclass(frozen=True)
class Rays:
    """A batch: origins_m, directions (R, 3); frame (R,) row of the body fit; colour (R, 3) in [0, 1]; person (R,) bool;
    edge (R,) bool: near the mask's outline; plate (R, 3) the clean plate's colour with the shadows on it, or None."""

    origins_m: Tensor
    directions: Tensor
    frame: Tensor
    colour: Tensor
    person: Tensor
    edge: Tensor
    plate: Tensor | None


@dataclass(frozen=True)
class Pixels:
    """Pixels of all images, ordered by frame and camera, on the host. starts (n + 1,): each frame's range. edges (E,),
    edge_starts (n + 1,): indices of those at edges likewise, or of all pixels of a frame that has none there.
    image_starts (I + 1,): each image's range; image_camera (I,); place (P,) int32: row-major in the image, or None
    where images are whole. colour, plate (P, 3) uint8; person, edge (P,) bool; widths_px (C,); rays_from_px (C, 3, 3);
    centres_m (C, 3)."""

    starts: Tensor
    edges: Tensor
    edge_starts: Tensor
    image_starts: Tensor
    image_camera: Tensor
    place: Tensor | None
    colour: Tensor
    plate: Tensor | None
    person: Tensor
    edge: Tensor
    widths_px: Tensor
    rays_from_px: Tensor
    centres_m: Tensor

    def draw(self, frames: Tensor, rays_per_frame: int, generator: torch.Generator, at_edges: float = AT_EDGES) -> Rays:
        """`rays_per_frame` pixels of each of the frames (rows), a share of them at edges, drawn with replacement; on
        the device of the frames and the generator."""
        shape = len(frames), rays_per_frame
        unit = torch.rand(shape, generator=generator, dtype=torch.float64, device=frames.device).cpu()
        rows, count = frames.cpu(), round(at_edges * rays_per_frame)
        mixed = self.edges[_within(self.edge_starts, rows, unit[:, :count])]
        pick = torch.cat([mixed, _within(self.starts, rows, unit[:, count:])], 1).flatten()
        origins_m, directions = self.rays(*self.where(pick))
        device = frames.device
        return Rays(
            origins_m.to(device),
            directions.to(device),
            frames.repeat_interleave(rays_per_frame),
            (self.colour[pick] / 255).to(device),
            self.person[pick].to(device),
            self.edge[pick].to(device),
            None if self.plate is None else (self.plate[pick] / 255).to(device),
        )

    def where(self, pick: Tensor) -> tuple[Tensor, Tensor]:
        """Cameras (R,) and coordinates xy_px (R, 2) of some pixels (R,)."""
        image = torch.searchsorted(self.image_starts, pick, right=True) - 1
        place = pick - self.image_starts[image] if self.place is None else self.place[pick]
        camera = self.image_camera[image]
        width_px = self.widths_px[camera]
        return camera, torch.stack([place % width_px, place // width_px], 1)

    def rays(self, camera: Tensor, xy_px: Tensor) -> tuple[Tensor, Tensor]:
        """Origins and unit directions (R, 3) of pixels (R, 2) of cameras (R,)."""
        homogeneous = torch.cat([xy_px.float(), torch.ones_like(xy_px[:, :1], dtype=torch.float32)], 1)
        directions = (self.rays_from_px[camera] @ homogeneous[..., None])[..., 0]
        return self.centres_m[camera], torch.nn.functional.normalize(directions, dim=-1)


def _within(starts: Tensor, rows: Tensor, unit: Tensor) -> Tensor:
    """Indices (n, k) in the ranges of some rows (n,), at unit (n, k) in [0, 1) of each."""
    first, after = starts[rows, None], starts[rows + 1, None]
    return first + (unit * (after - first)).long()


def everywhere(camera: Camera, vertices_m: np.ndarray) -> np.ndarray:
    """(H, W) bool: all pixels."""
    return np.ones((camera.height_px, camera.width_px), bool)


def within_box(camera: Camera, vertices_m: np.ndarray, margin_m: float) -> np.ndarray:
    """(H, W) bool: pixels whose rays meet the extent of the body (V, 3) and a margin; all where that lies about the
    camera."""
    lower_m, upper_m = vertices_m.min(0) - margin_m, vertices_m.max(0) + margin_m
    corners_px, depth_m = camera.project(np.array(list(itertools.product(*zip(lower_m, upper_m, strict=True)))))
    if depth_m.min() <= 0:
        return everywhere(camera, vertices_m)
    met = np.zeros((camera.height_px, camera.width_px), np.uint8)
    outline = cv2.convexHull(corners_px.clip(-FARTHEST_PX, FARTHEST_PX).round().astype(np.int32))
    return cv2.fillConvexPoly(met, outline, 1) > 0


def within_reach(camera: Camera, vertices_m: np.ndarray, reach_m: float) -> np.ndarray:
    """(H, W) bool: pixels whose rays pass within about `reach_m` of the body; its vertices before the camera, in the
    image or beside it, each a disc of the radius that the nearest ones need."""
    size_px = np.array([camera.width_px, camera.height_px])
    xy, depth_m = camera.project(vertices_m)
    xy, depth_m = xy[depth_m > 0], depth_m[depth_m > 0]
    if not len(depth_m):
        return np.zeros(size_px[::-1], bool)
    nearest_m, focal_px = np.percentile(depth_m, NEAREST_PERCENT), max(camera.K[0, 0], camera.K[1, 1])
    radius = int(np.ceil(min(reach_m * focal_px / nearest_m, np.hypot(*size_px))))
    xy = np.round(xy) + radius
    x, y = xy[((xy >= 0) & (xy < size_px + 2 * radius)).all(1)].astype(int).T
    outside = np.ones(size_px[::-1] + 2 * radius, np.uint8)
    outside[y, x] = 0
    apart_px = cv2.distanceTransform(outside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return apart_px[radius:-radius, radius:-radius] <= radius
