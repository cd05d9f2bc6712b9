"""Robust least squares."""

from torch import Tensor


def geman_mcclure(squared: Tensor, sigma: float | Tensor, outlier: float | Tensor) -> tuple[Tensor, Tensor]:
    """Return Geman-McClure (1987) weights of re-weighted least squares for squared residuals, and the costs, both of
    the residuals' shape.

    A residual well below `outlier` costs half its square over sigma^2, one far beyond nearly outlier^2 / (2 sigma^2).
    """
    falloff = 1 + squared / outlier**2
    return (sigma * falloff) ** -2, 0.5 * squared / sigma**2 / falloff
