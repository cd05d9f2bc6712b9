"""Conversion of one camera's recorded pixels to those of a linear camera of bounded size."""

import shutil
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from hnerf.capture.capture import read_rgb, write_image
from hnerf.capture.lens import Lens, distort_points, undistort_keypoints, undistort_points
from hnerf.errors import InputError
from hnerf.geometry.camera import Camera

MAX_ROUNDING = 1.0  # average difference between two decoders, in grey levels
MAX_LABELS = 64  # levels in a mask of labels; a mask with more has soft edges
GRID = 128  # samples along each side of an image, to measure what a distortion does


@dataclass(frozen=True)
class Normaliser:
    """The conversion of one camera's pixels. `camera` is the linear one, at the size that is written. `maps`:
    cv2.remap's tables, None without distortion.

    The linear camera keeps the calibrated K; where undistortion has no source pixel, the nearest edge pixel is
    repeated.
    """

    lens: Lens
    camera: Camera
    recorded_size_px: tuple[int, int]
    maps: tuple[np.ndarray, np.ndarray] | None

    @staticmethod
    def create(lens: Lens, recorded_size_px: tuple[int, int], max_side_px: int) -> "Normaliser":
        """Return the conversion of images of (width, height) pixels, shrunk so that no side exceeds `max_side_px`."""
        camera = Camera(lens.name, lens.K, lens.R, lens.t_m, *recorded_size_px)
        scale = max_side_px / max(recorded_size_px)
        if scale < 1:
            camera = camera.scaled(scale)
        maps = None
        if lens.distorts:
            rectify = cv2.fisheye.initUndistortRectifyMap if lens.fisheye else cv2.initUndistortRectifyMap
            maps = rectify(lens.K, lens.distortion, np.eye(3), lens.K, recorded_size_px, cv2.CV_16SC2)
        return Normaliser(lens, camera, recorded_size_px, maps)

    def pixels(self, recorded: np.ndarray) -> np.ndarray:
        """Return recorded pixels (H, W) or (H, W, 3) uint8 undistorted and shrunk."""
        if self.maps is not None:
            recorded = cv2.remap(recorded, *self.maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        if self.camera.size_px != self.recorded_size_px:
            recorded = cv2.resize(recorded, self.camera.size_px, interpolation=cv2.INTER_AREA)
        return recorded

    def keypoints(self, recorded: np.ndarray) -> np.ndarray:
        """Convert recorded keypoints (..., 3) x_px, y_px, confidence to the linear camera; points without
        confidence, and those outside the lens's valid image area, become zero."""
        if self.maps is not None:
            recorded = undistort_keypoints(recorded, self.lens)
        scale = np.array(self.camera.size_px) / self.recorded_size_px
        xy = recorded[..., :2] * scale + (scale - 1) / 2  # pixel centres at integers
        return np.concatenate([xy, recorded[..., 2:]], -1) * (recorded[..., 2:] > 0)

    def write_image(self, rgb: np.ndarray, source: Path, verbatim: Path | None, target: Path) -> None:
        """Write an image to `target` plus a suffix.

        The file `verbatim` itself is copied if `read_rgb` reads the same pixels from it, however it handles EXIF.
        Otherwise a JPEG of quality 95 without chroma subsampling is written: its error is far below that of the
        resampling, at a fifth of a PNG's size.
        """
        self._check_size(rgb, source)
        unchanged = self.maps is None and self.camera.size_px == self.recorded_size_px
        if verbatim and unchanged and _reads_as(verbatim, rgb):
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(verbatim, target.with_name(target.name + verbatim.suffix.lower()))
        else:
            write_image(target.with_name(f"{target.name}.jpg"), self.pixels(rgb))

    def write_mask(self, recorded: np.ndarray, soft: bool, source: Path, target: Path) -> None:
        """Write a mask (H, W) uint8 from file `source` as 0/255 PNG.

        The person is any level but black; if the camera's masks have soft edges, any light level.
        """
        self._check_size(recorded, source)
        black = 127 if soft else 0
        person = self.pixels(255 * (recorded > black).astype(np.uint8)) > 127
        write_image(target, 255 * person.astype(np.uint8))

    def _check_size(self, pixels: np.ndarray, source: Path) -> None:
        """Raise InputError unless pixels have the recorded size."""
        height_px, width_px = pixels.shape[:2]
        if (width_px, height_px) != self.recorded_size_px:
            raise InputError(
                f"{source}: is {width_px} x {height_px} px, but camera {self.lens.name} records "
                f"{self.recorded_size_px[0]} x {self.recorded_size_px[1]}; all images of a camera must have one size"
            )


def has_soft_edges(mask: np.ndarray, source: Path) -> bool:
    """Return whether a mask (H, W) uint8 from file `source` is a matte, comes from a JPEG, whose edges ring, or is
    antialiased: mostly white, and grey along lines rather than in the areas that labels fill."""
    pixels = np.bincount(mask.ravel(), minlength=256)
    if source.suffix.lower() in (".jpg", ".jpeg") or np.count_nonzero(pixels) > MAX_LABELS:
        return True
    if not 0 < pixels[1:255].sum() < pixels[255]:
        return False
    grey = ((mask > 0) & (mask < 255)).astype(np.uint8)
    areas = cv2.morphologyEx(grey, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    return bool(2 * np.count_nonzero(areas) < np.count_nonzero(grey))


def kept_share(lens: Lens, size_px: tuple[int, int]) -> float:
    """Return the share of an undistorted image of (width, height) pixels that the recorded image covers, from GRID x
    GRID samples."""
    return float(_inside(distort_points(_samples(size_px), lens), size_px).mean())


def lost_share(lens: Lens, size_px: tuple[int, int]) -> float:
    """Return the share of a recorded image of (width, height) pixels that is beyond the borders of the undistorted
    image, from GRID x GRID samples."""
    at_px = undistort_points(_samples(size_px), lens)  # NaN beyond the model
    return float(1 - _inside(at_px, size_px).mean())


def _samples(size_px: tuple[int, int]) -> np.ndarray:
    """Return the middles (N, 2), in pixels, of GRID x GRID equal parts of an image."""
    middles = (np.arange(GRID) + 0.5) / GRID
    return np.stack(np.meshgrid(*(side_px * middles - 0.5 for side_px in size_px)), -1).reshape(-1, 2)


def _inside(at_px: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
    """Return whether points (N, 2) are in an image of this size (N,)."""
    return np.all((at_px >= -0.5) & (at_px <= np.array(size_px) - 0.5), axis=1)


def _reads_as(path: Path, rgb: np.ndarray) -> bool:
    """Return whether `read_rgb` reads the same image from a file, up to the rounding of another decoder."""
    read = read_rgb(path)
    return read.shape == rgb.shape and cv2.norm(read, rgb, cv2.NORM_L1) < MAX_ROUNDING * rgb.size
