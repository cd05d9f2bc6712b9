"""The networks of the paper: F, eight layers of 256, and DH, six of 128; Swish, a skip connection to the middle."""

from collections.abc import Callable
from contextlib import nullcontext

import torch
from torch import Tensor, nn

from hnerf.fields.encoding import positional_encoding


class SkipMLP(nn.Module):
    """`layers` linear layers of `width`, Swish unless said otherwise; the input is fed again into the middle one.

    bf16: multiply, and keep what lies between the layers, in bfloat16, for half the memory and less time on processors
    that can.
    """

    def __init__(
        self,
        inputs: int,
        width: int,
        layers: int,
        activation: Callable[[Tensor], Tensor] = nn.functional.silu,
        bf16: bool = False,
    ):
        super().__init__()
        self.activation, self.bf16 = activation, bf16
        self.middle = layers // 2
        sizes = [inputs] + [width] * (layers - 1)
        sizes[self.middle] += inputs
        self.layers = nn.ModuleList(nn.Linear(size, width) for size in sizes)

    def init_kaiming(self) -> None:
        """Draw weights as He et al. (2015) do, biases zero: torch's own start leaves the output of eight layers nearly
        constant over space."""
        for layer in self.layers:
            assert isinstance(layer, nn.Linear)
            nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu")
            nn.init.zeros_(layer.bias)

    def forward(self, x: Tensor) -> Tensor:
        """(N, inputs) to (N, width)."""
        h, kind = x, x.device.type
        # not cached: threads share the cache, where one without gradients would leave weights cast for all
        with torch.autocast(kind, torch.bfloat16, cache_enabled=False) if self.bf16 else nullcontext():
            for k, layer in enumerate(self.layers):
                h = self.activation(layer(torch.cat([h, x], -1) if k == self.middle else h))
        return h.to(x.dtype)


class RadianceMLP(nn.Module):
    """F: (PE8(s, d), theta, T, v) -> (sigma, c). Density sees theta alone; colour also T and v, encoded with
    `view_octaves`."""

    OCTAVES = 8

    def __init__(
        self, point_inputs: int, pose_inputs: int, root_inputs: int, view_octaves: int = 0, bf16: bool = False
    ):
        super().__init__()
        self.view_octaves = view_octaves
        encoded = point_inputs * (1 + 2 * self.OCTAVES)
        self.trunk = SkipMLP(encoded + pose_inputs, 256, 8, bf16=bf16)
        self.trunk.init_kaiming()
        self.density = nn.Linear(256, 1)
        seen = root_inputs + 3 * (1 + 2 * view_octaves)
        self.colour = nn.Sequential(nn.Linear(256 + seen, 128), nn.SiLU(), nn.Linear(128, 3))

    def forward(self, point: Tensor, pose: Tensor, root: Tensor, view: Tensor) -> tuple[Tensor, Tensor]:
        """point (N, D) in scene units, pose (N, P), root (N, Q), view (N, 3): density (N,) per scene unit, colour (N,
        3)."""
        features = self.trunk(torch.cat([positional_encoding(point, self.OCTAVES), pose], -1))
        density = nn.functional.softplus(self.density(features)[:, 0])
        seen = positional_encoding(view, self.view_octaves)
        return density, torch.sigmoid(self.colour(torch.cat([features, root, seen], -1)))


class ResidualMLP(nn.Module):
    """DH: (PE1(s, d), theta) -> dd. The last layer starts at zero, so training starts from the body."""

    OCTAVES = 1

    def __init__(self, point_inputs: int, pose_inputs: int, bf16: bool = False):
        super().__init__()
        self.trunk = SkipMLP(point_inputs * (1 + 2 * self.OCTAVES) + pose_inputs, 128, 6, bf16=bf16)
        self.residual = nn.Linear(128, 1)
        nn.init.zeros_(self.residual.weight)
        nn.init.zeros_(self.residual.bias)

    def forward(self, point: Tensor, pose: Tensor) -> Tensor:
        """point (N, D), pose (N, P): dd (N,) in scene units."""
        return self.residual(self.trunk(torch.cat([positional_encoding(point, self.OCTAVES), pose], -1)))[:, 0]
