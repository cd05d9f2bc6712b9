"""What trainer and renderer ask of a field."""

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from hnerf.body.canonical import PoseCorrection, PosedBodies
from hnerf.body.fit_result import BodyFit
from hnerf.body.rig import Rig
from hnerf.fields.compositing import composite, weights_from_alpha
from hnerf.fields.conditions import Conditions, Draws
from hnerf.fields.samples import RaySamples
from hnerf.geometry.camera import Camera
from hnerf.geometry.reach import within_box


class Field(nn.Module, ABC):
    """H-NeRF's two machineries and the methods it is compared to.

    canonical_m (V, 3): the rig's canonical vertices, saved with the field; samples: random numbers that a ray needs;
    gamma: how sharp the outline of the distances that `sample` returns is, a unit of them; margin_m: how far around the
    body's extent anything can be seen; own_background: whether the field models the photograph's surroundings, or is
    composited over the clean plate; whole_images: whether training draws from all pixels, or from those that `reached`
    names and those of the mask; common_rest: whether the rest body takes what training changes in all poses alike.
    """

    own_background: ClassVar[bool] = False
    common_rest: ClassVar[bool] = False
    whole_images: bool = False
    canonical_m: Tensor
    samples: int
    gamma: float = 80.0  # a metre: the paper's 200 in a scene of 2.5 m
    margin_m: float = 0.1

    @classmethod
    @abstractmethod
    def build(cls, body: BodyFit, settings: Any, static: bool) -> "Field":
        """Return an untrained field around a fitted body; static: the capture has one training frame."""

    @abstractmethod
    def region(self, bodies: PosedBodies, conditions: Conditions) -> Any:
        """Where rays are sampled, by body row."""

    def tighten(self, rig: Rig, pose: Tensor) -> None:
        """Make that region no larger than what can be seen in some poses (n, P)."""

    def learn_for_all(self, rows: Tensor) -> None:
        """Give poses of which nothing is known what the frames of some rows (n,) have in common."""

    def reached(self, camera: Camera, vertices_m: np.ndarray) -> np.ndarray:
        """(H, W) bool: pixels that can show anything where the body's vertices are (V, 3)."""
        return within_box(camera, vertices_m, self.margin_m)

    @abstractmethod
    def parameter_groups(self) -> list[dict[str, Any]]:
        """Adam groups."""

    def frame_parameters(self) -> list[nn.Parameter]:
        """Those of single frames, with frames first: for novel frames they are fitted to the finished field, as poses
        are."""
        return []

    @abstractmethod
    def sample(
        self,
        bodies: PosedBodies,
        region: Any,
        origins_m: Tensor,
        directions: Tensor,
        frame: Tensor,
        conditions: Conditions,
        draws: Draws,
        correction: PoseCorrection | None = None,
    ) -> tuple[RaySamples, Tensor]:
        """Radiance and distance along rays (R, 3) of body rows (R,); also depths (R, K) in metres."""

    def samples_in_training(self, done: float) -> int:
        """Random numbers that a ray needs when so much of the training, 0 to 1, is over."""
        return self.samples

    def step_taken(self) -> None:
        """Said once after each step of the training, in however many parts it was made."""

    def samples_needed(self, region: Any, origins_m: Tensor, directions: Tensor, frame: Tensor) -> Tensor:
        """How many samples a rendering takes along rays (R, 3) of body rows (R,): (R,) long, 0 where nothing can be
        seen."""
        return torch.full((len(frame),), self.samples, device=frame.device)

    def render_rays(
        self,
        bodies: PosedBodies,
        region: Any,
        origins_m: Tensor,
        directions: Tensor,
        frame: Tensor,
        conditions: Conditions,
    ) -> Tensor:
        """The person alone along rays (R, 3) of body rows (R,), from b alpha (docs/method.md, "Evaluation protocol"):
        colour over black, coverage, and depth in metres, 0 where nothing is, (R, 5)."""
        needed = self.samples_needed(region, origins_m, directions, frame)
        seen = origins_m.new_zeros(len(frame), 5)
        for count in needed[needed > 0].unique().tolist():
            pick = torch.nonzero(needed == count)[:, 0]
            rays = (origins_m[pick], directions[pick], frame[pick])
            still = Draws.deterministic(len(pick), count, frame.device)
            samples, depths = self.sample(bodies, region, *rays, conditions, still)
            weights = weights_from_alpha(samples.in_box * samples.alpha)
            cover = weights.sum(1, keepdim=True)
            depth = (weights * depths).sum(1, keepdim=True) / cover.clamp(min=1e-6)
            seen[pick] = torch.cat([composite(weights, samples.colour), cover, depth * (cover > 0)], 1)
        return seen

    def coverage(self, samples: RaySamples) -> Tensor:
        """How far what the field has learned covers rays, (R,)."""
        return 1 - (1 - samples.in_box * samples.alpha).prod(1)

    @abstractmethod
    def signed_distance(self, bodies: PosedBodies, points_m: Tensor, conditions: Conditions) -> Tensor:
        """d_hat (N,) metres at points (N, 3) around the first body, negative inside."""

    @abstractmethod
    def colour(self, bodies: PosedBodies, points_m: Tensor, directions: Tensor, conditions: Conditions) -> Tensor:
        """c (N, 3) at points (N, 3) around the first body, seen along directions (N, 3)."""
