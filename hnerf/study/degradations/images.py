"""Degradations of the training cameras' images. Test cameras stay the same, so that scores can be compared.

Clean plates are degraded in the same way, since the same camera took them. Detections in the images (keypoints, hands,
landmarks, person masks) stay, unless pixels move or are hidden, and so do those of a board, which was filmed before.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from hnerf.capture.board_footage import BOARDS_FILE
from hnerf.capture.capture import PERSON, Capture, to_8_bit, write_image
from hnerf.capture.subset import PointChange, copy_pixels, require_several_cameras, subject_point, write_arrays

PixelChange = Callable[[str, np.ndarray], np.ndarray]


def add_noise(capture: Capture, levels: float, rng: np.random.Generator, out: Path) -> None:
    """Add independent Gaussian noise to every image. levels: its standard deviation, in levels of 255."""
    rewrite_images(capture, out, lambda _, rgb: to_8_bit(rgb + rng.normal(0, levels, rgb.shape)))


def blur(capture: Capture, percent: float, rng: np.random.Generator, out: Path) -> None:
    """Blur images with a Gaussian whose standard deviation is this percentage of their width."""
    rewrite_images(capture, out, lambda _, rgb: cv2.GaussianBlur(rgb, (0, 0), percent / 100 * rgb.shape[1]))


def vary_exposure(capture: Capture, power: float, rng: np.random.Generator, out: Path) -> None:
    """Multiply the encoded values of training cameras' images by gains from 2^-power to 2^power, evenly spaced in the
    exponent and assigned at random. Because of sRGB's gamma, a gain of 2 corresponds to 2.2 stops of light."""
    require_several_cameras(capture)
    names = rng.permutation(capture.train_cameras)
    gains = dict(zip(names.tolist(), 2 ** np.linspace(-power, power, len(names)), strict=True))
    rewrite_images(capture, out, lambda camera, rgb: to_8_bit(rgb * gains[camera]))


def resize(capture: Capture, scale: float, rng: np.random.Generator, out: Path) -> None:
    """Resize the training cameras' images and masks by a factor, together with the detections in them. Board footage is
    omitted."""
    cameras = capture.cameras | {
        name: camera.scaled(scale) for name, camera in capture.cameras.items() if name in capture.train_cameras
    }

    def resized(camera: str, pixels: np.ndarray) -> np.ndarray:
        shrinks = cameras[camera].width_px < pixels.shape[1]
        interpolation = cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC
        return cv2.resize(pixels, cameras[camera].size_px, interpolation=interpolation)

    def scaled(camera: str, points: np.ndarray) -> np.ndarray:
        scale = np.array(cameras[camera].size_px) / capture.cameras[camera].size_px
        xy = points[..., :2] * scale + (scale - 1) / 2  # pixel centres are at integers
        return np.concatenate([xy, points[..., 2:]], -1) * (points[..., 2:] > 0)  # unseen points stay zero

    rewrite_images(capture.with_cameras(cameras), out, resized, resized, scaled)
    (out / BOARDS_FILE).unlink(missing_ok=True)


def rewrite_images(
    capture: Capture,
    out: Path,
    change: PixelChange,
    change_mask: PixelChange = lambda _, mask: mask,
    change_points: PointChange = lambda _, points: points,
) -> None:
    """Copy a capture with changes. Every image and clean plate of its training cameras is changed by `change(camera,
    (H, W, 3) uint8)`, every given mask and detected person mask by `change_mask(camera, (H, W) uint8 from 0 to 255)`,
    and the points detected in any camera by `change_points(camera, (frames, ..., 3))`. Images are JPEG, as written by
    ingest."""
    kept = dataclasses.replace(capture, root=out, subject_point=subject_point(capture, capture, change_points))
    write_arrays(capture, kept, change_points)
    for name in capture.test_cameras:
        copy_pixels(capture, kept, name)
    for name in capture.train_cameras:
        for frame in capture.frames:
            write_image(out / "images" / name / f"{frame:06d}.jpg", change(name, capture.image(name, frame)))
            mask, likely = capture.given_mask(name, frame), capture.person_probability(name, frame)
            if mask is not None:
                grey = change_mask(name, np.where(mask, 255, 0).astype(np.uint8))
                write_image(out / "masks" / name / f"{frame:06d}.png", np.where(grey > 127, 255, 0).astype(np.uint8))
            if likely is not None:
                write_image(out / PERSON / name / f"{frame:06d}.png", change_mask(name, to_8_bit(255 * likely)))
        plate = capture.background(name)
        if plate is not None:
            write_image(out / "background" / f"{name}.jpg", change(name, plate))
    kept.save()
