"""A trained field on disk, no larger than what it learned: grids in 8 bits a feature, deflated, so that nodes that no
ray has touched, which are zero, take no room."""

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
)  # what becomes of a grid: a unit, and how many of it each feature is, a node's together
MAX_STEPS = 127  # of them


def write_field(field: nn.Module, path: Path) -> None:
    """All that the field has learned, as safetensors."""
    tensors = {name: value.detach().cpu().contiguous() for name, value in field.state_dict().items()}
    for name in _grids(field):
        features = tensors.pop(name)[0].movedim(0, -1)
        step = (features.abs().max() / MAX_STEPS).clamp(min=torch.finfo(features.dtype).tiny)
        steps = (features / step).round().to(torch.int8).contiguous()
        packed = bytearray(zlib.compress(steps.numpy().tobytes()))
        tensors |= {name + STEP_SUFFIX: step, name + STEPS_SUFFIX: torch.frombuffer(packed, dtype=torch.uint8)}
    path.write_bytes(save(tensors))  # as its own writer tells a full disk by no OSError


def load_field(field: nn.Module, tensors: dict[str, Tensor], path: Path) -> None:
    """Give the field what tensors read from `path` say; InputError if another version of it was written there."""
    tensors = dict(tensors)
    try:
        for name in _grids(field):
            _, channels, *nodes = field.get_parameter(name).shape
            packed, step = (tensors.pop(name + part) for part in (STEPS_SUFFIX, STEP_SUFFIX))
            room = channels * math.prod(nodes) + 1  # whatever the file pretends to hold
            steps = zlib.decompressobj().decompress(packed.cpu().numpy().tobytes(), room)
            features = torch.frombuffer(bytearray(steps), dtype=torch.int8).view(*nodes, channels).movedim(-1, 0)
            tensors[name] = features[None].to(step) * step
        field.load_state_dict(tensors)
    except (KeyError, RuntimeError, ValueError, zlib.error):
        raise version_error(path) from None


def version_error(path: Path) -> InputError:
    """The error of a file that another version of the library wrote."""
    return InputError(f"{path}: of another version; train the subject again")


def _grids(field: nn.Module) -> list[str]:
    grids = [(name, module) for name, module in field.named_modules() if isinstance(module, FeatureGrids)]
    return [f"{name}.levels.{level}" for name, module in grids for level in range(len(module.levels))]
