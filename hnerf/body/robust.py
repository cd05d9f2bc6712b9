"""Least squares that let go of what is far off."""

from torch import Tensor


def geman_mcclure(squared: Tensor, sigma: float | Tensor, fades_at: float) -> tuple[Tensor, Tensor]:
    """Geman-McClure (1987): weights of the re-weighted least squares for squared residuals, and the costs, each of
    their shape. A residual well below `fades_at` costs half its square over sigma^2, one far beyond nearly
    fades_at^2 / (2 sigma^2)."""
    fade = 1 + squared / fades_at**2
    return (sigma * fade) ** -2, 0.5 * squared / sigma**2 / fade
