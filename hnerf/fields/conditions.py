"""What the fields are conditioned on beside the point, and the random numbers of one step."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import torch
from torch import Tensor

from hnerf.body.rig import Rig

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Batch = TypeVar("Batch", bound="DataclassInstance")


@dataclass(frozen=True)
class Conditions:
    """By body row: pose (n, 3 free) the free joints' angles; root (n, 12) the rows of T, translation in scene units;
    frame_row (n,) the row of the fit whose pose it is, -1 for a pose that no frame has."""

    pose: Tensor
    root: Tensor
    frame_row: Tensor

    @staticmethod
    def of(rig: Rig, theta: Tensor, root: Tensor, frame_row: Tensor, scene_m: float) -> "Conditions":
        """theta (n, J, 3), root (n, 4, 4); scene_m: metres in a scene unit."""
        scaled = torch.cat([root[:, :3, :3], root[:, :3, 3:] / scene_m], -1)
        return Conditions(theta[:, rig.free].flatten(1), scaled.flatten(1), frame_row)

    def with_noise(self, sigma: float, generator: torch.Generator) -> "Conditions":
        """With Gaussian noise on theta and T, so that networks do not learn poses by heart (paper, section 4)."""
        device = self.pose.device
        pose, root = (sigma * torch.randn(c.shape, generator=generator, device=device) for c in (self.pose, self.root))
        return dataclasses.replace(self, pose=self.pose + pose, root=self.root + root)


@dataclass(frozen=True)
class Draws:
    """Random numbers of a batch: jitter (R, K) of samples in their strata, finer (R, K) for hierarchical sampling,
    beyond (R, 3) the colour behind the rays, probe (R,) which sample's gradient is regularised, view (R, 3) noise on
    directions. None where a rendering needs none."""

    jitter: Tensor
    background: Tensor
    fine: Tensor
    probe: Tensor | None = None
    view: Tensor | None = None

    @staticmethod
    def random(rays: int, samples: int, view_sigma: float, generator: torch.Generator) -> "Draws":
        """For one training step, on the generator's device."""
        device = generator.device
        jitter, fine = (torch.rand(rays, samples, generator=generator, device=device) for _ in range(2))
        background = torch.rand(rays, 3, generator=generator, device=device)
        probe = torch.rand(rays, generator=generator, device=device)
        view = view_sigma * torch.randn(rays, 3, generator=generator, device=device)
        return Draws(jitter, background, fine, probe, view)

    def with_background(self, background: Tensor) -> "Draws":
        """The same numbers, with another colour behind the rays."""
        return dataclasses.replace(self, background=background)

    @staticmethod
    def deterministic(rays: int, samples: int, device: torch.device) -> "Draws":
        """For a rendering: every sample in the middle of its stratum, black beyond."""
        middle = torch.full((rays, samples), 0.5, device=device)
        return Draws(middle, torch.zeros(rays, 3, device=device), middle)


def shard(batch: Batch, rank: int, world_size: int) -> Batch:
    """This rank's rays of a joint batch, a dataclass whose tensors all have the rays first: those that follow each
    other, so that a share has few frames."""
    values = {f.name: getattr(batch, f.name) for f in dataclasses.fields(batch)}
    return dataclasses.replace(
        batch, **{k: v if v is None else v.tensor_split(world_size)[rank] for k, v in values.items()}
    )


def concatenate(batches: Sequence[Batch]) -> Batch:
    """Shares of a batch, one after another."""
    values = {f.name: [getattr(batch, f.name) for batch in batches] for f in dataclasses.fields(batches[0])}
    return dataclasses.replace(batches[0], **{k: None if v[0] is None else torch.cat(v) for k, v in values.items()})
