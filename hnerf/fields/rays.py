"""What a field is queried with: rays, and the posed bodies that they pass."""

import dataclasses
from dataclasses import dataclass
from typing import Generic, TypeVar

import torch
from torch import Tensor

from hnerf.body.canonical import PoseCorrection, PosedBodies
from hnerf.fields.conditions import Conditions

Region = TypeVar("Region")


@dataclass(frozen=True)
class Rays:
    """A batch of rays. origins_m and unit directions (R, 3); frame (R,): the body row that each ray meets."""

    origins_m: Tensor
    directions: Tensor
    frame: Tensor

    def __len__(self) -> int:
        return len(self.frame)

    def pick(self, index: Tensor) -> "Rays":
        """Return the rays at `index` (N,)."""
        return Rays(self.origins_m[index], self.directions[index], self.frame[index])

    def points(self, depths_m: Tensor) -> Tensor:
        """Return the points (R, 3) or (R, K, 3) at depths (R,) or (R, K)."""
        one = depths_m.dim() == 1
        origins_m, directions = (t if one else t[:, None] for t in (self.origins_m, self.directions))
        return origins_m + directions * depths_m[..., None]


@dataclass(frozen=True)
class PosedScene(Generic[Region]):
    """The scene in which rays are evaluated, by body row: the posed bodies, the field's sampling region around them and
    its conditions. correction: the change of poses and shape that is being learned; None in rendering. pixel_rad: the
    angle between neighbouring pixels of the image that is rendered; None if there is none."""

    bodies: PosedBodies
    region: Region
    conditions: Conditions
    correction: PoseCorrection | None = None
    pixel_rad: float | None = None

    def with_noise(self, sigma: float, generator: torch.Generator) -> "PosedScene[Region]":
        """Return the scene with noise on its conditions."""
        return dataclasses.replace(self, conditions=self.conditions.with_noise(sigma, generator))
