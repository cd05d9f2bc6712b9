"""Common base classes of the compared methods: rays are sampled in the person's box, and in its coordinates."""

from abc import abstractmethod
from typing import Any

import torch
from torch import Tensor, nn

from hnerf.body.canonical import PosedBodies
from hnerf.body.fit_result import BodyFit
from hnerf.fields.base import Field
from hnerf.fields.compositing import alpha_from_density
from hnerf.fields.conditions import Conditions
from hnerf.fields.samples import RaySamples
from hnerf.fields.shell import Boxes

SURFACE_DENSITY_PER_M = 20.0  # density of the surface: sigma_h of H-NeRF, 50 per scene unit of 2.5 m
BAND_M = 0.01  # bound of the pseudo-distance


class BoxField(Field):
    """Field over the boxes of all poses, in coordinates with their centre at 0 and the ends of their longest side at -1
    and 1. Densities are per unit of these coordinates.

    The methods were published for a bounded object, a person cut out of the image, or a whole scene; here the
    background comes from the clean plate, so rays are sampled in the person's box only. Training draws rays from all
    pixels that see the box, more of them where colours are wrong, as for H-NeRF's preset `fast`. Outside the box the
    networks were never trained, so the surface ends there.
    """

    centre_m: Tensor
    scale_m: Tensor

    def __init__(self, body: BodyFit, settings: Any):
        super().__init__()
        self.settings, self.samples = settings, settings.samples
        boxes = Boxes.around(body.vertices_m(), self.margin_m)
        lower_m, upper_m = boxes.lower_m.amin(0), boxes.upper_m.amax(0)
        self.register_buffer("canonical_m", body.rig.vertices_m.clone())
        self.register_buffer("centre_m", (lower_m + upper_m) / 2)
        self.register_buffer("scale_m", (upper_m - lower_m).max() / 2)

    def scaled(self, points_m: Tensor) -> Tensor:
        """Transform world points to box coordinates."""
        return (points_m - self.centre_m) / self.scale_m

    def opacity(self, density: Tensor, depths_m: Tensor, far_m: Tensor) -> Tensor:
        """Return alpha (R, K) of densities at depths (R, K); the last sample extends to the end of the box, far_m
        (R,)."""
        return alpha_from_density(density, torch.diff(depths_m, dim=1, append=far_m[:, None]) / self.scale_m)

    def pseudo_distance(self, density: Tensor) -> Tensor:
        """Return BAND_M (sigma_h - sigma) / (sigma_h + sigma): zero where the density is sigma_h, negative where it is
        larger, within BAND_M. Only its sign and its zero set are meaningful, not its size."""
        threshold = SURFACE_DENSITY_PER_M * self.scale_m
        return BAND_M * (threshold - density) / (threshold + density)


class StaticField(BoxField):
    """Base of NeRF and IDR: a static scene in world coordinates; of the fitted body it uses only the box."""

    def signed_distance(self, bodies: PosedBodies, points_m: Tensor, conditions: Conditions) -> Tensor:
        """Return the signed distance (N,) in metres at points (N, 3), cut and closed by the box of the first body."""
        return torch.maximum(self.distance(points_m), self.region(bodies, conditions).signed_distance(points_m))

    @abstractmethod
    def distance(self, points_m: Tensor) -> Tensor:
        """Return the network's own signed distance (N,) in metres at points (N, 3) in the box."""


class DynamicField(BoxField):
    """Base of NeuralBody and Nerfies: a density field and a learned code per frame. Codes start at zero and stay zero
    for frames that are not trained on; a pose that belongs to no frame (Conditions.frame_row = -1) takes the zero
    code."""

    def __init__(self, body: BodyFit, settings: Any, code_width: int):
        super().__init__(body, settings)
        self.codes = nn.Parameter(torch.zeros(len(body.frames), code_width))

    def code(self, conditions: Conditions) -> Tensor:
        """Return the codes by body row, (n, code_width)."""
        unseen = torch.zeros_like(self.codes[:1])
        return torch.cat([self.codes, unseen])[conditions.frame_row]  # -1 is the last row

    def to_samples(self, density: Tensor, colour: Tensor, depths_m: Tensor, far_m: Tensor) -> RaySamples:
        """Build samples from density (R, K) and colour (R, K, 3) at depths (R, K); the last sample extends to the end
        of the box."""
        return box_samples(self.opacity(density, depths_m, far_m), colour, self.pseudo_distance(density))


def box_samples(alpha: Tensor, colour: Tensor, d: Tensor, **given: Any) -> RaySamples:
    """Return the samples of a field that knows no body: all in the box, with a single opacity, no residual and no
    gradients, unless these are given."""
    known = {"alpha_dot": alpha, "in_box": torch.ones_like(d), "density": None, "residual": torch.zeros_like(d)}
    return RaySamples(alpha=alpha, colour=colour, d=d, **(known | {"gradient_norm": d.new_zeros(0)} | given))
