"""All training pixels that can show the person, ready to be drawn as rays."""

from dataclasses import dataclass

import torch
from torch import Tensor

from hnerf.fields.rays import Rays

CELL_PX = 4  # side of the squares of pixels that share an error
LEAST_ERROR = 1e-6  # of a cell that a ray has met
CANDIDATES = 4  # per ray, of which the one in the cell with the largest error is drawn (docs/experiments.md)


@dataclass(frozen=True)
class PixelRays(Rays):
    """Rays of pixels. colour (R, 3) in [0, 1]; person (R,) bool; edge (R,) bool: near the mask's outline; plate (R, 3):
    the clean plate's colour with the shadows on it, or None; cell (R,): as in Pixels, in host memory, or None."""

    colour: Tensor
    person: Tensor
    edge: Tensor
    plate: Tensor | None
    cell: Tensor | None = None


class CellErrors:
    """The colour errors of training, by cell of the image.

    mean (C,): 0 in cells that no ray has met. Each step replaces the value of a cell by the mean of that value and the
    step's errors in it; so the first errors are averaged with 0, which costs nothing measurable (docs/experiments.md).
    """

    def __init__(self, cells: int):
        self.mean = torch.zeros(cells)

    def largest(self, cells: Tensor) -> Tensor:
        """Return which of the cells (K, ...) has the largest error, (...); cells that no ray has met come first."""
        mean = self.mean[cells]
        return torch.where(mean > 0, mean, torch.inf).argmax(0)

    def update(self, cells: Tensor, errors: Tensor) -> None:
        """Take in errors (R,) of rays in cells (R,)."""
        self.mean.scatter_reduce_(0, cells.long(), errors.clamp(min=LEAST_ERROR), "mean")


@dataclass(frozen=True)
class Pixels:
    """Pixels of all images, ordered by frame and camera, in host memory.

    starts (n + 1,): each frame's range. image_starts (I + 1,): each image's range; image_camera (I,). pixel_index (P,)
    int32: row-major in the image; cell (P,) int32: which square of CELL_PX px of which image; both None if images are
    whole. colour, plate (P, 3) uint8; person, edge (P,) bool. widths_px (C,); rays_from_px (C, 3, 3); centres_m (C, 3).
    """

    starts: Tensor
    image_starts: Tensor
    image_camera: Tensor
    pixel_index: Tensor | None
    cell: Tensor | None
    colour: Tensor
    plate: Tensor | None
    person: Tensor
    edge: Tensor
    widths_px: Tensor
    rays_from_px: Tensor
    centres_m: Tensor

    def draw(
        self, frames: Tensor, rays_per_frame: int, generator: torch.Generator, errors: CellErrors | None = None
    ) -> PixelRays:
        """Draw `rays_per_frame` pixels of each of the frames (rows) with replacement: uniformly, or given errors, each
        from CANDIDATES. Return their rays on the device of the frames and the generator."""
        shape = CANDIDATES if errors else 1, len(frames), rays_per_frame
        unit = torch.rand(shape, generator=generator, dtype=torch.float64, device=frames.device).cpu()
        pick = _within(self.starts, frames.cpu(), unit).flatten(1)
        if errors and self.cell is not None:
            pick = pick.gather(0, errors.largest(self.cell[pick])[None])
        pick = pick[0]
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
            None if self.cell is None else self.cell[pick],
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
    """Return indices (..., n, k) in the ranges of rows (n,), at the relative positions unit (..., n, k) in [0, 1)."""
    first, after = starts[rows, None], starts[rows + 1, None]
    return first + (unit * (after - first)).long()
