"""Common base of NeRF and IDR: a static scene in world coordinates."""

from abc import abstractmethod

import torch
from torch import Tensor

from hnerf.baselines.box import BoxField
from hnerf.body.canonical import PosedBodies
from hnerf.fields.conditions import Conditions


class StaticField(BoxField):
    """Field of a static scene; of the fitted body it uses only the box."""

    def signed_distance(self, bodies: PosedBodies, points_m: Tensor, conditions: Conditions) -> Tensor:
        """Return the signed distance (N,) in metres at points (N, 3), cut and closed by the box of the first body."""
        return torch.maximum(self.distance(points_m), self.box(bodies).signed_distance(points_m))

    @abstractmethod
    def distance(self, points_m: Tensor) -> Tensor:
        """Return the network's own signed distance (N,) in metres at points (N, 3) in the box."""
