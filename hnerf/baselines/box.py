"""What all compared methods share: rays are sampled in the person's box, and in its coordinates."""

from typing import Any, Self

import torch
from torch import Tensor

from hnerf.body.canonical import PosedBodies
from hnerf.body.fit_result import BodyFit
from hnerf.fields.base import Field
from hnerf.fields.compositing import alpha_from_density
from hnerf.fields.conditions import Conditions
from hnerf.fields.shell import Boxes

SURFACE_DENSITY_PER_M = 20.0  # sigma_h of H-NeRF, 50 per scene unit of 2.5 m: where a surface is read off
BAND_M = 0.01  # bound of the distance that is read off


class BoxField(Field):
    """A field over the boxes of all poses, in coordinates that put their middle at 0 and the ends of the longest side
    at -1 and 1. Densities are per unit of these coordinates.

    The methods were published for a bounded object, a person cut out of the picture, or the whole scene; here the
    surroundings come from the clean plate, so rays are sampled in the person's box only, those of all pixels that see
    it. What the networks say outside the box was never trained, so the surface ends there.
    """

    centre_m: Tensor
    scale_m: Tensor

    @classmethod
    def build(cls, body: BodyFit, settings: Any, static: bool) -> Self:
        """Return an untrained field; those that model one moment are never given more."""
        return cls(body, settings)  # type: ignore[call-arg]  # as all that derive from this are constructed

    def __init__(self, body: BodyFit, samples: int, learning_rate: float):
        super().__init__()
        self.samples, self.learning_rate = samples, learning_rate
        boxes = Boxes.around(body.vertices_m(), self.margin_m)
        lower_m, upper_m = boxes.lower_m.amin(0), boxes.upper_m.amax(0)
        self.register_buffer("canonical_m", body.rig.vertices_m.clone())
        self.register_buffer("centre_m", (lower_m + upper_m) / 2)
        self.register_buffer("scale_m", (upper_m - lower_m).max() / 2)

    def box(self, bodies: PosedBodies) -> Boxes:
        """The box of each body."""
        return Boxes.around(bodies.vertices_m, self.margin_m)

    def region(self, bodies: PosedBodies, conditions: Conditions) -> Any:
        """The boxes."""
        return self.box(bodies)

    def parameter_groups(self) -> list[dict[str, Any]]:
        """One group."""
        return [{"params": list(self.parameters()), "lr": self.learning_rate}]

    def scaled(self, points_m: Tensor) -> Tensor:
        """World points in the boxes' coordinates."""
        return (points_m - self.centre_m) / self.scale_m

    def opacity(self, density: Tensor, depths_m: Tensor, far_m: Tensor) -> Tensor:
        """alpha (R, K) of densities at depths (R, K); the last sample reaches to the box's end (R,)."""
        return alpha_from_density(density, torch.diff(depths_m, dim=1, append=far_m[:, None]) / self.scale_m)

    def read_off(self, density: Tensor) -> Tensor:
        """BAND_M (sigma_h - sigma) / (sigma_h + sigma): zero where the density is sigma_h, negative where it is more,
        within BAND_M. Its sign and its zero set mean something; its size does not."""
        threshold = SURFACE_DENSITY_PER_M * self.scale_m
        return BAND_M * (threshold - density) / (threshold + density)


def along(origins_m: Tensor, directions: Tensor, depths_m: Tensor) -> Tensor:
    """Points (..., 3) at depths (...) of rays (..., 3)."""
    return origins_m + directions * depths_m[..., None]
