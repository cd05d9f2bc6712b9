"""Degradations of the training cameras' images. Test cameras stay as they are, so that scores can be compared.

Clean plates are degraded likewise, since the same camera took them; keypoints stay, unless pixels move.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from hnerf.capture.capture import Capture, write_image
from hnerf.capture.subset import copy_pixels, read_keypoints, require_several_cameras, write_arrays, write_keypoints
from hnerf.geometry.camera import Camera

PixelChange = Callable[[str, np.ndarray], np.ndarray]


def add_noise(capture: Capture, levels: float, rng: np.random.Generator, out: Path) -> None:
    """Add Gaussian noise of this standard deviation, in levels of 255, independently to every image."""
    rewrite_images(capture, out, lambda _, rgb: _to_8_bit(rgb + rng.normal(0, levels, rgb.shape)))


def blur(capture: Capture, percent: float, rng: np.random.Generator, out: Path) -> None:
    """Blur images by a Gaussian whose standard deviation is this percentage of their width."""
    rewrite_images(capture, out, lambda _, rgb: cv2.GaussianBlur(rgb, (0, 0), percent / 100 * rgb.shape[1]))


def vary_exposure(capture: Capture, stops: float, rng: np.random.Generator, out: Path) -> None:
    """Multiply training cameras' images by gains from 2^-stops to 2^stops, evenly spaced in stops and assigned at
    random."""
    require_several_cameras(capture)
    names = rng.permutation(capture.train_cameras)
    gains = dict(zip(names.tolist(), 2 ** np.linspace(-stops, stops, len(names)), strict=True))
    rewrite_images(capture, out, lambda camera, rgb: _to_8_bit(rgb * gains[camera]))


def resize(capture: Capture, scale: float, rng: np.random.Generator, out: Path) -> None:
    """Resize training cameras' images, keypoints and given masks by a factor. Board footage is omitted."""
    cameras = {name: capture.cameras[name] for name in capture.train_cameras}
    small = {name: c.resized(*(max(1, round(scale * px)) for px in (c.width_px, c.height_px)))
             for name, c in cameras.items()}  # fmt: skip

    def resized(camera: str, pixels: np.ndarray) -> np.ndarray:
        return _resized(pixels, small[camera])

    rewrite_images(capture.with_cameras(capture.cameras | small), out, resized, resized)
    keypoints = read_keypoints(capture)
    for name in set(keypoints) & set(small):
        keypoints[name] = _scaled_keypoints(keypoints[name], cameras[name], small[name])
    write_keypoints(out, keypoints)


def rewrite_images(
    capture: Capture, out: Path, change: PixelChange, change_mask: PixelChange = lambda _, mask: mask
) -> None:
    """Copy a capture, changing every image and clean plate of its training cameras by `change(camera, (H, W, 3)
    uint8)`, and every given mask by `change_mask(camera, (H, W) uint8 of 0 and 255)`. Images are JPEG, as written by
    ingest."""
    kept = dataclasses.replace(capture, root=out)
    write_arrays(capture, kept)
    for name in capture.test_cameras:
        copy_pixels(capture, kept, name)
    for name in capture.train_cameras:
        for frame in capture.frames:
            write_image(out / "images" / name / f"{frame:06d}.jpg", change(name, capture.image(name, frame)))
            mask = capture.given_mask(name, frame)
            if mask is not None:
                grey = change_mask(name, np.where(mask, 255, 0).astype(np.uint8))
                write_image(out / "masks" / name / f"{frame:06d}.png", np.where(grey > 127, 255, 0).astype(np.uint8))
        plate = capture.background(name)
        if plate is not None:
            write_image(out / "background" / f"{name}.jpg", change(name, plate))
    kept.save()


def _resized(pixels: np.ndarray, camera: Camera) -> np.ndarray:
    size_px = camera.width_px, camera.height_px
    shrinks = size_px[0] < pixels.shape[1]
    return cv2.resize(pixels, size_px, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)


def _scaled_keypoints(keypoints: np.ndarray, old: Camera, new: Camera) -> np.ndarray:
    """Scale keypoints (..., 3) to another image size, pixel centres at integers; those of zero confidence stay zero."""
    scale = np.array([new.width_px / old.width_px, new.height_px / old.height_px])
    xy = keypoints[..., :2] * scale + (scale - 1) / 2
    return np.concatenate([xy, keypoints[..., 2:]], -1) * (keypoints[..., 2:] > 0)


def _to_8_bit(rgb: np.ndarray) -> np.ndarray:
    return rgb.round().clip(0, 255).astype(np.uint8)
