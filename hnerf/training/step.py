"""One optimisation step: from a joint batch of rays to the gradients of its losses."""

import dataclasses
from typing import Any

import torch
from torch import Tensor, nn

from hnerf.body.canonical import PoseCorrection
from hnerf.config import TrainingSettings
from hnerf.fields.base import Field
from hnerf.fields.conditions import Draws
from hnerf.fields.rays import PosedScene
from hnerf.training import losses
from hnerf.training.distributed import Distributed
from hnerf.training.pixels import PixelRays


class TrainingError(RuntimeError):
    """Training that cannot go on; the message names the likely cause."""


class Objective(nn.Module):
    """Field and pose correction with their losses; DistributedDataParallel wraps the forward pass."""

    def __init__(
        self, field: Field, correction: PoseCorrection, settings: TrainingSettings, ground_axis: int | None = None
    ):
        """ground_axis: the vertical axis of a world with its ground at 0; None if the ground's height is unknown."""
        super().__init__()
        self.field, self.correction, self.settings = field, correction, settings
        self.ground_axis = ground_axis

    def forward(self, scene: PosedScene[Any], rays: PixelRays, draws: Draws) -> tuple[dict[str, Tensor], Tensor]:
        """Return the weighted losses by name, whose sum is minimised, and the colour errors of the rays (R,)."""
        target = make_target(rays, draws.background, self.field.models_background)
        samples, depths_m = self.field.sample(dataclasses.replace(scene, correction=self.correction), rays, draws)
        s, gamma = self.settings.losses, self.field.gamma
        errors = losses.colour_errors(samples, target)
        terms = {
            "reconstruction": lambda: errors.mean(),
            "mask": lambda: losses.mask(samples, target),
            "fog": lambda: losses.fog(samples, target),
            "blend": lambda: losses.blend(samples, target, s.eta),
            "geometry": lambda: losses.geometry(
                samples, s.density_threshold, s.density_steepness, gamma, s.geometry_roles
            ),
            "segmentation": lambda: losses.segmentation(samples.d_hat, target, gamma),
            "eikonal": lambda: losses.eikonal(samples),
            "residual": lambda: losses.residual(samples),
            "fit": lambda: losses.segmentation(samples.d, target, gamma),
            "increment": lambda: losses.increment(self.correction),
            "elastic": lambda: losses.elastic(samples),
        }
        if self.ground_axis is not None:
            d_hat_m = self.field.unit_m * samples.d_hat
            terms["floor"] = lambda: losses.floor(d_hat_m, rays.points(depths_m)[..., self.ground_axis])
        weighted = {name: getattr(s, name) * term() for name, term in terms.items() if getattr(s, name)}
        return weighted, errors.detach()


def make_target(rays: PixelRays, drawn: Tensor, models_background: bool) -> losses.Target:
    """Return the target of the rays.

    A field that models the background is compared with the photograph. Any other field is composited over the clean
    plate, so that outline pixels, which mix person and plate, count, too; without a plate it is composited over drawn
    colours (R, 3), and the outline is left out.
    """
    person = rays.person.float()
    everywhere = torch.ones_like(person)
    if models_background:
        return losses.Target(rays.colour, person, everywhere, torch.zeros_like(rays.colour))
    if rays.plate is not None:
        colour = torch.where((rays.person | rays.edge)[:, None], rays.colour, rays.plate)
        return losses.Target(colour, person, everywhere, rays.plate)
    colour = torch.where(rays.person[:, None], rays.colour, drawn)
    return losses.Target(colour, person, (~rays.edge).float(), drawn)


def not_finite(terms: dict[str, Tensor], gradients: list[Tensor], step: int, processes: Distributed) -> str | None:
    """Return None if all values are finite in all processes, so that these continue or skip together; otherwise a
    message that names the losses or gradients that are not. Values are read from the device once."""
    values = torch.stack([value.detach() for value in terms.values()] + [g.sum() for g in gradients])
    finite = values.isfinite().tolist()
    if not processes.all_max(float(not all(finite))):
        return None
    if all(finite):
        return f"step {step}: not finite in another process"
    bad = [name for name, fine in zip(terms, finite, strict=False) if not fine]
    return f"step {step}: {', '.join(bad) if bad else 'a gradient is'} not finite"
