"""A trained person, as evaluation and export use it, whatever its field."""

import dataclasses
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from hnerf.avatar.antialiasing import antialiased
from hnerf.body.canonical import PosedBodies
from hnerf.body.fit_result import BodyFit
from hnerf.fields.base import Field
from hnerf.fields.conditions import Conditions
from hnerf.fields.rays import Rays
from hnerf.geometry.camera import Camera

RAYS_PER_BATCH = 1 << 12  # their samples stay in a CPU's cache
SAMPLES_PER_BATCH = 1 << 20  # coarse ones, for fields with many per ray: a network keeps some KiB for each
GPU_RAYS, GPU_SAMPLES = 1 << 16, 1 << 22  # the same on a GPU, which would wait for the launches of smaller ones
POINTS_PER_BATCH = 1 << 17

Gains = dict[str, tuple[float, float, float]]  # exposure of red, green and blue by camera, relative to a gain of 1


@dataclass(frozen=True)
class Rendering:
    """One image over black: rgb (H, W, 3) in [0, 1], premultiplied by alpha (H, W); depth_m (H, W) along the ray
    through the pixel's centre, 0 where it meets nobody."""

    rgb: Tensor
    alpha: Tensor
    depth_m: Tensor


@dataclass(frozen=True)
class Avatar:
    """A trained person: a field, and the body under the clothes, with its poses. learned: poses of the frames that the
    field knows, whatever body and poses are shown.

    theta (J, 3) in radians and root (4, 4), world from body, set the pose, which need not be one of `body`. All tensors
    that methods take are float32, on the device of `body`, and have one pose; cameras are in numpy.
    """

    field: Field
    body: BodyFit
    learned: BodyFit
    gains: Gains = dataclasses.field(default_factory=dict)

    @torch.no_grad()
    def render(self, camera: Camera, theta: Tensor, root: Tensor) -> Rendering:
        """Render colour, coverage and depth of the person alone, exposed as the training camera of this name."""
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

    def without_frames(self) -> "Avatar":
        """Return the same person without what was learned for single frames, so that every pose is shown as an unseen
        one."""
        none = dataclasses.replace(self.learned, theta=self.learned.theta[:0], root=self.learned.root[:0], frames=())
        return dataclasses.replace(self, learned=none)

    def with_body(self, body: BodyFit) -> "Avatar":
        """Return the same person with another body under the clothes, other poses, or both; the rig keeps its
        topology."""
        return dataclasses.replace(self, body=body.to(self.body.theta.device))

    @torch.no_grad()
    def frame_displacements(self, points_m: Tensor, theta: Tensor, root: Tensor) -> Tensor:
        """Return how far the surface next to points (N, 3) around the body at rest is moved by what was learned for the
        frames of poses theta (n, J, 3), root (n, 4, 4), relative to a pose that belongs to no frame: (n, N, 3), in the
        axes of the body at rest."""
        bodies, _ = self._pose(torch.zeros_like(theta[0]), torch.eye(4).to(root))
        rows = torch.cat([self._frame_row(*pose) for pose in zip(theta, root, strict=True)])
        return self.field.frame_displacements(bodies, points_m, rows)

    @torch.no_grad()
    def signed_distance(self, points_m: Tensor, theta: Tensor, root: Tensor) -> Tensor:
        """Return d_hat (N,) at world points (N, 3): metres to the clothed surface, negative inside."""
        bodies, conditions = self._pose(theta, root)
        parts = points_m.split(POINTS_PER_BATCH)
        return torch.cat([self.field.signed_distance(bodies, part, conditions) for part in parts])

    @torch.no_grad()
    def colour(self, points_m: Tensor, directions: Tensor, theta: Tensor, root: Tensor) -> Tensor:
        """Return the radiance (N, 3) in [0, 1] at world points (N, 3) seen along unit directions (N, 3)."""
        bodies, conditions = self._pose(theta, root)
        parts = zip(points_m.split(POINTS_PER_BATCH), directions.split(POINTS_PER_BATCH), strict=True)
        return torch.cat([self.field.colour(bodies, x, v, conditions) for x, v in parts])

    def _pose(self, theta: Tensor, root: Tensor) -> tuple[PosedBodies, Conditions]:
        bodies = PosedBodies(self.body.rig, theta[None], root[None], self.field.canonical_m)
        return bodies, Conditions.of(bodies, self._frame_row(theta, root), self.field.settings.scene_m)

    def _frame_row(self, theta: Tensor, root: Tensor) -> Tensor:
        """Return the learned row (1,) with the same joint angles theta: of several, the one with the closest root; -1
        if there is none."""
        same = torch.nonzero((self.learned.theta == theta).flatten(1).all(1))[:, 0]
        apart = (self.learned.root[same] - root).flatten(1).norm(dim=1)
        return same[apart.argmin(keepdim=True)] if len(same) else torch.full((1,), -1, device=theta.device)
