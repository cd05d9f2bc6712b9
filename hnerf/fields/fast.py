"""The fast avatar: radiance and SDF co-learned on grids over the canonical shell, rendered in the shell alone."""

import dataclasses

import numpy as np
import torch
from torch import Tensor, nn

from hnerf.body.canonical import FAR_M, Descriptor, PoseCorrection, PosedBodies
from hnerf.body.descriptor import vertex_normals
from hnerf.body.fit_result import BodyFit
from hnerf.body.rig import Rig
from hnerf.config import FastFieldSettings
from hnerf.fields.base import Field
from hnerf.fields.compositing import alpha_from_sdf, occupancy, weights_from_alpha
from hnerf.fields.conditions import Conditions, Draws
from hnerf.fields.deformation import FrameDeformation
from hnerf.fields.grids import CanonicalField
from hnerf.fields.samples import RaySamples
from hnerf.fields.shell import ShellGrid, lattice
from hnerf.geometry.camera import Camera
from hnerf.geometry.reach import within_reach

INITIAL_SHARPNESS_PER_M = 100.0  # of the logistic that makes opacity of distance
GRADIENT_STEP_M = 0.005
SETTLED = 5.0  # where the logistic of density is 1 or 0 within 1 %
GRID_ROOM_M = 0.01  # between shell and the end of the grids
ROOM_M = 0.012  # for what the surface still moves, and what poses that were not asked about do to it
TIGHTEN_STEP_M = 0.004
ELASTIC_M = 0.01  # a displacement whose elastic energy is 1
SPACING_M = 0.012  # between the samples of a rendering; twice as many gain 0.05 dB on valid-wave for twice the time
SAMPLES = (6, 12, 18, 24, 36, 64)  # of which a ray gets the first that is enough, or the last
COARSE = 0.75  # of the training has half the samples: as accurate on three captures, in three quarters of the time
JOINED_M = 0.03  # between neighbours on a ray, in the canonical volume: farther apart, they lie on different limbs
GRAZING_M = 1e-4  # of descent from a sample to the next, below which the way to the surface has no useful derivative
NEGLIGIBLE = 1e-3  # a sample of less weight gets no colour


class FastField(Field):
    """Networks, sharpness, the canonical body and its deformation in every frame; no pose of its own."""

    common_rest = True
    outer_m: Tensor
    inner_m: Tensor
    corners: Tensor
    weights: Tensor

    @classmethod
    def build(cls, body: BodyFit, settings: FastFieldSettings, static: bool) -> "FastField":
        """Return an untrained field; one training frame or many make no difference."""
        return cls(body.rig, settings, len(body.frames))

    def __init__(self, rig: Rig, settings: FastFieldSettings, frames: int):
        """frames: rows of the fit that the field is trained with."""
        super().__init__()
        self.settings = settings
        self.samples = settings.samples
        self.register_buffer("canonical_m", rig.vertices_m.clone())
        for name in ("outer_m", "inner_m"):
            self.register_buffer(name, torch.full((len(rig.vertices_m),), getattr(settings, name)))
        corners, weights = lattice(rig.vertices_m, rig.faces, settings.shell_cell_m)
        self.register_buffer("corners", corners, persistent=False)
        self.register_buffer("weights", weights, persistent=False)
        beyond_m = settings.outer_m + GRID_ROOM_M
        lower_m, upper_m = rig.vertices_m.amin(0) - beyond_m, rig.vertices_m.amax(0) + beyond_m
        self.field = CanonicalField(lower_m, upper_m, settings, 3 * int(rig.free.sum()))
        self.deformation = (
            FrameDeformation(rig.vertices_m, rig.faces, settings.nodes, frames) if settings.nodes else None
        )
        self.log_sharpness = nn.Parameter(torch.tensor(INITIAL_SHARPNESS_PER_M).log())

    @property
    def reach_m(self) -> float:
        """How far from the body a sample can lie: the shell and the slack of its cells."""
        return max(self.settings.outer_m, self.settings.inner_m) + 2 * self.settings.shell_cell_m

    def reached(self, camera: Camera, vertices_m: np.ndarray) -> np.ndarray:
        """Pixels whose rays pass through the shell."""
        return within_reach(camera, vertices_m, self.settings.outer_m + self.settings.shell_cell_m)

    def region(self, bodies: PosedBodies, conditions: Conditions) -> ShellGrid:
        """Where rays are sampled: the shell around bodies as they stand now, where their frames displace it to."""
        outwards_m = bodies.vertices_m.new_zeros(len(bodies.vertices_m), 1)
        if self.deformation is not None:
            outwards_m = self.deformation.outwards(conditions.frame_row)
        s, least_m = self.settings, self.settings.shell_cell_m
        outer_m = (self.outer_m + outwards_m).clamp(least_m, s.outer_m)
        inner_m = (self.inner_m - outwards_m).clamp(least_m, s.inner_m)
        return ShellGrid.around(bodies.vertices_m, outer_m, inner_m, (self.corners, self.weights), s.shell_cell_m)

    @torch.no_grad()
    def tighten(self, rig: Rig, pose: Tensor) -> None:
        """Make the shell no thicker than what can be seen: where, in any of some poses (n, P), the opacity's logistic
        has not yet settled, with some room to move. Nothing outside the old shell is asked, and of no frame's
        deformation, with which the shell moves."""
        s, rest = self.settings, torch.zeros(1, len(rig.joints_m), 3, device=self.canonical_m.device)
        bodies = PosedBodies(rig, rest, torch.eye(4, device=rest.device)[None], self.canonical_m)
        normals = vertex_normals(bodies.vertices_m[0], rig.faces)
        only = torch.zeros(len(normals), dtype=torch.long, device=rest.device)
        settled_m = SETTLED / self.log_sharpness.exp()
        reached_m = {1: torch.zeros_like(self.outer_m), -1: torch.zeros_like(self.inner_m)}
        for depth_m in torch.arange(-s.inner_m, s.outer_m, TIGHTEN_STEP_M).tolist():
            described = bodies.describe(bodies.vertices_m[0] + depth_m * normals, only, self.reach_m)
            seen = torch.zeros_like(described.near)
            for row in pose:
                d_hat = described.d + self._residual(described, row.expand(len(normals), -1))
                seen |= described.near & (d_hat.abs() < settled_m)
            for side, reached in reached_m.items():
                reached.scatter_reduce_(0, described.vertex[seen], side * described.d[seen], "amax")
        for side, thickness_m in ((1, self.outer_m), (-1, self.inner_m)):
            thickness_m.copy_((reached_m[side] + ROOM_M).minimum(thickness_m))

    def learn_for_all(self, rows: Tensor) -> None:
        """The mean deformation."""
        if self.deformation is not None:
            self.deformation.learn_for_all(rows)

    def parameter_groups(self) -> list[dict]:
        """Adam groups; feature grids bear a larger rate than networks."""
        s, networks = self.settings, [*self.field.pose_code.parameters()]
        networks += [*self.field.geometry.parameters(), *self.field.radiance.parameters()]
        grids = [*self.field.geometry_grids.parameters(), *self.field.colour_grids.parameters()]
        return [
            {"params": grids, "lr": s.grid_learning_rate},
            {"params": networks, "lr": s.network_learning_rate},
            {"params": [self.log_sharpness], "lr": s.grid_learning_rate},
            {"params": self.frame_parameters(), "lr": s.deformation_learning_rate},
        ]

    def frame_parameters(self) -> list[nn.Parameter]:
        """The deformations."""
        return [] if self.deformation is None else [self.deformation.displacement]

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
        depths, met, core = region.sample_rays(origins_m, directions, frame, draws.jitter)
        hit = torch.nonzero(met)[:, 0]  # only these rays are asked about; the others see nothing
        points = origins_m[hit, None] + directions[hit, None] * depths[hit][..., None]
        row = frame[hit].repeat_interleave(depths.shape[1])
        skin = bodies.describe(points.flatten(0, 1), row, self.reach_m, correction)
        described, moved = self._deformed(skin, conditions.frame_row[row])
        pose = conditions.pose.index_select(0, row)
        d = torch.where(described.near, described.d, self.reach_m).view(len(hit), depths.shape[1])
        residual = torch.where(described.near, self._residual(described, pose), 0.0).view_as(d)
        alpha_dot = alpha_from_sdf(d + residual, self.log_sharpness.exp())
        end = torch.where(core[hit, None], 1.0, alpha_dot[:, -1:])  # nothing shines through, if the surface lies deeper
        alpha = torch.cat([alpha_dot[:, :-1], end], 1)
        visible = weights_from_alpha(alpha.detach()).flatten() > NEGLIGIBLE
        colour = self._colour(at_surface(described, d + residual), pose, visible)
        norms = d.new_zeros(0)
        if draws.probe is not None:
            norms = self._gradient_norms(described, skin, pose, draws.probe[hit], depths.shape[1])
        elastic = None
        if moved is not None:
            energy = torch.where(described.near, (moved / ELASTIC_M).square().sum(-1), 0.0)
            elastic = energy.view_as(d).mean(1)

        def everywhere(values: Tensor, elsewhere: float) -> Tensor:
            return values.new_full((len(met), *values.shape[1:]), elsewhere).index_copy(0, hit, values)

        alpha, alpha_dot, residual = (everywhere(values, 0.0) for values in (alpha, alpha_dot, residual))
        colour = everywhere(colour.view(len(hit), depths.shape[1], 3), 0.0)
        d, in_box = everywhere(d, self.reach_m), everywhere(torch.ones_like(d), 0.0)
        samples = RaySamples(alpha, alpha_dot, in_box, colour, None, d, residual, norms, draws.beyond, elastic)
        return samples, depths

    def coverage(self, samples: RaySamples) -> Tensor:
        """By the surface, not by the core that ends rays behind it; rays that begin inside it are covered, too."""
        return occupancy(samples.d_hat, self.log_sharpness.exp()).amax(1)

    def samples_in_training(self, done: float) -> int:
        """Half of them first in either phase, while surface or novel poses are not where they will be."""
        return self.samples if done >= COARSE else -(-self.samples // 2)

    def samples_needed(self, region: ShellGrid, origins_m: Tensor, directions: Tensor, frame: Tensor) -> Tensor:
        """As many as a ray's way through the shell asks for."""
        needed = region.path_m(origins_m, directions, frame) / SPACING_M
        steps = torch.tensor(SAMPLES, device=frame.device)
        enough = torch.searchsorted(steps.to(needed), needed).clamp(max=len(SAMPLES) - 1)
        return torch.where(needed > 0, steps[enough], 0)

    def _deformed(self, described: Descriptor, frame_row: Tensor) -> tuple[Descriptor, Tensor | None]:
        """Descriptors (N,) on the body as the frames of rows `frame_row` (N,) deform it, and displacements (N, 3)."""
        if self.deformation is None:
            return described, None
        moved, outwards = self.deformation(described, frame_row)
        return dataclasses.replace(described, y=described.y - moved, d=described.d - outwards), moved

    def _residual(self, described: Descriptor, pose: Tensor) -> Tensor:
        """dd (N,) in the shell; 0 beyond it and deeper inside, where no ray asks and the body's d is enough."""
        s = self.settings
        trained = described.near & (described.d < self.reach_m) & (described.d > -s.inner_m - 2 * s.shell_cell_m)
        return torch.where(trained, self.field.residual(described.y, described.d, pose), 0.0)

    def _colour(self, described: Descriptor, pose: Tensor, visible: Tensor) -> Tensor:
        """Colours (N, 3) of the samples that count, zero elsewhere."""
        pick = torch.nonzero(visible)[:, 0]
        colour = described.d.new_zeros(len(visible), 3)
        at = (t.index_select(0, pick) for t in (described.y, described.d, described.normal, pose))
        seen = self.field.colour(*at)
        return colour.index_copy(0, pick, seen)

    def _gradient_norms(
        self, described: Descriptor, skin: Descriptor, pose: Tensor, probe: Tensor, samples: int
    ) -> Tensor:
        """|grad d_hat| in the canonical frame at one of a ray's samples, probe (R,) in [0, 1), by forward differences:
        the interpolation of a grid has no useful second derivative. skin: descriptors before the deformation, which say
        where outwards is. Gradients flow to the field alone."""
        pick = torch.arange(len(probe), device=probe.device) * samples + (probe * samples).long()
        pick = pick[described.near[pick]]
        y, d = described.y[pick].detach(), described.d[pick].detach()
        away = (skin.y - skin.s)[pick].detach() * skin.d[pick].detach().sign()[:, None]
        outward = nn.functional.normalize(away, dim=-1)
        axes = torch.cat([y.new_zeros(1, 3), torch.eye(3, device=y.device)])  # here, and a step along each axis
        d = d + GRADIENT_STEP_M * axes @ outward.T
        y = y + GRADIENT_STEP_M * axes[:, None]
        found = self.field.residual(y.flatten(0, 1), d.flatten(), pose[pick].repeat(len(axes), 1)).view_as(d)
        return (outward + (found[1:] - found[0]).T / GRADIENT_STEP_M).norm(dim=-1)

    def signed_distance(self, bodies: PosedBodies, points_m: Tensor, conditions: Conditions) -> Tensor:
        """d_hat (N,) at points (N, 3) around the first body; beyond reach the body's own distance stands alone."""
        row = torch.zeros(len(points_m), dtype=torch.long, device=points_m.device)
        described, _ = self._deformed(bodies.describe(points_m, row, FAR_M, exact_sign=True), conditions.frame_row[row])
        return described.d + self._residual(described, conditions.pose[row])

    def colour(self, bodies: PosedBodies, points_m: Tensor, directions: Tensor, conditions: Conditions) -> Tensor:
        """c (N, 3) at points around the first body; this field does not depend on the viewing direction."""
        row = torch.zeros(len(points_m), dtype=torch.long, device=points_m.device)
        described, _ = self._deformed(bodies.describe(points_m, row, FAR_M), conditions.frame_row[row])
        return self.field.colour(described.y, described.d, described.normal, conditions.pose[row])


def at_surface(described: Descriptor, d_hat: Tensor) -> Descriptor:
    """Samples (R K,) of rays moved on to where d_hat (R, K), linear from each to the next, is zero or nearest to it.

    A sample's opacity is that of the way to the next one, its colour that of the surface which makes it opaque. Left
    where they are: a ray's last sample, and those whose next one is out of reach or on another limb. Gradients flow
    through the place of the zero, too (as in IDR, Yariv et al. 2020): a body that moves along a ray shows the same
    point to it, and without that term would be drawn away from or towards its camera.
    """
    y, d, normal, near = (
        t.unflatten(0, d_hat.shape) for t in (described.y, described.d, described.normal, described.near)
    )
    ahead, after = d_hat[:, :-1], d_hat[:, 1:]
    joined = near[:, :-1] & near[:, 1:] & ((y[:, 1:] - y[:, :-1]).norm(dim=-1) < JOINED_M)
    descent_m = (ahead - after).clamp(min=GRAZING_M)
    share = torch.where(joined & (ahead > after), ahead / descent_m, 0.0).clamp(0, 1)[..., None]

    def moved(values: Tensor) -> Tensor:
        return torch.cat([torch.lerp(values[:, :-1], values[:, 1:], share), values[:, -1:]], 1).flatten(0, 1)

    return dataclasses.replace(described, y=moved(y), d=moved(d[..., None])[:, 0], normal=moved(normal))
