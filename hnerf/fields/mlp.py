"""The networks of the paper: F with eight layers of 256, DH with six of 128; Swish, with a skip connection to the
middle."""

from collections.abc import Callable

import torch
from torch import Tensor, nn

from hnerf.fields.encoding import positional_encoding

MULTIPLE = 8  # of a matrix's rows in bfloat16: tensor cores process other sizes at a fraction of their speed


class SkipMLP(nn.Module):
    """MLP of `layers` linear layers of `width`, with Swish by default; the input is fed again into the middle layer.

    bf16: compute, store and return activations in bfloat16, for half the memory and less time on processors that
    support it.
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
        """Initialise weights as in He et al. (2015), biases to zero: torch's default leaves the output of eight layers
        nearly constant over space."""
        for layer in self.layers:
            assert isinstance(layer, nn.Linear)
            nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu")
            nn.init.zeros_(layer.bias)

    def forward(self, x: Tensor) -> Tensor:
        """Map (..., inputs) to (..., width)."""
        if self.bf16:
            x = pad_columns(x).bfloat16()
        h = x
        for k, layer in enumerate(self.layers):
            h = self.activation(linear(layer, torch.cat([h, x], -1) if k == self.middle else h))
        return h


def linear(layer: nn.Module, x: Tensor) -> Tensor:
    """Return a linear layer's output in the type of x; x (..., inputs) may have columns of zeros beyond the inputs."""
    assert isinstance(layer, nn.Linear)
    beyond = x.shape[-1] - layer.in_features
    weight = nn.functional.pad(layer.weight, (0, beyond)) if beyond else layer.weight
    return nn.functional.linear(x, weight.to(x.dtype), layer.bias.to(x.dtype))


def pad_columns(x: Tensor) -> Tensor:
    """Return x (..., inputs) with columns of zeros up to a multiple of MULTIPLE."""
    return nn.functional.pad(x, (0, -x.shape[-1] % MULTIPLE))


class RadianceMLP(nn.Module):
    """F: (PE8(s, d), theta, T, v) -> (sigma, c). Density depends on theta only; colour also on T and v, encoded with
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
        """Map point (N, D) in scene units, pose (N, P), root (N, Q) and view (N, 3) to density (N,) per scene unit and
        colour (N, 3)."""
        features = self.trunk(torch.cat([positional_encoding(point, self.OCTAVES), pose], -1))
        density = nn.functional.softplus(self.density(features.to(point.dtype))[:, 0])
        seen = torch.cat([root, positional_encoding(view, self.view_octaves)], -1).to(features.dtype)
        hidden, activation, last = self.colour
        inputs = torch.cat([features, seen], -1)
        shaded = activation(linear(hidden, pad_columns(inputs) if self.trunk.bf16 else inputs))
        return density, torch.sigmoid(last(shaded.to(point.dtype)))


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
        """Map point (N, D) and pose (N, P) to dd (N,) in scene units."""
        features = self.trunk(torch.cat([positional_encoding(point, self.OCTAVES), pose], -1))
        return self.residual(features.to(point.dtype))[:, 0]
