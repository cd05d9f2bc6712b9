"""Common base of NeuralBody and Nerfies: a density field and a learned code per frame."""

from typing import Any

import torch
from torch import Tensor, nn

from hnerf.baselines.box import BoxField, box_samples
from hnerf.body.fit_result import BodyFit
from hnerf.fields.conditions import Conditions
from hnerf.fields.samples import RaySamples


class DynamicField(BoxField):
    """Field with a code per frame. Codes start at zero and stay zero for frames that are not trained on; a pose of no
    frame (Conditions.frame_row = -1) takes the zero code."""

    def __init__(self, body: BodyFit, samples: int, learning_rate: float, code_width: int):
        super().__init__(body, samples, learning_rate)
        self.codes = nn.Parameter(torch.zeros(len(body.frames), code_width))

    def code(self, conditions: Conditions) -> Tensor:
        """Return the codes by body row, (n, code_width)."""
        unseen = torch.zeros_like(self.codes[:1])
        return torch.cat([self.codes, unseen])[conditions.frame_row]  # -1 is the last row

    def to_samples(self, density: Tensor, colour: Tensor, depths_m: Tensor, far_m: Tensor, **extra: Any) -> RaySamples:
        """Build samples from density (R, K) and colour (R, K, 3) at depths (R, K); the last sample extends to the end
        of the box."""
        return box_samples(self.opacity(density, depths_m, far_m), colour, self.pseudo_distance(density), **extra)
