"""The encoding of a position by sines and cosines (Mildenhall et al. 2020)."""

import torch
from jaxtyping import Float
from torch import Tensor


def positional_encoding(x: Float[Tensor, "*S D"], octaves: int) -> Float[Tensor, "*S {x.shape[-1]*(1+2*octaves)}"]:
    """Encode positions: x, then sin and cos of 2^k pi x for k = 0 .. octaves - 1."""
    angles = x[..., None, :] * (torch.pi * 2.0 ** torch.arange(octaves, device=x.device, dtype=x.dtype))[:, None]
    return torch.cat([x, angles.sin().flatten(-2), angles.cos().flatten(-2)], -1)
