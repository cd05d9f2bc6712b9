"""Degradations of the camera rig: fewer cameras or frames, one camera rotated, or one camera delayed."""

import dataclasses
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np

from hnerf.capture.capture import Capture
from hnerf.capture.subset import copy_pixels, require_several_cameras, subject_point, subset, write_arrays
from hnerf.errors import NotApplicableError

T = TypeVar("T")


def keep_cameras(capture: Capture, count: float, rng: np.random.Generator, out: Path) -> None:
    """Keep `count` training cameras, drawn at random. Raises NotApplicableError if there are no more than `count`."""
    subset(capture, out, _random_subset(capture.name, "cameras", capture.train_cameras, count, rng))


def keep_frames(capture: Capture, count: float, rng: np.random.Generator, out: Path) -> None:
    """Keep `count` training frames, drawn at random. Raises NotApplicableError if there are no more than `count`."""
    kept = _random_subset(capture.name, "frames", capture.train_frames, count, rng)
    subset(capture, out, train_frames=kept)


def rotate_camera(capture: Capture, angle_deg: float, rng: np.random.Generator, out: Path) -> None:
    """Rotate the extrinsics of one training camera about its centre and a random axis; its images stay the same."""
    require_several_cameras(capture)
    camera = capture.cameras[str(rng.choice(capture.train_cameras))]
    axis = rng.normal(size=3)
    turn = cv2.Rodrigues(np.deg2rad(angle_deg) * axis / np.linalg.norm(axis))[0]
    turned = dataclasses.replace(camera, R=turn @ camera.R, t_m=turn @ camera.t_m)
    subset(capture.with_cameras(capture.cameras | {camera.name: turned}), out)


def delay_camera(capture: Capture, frames: float, rng: np.random.Generator, out: Path) -> None:
    """Delay one random training camera: at each frame it shows its image of `frames` frames earlier, or its first image
    if there is none. Masks and detections are delayed with the image."""
    if not 1 <= round(frames) < len(capture.frames):
        raise NotApplicableError(f"{capture.name}: has {len(capture.frames)} frames; none can be delayed by {frames:g}")
    require_several_cameras(capture)
    late = str(rng.choice(capture.train_cameras))
    rows = np.maximum(np.arange(len(capture.frames)) - round(frames), 0)
    shown = {late: tuple(capture.frames[row] for row in rows)}
    named = subject_point(capture, capture, lambda name, points: points[rows] if name == late else points)
    kept = dataclasses.replace(capture, root=out, subject_point=named)
    write_arrays(capture, kept, shown=shown)
    for name in capture.cameras:
        copy_pixels(capture, kept, name, shown.get(name))
    kept.save()


def _random_subset(
    name: str, what: str, available: tuple[T, ...], count: float, rng: np.random.Generator
) -> tuple[T, ...]:
    if count >= len(available):
        raise NotApplicableError(f"{name}: has only {len(available)} training {what}; keep fewer than that")
    rows = np.sort(rng.permutation(len(available))[: round(count)])
    return tuple(available[row] for row in rows)
