"""Checks of a field on rays that stay the same: its PSNR on unseen frames, and whether it has a surface."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from hnerf.fields.base import Field
from hnerf.fields.conditions import Draws, concatenate, shard
from hnerf.fields.rays import PosedScene
from hnerf.fields.samples import RaySamples
from hnerf.training.losses import box_colour
from hnerf.training.pixels import PixelRays, Pixels
from hnerf.training.step import TrainingError

RAYS = 2048
MIN_PERSON_COVERAGE = 0.1  # of the person's pixels; below it the surface has collapsed
MAX_BACKGROUND_COVERAGE = 0.8  # of the background pixels; above it the surface fills the box
MIN_SAMPLES_PER_RAY = 64  # through a whole scene: valid-wave's body covers 38 % with 16, 59 % with 64, 64 % with 256


@dataclass(frozen=True)
class FixedRays:
    """Rays through pixels, chosen by a seed; most_rays: how many fit into memory at once."""

    field: Field
    pixels: Pixels
    seed: int
    most_rays: float

    @torch.no_grad()
    def psnr(self, scene: PosedScene[Any], rows: Tensor) -> float | None:
        """Return the PSNR on the person's pixels of the frames in rows; None if none is drawn."""
        rays, samples = self.sample(scene, rows)
        mixed = rays.edge & (not self.field.models_background)  # mixed with a background that only such a field models
        error = (box_colour(samples, torch.zeros_like(rays.colour)) - rays.colour)[rays.person & ~mixed]
        return float(-10 * torch.log10((error**2).mean())) if len(error) else None

    @torch.no_grad()
    def require_surface(self, scene: PosedScene[Any], rows: Tensor) -> None:
        """Raise TrainingError if the surface is empty or fills the box. Of the background, only rays through the box
        count. A sound surface may cover those near outlines, if it is blurred, or those away from outlines, which in a
        tight shell are mostly rays through holes in masks. One that fills the box covers both."""
        rays, samples = self.sample(scene, rows, MIN_SAMPLES_PER_RAY if self.field.models_background else 0)
        coverage = self.field.coverage(samples)
        beside = ~rays.person & (samples.in_box > 0).any(1)
        clear = beside & ~rays.edge
        person = coverage[rays.person].mean()
        around = min(coverage[beside].mean(), coverage[clear if clear.any() else beside].mean())
        if not person >= MIN_PERSON_COVERAGE:  # also true for NaN
            raise TrainingError(f"the surface is empty (covers {person:.0%} of the person): check masks and body fit")
        if around > MAX_BACKGROUND_COVERAGE:
            raise TrainingError(f"the surface fills the box (covers {around:.0%} of the surroundings): check the masks")

    def sample(self, scene: PosedScene[Any], rows: Tensor, least: int = 0) -> tuple[PixelRays, RaySamples]:
        """Return the rays at the frames in rows, and their samples in the middle of their strata, as many as at the end
        of training, but with at least `least` random numbers per ray."""
        most, spacing_m = self.field.training_samples(1.0)
        generator = torch.Generator(rows.device).manual_seed(self.seed)
        rays = self.pixels.draw(rows, RAYS // len(rows) + 1, generator)
        parts, found = math.ceil(len(rays) / self.most_rays), []
        for part in (shard(rays, k, parts) for k in range(parts)):
            draws = Draws.deterministic(len(part), max(most, least), rows.device, spacing_m)
            found.append(self.field.sample(scene, part, draws)[0])
        return rays, concatenate(found)
