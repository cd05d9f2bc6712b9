"""Interface of a field, used by trainer and renderer."""

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from hnerf.body.canonical import PosedBodies
from hnerf.body.fit_result import BodyFit
from hnerf.body.rig import Rig
from hnerf.fields.compositing import composite, weights_from_alpha
from hnerf.fields.conditions import Conditions, Draws
from hnerf.fields.rays import PosedScene, Rays
from hnerf.fields.samples import RaySamples
from hnerf.fields.shell import Boxes
from hnerf.geometry.camera import Camera
from hnerf.geometry.reach import within_box


class Field(nn.Module, ABC):
    """Base class of H-NeRF's two fields and the compared methods.

    settings: its own section. canonical_m (V, 3): the rig's canonical vertices, saved with the field. samples: random
    numbers needed per ray. unit_m: unit of the distances that `sample` returns. gamma: sharpness of the silhouette, per
    such unit. margin_m: how far around the body's extent anything can be visible. models_background: whether the field
    models the photograph's background; otherwise it is composited over the clean plate. whole_images: whether training
    draws from all pixels, or only from `visible_pixels` and the mask's. common_rest: whether the rest body absorbs
    changes that training makes to all poses alike.
    """

    models_background: ClassVar[bool] = False
    common_rest: ClassVar[bool] = False
    whole_images: bool = False
    settings: Any
    canonical_m: Tensor
    samples: int
    unit_m: float = 1.0
    gamma: float = 80.0  # per metre: the paper's 200 in a scene of 2.5 m
    margin_m: float = 0.1

    @classmethod
    def build(cls, body: BodyFit, settings: Any, static: bool) -> "Field":
        """Return an untrained field around a fitted body; static: the capture has one training frame."""
        return cls(body, settings)  # type: ignore[call-arg]  # how most fields are constructed

    def region(self, bodies: PosedBodies, conditions: Conditions) -> Any:
        """Return where rays are sampled, by body row: by default in the extent of each body, and a margin."""
        return Boxes.around(bodies.vertices_m, self.margin_m)

    def scene(self, bodies: PosedBodies, conditions: Conditions) -> PosedScene[Any]:
        """Return the scene in which rays around these bodies are evaluated."""
        return PosedScene(bodies, self.region(bodies, conditions), conditions)

    def tighten(self, rig: Rig, pose: Tensor) -> None:
        """Shrink the region to what is visible in the given poses (n, P)."""

    def average_over_frames(self, rows: Tensor) -> None:
        """Give poses outside the frames of `rows` (n,) the mean of what was learned for these frames."""

    def visible_pixels(self, camera: Camera, vertices_m: np.ndarray) -> np.ndarray:
        """Return the pixels (H, W) bool that can show any part of a body with vertices (V, 3)."""
        return within_box(camera, vertices_m, self.margin_m)

    def parameter_groups(self) -> list[dict[str, Any]]:
        """Return parameter groups for Adam: by default a single one."""
        return [{"params": list(self.parameters()), "lr": self.settings.learning_rate}]

    def compile_networks(self) -> None:
        """Have torch fuse the operations of networks that spend their time moving activations, for training on a
        GPU."""

    def frame_parameters(self) -> list[nn.Parameter]:
        """Return the parameters that belong to single frames, frames on the first axis. For novel frames they are
        fitted to the finished field, as poses are."""
        return []

    @abstractmethod
    def sample(self, scene: PosedScene[Any], rays: Rays, draws: Draws) -> tuple[RaySamples, Tensor]:
        """Evaluate radiance and distance along R rays; also return their samples' depths (R, K) in metres."""

    def training_samples(self, progress: float) -> tuple[int, float | None]:
        """Return the random numbers needed per ray at a training progress from 0 to 1, and the metres between samples,
        None if every ray gets all of them."""
        return self.samples, None

    def on_progress(self, progress: float) -> None:
        """Record the progress of the field's training, from 0 to 1. Called once after each step but the last, however
        many parts a step has."""

    def rendering_draws(self, scene: PosedScene[Any], rays: Rays) -> Draws:
        """Return the draws with which R rays are rendered."""
        return Draws.deterministic(len(rays), self.samples, rays.frame.device)

    def render_rays(self, scene: PosedScene[Any], rays: Rays) -> Tensor:
        """Render the person alone along R rays, with opacity b alpha (docs/method.md, "Evaluation protocol").

        Returns (R, 5): colour over black, coverage, and depth in metres, 0 where nothing is hit.
        """
        return composited(*self.sample(scene, rays, self.rendering_draws(scene, rays)))

    def render_beside(self, scene: PosedScene[Any], rays: Rays, directions: Tensor) -> Tensor:
        """Render M neighbours of each of R rays as `render_rays` does: (M, R, 5). They have the same origins, and unit
        directions (M, R, 3) close to those of the rays."""
        return torch.stack([self.render_rays(scene, Rays(rays.origins_m, d, rays.frame)) for d in directions])

    def coverage(self, samples: RaySamples) -> Tensor:
        """Return how far the learned content covers each ray, (R,)."""
        return 1 - (1 - samples.in_box * samples.alpha).prod(1)

    def frame_displacements(self, bodies: PosedBodies, points_m: Tensor, frame_row: Tensor) -> Tensor:
        """Return how far the frames of rows `frame_row` (n,) move the surface next to points (N, 3) around the first
        body, which is at rest, from where it is in a pose that belongs to no frame, (n, N, 3)."""
        return points_m.new_zeros(len(frame_row), *points_m.shape)

    @abstractmethod
    def signed_distance(self, bodies: PosedBodies, points_m: Tensor, conditions: Conditions) -> Tensor:
        """Return d_hat (N,) in metres at points (N, 3) around the first body, negative inside."""

    @abstractmethod
    def colour(self, bodies: PosedBodies, points_m: Tensor, directions: Tensor, conditions: Conditions) -> Tensor:
        """Return the colour c (N, 3) at points (N, 3) around the first body, seen along directions (N, 3)."""


def composited(samples: RaySamples, depths: Tensor) -> Tensor:
    """Return what R rays with samples at depths (R, K) see of the person alone, (R, 5), as `Field.render_rays` does."""
    weights = weights_from_alpha(samples.in_box * samples.alpha)
    cover = weights.sum(1, keepdim=True)
    shown = depths if samples.surface_m is None else samples.surface_m
    depth = (weights * shown).sum(1, keepdim=True) / cover.clamp(min=1e-6)
    return torch.cat([composite(weights, samples.colour), cover, depth * (cover > 0)], 1)
