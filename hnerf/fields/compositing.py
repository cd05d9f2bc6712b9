"""Volume rendering: from samples on rays to pixels."""

import torch
from jaxtyping import Float
from torch import Tensor


def alpha_from_density(density: Float[Tensor, "R K"], spacing: Float[Tensor, "R K"]) -> Float[Tensor, "R K"]:
    """Return alpha_i = 1 - exp(-sigma_i delta_i) (paper, eq. 2)."""
    return 1 - torch.exp(-density * spacing)


def occupancy(signed_distance: Float[Tensor, "*S"], sharpness: Float[Tensor, ""] | float) -> Float[Tensor, "*S"]:
    """Return alpha_dot = sigmoid(-gamma d_hat): 1 inside (docs/method.md, "Rendering and losses")."""
    return torch.sigmoid(-sharpness * signed_distance)


def alpha_from_sdf(signed_distance: Float[Tensor, "R K"], sharpness: Float[Tensor, ""]) -> Float[Tensor, "R K"]:
    """Return alpha_i = max(0, (Phi_i - Phi_{i+1}) / Phi_i), Phi = sigmoid(sharpness d) (NeuS, Wang et al. 2021, eq.
    13).

    Opacity then does not depend on the sampling density; a ray that passes the surface at distance d is covered by 1 -
    Phi(d). The last sample's alpha is 0.
    """
    log_phi = torch.nn.functional.logsigmoid(sharpness * signed_distance)
    alpha = 1 - torch.exp((log_phi[:, 1:] - log_phi[:, :-1]).clamp(max=0))
    return torch.cat([alpha, torch.zeros_like(signed_distance[:, :1])], 1)


def weights_from_alpha(alpha: Float[Tensor, "R K"]) -> Float[Tensor, "R K"]:
    """Return w_i = alpha_i prod_{j<i} (1 - alpha_j) (paper, eq. 1)."""
    before = torch.cat([torch.ones_like(alpha[:, :1]), 1 - alpha[:, :-1]], 1)
    return alpha * before.cumprod(1)


def composite(weights: Float[Tensor, "R K"], values: Float[Tensor, "R K C"]) -> Float[Tensor, "R C"]:
    """Return sum_i w_i values_i."""
    return (weights[..., None] * values).sum(1)
