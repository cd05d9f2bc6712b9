"""What a field says of a batch of rays."""

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class RaySamples:
    """What a model says of a batch of rays. (R, K) each: alpha of the radiance field, alpha_dot of the SDF, in_box b,
    d of the body, residual dd, gradient_norm |grad d_hat| (or a subset of samples, any shape); colour (R, K, 3);
    density (R, K) or None where the SDF itself is the density; beyond (R, 3): the colour behind the samples;
    elastic: energy of a deformation on rays that it knows of, or None where nothing is deformed."""

    alpha: Tensor
    alpha_dot: Tensor
    in_box: Tensor
    colour: Tensor
    density: Tensor | None
    d: Tensor
    residual: Tensor
    gradient_norm: Tensor
    background: Tensor
    elastic: Tensor | None = None

    @property
    def d_hat(self) -> Tensor:
        """Signed distance to the clothed person."""
        return self.d + self.residual
