"""What NeuralBody and Nerfies share: a density, and a learned code of each frame."""

from typing import Any

import torch
from torch import Tensor, nn

from hnerf.baselines.box import BoxField
from hnerf.body.fit_result import BodyFit
from hnerf.fields.conditions import Conditions
from hnerf.fields.samples import RaySamples


class DynamicField(BoxField):
    """Codes start at zero and stay there where a frame is not trained on; a pose that no frame has
    (Conditions.frame_row = -1) takes zero."""

    def __init__(self, body: BodyFit, samples: int, learning_rate: float, code_width: int):
        super().__init__(body, samples, learning_rate)
        self.codes = nn.Parameter(torch.zeros(len(body.frames), code_width))

    def code(self, conditions: Conditions) -> Tensor:
        """By body row, (n, code_width)."""
        unseen = torch.zeros_like(self.codes[:1])
        return torch.cat([self.codes, unseen])[conditions.frame_row]  # -1 is the last row

    def to_samples(self, density: Tensor, colour: Tensor, depths_m: Tensor, far_m: Tensor, **extra: Any) -> RaySamples:
        """Density (R, K) and colour (R, K, 3) at depths (R, K) as samples; the last one reaches to the box's end."""
        alpha, d = self.opacity(density, depths_m, far_m), self.pseudo_distance(density)
        return RaySamples(
            alpha=alpha,
            alpha_dot=alpha,
            in_box=torch.ones_like(d),
            colour=colour,
            density=None,
            d=d,
            residual=torch.zeros_like(d),
            gradient_norm=d.new_zeros(0),
            **extra,
        )
