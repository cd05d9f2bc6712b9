"""All training pixels that can show the person, ready to be drawn as rays."""

from dataclasses import dataclass

import torch
from torch import Tensor

from hnerf.fields.rays import Rays

EDGE_SHARE = 1 / 3  # of the rays: half of the error is at edges, mostly in hands and feet, which are nearly all edge


@dataclass(frozen=True)
class PixelRays(Rays):
    """Rays of pixels. colour (R, 3) in [0, 1]; person (R,) bool; edge (R,) bool: near the mask's outline; plate (R, 3):
    the clean plate's colour with the shadows on it, or None."""

    colour: Tensor
    person: Tensor
    edge: Tensor
    plate: Tensor | None


@dataclass(frozen=True)
class Pixels:
    """Pixels of all images, ordered by frame and camera, in host memory.

    starts (n + 1,): each frame's range. edges (E,), edge_starts (n + 1,): indices of the edge pixels by frame, or of
    all pixels of a frame without edges. image_starts (I + 1,): each image's range; image_camera (I,). pixel_index (P,)
    int32: row-major in the image, None if images are whole. colour, plate (P, 3) uint8; person, edge (P,) bool.
    widths_px (C,); rays_from_px (C, 3, 3); centres_m (C, 3).
    """

    starts: Tensor
    edges: Tensor
    edge_starts: Tensor
    image_starts: Tensor
    image_camera: Tensor
    pixel_index: Tensor | None
    colour: Tensor
    plate: Tensor | None
    person: Tensor
    edge: Tensor
    widths_px: Tensor
    rays_from_px: Tensor
    centres_m: Tensor

    def draw(
        self, frames: Tensor, rays_per_frame: int, generator: torch.Generator, edge_share: float = EDGE_SHARE
    ) -> PixelRays:
        """Draw `rays_per_frame` pixels of each of the frames (rows) with replacement, a share `edge_share` of them at
        edges. Return their rays on the device of the frames and the generator."""
        shape = len(frames), rays_per_frame
        unit = torch.rand(shape, generator=generator, dtype=torch.float64, device=frames.device).cpu()
        rows, count = frames.cpu(), round(edge_share * rays_per_frame)
        mixed = self.edges[_within(self.edge_starts, rows, unit[:, :count])]
        pick = torch.cat([mixed, _within(self.starts, rows, unit[:, count:])], 1).flatten()
        origins_m, directions = self.rays(*self.cameras_and_xy(pick))
        device = frames.device
        return PixelRays(
            origins_m.to(device),
            directions.to(device),
            frames.repeat_interleave(rays_per_frame),
            (self.colour[pick] / 255).to(device),
            self.person[pick].to(device),
            self.edge[pick].to(device),
            None if self.plate is None else (self.plate[pick] / 255).to(device),
        )

    def cameras_and_xy(self, pick: Tensor) -> tuple[Tensor, Tensor]:
        """Return cameras (R,) and coordinates xy_px (R, 2) of pixels (R,)."""
        image = torch.searchsorted(self.image_starts, pick, right=True) - 1
        pixel_index = pick - self.image_starts[image] if self.pixel_index is None else self.pixel_index[pick]
        camera = self.image_camera[image]
        width_px = self.widths_px[camera]
        return camera, torch.stack([pixel_index % width_px, pixel_index // width_px], 1)

    def rays(self, camera: Tensor, xy_px: Tensor) -> tuple[Tensor, Tensor]:
        """Return origins and unit directions (R, 3) of pixels (R, 2) of cameras (R,)."""
        homogeneous = torch.cat([xy_px.float(), torch.ones_like(xy_px[:, :1], dtype=torch.float32)], 1)
        directions = (self.rays_from_px[camera] @ homogeneous[..., None])[..., 0]
        return self.centres_m[camera], torch.nn.functional.normalize(directions, dim=-1)


def _within(starts: Tensor, rows: Tensor, unit: Tensor) -> Tensor:
    """Return indices (n, k) in the ranges of rows (n,), at the relative positions unit (n, k) in [0, 1)."""
    first, after = starts[rows, None], starts[rows + 1, None]
    return first + (unit * (after - first)).long()
