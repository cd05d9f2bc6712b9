"""Every training pixel that the person can reach, on the device, ready to be drawn as rays."""

import dataclasses
import itertools
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from hnerf.body.fit_result import BodyFit
from hnerf.capture.camera import Camera
from hnerf.capture.capture import Capture
from hnerf.segmentation.edge import shaded_plate
from hnerf.segmentation.masks import Masks
from hnerf.segmentation.prior import window_around

AT_EDGES = 1 / 3  # of the rays: half of the error is there, most of it in hands and feet, which are little else
LEVELLED_AT_ONCE = 1 << 20  # pixels, which bounds memory
NEAREST_PERCENT = 1  # of the vertices: a finger alone does not widen the reach of all others
FARTHEST_PX = 1e5  # from the image's corner: more is not asked of what fills polygons
EDGE_PX = 2  # half-width of the band around a mask's outline in which a pixel may mix person and surroundings

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
    """Pixels of all images, ordered by frame. starts (n + 1,): each frame's range. edges (E,), edge_starts (n + 1,):
    indices of those at edges likewise, or of all pixels of a frame that has none there. camera (P,), xy_px (P, 2)
    int16; colour, plate (P, 3) uint8; person, edge (P,) bool; rays_from_px (C, 3, 3); centres_m (C, 3)."""

    starts: Tensor
    edges: Tensor
    edge_starts: Tensor
    camera: Tensor
    xy_px: Tensor
    colour: Tensor
    plate: Tensor | None
    person: Tensor
    edge: Tensor
    rays_from_px: Tensor
    centres_m: Tensor

    def draw(self, frames: Tensor, rays_per_frame: int, generator: torch.Generator, at_edges: float = AT_EDGES) -> Rays:
        """`rays_per_frame` pixels of each of the frames (rows), a share of them at edges, drawn with replacement."""
        shape = len(frames), rays_per_frame
        unit = torch.rand(shape, generator=generator, dtype=torch.float64, device=frames.device)
        count = round(at_edges * rays_per_frame)
        mixed = self.edges[_within(self.edge_starts, frames, unit[:, :count])]
        pick = torch.cat([mixed, _within(self.starts, frames, unit[:, count:])], 1).flatten()
        camera = self.camera[pick].long()
        origins_m, directions = self.rays(camera, self.xy_px[pick])
        return Rays(
            origins_m,
            directions,
            frames.repeat_interleave(rays_per_frame),
            self.colour[pick] / 255,
            self.person[pick],
            self.edge[pick],
            None if self.plate is None else self.plate[pick] / 255,
        )

    def levelled(self, gains: Tensor) -> "Pixels":
        """As cameras would show them that were exposed alike: colour and plate by the gains (C, 3) of their cameras."""

        def level(shown: Tensor) -> Tensor:
            parts = zip(shown.split(LEVELLED_AT_ONCE), self.camera.split(LEVELLED_AT_ONCE), strict=True)
            return torch.cat([(part / gains[camera.long()]).round().clamp(0, 255).byte() for part, camera in parts])

        plate = None if self.plate is None else level(self.plate)
        return dataclasses.replace(self, colour=level(self.colour), plate=plate)

    def rays(self, camera: Tensor, xy_px: Tensor) -> tuple[Tensor, Tensor]:
        """Origins and unit directions (R, 3) of pixels (R, 2) of cameras (R,)."""
        homogeneous = torch.cat([xy_px.float(), torch.ones_like(xy_px[:, :1], dtype=torch.float32)], 1)
        directions = (self.rays_from_px[camera] @ homogeneous[..., None])[..., 0]
        return self.centres_m[camera], torch.nn.functional.normalize(directions, dim=-1)


def gather_pixels(
    capture: Capture, masks: Masks, body: BodyFit, frames: tuple[int, ...], reached: Reached, device: torch.device
) -> Pixels:
    """Pixels of the training cameras in `frames` that are reached from the fitted body, or on the mask; none where the
    mask was dropped."""
    names = capture.train_cameras
    cameras = [capture.cameras[name] for name in names]
    plates = [capture.background(name) for name in names]
    with_plates = all(plate is not None for plate in plates)
    vertices_m = body.vertices_m().numpy()
    columns: dict[str, list[np.ndarray]] = {k: [] for k in ("camera", "xy_px", "colour", "plate", "person", "edge")}
    starts, edges, edge_starts = [0], [], [0]
    for frame in frames:
        first = len(columns["edge"])
        for c, (camera, plate) in enumerate(zip(cameras, plates, strict=True)):
            if (camera.name, frame) not in masks:
                continue
            mask = masks.get(camera.name, frame)
            wanted = reached(camera, vertices_m[body.index(frame)]) | mask
            y, x = np.nonzero(wanted)
            columns["camera"].append(np.full(len(x), c, np.uint8))
            columns["xy_px"].append(np.stack([x, y], 1).astype(np.int16))
            image = capture.image(camera.name, frame)
            columns["colour"].append(image[y, x])
            columns["person"].append(mask[y, x])
            columns["edge"].append(_edge(mask)[y, x])
            if plate is not None and with_plates:
                window = window_around(wanted)
                shaded = shaded_plate(mask[window], image[window], plate[window])[wanted[window]]
                columns["plate"].append(shaded.clip(0, 255).round().astype(np.uint8))
        edge = np.concatenate([np.zeros(0, bool), *columns["edge"][first:]])
        edges.append(starts[-1] + (np.flatnonzero(edge) if edge.any() else np.arange(len(edge))))
        starts.append(starts[-1] + len(edge))
        edge_starts.append(edge_starts[-1] + len(edges[-1]))
    stacked = {k: torch.from_numpy(np.concatenate(v)).to(device) for k, v in columns.items() if k != "plate"}
    inverse = np.stack([c.R.T @ np.linalg.inv(c.K) for c in cameras])
    return Pixels(
        starts=torch.tensor(starts, device=device),
        edges=torch.from_numpy(np.concatenate(edges)).to(device),
        edge_starts=torch.tensor(edge_starts, device=device),
        plate=torch.from_numpy(np.concatenate(columns["plate"])).to(device) if with_plates else None,
        rays_from_px=torch.from_numpy(inverse).float().to(device),
        centres_m=torch.from_numpy(np.stack([c.centre_m for c in cameras])).float().to(device),
        **stacked,
    )


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


def _edge(mask: np.ndarray) -> np.ndarray:
    kernel = np.ones((2 * EDGE_PX + 1,) * 2, np.uint8)
    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_GRADIENT, kernel) > 0
