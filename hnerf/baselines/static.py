"""What NeRF and IDR share: they model one moment, in the world."""

from abc import abstractmethod

import torch
from torch import Tensor

from hnerf.baselines.box import BoxField
from hnerf.body.canonical import PosedBodies
from hnerf.fields.conditions import Conditions


class StaticField(BoxField):
    """The box is all that it learns of the fitted body."""

    def signed_distance(self, bodies: PosedBodies, points_m: Tensor, conditions: Conditions) -> Tensor:
        """Of what is inside the box of the first body, (N,) metres at points (N, 3); the box cuts and closes it."""
        return torch.maximum(self.distance(points_m), self.box(bodies).signed_distance(points_m))

    @abstractmethod
    def distance(self, points_m: Tensor) -> Tensor:
        """The network's own signed distance (N,) metres, at points (N, 3) of the box."""
