"""The losses (docs/method.md): H-NeRF's nine, and three more. Sums over rays are means over rays here, so that a
batch's size does not change the balance; sums over a ray's samples stay sums. Preset `paper` has the printed weights.
`inc` is no sum over rays, so it weighs more than in the paper; preset `print` corrects that (docs/method.md).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import relu, softplus

from hnerf.body.canonical import PoseCorrection
from hnerf.config import GeometryRoles
from hnerf.fields.compositing import composite, weights_from_alpha
from hnerf.fields.samples import RaySamples

EPSILON = 1e-6  # keeps logarithms finite


@dataclass(frozen=True)
class Target:
    """Target of a batch: the observed colour; person M; weight: 0 excludes a ray from the colour losses; background:
    the colour behind the samples."""

    colour: Float[Tensor, "R 3"]
    person: Float[Tensor, " R"]
    weight: Float[Tensor, " R"]
    background: Float[Tensor, "R 3"]


def pixel_colour(
    alpha: Float[Tensor, "R K"], samples: RaySamples, background: Float[Tensor, "R 3"]
) -> Float[Tensor, "R 3"]:
    """Return the composited colour for one choice of opacity, over the background."""
    weights = weights_from_alpha(alpha)
    return composite(weights, samples.colour) + (1 - weights.sum(1, keepdim=True)) * background


def box_colour(samples: RaySamples, background: Float[Tensor, "R 3"]) -> Float[Tensor, "R 3"]:
    """Return C~: the colour composited with b alpha."""
    return pixel_colour(samples.in_box * samples.alpha, samples, background)


def colour_errors(samples: RaySamples, target: Target) -> Float[Tensor, " R"]:
    """Return |C_gt - C|_1 of each ray; its mean over rays is rec."""
    return target.weight * (target.colour - pixel_colour(samples.alpha, samples, target.background)).abs().sum(1)


def mask(samples: RaySamples, target: Target) -> Float[Tensor, ""]:
    """Return mask: |M (C_gt - C~)|_1."""
    error = (target.colour - box_colour(samples, target.background)).abs().sum(1)
    return (target.weight * target.person * error).mean()


def fog(samples: RaySamples, target: Target) -> Float[Tensor, ""]:
    """Return fog: |(1 - M) C~|_1, for fields that model the background, since rec takes fog in the box for
    background."""
    return (target.weight * (1 - target.person) * box_colour(samples, target.background).sum(1)).mean()


def blend(samples: RaySamples, target: Target, eta: float) -> Float[Tensor, ""]:
    """Return blend: |M (C_gt - C^)|_1 + eta |(1 - M)(C_gt - C^)|_1, C^ composited with b alpha_dot + (1 - b) alpha."""
    alpha = samples.in_box * samples.alpha_dot + (1 - samples.in_box) * samples.alpha
    error = (target.colour - pixel_colour(alpha, samples, target.background)).abs().sum(1)
    return (target.weight * (target.person + eta * (1 - target.person)) * error).mean()


def geometry(
    samples: RaySamples, threshold: float, steepness: float, gamma: float, roles: GeometryRoles
) -> Float[Tensor, ""]:
    """Return geom: sum_i b_i BCE(sigmoid(lambda (sigma_i - sigma_h)), alpha_dot_i); 0 where the SDF is the density.

    roles: "print" takes the density as the label, because the paper's seg has the label first, and moves both; with
    "surface_leads" the density follows alpha_dot, which gets no gradient (docs/findings.md, "Published networks").
    """
    if samples.density is None:
        return samples.d.new_zeros(())
    opaque, occupied = steepness * (samples.density - threshold), -gamma * samples.d_hat  # before the sigmoid
    logit, label = (occupied, opaque.sigmoid()) if roles == "print" else (opaque, samples.alpha_dot.detach())
    return (samples.in_box * _cross_entropy(logit, label)).sum(1).mean()


def segmentation(distance: Float[Tensor, "R K"], target: Target, sharpness: float) -> Float[Tensor, ""]:
    """Return seg or fit: BCE(M, sigmoid(-gamma min_i d_i)) of distances: d_hat for seg, the body's d for fit."""
    return _cross_entropy(-sharpness * distance.amin(1), target.person).mean()


def _cross_entropy(logit: Tensor, label: Tensor) -> Tensor:
    """Return BCE(label, sigmoid(logit)). It is computed from the logit, so that the worst prediction has the full
    slope: dense fog thins out, and a person's pixel attracts a body however far away. NaN passes through, so that the
    step can be skipped."""
    return softplus(logit) - label * logit


def eikonal(samples: RaySamples) -> Float[Tensor, ""]:
    """Return eik: sum_i b_i (|grad_x d_hat| - 1)^2, given the norms inside the box."""
    return ((samples.gradient_norm - 1) ** 2).sum() / len(samples.d)


def residual(samples: RaySamples) -> Float[Tensor, ""]:
    """Return reg: |relu(dd)|_1. Clothing lies outside the skin, where d_hat < d."""
    return relu(samples.residual).sum(1).mean()


def increment(correction: PoseCorrection) -> Float[Tensor, ""]:
    """Return inc: |dbeta|_2 + mean_t |dtheta_t|_2."""
    turn, move_m, shape = correction.totals()
    return _norm(shape) + _norm(torch.cat([turn.flatten(1), move_m], 1)).mean()


def floor(d_hat: Float[Tensor, "R K"], height_m: Float[Tensor, "R K"]) -> Float[Tensor, ""]:
    """Return floor: sum_i relu(-d_hat_i) over samples below the ground, where nobody can be: masks include the shadow
    under a sole."""
    return (relu(-d_hat) * (height_m < 0)).sum(1).mean()


def elastic(samples: RaySamples) -> Float[Tensor, ""]:
    """Return the elastic energy of the deformation, mean over rays; 0 without a deformation."""
    energy = samples.d.new_zeros(1) if samples.elastic is None else samples.elastic
    return energy.sum() / len(samples.d)


def _norm(x: Tensor) -> Tensor:
    return (x.square().sum(-1) + EPSILON**2).sqrt()
