"""Checkpoints: written to a temporary file and renamed, read without unpickling anything but tensors."""

import os
from pathlib import Path
from typing import Any

import torch

NAME = "checkpoint.pt"


def save_checkpoint(folder: Path, state: dict[str, Any]) -> None:
    """Replace the checkpoint in `folder` atomically. state: tensors, numbers, strings and containers of them."""
    beside = folder / f"{NAME}.tmp"  # the next write overwrites what an interrupted one leaves
    with beside.open("wb") as file:
        try:
            torch.save(state, file)
        except RuntimeError as error:  # raised by torch on closing an incomplete file, in place of the OSError
            raise (error.__context__ if isinstance(error.__context__, OSError) else error) from None
        file.flush()
        os.fsync(file.fileno())
    os.replace(beside, folder / NAME)


def remove_checkpoint(folder: Path) -> None:
    """Delete the checkpoint, and what an interrupted write left, once the final files have been written."""
    for path in folder.glob(f"{NAME}*"):
        path.unlink()


def load_checkpoint(folder: Path, device: torch.device) -> dict[str, Any] | None:
    """Load the last checkpoint; None if there is none."""
    path = folder / NAME
    return torch.load(path, map_location=device, weights_only=True) if path.exists() else None
