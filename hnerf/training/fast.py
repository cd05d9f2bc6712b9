"""The fast avatar: radiance and SDF co-learned on grids over the canonical shell, rendered in the shell alone."""

import torch
from torch import Tensor, nn

from hnerf.body.canonical import Descriptor, PoseCorrection, PosedBodies
from hnerf.body.rig import Rig
from hnerf.config import FastFieldSettings
from hnerf.field.canonical import CanonicalField
from hnerf.render.compositing import alpha_from_sdf, weights_from_alpha
from hnerf.render.shell import ShellGrid
from hnerf.training.conditions import Conditions, Draws, pose_inputs
from hnerf.training.losses import RaySamples

NEGLIGIBLE = 1e-3  # a sample of less weight gets no colour
FAR_M = 10.0  # farther than any point that is asked about


class FastField(nn.Module):
    """Networks, sharpness and the canonical body; no pose of its own."""

    canonical_m: Tensor

    def __init__(self, rig: Rig, settings: FastFieldSettings):
        super().__init__()
        self.settings = settings
        self.samples = settings.samples
        self.register_buffer("canonical_m", rig.vertices_m.clone())
        margin_m = settings.outer_m + 0.01
        self.field = CanonicalField(
            rig.vertices_m.amin(0) - margin_m,
            rig.vertices_m.amax(0) + margin_m,
            settings.geometry_cells,
            settings.colour_cells,
            settings.channels,
            settings.width,
            settings.pose_width,
            pose_inputs(rig, torch.zeros(1, len(rig.joints_m), 3)).shape[1],
            settings.outer_m,
        )
        self.log_sharpness = nn.Parameter(torch.tensor(settings.initial_sharpness_per_m).log())

    @property
    def reach_m(self) -> float:
        """How far from the body a sample can lie: the shell and the slack of its cells."""
        return self.settings.outer_m + 2 * self.settings.shell_cell_m

    def region(self, bodies: PosedBodies) -> ShellGrid:
        """Where rays are sampled: the shell around bodies as they stand now."""
        s = self.settings
        return ShellGrid.around(bodies.vertices_m, s.outer_m, s.inner_m, s.shell_cell_m)

    def parameter_groups(self) -> list[dict]:
        """Adam groups; feature grids bear a larger rate than networks."""
        grids = [p for name, p in self.named_parameters() if "grids" in name]
        networks = [p for name, p in self.named_parameters() if "grids" not in name and p is not self.log_sharpness]
        return [
            {"params": grids, "lr": self.settings.grid_learning_rate},
            {"params": networks, "lr": self.settings.network_learning_rate},
            {"params": [self.log_sharpness], "lr": self.settings.grid_learning_rate},
        ]

    def sample(
        self,
        bodies: PosedBodies,
        region: ShellGrid,
        origins_m: Tensor,
        directions: Tensor,
        frame: Tensor,
        conditions: Conditions,
        draws: Draws,
        correction: PoseCorrection | None = None,
    ) -> tuple[RaySamples, Tensor]:
        """Radiance and distance along rays (R, 3) of body rows (R,); also depths (R, K)."""
        depths, met = region.sample_rays(origins_m, directions, frame, draws.jitter)
        points = (origins_m[:, None] + directions[:, None] * depths[..., None]).flatten(0, 1)
        row = frame.repeat_interleave(depths.shape[1])
        described = bodies.describe(points, row, self.reach_m, correction)
        near = described.near & met.repeat_interleave(depths.shape[1])
        d = torch.where(near, described.d, self.reach_m)
        pose = conditions.pose[row]
        residual = torch.where(near, self._residual(described, pose), 0.0)
        d, residual = d.view_as(depths), residual.view_as(depths)
        alpha = alpha_from_sdf(d + residual, self.log_sharpness.exp())
        colour = self._colour(described, pose, weights_from_alpha(alpha.detach()).flatten() > NEGLIGIBLE)
        norms = described.d.new_zeros(0)
        if draws.probe is not None:
            norms = self._gradient_norms(described, residual, near, pose, draws.probe)
        samples = RaySamples(
            alpha, alpha, torch.ones_like(d), colour.view(*depths.shape, 3), None, d, residual, norms, draws.beyond
        )
        return samples, depths

    def _residual(self, described: Descriptor, pose: Tensor) -> Tensor:
        """dd (N,) in the shell; 0 beyond it and deeper inside, where no ray asks and the body's d is enough."""
        s = self.settings
        trained = described.near & (described.d < self.reach_m) & (described.d > -s.inner_m - 2 * s.shell_cell_m)
        return torch.where(trained, self.field.residual(described.y, described.d, pose), 0.0)

    def _colour(self, described: Descriptor, pose: Tensor, visible: Tensor) -> Tensor:
        """Colours (N, 3) of the samples that count, zero elsewhere."""
        pick = torch.nonzero(visible)[:, 0]
        colour = described.d.new_zeros(len(visible), 3)
        seen = self.field.colour(described.y[pick], described.d[pick], described.normal[pick], pose[pick])
        return colour.index_copy(0, pick, seen)

    def _gradient_norms(
        self, described: Descriptor, residual: Tensor, near: Tensor, pose: Tensor, probe: Tensor
    ) -> Tensor:
        """|grad d_hat| in the canonical frame at one sample a ray, probe (R,) in [0, 1), by forward differences: the
        interpolation of a grid has no useful second derivative."""
        rays, samples = residual.shape
        pick = torch.arange(rays, device=probe.device) * samples + (probe * samples).long()
        pick = pick[near[pick]]
        step_m = self.settings.gradient_step_m
        y, d = described.y[pick].detach(), described.d[pick].detach()
        outward = nn.functional.normalize((y - described.s[pick]) * d.sign()[:, None], dim=-1)
        ahead = [
            self.field.residual(y + step_m * axis, d + step_m * outward @ axis, pose[pick])
            for axis in torch.eye(3, device=y.device)
        ]
        here = residual.flatten()[pick][:, None]
        return (outward + (torch.stack(ahead, -1) - here) / step_m).norm(dim=-1)

    def signed_distance(self, bodies: PosedBodies, points_m: Tensor, conditions: Conditions) -> Tensor:
        """d_hat (N,) at points (N, 3) around the first body; beyond reach the body's own distance stands alone."""
        row = torch.zeros(len(points_m), dtype=torch.long, device=points_m.device)
        described = bodies.describe(points_m, row, FAR_M, exact_sign=True)
        return described.d + self._residual(described, conditions.pose[row])

    def colour(self, bodies: PosedBodies, points_m: Tensor, directions: Tensor, conditions: Conditions) -> Tensor:
        """c (N, 3) at points around the first body; this field does not depend on the viewing direction."""
        row = torch.zeros(len(points_m), dtype=torch.long, device=points_m.device)
        described = bodies.describe(points_m, row, FAR_M)
        return self.field.colour(described.y, described.d, described.normal, conditions.pose[row])
