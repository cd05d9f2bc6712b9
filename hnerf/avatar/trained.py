"""A trained subject: built for training, saved, and loaded again as an Avatar."""

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pydantic import ValidationError
from safetensors.torch import load_file
from torch import Tensor

from hnerf.avatar.avatar import Rendering
from hnerf.avatar.model_file import fill_field, other_version
from hnerf.baselines.idr import IdrField
from hnerf.baselines.nerf import NerfField
from hnerf.baselines.nerfies import NerfiesField
from hnerf.baselines.neural_body import NeuralBodyField
from hnerf.body.canonical import PosedBodies
from hnerf.body.fit_result import BodyFit
from hnerf.config import (
    FastFieldSettings,
    FieldSettings,
    IdrSettings,
    NerfiesSettings,
    NerfSettings,
    NeuralBodySettings,
    PaperFieldSettings,
    TrainingSettings,
)
from hnerf.errors import InputError
from hnerf.fields.base import Field
from hnerf.fields.conditions import Conditions
from hnerf.fields.fast import FastField
from hnerf.fields.paper import PaperField
from hnerf.geometry.camera import Camera

Gains = dict[str, tuple[float, float, float]]

RAYS_AT_ONCE = 16384
SAMPLES_AT_ONCE = 1 << 20  # coarse ones, of fields that take many on a ray: a network keeps some KiB for each
POINTS_AT_ONCE = 1 << 17
FIELDS: dict[type[FieldSettings], type[Field]] = {
    FastFieldSettings: FastField,
    PaperFieldSettings: PaperField,
    NerfSettings: NerfField,
    IdrSettings: IdrField,
    NeuralBodySettings: NeuralBodyField,
    NerfiesSettings: NerfiesField,
}


def build_field(settings: FieldSettings, body: BodyFit, static: bool) -> Field:
    """An untrained field around the fitted body; static: the capture has one training frame."""
    if not (static or settings.models_motion):
        raise InputError(f"{settings.kind} models one moment; choose a single training frame, or another method")
    return FIELDS[type(settings)].build(body, settings, static)


@dataclass(frozen=True)
class TrainedAvatar:
    """A field and the fine-tuned body: the Avatar of hnerf/avatar/avatar.py. learned: the poses of the frames that the
    field knows, whatever body and poses are shown; gains: of cameras by name, as which others show it at 1."""

    field: Field
    body: BodyFit
    scene_m: float
    learned: BodyFit
    gains: Gains = dataclasses.field(default_factory=dict)

    @torch.no_grad()
    def render(self, camera: Camera, theta: Tensor, root: Tensor) -> Rendering:
        """Colour, coverage and depth of the person alone."""
        bodies, conditions = self._pose(theta, root)
        region: Any = self.field.region(bodies, conditions)
        device = bodies.vertices_m.device
        y, x = np.nonzero(self.field.reached(camera, bodies.vertices_m[0].cpu().numpy()))
        origins, directions = camera.rays(np.stack([x, y], 1).astype(np.float64))
        flat = torch.zeros(camera.height_px * camera.width_px, 5, device=device)
        index = torch.from_numpy(y * camera.width_px + x).to(device)
        count = max(1, min(RAYS_AT_ONCE, SAMPLES_AT_ONCE // self.field.samples))
        for start in range(0, len(x), count):
            part = slice(start, start + count)
            o, d = (torch.from_numpy(np.ascontiguousarray(a[part])).float().to(device) for a in (origins, directions))
            row = torch.zeros(len(o), dtype=torch.long, device=device)
            flat[index[part]] = self.field.render_rays(bodies, region, o, d, row, conditions)
        image = flat.view(camera.height_px, camera.width_px, 5)
        gain = torch.tensor(self.gains.get(camera.name, (1.0, 1.0, 1.0)), device=device)
        return Rendering((gain * image[..., :3]).clamp(0, 1), image[..., 3], image[..., 4])

    def without_frames(self) -> "TrainedAvatar":
        """The same avatar, in no pose of which it knows more than in others."""
        none = dataclasses.replace(self.learned, theta=self.learned.theta[:0], root=self.learned.root[:0], frames=())
        return dataclasses.replace(self, learned=none)

    def on_body(self, body: BodyFit) -> "TrainedAvatar":
        """The avatar with another body under its clothes, other poses, or both; the rig keeps its topology."""
        return dataclasses.replace(self, body=body.to(self.body.theta.device))

    @torch.no_grad()
    def signed_distance(self, points_m: Tensor, theta: Tensor, root: Tensor) -> Tensor:
        """d_hat at world points (N, 3), (N,) metres."""
        bodies, conditions = self._pose(theta, root)
        parts = points_m.split(POINTS_AT_ONCE)
        return torch.cat([self.field.signed_distance(bodies, part, conditions) for part in parts])

    @torch.no_grad()
    def colour(self, points_m: Tensor, directions: Tensor, theta: Tensor, root: Tensor) -> Tensor:
        """Radiance at world points (N, 3) along unit directions (N, 3), (N, 3)."""
        bodies, conditions = self._pose(theta, root)
        parts = zip(points_m.split(POINTS_AT_ONCE), directions.split(POINTS_AT_ONCE), strict=True)
        return torch.cat([self.field.colour(bodies, x, v, conditions) for x, v in parts])

    def _pose(self, theta: Tensor, root: Tensor) -> tuple[PosedBodies, Conditions]:
        rig = self.body.rig
        bodies = PosedBodies(rig, theta[None], root[None], self.field.canonical_m)
        return bodies, Conditions.of(rig, theta[None], root[None], self._frame_row(theta, root), self.scene_m)

    def _frame_row(self, theta: Tensor, root: Tensor) -> Tensor:
        """The learned row (1,) whose joints turn like theta, of several the one whose root is nearest; -1 for none."""
        same = torch.nonzero((self.learned.theta == theta).flatten(1).all(1))[:, 0]
        apart = (self.learned.root[same] - root).flatten(1).norm(dim=1)
        return same[apart.argmin(keepdim=True)] if len(same) else torch.full((1,), -1, device=theta.device)


def load_avatar(folder: Path, device: torch.device | str = "cpu") -> TrainedAvatar:
    """The subject that training left in `folder`; InputError if another version left it."""
    settings, static, gains = _stored_settings(folder / "settings.json")
    body = BodyFit.load(folder).to(device)
    path = folder / "model.safetensors"
    tensors = load_file(path, device=str(device))
    if "canonical_m" not in tensors:
        raise other_version(path)
    before_tuning = dataclasses.replace(body, rig=dataclasses.replace(body.rig, vertices_m=tensors["canonical_m"]))
    field = build_field(settings.field, before_tuning, static).to(device)
    fill_field(field, tensors, path)
    return TrainedAvatar(field.eval(), body, settings.field.scene_m, body, gains)


def _stored_settings(path: Path) -> tuple[TrainingSettings, bool, Gains]:
    """What a subject was trained with, whether it had one training frame, and the gains of its cameras."""
    stored = json.loads(path.read_text())
    try:
        gains = {name: tuple(gain) for name, gain in stored.get("gains", {}).items()}
        return TrainingSettings.model_validate(stored["training"]), stored["static"], gains
    except (KeyError, ValidationError):
        raise other_version(path) from None
