"""What fields are conditioned on in addition to the sample point, and the random numbers of one step."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import torch
from torch import Tensor

from hnerf.body.canonical import PosedBodies

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Batch = TypeVar("Batch", bound="DataclassInstance")


@dataclass(frozen=True)
class Conditions:
    """Conditioning by body row: pose (n, 3 free), the angles of the free joints; root (n, 12), the rows of T with the
    translation in scene units; frame_row (n,), the row of the body fit with this pose, -1 for a pose that belongs to no
    frame."""

    pose: Tensor
    root: Tensor
    frame_row: Tensor

    @staticmethod
    def of(bodies: PosedBodies, frame_row: Tensor, scene_m: float) -> "Conditions":
        """Build the conditions of n bodies; scene_m: metres per scene unit."""
        scaled = torch.cat([bodies.root[:, :3, :3], bodies.root[:, :3, 3:] / scene_m], -1)
        return Conditions(bodies.theta[:, bodies.rig.free].flatten(1), scaled.flatten(1), frame_row)

    def with_noise(self, sigma: float, generator: torch.Generator) -> "Conditions":
        """Return the conditions with Gaussian noise on theta and T, so that networks do not memorise poses (paper,
        section 4)."""
        device = self.pose.device
        pose, root = (sigma * torch.randn(c.shape, generator=generator, device=device) for c in (self.pose, self.root))
        return dataclasses.replace(self, pose=self.pose + pose, root=self.root + root)


@dataclass(frozen=True)
class Draws:
    """Random numbers of a batch: jitter (R, K) of samples in their strata; fine (R, K) for hierarchical sampling;
    background (R, 3), the colour behind the rays; probe (R,), which sample's gradient is regularised; view (R, 3),
    noise on directions. None where rendering needs none. spacing_m (R,): metres between the samples of a ray, which
    then are as many as its path requires, at most K; None: all rays get K samples."""

    jitter: Tensor
    background: Tensor
    fine: Tensor
    probe: Tensor | None = None
    view: Tensor | None = None
    spacing_m: Tensor | None = None

    @staticmethod
    def random(
        rays: int, samples: int, view_sigma: float, generator: torch.Generator, spacing_m: float | None = None
    ) -> "Draws":
        """Draw the numbers of one training step on the generator's device."""
        device = generator.device
        jitter, fine = (torch.rand(rays, samples, generator=generator, device=device) for _ in range(2))
        background = torch.rand(rays, 3, generator=generator, device=device)
        probe = torch.rand(rays, generator=generator, device=device)
        view = view_sigma * torch.randn(rays, 3, generator=generator, device=device)
        return Draws(jitter, background, fine, probe, view, _by_ray(spacing_m, rays, device))

    @staticmethod
    def deterministic(
        rays: int, samples: int, device: torch.device, spacing_m: Tensor | float | None = None
    ) -> "Draws":
        """Return the numbers for rendering: every sample in the middle of its stratum."""
        middle = torch.full((rays, samples), 0.5, device=device)
        return Draws(middle, torch.zeros(rays, 3, device=device), middle, spacing_m=_by_ray(spacing_m, rays, device))


def _by_ray(spacing_m: Tensor | float | None, rays: int, device: torch.device) -> Tensor | None:
    return None if spacing_m is None else torch.as_tensor(spacing_m, device=device).expand(rays)


def shard(batch: Batch, rank: int, world_size: int) -> Batch:
    """Return this rank's rays of a joint batch, a dataclass whose tensors all have rays as first axis. Shares are
    contiguous, so that each has few frames."""
    values = {f.name: getattr(batch, f.name) for f in dataclasses.fields(batch)}
    return dataclasses.replace(
        batch, **{k: v if v is None else v.tensor_split(world_size)[rank] for k, v in values.items()}
    )


def concatenate(batches: Sequence[Batch]) -> Batch:
    """Concatenate shares of a batch."""
    values = {f.name: [getattr(batch, f.name) for batch in batches] for f in dataclasses.fields(batches[0])}
    return dataclasses.replace(batches[0], **{k: None if v[0] is None else torch.cat(v) for k, v in values.items()})
