"""Samples of a field along a batch of rays."""

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class RaySamples:
    """A field evaluated along a batch of rays.

    (R, K) each: alpha of the radiance field, alpha_dot of the SDF, in_box b, d of the body, residual dd. gradient_norm:
    |grad d_hat| at some or all samples, any shape. colour (R, K, 3). density (R, K), None where the SDF itself is the
    density. background (R, 3): the colour behind the samples. elastic: deformation energy of the rays that have one,
    None without a deformation.
    """

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
        """Signed distance to the clothed person, (R, K)."""
        return self.d + self.residual
