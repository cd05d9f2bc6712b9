"""A trained field on disk, no larger than what it learned: a grid's nodes that no ray has touched are zero and left
out, the others are stored in half precision."""

from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save
from torch import Tensor, nn

from hnerf.errors import CaptureError
from hnerf.field.encoding import FeatureGrids

TOUCHED, FEATURES = ".touched", ".features"  # what becomes of a grid: a bit a node, (n, C) of those that are set


def write_field(field: nn.Module, path: Path) -> None:
    """All that the field has learned, as safetensors."""
    tensors = {name: value.detach().cpu().contiguous() for name, value in field.state_dict().items()}
    for name in _grids(field):
        features = tensors.pop(name)[0].flatten(1).T
        touched = features.any(1)
        tensors[name + TOUCHED] = torch.from_numpy(np.packbits(touched.numpy()))
        tensors[name + FEATURES] = features[touched].half().contiguous()
    path.write_bytes(save(tensors))  # as its own writer tells a full disk by no OSError


def fill_field(field: nn.Module, tensors: dict[str, Tensor], path: Path) -> None:
    """Give the field what tensors read from `path` say; CaptureError if another version of it was written there."""
    tensors = dict(tensors)
    try:
        for name in _grids(field):
            grid = torch.zeros_like(field.get_parameter(name))
            nodes = grid[0].flatten(1)
            touched = np.unpackbits(tensors.pop(name + TOUCHED).cpu().numpy(), count=nodes.shape[1]).astype(bool)
            nodes[:, torch.from_numpy(touched).to(nodes.device)] = tensors.pop(name + FEATURES).float().T
            tensors[name] = grid
        field.load_state_dict(tensors)
    except (KeyError, RuntimeError):
        raise other_version(path) from None


def other_version(path: Path) -> CaptureError:
    """The error of a file that another version of the library wrote."""
    return CaptureError(f"{path}: of another version; train the subject again")


def _grids(field: nn.Module) -> list[str]:
    grids = [(name, module) for name, module in field.named_modules() if isinstance(module, FeatureGrids)]
    return [f"{name}.levels.{level}" for name, module in grids for level in range(len(module.levels))]
