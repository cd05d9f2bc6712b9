"""The training pixels, gathered by one process and held once per machine, whatever the number of processes."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from hnerf.avatar.avatar import Gains
from hnerf.body.fit_result import BodyFit
from hnerf.capture.capture import Capture, to_8_bit
from hnerf.capture.masks import Masks
from hnerf.geometry.reach import ReachablePixels
from hnerf.segmentation.edge import shaded_plate
from hnerf.segmentation.prior import bounding_window
from hnerf.training.distributed import Distributed
from hnerf.training.pixels import CELL_PX, Pixels
from hnerf.training.plates import Plate, plates_of

EDGE_PX = 2  # half-width of the band around a mask's outline in which a pixel may mix person and background
SUFFIX = ".pixels"  # of the files that hold the columns of Pixels; COLUMNS: the columns' types and widths
COLUMNS = {
    "starts": (torch.int64, 1),
    "image_starts": (torch.int64, 1),
    "image_camera": (torch.int64, 1),
    "pixel_index": (torch.int32, 1),
    "cell": (torch.int32, 1),
    "colour": (torch.uint8, 3),
    "plate": (torch.uint8, 3),
    "person": (torch.bool, 1),
    "edge": (torch.bool, 1),
}
NUMPY = {torch.int64: np.int64, torch.int32: np.int32, torch.uint8: np.uint8, torch.bool: np.bool_}


def gather_pixels(
    capture: Capture,
    masks: Masks,
    body: BodyFit,
    visible_pixels: ReachablePixels | None,
    gains: Gains,
    folder: Path,
    processes: Distributed,
    with_plates: bool = True,
) -> Pixels:
    """Gather the training cameras' pixels in the fit's frames that can show the body or lie on the mask; none where the
    mask was dropped. visible_pixels None: all pixels. with_plates: whether the person is composited over plates, which
    a field that models the background does not need.

    Colours and plates are divided by the gains of their cameras, if any, as if all were exposed alike. One process
    gathers, image by image, into files in `folder`; all processes map them, so that the machine holds them once and may
    page them out. The files are unlinked by the time this returns: their space is freed when the last process ends,
    however it ends.
    """
    try:
        if processes.is_main:
            folder.mkdir(parents=True, exist_ok=True)
            _remove(folder)  # what a killed process left
            plates = plates_of(capture, masks, body.frames) if with_plates else None
            _write_pixels(capture, masks, body, visible_pixels, plates, gains, folder)
        processes.barrier()
        columns: dict[str, Any] = {name: _mapped(folder / f"{name}{SUFFIX}", *kind) for name, kind in COLUMNS.items()}
        processes.barrier()
    finally:
        if processes.is_main:
            _remove(folder)
    cameras = [capture.cameras[name] for name in capture.train_cameras]
    return Pixels(
        widths_px=torch.tensor([c.width_px for c in cameras]),
        rays_from_px=torch.from_numpy(np.stack([c.R.T @ np.linalg.inv(c.K) for c in cameras])).float(),
        centres_m=torch.from_numpy(np.stack([c.centre_m for c in cameras])).float(),
        **columns,
    )


def _write_pixels(
    capture: Capture,
    masks: Masks,
    body: BodyFit,
    visible_pixels: ReachablePixels | None,
    plates: list[Plate] | None,
    gains: Gains,
    folder: Path,
) -> None:
    """Write the columns of Pixels, one file each, frame by frame."""
    cameras = [capture.cameras[name] for name in capture.train_cameras]
    columns, cells = _Columns(folder), 0
    for frame, vertices_m in zip(body.frames, body.vertices_m().numpy(), strict=True):
        for c, camera in enumerate(cameras):
            if (camera.name, frame) not in masks:
                continue
            image, mask = capture.image(camera.name, frame), masks.get(camera.name, frame)
            wanted, edge, gain = np.ones_like(mask), _edge(mask), gains.get(camera.name)
            if visible_pixels:
                wanted = visible_pixels(camera, vertices_m) | mask
                if plates:
                    wanted &= plates[c].known | ~edge  # at other edges, the person's share is unknown
                columns.append("pixel_index", np.flatnonzero(wanted))
                y, x = np.nonzero(wanted)
                met, cell = np.unique(y // CELL_PX * wanted.shape[1] + x // CELL_PX, return_inverse=True)
                columns.append("cell", cells + cell)
                cells += len(met)
            columns.append("colour", _exposure_corrected(image[wanted], gain))
            columns.append("person", mask[wanted])
            columns.append("edge", edge[wanted])
            columns.append("image_camera", [c])
            columns.close("image_starts", int(wanted.sum()))
            if plates and wanted.any():
                window = bounding_window(wanted)
                shaded = shaded_plate(mask[window], image[window], plates[c].colour[window])[wanted[window]]
                columns.append("plate", _exposure_corrected(to_8_bit(shaded), gain))
        columns.close("starts", columns.ends["image_starts"] - columns.ends["starts"])


class _Columns:
    """The columns of Pixels while their files are written; ends: number of rows in the parts written so far, by column
    of starts."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.ends = folder, {"starts": 0, "image_starts": 0}
        for name in self.ends:
            self.close(name, 0)

    def append(self, name: str, values: Any) -> None:
        """Write further values to the end of a column."""
        with (self.folder / f"{name}{SUFFIX}").open("ab") as file:
            file.write(np.ascontiguousarray(values, NUMPY[COLUMNS[name][0]]).data)

    def close(self, name: str, count: int) -> None:
        """End a part of `count` rows in a column of starts."""
        self.ends[name] += count
        self.append(name, [self.ends[name]])


def _exposure_corrected(shown: np.ndarray, gain: tuple[float, float, float] | None) -> np.ndarray:
    """Return colours (P, 3) uint8 as a camera of gain 1 would show them."""
    return shown if gain is None else to_8_bit(shown / np.array(gain, np.float32))


def _mapped(path: Path, kind: torch.dtype, width: int) -> Tensor | None:
    """Map a file as a tensor, (N,) or (N, width), in memory that processes share; None if there is no file."""
    if not path.exists():
        return None
    flat = torch.from_file(str(path), False, path.stat().st_size // kind.itemsize, dtype=kind)
    return flat.view(-1, width) if width > 1 else flat


def _remove(folder: Path) -> None:
    for path in folder.glob(f"*{SUFFIX}"):
        path.unlink()


def _edge(mask: np.ndarray) -> np.ndarray:
    kernel = np.ones((2 * EDGE_PX + 1,) * 2, np.uint8)
    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_GRADIENT, kernel) > 0
