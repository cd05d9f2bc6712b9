"""A trained subject: built for training, saved, and loaded again as an Avatar."""

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from pydantic import ValidationError
from safetensors.torch import load_file
from torch import Tensor

from hnerf import config
from hnerf.avatar.antialiasing import antialiased
from hnerf.avatar.avatar import Gains, Rendering
from hnerf.avatar.model_file import load_field, version_error
from hnerf.baselines.idr import IdrField
from hnerf.baselines.nerf import NerfField
from hnerf.baselines.nerfies import NerfiesField
from hnerf.baselines.neural_body import NeuralBodyField
from hnerf.body.canonical import PosedBodies
from hnerf.body.fit_result import BodyFit
from hnerf.errors import InputError
from hnerf.fields.base import Field
from hnerf.fields.conditions import Conditions
from hnerf.fields.fast import FastField
from hnerf.fields.paper import PaperField
from hnerf.fields.rays import Rays
from hnerf.geometry.camera import Camera

RAYS_PER_BATCH = 1 << 12  # their samples stay in a CPU's cache
SAMPLES_PER_BATCH = 1 << 20  # coarse ones, for fields with many per ray: a network keeps some KiB for each
GPU_RAYS, GPU_SAMPLES = 1 << 16, 1 << 22  # the same on a GPU, which would wait for the launches of smaller ones
POINTS_PER_BATCH = 1 << 17
FIELDS: dict[type[config.FieldSettings], type[Field]] = {
    config.FastFieldSettings: FastField,
    config.PaperFieldSettings: PaperField,
    config.NerfSettings: NerfField,
    config.IdrSettings: IdrField,
    config.NeuralBodySettings: NeuralBodyField,
    config.NerfiesSettings: NerfiesField,
}


def build_field(settings: config.FieldSettings, body: BodyFit, static: bool) -> Field:
    """Return an untrained field around the fitted body; static: the capture has one training frame.

    Raises InputError if the field models one moment and there are more frames.
    """
    if not (static or settings.models_motion):
        raise InputError(f"{settings.no_new_poses}; choose a single training frame, or another method")
    return FIELDS[type(settings)].build(body, settings, static)


@dataclass(frozen=True)
class TrainedAvatar:
    """A field and the fine-tuned body, as the Avatar of hnerf/avatar/avatar.py. learned: poses of the frames that the
    field knows, whatever body and poses are shown; gains: exposure by camera name, relative to a camera of gain 1."""

    field: Field
    body: BodyFit
    scene_m: float
    learned: BodyFit
    gains: Gains = dataclasses.field(default_factory=dict)

    @torch.no_grad()
    def render(self, camera: Camera, theta: Tensor, root: Tensor) -> Rendering:
        """Render colour, coverage and depth of the person alone."""
        bodies, conditions = self._pose(theta, root)
        scene = dataclasses.replace(self.field.scene(bodies, conditions), pixel_rad=1 / camera.K[0, 0])
        device = bodies.vertices_m.device
        gpu = device.type == "cuda"
        rays, samples = (GPU_RAYS, GPU_SAMPLES) if gpu else (RAYS_PER_BATCH, SAMPLES_PER_BATCH)
        at_once = max(1, min(rays, samples // self.field.samples))

        def rays_at(points_px: np.ndarray) -> Rays:
            o, d = (torch.from_numpy(row.astype(np.float32)).to(device) for row in camera.rays(points_px.astype(float)))
            return Rays(o, d, torch.zeros(len(o), dtype=torch.long, device=device))

        def render_rays_at(points_px: np.ndarray) -> Tensor:
            seen = [torch.zeros(0, 5, device=device)]
            for start in range(0, len(points_px), at_once):
                seen.append(self.field.render_rays(scene, rays_at(points_px[start : start + at_once])))
            return torch.cat(seen)

        def render_beside(points_px: np.ndarray, offsets_px: np.ndarray) -> Tensor:
            step = -(-at_once // len(offsets_px))
            seen = [torch.zeros(len(offsets_px), 0, 5, device=device)]
            for start in range(0, len(points_px), step):
                part = points_px[start : start + step]
                directions = torch.stack([rays_at(part + offset_px).directions for offset_px in offsets_px])
                seen.append(self.field.render_beside(scene, rays_at(part), directions))
            return torch.cat(seen, 1)

        visible = self.field.visible_pixels(camera, bodies.vertices_m[0].cpu().numpy())
        image = antialiased(render_rays_at, render_beside, visible)
        gain = torch.tensor(self.gains.get(camera.name, (1.0, 1.0, 1.0)), device=device)
        return Rendering((gain * image[..., :3]).clamp(0, 1), image[..., 3], image[..., 4])

    def without_frames(self) -> "TrainedAvatar":
        """Return the same avatar with no frames to look up, so that every pose is rendered as an unseen one."""
        none = dataclasses.replace(self.learned, theta=self.learned.theta[:0], root=self.learned.root[:0], frames=())
        return dataclasses.replace(self, learned=none)

    def with_body(self, body: BodyFit) -> "TrainedAvatar":
        """Return the avatar with another body under its clothes, other poses, or both; the rig keeps its topology."""
        return dataclasses.replace(self, body=body.to(self.body.theta.device))

    @torch.no_grad()
    def frame_displacements(self, points_m: Tensor, theta: Tensor, root: Tensor) -> Tensor:
        """Return how far the surface next to points (N, 3) around the body at rest, (n, N, 3), is moved by what was
        learned for the frames of poses theta (n, J, 3), root (n, 4, 4)."""
        bodies, _ = self._pose(torch.zeros_like(theta[0]), torch.eye(4).to(root))
        rows = torch.cat([self._frame_row(*pose) for pose in zip(theta, root, strict=True)])
        return self.field.frame_displacements(bodies, points_m, rows)

    @torch.no_grad()
    def signed_distance(self, points_m: Tensor, theta: Tensor, root: Tensor) -> Tensor:
        """Return d_hat (N,) in metres at world points (N, 3)."""
        bodies, conditions = self._pose(theta, root)
        parts = points_m.split(POINTS_PER_BATCH)
        return torch.cat([self.field.signed_distance(bodies, part, conditions) for part in parts])

    @torch.no_grad()
    def colour(self, points_m: Tensor, directions: Tensor, theta: Tensor, root: Tensor) -> Tensor:
        """Return the radiance (N, 3) at world points (N, 3) along unit directions (N, 3)."""
        bodies, conditions = self._pose(theta, root)
        parts = zip(points_m.split(POINTS_PER_BATCH), directions.split(POINTS_PER_BATCH), strict=True)
        return torch.cat([self.field.colour(bodies, x, v, conditions) for x, v in parts])

    def _pose(self, theta: Tensor, root: Tensor) -> tuple[PosedBodies, Conditions]:
        rig = self.body.rig
        bodies = PosedBodies(rig, theta[None], root[None], self.field.canonical_m)
        return bodies, Conditions.of(rig, theta[None], root[None], self._frame_row(theta, root), self.scene_m)

    def _frame_row(self, theta: Tensor, root: Tensor) -> Tensor:
        """Return the learned row (1,) with the same joint angles theta: of several, the one with the closest root; -1
        if there is none."""
        same = torch.nonzero((self.learned.theta == theta).flatten(1).all(1))[:, 0]
        apart = (self.learned.root[same] - root).flatten(1).norm(dim=1)
        return same[apart.argmin(keepdim=True)] if len(same) else torch.full((1,), -1, device=theta.device)


def load_avatar(folder: Path, device: torch.device | str | None = None) -> TrainedAvatar:
    """Load the subject that training left in `folder`, onto the GPU if there is one and no other device is named.
    Raises InputError if another version wrote it."""
    device = device or ("cuda" if torch.cuda.is_available() else "cpu")
    settings, static, gains = stored_settings(folder)
    body = BodyFit.load(folder).to(device)
    path = folder / "model.safetensors"
    tensors = load_file(path, device=str(device))
    if "canonical_m" not in tensors:
        raise version_error(path)
    before_tuning = dataclasses.replace(body, rig=dataclasses.replace(body.rig, vertices_m=tensors["canonical_m"]))
    field = build_field(settings.field, before_tuning, static).to(device)
    load_field(field, tensors, path)
    return TrainedAvatar(field.eval(), body, settings.field.scene_m, body, gains)


def stored_settings(folder: Path) -> tuple[config.TrainingSettings, bool, Gains]:
    """Return the settings of the training that wrote `folder`, whether it had one training frame, and the gains of its
    cameras. Raises InputError if another version wrote them."""
    path = folder / "settings.json"
    stored = json.loads(path.read_text())
    try:
        gains = {name: tuple(gain) for name, gain in stored.get("gains", {}).items()}
        return config.TrainingSettings.model_validate(stored["training"]), stored["static"], gains
    except (KeyError, ValidationError):
        raise version_error(path) from None
