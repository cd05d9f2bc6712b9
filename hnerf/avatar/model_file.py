"""Storage of a trained field: feature grids in 8 bits per feature, deflated, so that nodes that no ray has touched,
which are zero, take no space."""

import math
import zlib
from pathlib import Path

import torch
from safetensors.torch import save
from torch import Tensor, nn

from hnerf.errors import InputError
from hnerf.fields.encoding import FeatureGrids

STEP_SUFFIX, STEPS_SUFFIX = (
    ".step",
    ".steps",
)  # of a grid's quantisation step and its features in steps
MAX_STEPS = 127  # of a feature, either sign


def write_field(field: nn.Module, path: Path) -> None:
    """Write all that the field has learned, as safetensors."""
    tensors = {name: value.detach().cpu().contiguous() for name, value in field.state_dict().items()}
    for name in _grids(field):
        features = tensors.pop(name)[0].movedim(0, -1)
        step = (features.abs().max() / MAX_STEPS).clamp(min=torch.finfo(features.dtype).tiny)
        steps = (features / step).round().to(torch.int8).contiguous()
        packed = bytearray(zlib.compress(steps.numpy().tobytes()))
        tensors |= {name + STEP_SUFFIX: step, name + STEPS_SUFFIX: torch.frombuffer(packed, dtype=torch.uint8)}
    path.write_bytes(save(tensors))  # safetensors' own writer raises no OSError on a full disk


def load_field(field: nn.Module, tensors: dict[str, Tensor], path: Path) -> None:
    """Load the field's state from tensors read from `path`. Raises InputError if another version wrote the file."""
    tensors = dict(tensors)
    try:
        for name in _grids(field):
            _, channels, *nodes = field.get_parameter(name).shape
            packed, step = (tensors.pop(name + part) for part in (STEPS_SUFFIX, STEP_SUFFIX))
            room = channels * math.prod(nodes) + 1  # bounds memory, whatever size the file claims
            steps = zlib.decompressobj().decompress(packed.cpu().numpy().tobytes(), room)
            features = torch.frombuffer(bytearray(steps), dtype=torch.int8).view(*nodes, channels).movedim(-1, 0)
            tensors[name] = features[None].to(step) * step
        field.load_state_dict(tensors)
    except (KeyError, RuntimeError, ValueError, zlib.error):
        raise version_error(path) from None


def version_error(path: Path) -> InputError:
    """Return the error for a file that another version of the library wrote."""
    return InputError(f"{path}: written by another version; train the subject again")


def _grids(field: nn.Module) -> list[str]:
    grids = [(name, module) for name, module in field.named_modules() if isinstance(module, FeatureGrids)]
    return [f"{name}.levels.{level}" for name, module in grids for level in range(len(module.levels))]
