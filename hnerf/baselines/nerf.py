"""NeRF (Mildenhall et al., Representing Scenes as Neural Radiance Fields for View Synthesis, ECCV 2020)."""

import torch
from torch import Tensor, nn

from hnerf.baselines.box import StaticField, box_samples
from hnerf.body.canonical import PosedBodies
from hnerf.body.fit_result import BodyFit
from hnerf.config import NerfSettings
from hnerf.fields.compositing import weights_from_alpha
from hnerf.fields.conditions import Conditions, Draws
from hnerf.fields.encoding import positional_encoding
from hnerf.fields.mlp import SkipMLP
from hnerf.fields.paper import sample_pdf
from hnerf.fields.rays import PosedScene, Rays
from hnerf.fields.samples import RaySamples
from hnerf.fields.shell import Boxes, stratified

LAYERS = 8
POSITION_OCTAVES, VIEW_OCTAVES = 10, 4
DENSITY_GAIN = 10.0  # an opaque surface has densities of tens to hundreds, out of reach of few steps otherwise


class NerfNetwork(nn.Module):
    """(gamma(x), gamma(v)) -> (sigma, c); density does not depend on the view (figure 7 of the paper)."""

    def __init__(self, width: int):
        super().__init__()
        self.trunk = SkipMLP(3 * (1 + 2 * POSITION_OCTAVES), width, LAYERS)
        self.density = nn.Linear(width, 1)
        view = 3 * (1 + 2 * VIEW_OCTAVES)
        self.colour = nn.Sequential(nn.Linear(width + view, width // 2), nn.SiLU(), nn.Linear(width // 2, 3))

    def forward(self, point: Tensor, view: Tensor) -> tuple[Tensor, Tensor]:
        """Map point in [-1, 1] and view, (..., 3) each, to density (...) per unit of the point's coordinates and colour
        (..., 3)."""
        features = self.trunk(positional_encoding(point, POSITION_OCTAVES))
        density = nn.functional.softplus(DENSITY_GAIN * self.density(features)[..., 0])
        encoded = positional_encoding(view, VIEW_OCTAVES)
        return density, torch.sigmoid(self.colour(torch.cat([features, encoded], -1)))


class NerfField(StaticField):
    """Static field: a coarse and a fine network, hierarchical sampling, view-dependent colour. Of the body it uses only
    the box.

    The first samples of a ray belong to the coarse network. Its opacity is `alpha_dot`, the fine network's is `alpha`;
    each is zero at the other network's samples. So the loss `reconstruction` measures the fine colour, and `blend` with
    eta = 1 the coarse one: the two terms of the paper's equation 6.

    Simplified: both terms are absolute errors, as for all compared methods, not squared ones; as many fine samples as
    coarse ones (64 and 128 in the paper); smaller networks, so that minutes on two CPU cores are meaningful (8 layers
    as published, `width` 256 in the paper); Swish as in H-NeRF instead of ReLU, which took several times as many steps
    to leave an empty box; softplus instead of ReLU for the density, which cannot die; without the linear layer
    between trunk and view, which the next one absorbs; rays end with the person's box, in front of the clean plate.
    """

    def __init__(self, body: BodyFit, settings: NerfSettings):
        super().__init__(body, settings)
        self.coarse, self.fine = NerfNetwork(settings.width), NerfNetwork(settings.width)

    def sample(self, scene: PosedScene[Boxes], rays: Rays, draws: Draws) -> tuple[RaySamples, Tensor]:
        """Evaluate rays as Field.sample does: `samples` of the coarse network, then twice as many of the fine one (K =
        3 x samples)."""
        near, far = scene.region.interval(rays)
        first = stratified(near, far, draws.jitter)
        first_alpha, first_density, first_colour = self._evaluate(self.coarse, rays, first, far)
        drawn = sample_pdf(first, near, far, weights_from_alpha(first_alpha.detach()), draws.fine)
        every = torch.cat([first, drawn], 1).sort(1).values
        alpha, density, colour = self._evaluate(self.fine, rays, every, far)
        samples = box_samples(
            alpha=torch.cat([torch.zeros_like(first_alpha), alpha], 1),
            alpha_dot=torch.cat([first_alpha, torch.zeros_like(alpha)], 1),
            colour=torch.cat([first_colour, colour], 1),
            d=self.pseudo_distance(torch.cat([first_density, density], 1)),
        )
        return samples, torch.cat([first, every], 1)

    def _evaluate(
        self, network: NerfNetwork, rays: Rays, depths_m: Tensor, far_m: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return alpha, density (R, K) and colour (R, K, 3) at depths (R, K); the last sample extends to the end of the
        box."""
        points = self.scaled(rays.points(depths_m))
        density, colour = network(points, rays.directions[:, None].expand_as(points))
        return self.opacity(density, depths_m, far_m), density, colour

    def distance(self, points_m: Tensor) -> Tensor:
        """Return the pseudo-distance (N,) to the fine network's surface of density sigma_h, bounded by BAND_M."""
        return self.pseudo_distance(self.fine(self.scaled(points_m), torch.zeros_like(points_m))[0])

    def colour(self, bodies: PosedBodies, points_m: Tensor, directions: Tensor, conditions: Conditions) -> Tensor:
        """Return c (N, 3) of the fine network at points (N, 3) seen along directions (N, 3)."""
        return self.fine(self.scaled(points_m), directions)[1]
