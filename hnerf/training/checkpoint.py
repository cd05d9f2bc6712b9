"""A training in progress on disk: written beside and renamed, read without unpickling anything but tensors."""

import os
from pathlib import Path
from typing import Any

import torch

NAME = "checkpoint.pt"


def save_checkpoint(folder: Path, state: dict[str, Any]) -> None:
    """Replace the checkpoint in `folder` atomically. state: tensors, numbers, strings and containers of them."""
    beside = folder / f"{NAME}.tmp"  # what an interrupted write leaves, the next one overwrites
    with beside.open("wb") as file:
        try:
            torch.save(state, file)
        except RuntimeError as error:  # torch's own, while it closes what could not be written
            raise (error.__context__ if isinstance(error.__context__, OSError) else error) from None
        file.flush()
        os.fsync(file.fileno())
    os.replace(beside, folder / NAME)


def remove_checkpoint(folder: Path) -> None:
    """Of a training whose files are safe; and what an interrupted write left."""
    for path in folder.glob(f"{NAME}*"):
        path.unlink()


def load_checkpoint(folder: Path, device: torch.device) -> dict[str, Any] | None:
    """The last checkpoint, or None where there is none."""
    path = folder / NAME
    return torch.load(path, map_location=device, weights_only=True) if path.exists() else None
