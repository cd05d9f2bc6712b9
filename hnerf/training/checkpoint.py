"""Checkpoints: written to a temporary file and renamed, read without unpickling anything but tensors."""

import hashlib
import logging
import os
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
import torch

from hnerf.body.fit_result import BodyFit
from hnerf.capture.capture import Capture
from hnerf.capture.masks import Masks
from hnerf.config import TrainingSettings
from hnerf.errors import one_line, printable

log = logging.getLogger("hnerf.training")

NAME = "checkpoint.pt"


def training_key(capture: Capture, masks: Masks, body: BodyFit, settings: TrainingSettings) -> str:
    """Return a digest of a training's inputs, which identifies its checkpoint. Of the images it covers only which ones
    there are, because the body was fitted to them."""
    digest = hashlib.sha256(f"{settings.key_values()} {capture.name} {capture.train_frames}".encode())
    for camera in capture.cameras.values():
        digest.update(f"{camera.name} {camera.width_px} {camera.height_px}".encode())
        for numbers in (camera.K, camera.R, camera.t_m):
            digest.update(np.ascontiguousarray(numbers, dtype=np.float64).tobytes())
        digest.update(bytes((camera.name, frame) in masks for frame in capture.frames))
    for tensor in (body.theta, body.root, body.rig.vertices_m):
        digest.update(tensor.cpu().numpy().tobytes())
    return digest.hexdigest()


def save_checkpoint(folder: Path, state: dict[str, Any]) -> None:
    """Replace the checkpoint in `folder` atomically. state: tensors, numbers, strings and containers of them."""
    beside = folder / f"{NAME}.tmp"  # the next write overwrites what a killed one leaves
    try:
        with beside.open("wb") as file:
            try:
                torch.save(state, file)
            except RuntimeError as error:  # raised by torch on closing an incomplete file, in place of the OSError
                raise (error.__context__ if isinstance(error.__context__, OSError) else error) from None
            file.flush()
            os.fsync(file.fileno())
        os.replace(beside, folder / NAME)
    finally:
        beside.unlink(missing_ok=True)  # on a full disk, the message that says so needs room, too


def load_checkpoint(folder: Path, device: torch.device, key: str) -> dict[str, Any] | None:
    """Load the last checkpoint of the training with this key. Return None if there is none or, with a warning, if it
    cannot be read or belongs to another training; the next write replaces it."""
    path = folder / NAME
    try:
        with ZipFile(path) as archive:  # torch reads tensors without checking their checksums
            if damaged := archive.testzip():
                raise ValueError(f"{damaged} has changed")
        state = torch.load(path, map_location=device, weights_only=True)
    except FileNotFoundError:
        return None
    except Exception as error:  # torch and its unpickler raise nearly anything on damage
        log.warning("%s: cannot be read (%s); the training starts again", path, printable(one_line(error)))
        return None
    if not isinstance(state, dict) or state.get("key") != key:
        log.warning("%s: is of another training; this one starts again", path)
        return None
    return state
