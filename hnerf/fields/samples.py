"""Samples of a field along a batch of rays."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class RaySamples:
    """A field evaluated along a batch of rays.

    alpha of the radiance field, alpha_dot of the SDF, in_box b, d of the body, residual dd. density: None if the SDF
    itself is the density. gradient_norm: |grad d_hat| at some or all samples. elastic: deformation energy of the rays
    that have one, None without a deformation. surface_m: depths of the surfaces whose colours the samples show, None if
    these are their own.
    """

    alpha: Float[Tensor, "R K"]
    alpha_dot: Float[Tensor, "R K"]
    in_box: Float[Tensor, "R K"]
    colour: Float[Tensor, "R K 3"]
    density: Float[Tensor, "R K"] | None
    d: Float[Tensor, "R K"]
    residual: Float[Tensor, "R K"]
    gradient_norm: Float[Tensor, "..."]
    elastic: Float[Tensor, " E"] | None = None
    surface_m: Float[Tensor, "R K"] | None = None

    @property
    def d_hat(self) -> Float[Tensor, "R K"]:
        """Return the signed distance to the clothed person."""
        return self.d + self.residual
