"""What NeRF and IDR share: they model one moment, in the world, and know of the person nothing but a box."""

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from hnerf.body.canonical import PosedBodies
from hnerf.body.fit_result import BodyFit
from hnerf.errors import CaptureError
from hnerf.render.shell import box_interval
from hnerf.training.conditions import Conditions
from hnerf.training.field import Field


@dataclass(frozen=True)
class Boxes:
    """The person's box by body row: lower_m, upper_m (n, 3)."""

    lower_m: Tensor
    upper_m: Tensor

    @staticmethod
    def around(vertices_m: Tensor, margin_m: float) -> "Boxes":
        """The extent of bodies (n, V, 3) and a margin."""
        return Boxes(vertices_m.amin(1) - margin_m, vertices_m.amax(1) + margin_m)

    def interval(self, origins_m: Tensor, directions: Tensor, frame: Tensor) -> tuple[Tensor, Tensor]:
        """Entry and exit depths (R,) of rays (R, 3) in the boxes of body rows (R,); equal where the box is missed."""
        return box_interval(origins_m, directions, self.lower_m[frame], self.upper_m[frame])

    def signed_distance(self, points_m: Tensor) -> Tensor:
        """Of points (N, 3) to the first box, (N,) metres, negative inside."""
        beyond = torch.maximum(self.lower_m[0] - points_m, points_m - self.upper_m[0])
        return beyond.clamp(min=0).norm(dim=-1) + beyond.amax(-1).clamp(max=0)


class StaticField(Field):
    """A field over the box, in coordinates that put the box's middle at 0 and the ends of its longest side at -1 and 1.

    Such methods were published for a bounded object alone. The surroundings come from the clean plate, so rays are
    sampled in the person's box only; that box is all they learn of the fitted body. What the networks say outside the
    box was never trained, so the surface ends there.
    """

    centre_m: Tensor
    scale_m: Tensor

    def __init__(self, body: BodyFit, box_margin_m: float, samples: int, learning_rate: float):
        super().__init__()
        self.box_margin_m, self.samples, self.learning_rate = box_margin_m, samples, learning_rate
        boxes = Boxes.around(body.vertices_m(), box_margin_m)
        self.register_buffer("canonical_m", body.rig.vertices_m.clone())
        self.register_buffer("centre_m", (boxes.lower_m + boxes.upper_m).mean(0) / 2)
        self.register_buffer("scale_m", (boxes.upper_m - boxes.lower_m).max() / 2)

    def region(self, bodies: PosedBodies) -> Boxes:
        """The box of each body."""
        return Boxes.around(bodies.vertices_m, self.box_margin_m)

    def parameter_groups(self) -> list[dict[str, Any]]:
        """One group."""
        return [{"params": list(self.parameters()), "lr": self.learning_rate}]

    def signed_distance(self, bodies: PosedBodies, points_m: Tensor, conditions: Conditions) -> Tensor:
        """Of what is inside the box of the first body, (N,) metres at points (N, 3); the box cuts and closes it."""
        return torch.maximum(self.distance(points_m), self.region(bodies).signed_distance(points_m))

    @abstractmethod
    def distance(self, points_m: Tensor) -> Tensor:
        """The network's own signed distance (N,) metres, at points (N, 3) of the box."""

    def scaled(self, points_m: Tensor) -> Tensor:
        """World points in the box's coordinates."""
        return (points_m - self.centre_m) / self.scale_m


def stratified(near: Tensor, far: Tensor, jitter: Tensor) -> Tensor:
    """Depths (R, K), one in each of K equal parts of [near, far] (R,), at jitter (R, K) in [0, 1) of its part."""
    strata = torch.arange(jitter.shape[1], device=near.device)
    return near[:, None] + (far - near)[:, None] * (strata + jitter) / jitter.shape[1]


def along(origins_m: Tensor, directions: Tensor, depths_m: Tensor) -> Tensor:
    """Points (..., 3) at depths (...) of rays (..., 3)."""
    return origins_m + directions * depths_m[..., None]


def require_one_moment(static: bool, method: str) -> None:
    """CaptureError where there is more than one training frame."""
    if not static:
        raise CaptureError(f"{method} models one moment; choose a single training frame, or another machinery")
