"""What NeuralBody and Nerfies share: a density in the person's box, and a learned code of each frame."""

from typing import Any

import torch
from torch import Tensor, nn

from hnerf.baselines.nerf import BAND_M, SURFACE_DENSITY_PER_M
from hnerf.baselines.static import Boxes
from hnerf.body.canonical import PosedBodies
from hnerf.body.fit_result import BodyFit
from hnerf.render.compositing import alpha_from_density
from hnerf.training.conditions import Conditions
from hnerf.training.field import Field
from hnerf.training.losses import RaySamples


class DynamicField(Field):
    """A field over the boxes of all poses, in coordinates that put their middle at 0 and the ends of the longest side
    at -1 and 1. Densities are per unit of these coordinates.

    Both methods were published for a person cut out of the picture or for the whole scene; here the surroundings come
    from the clean plate, so rays are sampled in the person's box only. What the networks say outside the box was never
    trained, so the surface ends there. Codes start at zero and stay there where a frame is not trained on; a pose that
    no frame has (Conditions.moment = -1) takes zero.
    """

    centre_m: Tensor
    scale_m: Tensor

    def __init__(self, body: BodyFit, box_margin_m: float, samples: int, code_width: int):
        super().__init__()
        self.box_margin_m, self.samples = box_margin_m, samples
        boxes = Boxes.around(body.vertices_m(), box_margin_m)
        lower_m, upper_m = boxes.lower_m.amin(0), boxes.upper_m.amax(0)
        self.register_buffer("canonical_m", body.rig.vertices_m.clone())
        self.register_buffer("centre_m", (lower_m + upper_m) / 2)
        self.register_buffer("scale_m", (upper_m - lower_m).max() / 2)
        self.codes = nn.Parameter(torch.zeros(len(body.frames), code_width))

    def box(self, bodies: PosedBodies) -> Boxes:
        """The box of each body."""
        return Boxes.around(bodies.vertices_m, self.box_margin_m)

    def code(self, conditions: Conditions) -> Tensor:
        """By body row, (n, code_width)."""
        nobody = torch.zeros_like(self.codes[:1])
        return torch.cat([self.codes, nobody])[conditions.moment]  # -1 is the last row

    def scaled(self, points_m: Tensor) -> Tensor:
        """World points in the boxes' coordinates."""
        return (points_m - self.centre_m) / self.scale_m

    def read_off(self, density: Tensor) -> Tensor:
        """BAND_M (sigma_h - sigma) / (sigma_h + sigma), as of NerfField: its sign and its zero set mean something, its
        size does not."""
        threshold = SURFACE_DENSITY_PER_M * self.scale_m
        return BAND_M * (threshold - density) / (threshold + density)

    def seen(self, density: Tensor, colour: Tensor, depths_m: Tensor, far_m: Tensor, **more: Any) -> RaySamples:
        """Density (R, K) and colour (R, K, 3) at depths (R, K) as samples; the last one reaches to the box's end."""
        spacing = torch.diff(depths_m, dim=1, append=far_m[:, None]) / self.scale_m
        alpha, d = alpha_from_density(density, spacing), self.read_off(density)
        return RaySamples(
            alpha=alpha,
            alpha_dot=alpha,
            in_box=torch.ones_like(d),
            colour=colour,
            density=None,
            d=d,
            residual=torch.zeros_like(d),
            gradient_norm=d.new_zeros(0),
            **more,
        )
