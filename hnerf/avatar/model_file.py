"""Storage of a trained field: feature grids in 8 bits per feature, deflated, so that nodes that no ray has touched,
which are zero, take no space."""

import zlib
from pathlib import Path

import torch
from safetensors.torch import save
from torch import Tensor, nn

from hnerf.errors import InputError
from hnerf.fields.sparse_grids import SparseGrids

STEP_SUFFIX, STEPS_SUFFIX = (".step", ".steps")  # of a grid's quantisation step and its features in steps
MAX_STEPS = 127  # of a feature, either sign


def write_field(field: nn.Module, path: Path) -> None:
    """Write all that the field has learned, as safetensors."""
    tensors = {name: value.detach().cpu().contiguous() for name, value in field.state_dict().items()}
    for name, grids in _grids(field):
        del tensors[f"{name}.features"]
        for level, features in enumerate(grids.dense_levels()):
            step = (features.abs().max() / MAX_STEPS).clamp(min=torch.finfo(features.dtype).tiny)
            steps = (features / step).round().to(torch.int8).cpu()
            packed = torch.frombuffer(bytearray(zlib.compress(steps.numpy().tobytes())), dtype=torch.uint8)
            key = f"{name}.levels.{level}"
            tensors |= {f"{key}{STEP_SUFFIX}": step.cpu(), f"{key}{STEPS_SUFFIX}": packed}
    path.write_bytes(save(tensors))  # safetensors' own writer raises no OSError on a full disk


def load_field(field: nn.Module, tensors: dict[str, Tensor], path: Path) -> None:
    """Load the field's state from tensors read from `path`. Raises InputError if another version wrote the file."""
    tensors = dict(tensors)
    try:
        for name, grids in _grids(field):
            levels = []
            for level, empty in enumerate(grids.dense_levels()):
                packed, step = (tensors.pop(f"{name}.levels.{level}{part}") for part in (STEPS_SUFFIX, STEP_SUFFIX))
                room = empty.numel() + 1  # bounds memory, whatever size the file claims
                steps = zlib.decompressobj().decompress(packed.cpu().numpy().tobytes(), room)
                levels.append(torch.frombuffer(bytearray(steps), dtype=torch.int8).view_as(empty).to(step) * step)
            grids.set_levels(levels)
            tensors[f"{name}.features"] = grids.features
        field.load_state_dict(tensors)
    except (KeyError, RuntimeError, ValueError, zlib.error):
        raise version_error(path) from None


def version_error(path: Path) -> InputError:
    """Return the error for a file that another version of the library wrote."""
    return InputError(f"{path}: written by another version; train the subject again")


def _grids(field: nn.Module) -> list[tuple[str, SparseGrids]]:
    return [(name, module) for name, module in field.named_modules() if isinstance(module, SparseGrids)]
