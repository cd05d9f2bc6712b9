"""The fast field: radiance and SDF on feature grids over the canonical shell, rendered in the shell alone."""

import dataclasses

import numpy as np
import torch
from torch import Tensor, nn

from hnerf.body.canonical import FAR_M, Descriptor, PosedBodies, weighted_sum
from hnerf.body.descriptor import BodyMeshes, vertex_normals
from hnerf.body.fit_result import BodyFit
from hnerf.body.rig import Rig
from hnerf.config import FastFieldSettings
from hnerf.fields.base import Field, composited
from hnerf.fields.compositing import alpha_from_sdf, occupancy, weights_from_alpha
from hnerf.fields.conditions import Conditions, Draws
from hnerf.fields.deformation import FrameDeformation
from hnerf.fields.grids import CanonicalField
from hnerf.fields.rays import PosedScene, Rays
from hnerf.fields.samples import RaySamples
from hnerf.fields.shell import MIN_SAMPLES, ShellGrid, surface_points
from hnerf.geometry.camera import Camera
from hnerf.geometry.reach import within_reach

INITIAL_SHARPNESS_PER_M = 100.0  # of the logistic that turns distance into opacity
GRADIENT_STEP_M = 0.005  # of forward differences of the signed distance
SATURATED_LOGIT = 5.0  # argument beyond which the opacity's logistic is within 1 % of 0 or 1
GRID_MARGIN_M = 0.01  # between the shell and the end of the grids
SHELL_MARGIN_M = 0.012  # for later movement of the surface, and for poses that were not evaluated
TIGHTEN_STEP_M = 0.004
ELASTIC_M = 0.01  # displacement whose elastic energy is 1
SPACING_M = 0.01  # between rendered samples
SPACING_PX, MIN_SPACING_M = 4, 0.003  # in close-ups, where fingers would have fringes, and ears speckles
MOST_SAMPLES, MOST_RENDERED = 64, 128  # on a ray, in training and in rendering
WIDE_SPACING_UNTIL = 0.75  # of the training: half the samples there were as accurate, in three quarters of the time
MAX_NEIGHBOUR_DISTANCE_M = 0.03  # canonical; neighbours on a ray that are farther apart lie on different limbs
MIN_DESCENT_M = 1e-4  # of d_hat from one sample to the next; below it the surface position has no useful derivative
MIN_COLOUR_WEIGHT = 1e-3  # samples of less weight are not coloured
MIN_SHOWN_WEIGHT = 1e-2  # the same in rendering, where coloured ones take over their weight: - 0.002 dB on valid-wave


class FastField(Field):
    """Networks, sharpness, the canonical body, and its deformation in every frame; it holds no poses."""

    common_rest = True
    settings: FastFieldSettings
    outer_m: Tensor
    inner_m: Tensor
    corners: Tensor
    weights: Tensor
    rest_normals: Tensor

    @classmethod
    def build(cls, body: BodyFit, settings: FastFieldSettings, static: bool) -> "FastField":
        """Return an untrained field, the same for one training frame or many."""
        return cls(body.rig, settings, len(body.frames))

    def __init__(self, rig: Rig, settings: FastFieldSettings, frames: int):
        """Build an untrained field around the rig. frames: number of rows of the body fit."""
        super().__init__()
        self.settings = settings
        self.samples = MOST_SAMPLES
        self.register_buffer("canonical_m", rig.vertices_m.clone())
        self.register_buffer("rest_normals", vertex_normals(rig.vertices_m, rig.faces), persistent=False)
        for name in ("outer_m", "inner_m"):
            self.register_buffer(name, torch.full((len(rig.vertices_m),), getattr(settings, name)))
        corners, weights = surface_points(rig.vertices_m, rig.faces, settings.shell_cell_m)
        self.register_buffer("corners", corners, persistent=False)
        self.register_buffer("weights", weights, persistent=False)
        beyond_m = settings.outer_m + GRID_MARGIN_M
        lower_m, upper_m = rig.vertices_m.amin(0) - beyond_m, rig.vertices_m.amax(0) + beyond_m
        body = BodyMeshes(rig.vertices_m[None], rig.faces)

        def near(points_m: Tensor, beyond_m: float) -> Tensor:
            only = torch.zeros(len(points_m), dtype=torch.int32, device=points_m.device)
            return body.closest_points(points_m, only, self.reach_m + GRID_MARGIN_M + beyond_m).face >= 0

        self.field = CanonicalField(lower_m, upper_m, settings, 3 * int(rig.free.sum()), near)
        self.deformation = (
            FrameDeformation(rig.vertices_m, rig.faces, settings.nodes, frames) if settings.nodes else None
        )
        self.log_sharpness = nn.Parameter(torch.tensor(INITIAL_SHARPNESS_PER_M).log())

    @property
    def reach_m(self) -> float:
        """Return how far from the body a sample can lie: the shell and the slack of its cells."""
        return max(self.settings.outer_m, self.settings.inner_m) + 2 * self.settings.shell_cell_m

    def visible_pixels(self, camera: Camera, vertices_m: np.ndarray) -> np.ndarray:
        """Return the pixels whose rays pass through the shell."""
        return within_reach(camera, vertices_m, self.settings.outer_m + self.settings.shell_cell_m)

    def region(self, bodies: PosedBodies, conditions: Conditions) -> ShellGrid:
        """Return the shell around the bodies, displaced as their frames deform it."""
        outwards_m = bodies.vertices_m.new_zeros(len(bodies.vertices_m), 1)
        if self.deformation is not None:
            outwards_m = self.deformation.normal_displacement(conditions.frame_row)
        s, least_m = self.settings, self.settings.shell_cell_m
        outer_m = (self.outer_m + outwards_m).clamp(least_m, s.outer_m)
        inner_m = (self.inner_m - outwards_m).clamp(least_m, s.inner_m)
        return ShellGrid.around(bodies.vertices_m, outer_m, inner_m, (self.corners, self.weights), s.shell_cell_m)

    @torch.no_grad()
    def tighten(self, rig: Rig, pose: Tensor) -> None:
        """Shrink the shell to what is visible in any of the given poses (n, P): where the opacity's logistic is not
        saturated, plus a margin for movement. Only the old shell is evaluated, and no frame's deformation, because the
        shell moves with it."""
        s, rest = self.settings, torch.zeros(1, len(rig.joints_m), 3, device=self.canonical_m.device)
        bodies = PosedBodies(rig, rest, torch.eye(4, device=rest.device)[None], self.canonical_m)
        normals = vertex_normals(bodies.vertices_m[0], rig.faces)
        only = torch.zeros(len(normals), dtype=torch.long, device=rest.device)
        settled_m = SATURATED_LOGIT / self.log_sharpness.exp()
        extent_m = {1: torch.zeros_like(self.outer_m), -1: torch.zeros_like(self.inner_m)}
        for depth_m in torch.arange(-s.inner_m, s.outer_m, TIGHTEN_STEP_M).tolist():
            old = torch.nonzero((-self.inner_m <= depth_m) & (depth_m <= self.outer_m))[:, 0]
            described = bodies.describe((bodies.vertices_m[0] + depth_m * normals)[old], only[old], self.reach_m)
            seen, pick = torch.zeros_like(described.near), self._trained(described)
            for residual in self.field.residual_in_each(described.y[pick], described.d[pick], pose):
                d_hat = described.d.index_add(0, pick, residual)
                seen |= described.near & (d_hat.abs() < settled_m)
            for side, extent in extent_m.items():
                extent.scatter_reduce_(0, described.vertex[seen], side * described.d[seen], "amax")
        for side, thickness_m in ((1, self.outer_m), (-1, self.inner_m)):
            thickness_m.copy_((extent_m[side] + SHELL_MARGIN_M).minimum(thickness_m))

    def average_over_frames(self, rows: Tensor) -> None:
        """Give all other frames the mean deformation of `rows` (n,)."""
        if self.deformation is not None:
            self.deformation.average_over_frames(rows)

    def parameter_groups(self) -> list[dict]:
        """Return parameter groups for Adam; feature grids take a larger rate than networks."""
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
        """Return the deformations."""
        return [] if self.deformation is None else [self.deformation.displacement]

    def sample(self, scene: PosedScene[ShellGrid], rays: Rays, draws: Draws) -> tuple[RaySamples, Tensor]:
        """Evaluate rays as Field.sample does, in the shell alone."""
        return self._sample(scene, rays, draws, None)

    def render_beside(self, scene: PosedScene[ShellGrid], rays: Rays, directions: Tensor) -> Tensor:
        """Render M neighbours of each ray as Field.render_beside does. Their descriptors are derived, to first order,
        from the closest points of the ray between them: a quarter of a pixel away, these are the same."""
        seen = composited(*self._sample(scene, rays, self.rendering_draws(scene, rays), directions))
        return seen.unflatten(0, (len(directions), -1))

    def _sample(
        self, scene: PosedScene[ShellGrid], rays: Rays, draws: Draws, directions: Tensor | None
    ) -> tuple[RaySamples, Tensor]:
        """Evaluate rays or, with directions (M, R, 3), the M R neighbours along these, at the depths of the rays
        themselves."""
        depths, count, core = scene.region.sample_rays(rays, draws.jitter, draws.spacing_m)
        # Only samples that count are evaluated, one ray after another; slots: their places among all, (N,).
        slots = torch.nonzero((torch.arange(depths.shape[1], device=count.device) < count[:, None]).flatten())[:, 0]
        ray, depth_m = slots // depths.shape[1], depths.flatten()[slots]
        row, beside_m = rays.frame[ray], None
        if directions is not None:
            beside_m = (directions - rays.directions)[:, ray] * depth_m[:, None]
        bodies, pose, points_m = scene.bodies, scene.conditions.pose, rays.pick(ray).points(depth_m)
        skin, more = bodies.describe_by_limbs(points_m, row, self.reach_m, scene.correction, beside_m=beside_m)
        if directions is not None:
            many, depth_m = len(directions), depth_m.repeat(len(directions))
            slots = (slots + depths.numel() * torch.arange(many, device=slots.device)[:, None]).flatten()
            depths, count, core, row = (torch.cat([t] * many) for t in (depths, count, core, row))
        met = torch.nonzero(count)[:, 0]  # the rays that have samples
        last = count.cumsum(0)[met] - 1
        ends = torch.zeros_like(row, dtype=torch.bool).index_fill(0, last, True)
        rows = torch.cat([row, row[more]])
        described, moved = self._deformed(skin, scene.conditions.frame_row[rows])
        near = described.near & (described.d <= self.outer_m[described.vertex])  # cells reach farther than the shell
        described = dataclasses.replace(described, near=near)
        d = torch.where(described.near, described.d, self.reach_m)
        residual = self._residual(described, pose, rows)
        chosen = least_of_limbs(d + residual, more)
        described, d, residual = described.pick(chosen), d.index_select(0, chosen), residual.index_select(0, chosen)
        d_hat = d + residual

        def on_rays(values: Tensor, elsewhere: float) -> Tensor:
            every = values.new_full((depths.numel(), *values.shape[1:]), elsewhere)
            return every.index_copy(0, slots, values).unflatten(0, depths.shape)

        least = least_around(described, d_hat, ends)
        alpha_dot = alpha_from_sdf(on_rays(least, self.reach_m), self.log_sharpness.exp())
        # an opaque core: nothing shines through if the surface lies deeper
        end = torch.where(core[met], 1.0, alpha_dot.flatten()[slots[last]])
        alpha = alpha_dot.flatten().index_copy(0, slots[last], end).view_as(alpha_dot)
        on_surface, surface_m = move_to_surface(described, d_hat, depth_m, ends)
        weights = weights_from_alpha(alpha.detach())
        colour = self._ray_colours(scene, on_surface, weights, slots, row)
        norms = d.new_zeros(0)
        if draws.probe is not None:
            probed = last - count[met] + 1 + (draws.probe[met] * count[met]).long()
            norms = self._gradient_norms(described.pick(probed), skin.pick(chosen[probed]), pose, row[probed])
        elastic = None
        if moved is not None:
            energy = torch.where(described.near, (moved.index_select(0, chosen) / ELASTIC_M).square().sum(-1), 0.0)
            elastic = on_rays(energy, 0.0).sum(1)[met] / count[met]
        in_box = on_rays(described.near, False).any(1, keepdim=True).expand_as(alpha).float()
        d, residual, surface_m = on_rays(d, self.reach_m), on_rays(residual, 0.0), on_rays(surface_m.detach(), 0.0)
        found = RaySamples(alpha, alpha_dot, in_box, colour, None, d, residual, norms, elastic, surface_m)
        return found, depths

    def coverage(self, samples: RaySamples) -> Tensor:
        """Return the coverage by the surface, not by the solid core that ends rays behind it; rays that start inside
        also count as covered."""
        return occupancy(samples.d_hat, self.log_sharpness.exp()).amax(1)

    def training_samples(self, progress: float) -> tuple[int, float | None]:
        """Return twice the spacing early in each phase, while the surface or novel poses are still far from their final
        state."""
        wider = 1 if progress >= WIDE_SPACING_UNTIL else 2
        return MOST_SAMPLES // wider, self.settings.spacing_m * wider

    def rendering_draws(self, scene: PosedScene[ShellGrid], rays: Rays) -> Draws:
        """Return the draws of samples SPACING_M apart, closer where pixels are small."""
        length_m, start_m = scene.region.path_m(rays)
        spacing_m = torch.full_like(start_m, SPACING_M)
        if scene.pixel_rad is not None:
            spacing_m = (SPACING_PX * scene.pixel_rad * start_m).clamp(MIN_SPACING_M, SPACING_M)
        most = int((length_m / spacing_m).ceil().amax().clamp(MIN_SAMPLES, MOST_RENDERED))
        return Draws.deterministic(len(rays), most, length_m.device, spacing_m)

    def _deformed(self, described: Descriptor, frame_row: Tensor) -> tuple[Descriptor, Tensor | None]:
        """Return descriptors (N,) relative to the body as frames `frame_row` (N,) deform it, and the displacements (N,
        3)."""
        if self.deformation is None:
            return described, None
        moved, normal_displacement = self.deformation(described, frame_row)
        return dataclasses.replace(described, y=described.y - moved, d=described.d - normal_displacement), moved

    def _trained(self, described: Descriptor) -> Tensor:
        """Return which points (M,) are in the shell: neither outside it nor deeper inside, where no ray samples and the
        body's d is enough."""
        s = self.settings
        trained = described.near & (described.d < self.reach_m) & (described.d > -s.inner_m - 2 * s.shell_cell_m)
        return torch.nonzero(trained)[:, 0]

    def _residual(self, described: Descriptor, pose: Tensor, row: Tensor) -> Tensor:
        """Return dd (N,) in the shell, 0 elsewhere."""
        pick = self._trained(described)
        y, d, row = (t.index_select(0, pick) for t in (described.y, described.d, row))
        return torch.zeros_like(described.d).index_copy(0, pick, self.field.residual(y, d, pose, row))

    def _ray_colours(
        self, scene: PosedScene[ShellGrid], described: Descriptor, weights: Tensor, slots: Tensor, row: Tensor
    ) -> Tensor:
        """Return the colours (R, K, 3) of samples on rays with weights (R, K). described, slots, row (N,): the samples
        that count, and their places among all. Samples of little weight are not coloured; in rendering, without
        gradients, there are more such samples, and the colours of the others are scaled up to the weight of the whole
        ray."""
        rendering = not torch.is_grad_enabled()
        visible = shown(weights) if rendering else weights > MIN_COLOUR_WEIGHT
        pick = torch.nonzero(visible.flatten()[slots])[:, 0]
        found = self._colour(scene.bodies, described.pick(pick), scene.conditions.pose, row[pick])
        colour = found.new_zeros(weights.numel(), 3).index_copy(0, slots[pick], found)
        share = weights.sum(1) / (weights * visible).sum(1).clamp(min=1e-9) if rendering else weights.new_ones(())
        return colour.view(*weights.shape, 3) * share.view(-1, 1, 1)

    def _colour(self, bodies: PosedBodies, described: Descriptor, pose: Tensor, row: Tensor) -> Tensor:
        """Return the colours (N, 3) of samples. Light falls on the surface's own normal, so that shading shapes the
        surface, too (as in IDR)."""
        y, d, corners, barycentric = described.y, described.d, described.corners, described.barycentric
        outward = weighted_sum(self.rest_normals, corners, barycentric)
        gradient = self._distance_gradient(y, d, outward, pose, row)
        normal = nn.functional.normalize(bodies.turn(gradient, row, corners, barycentric), dim=-1)
        return self.field.colour(y, d, normal, pose, row)

    def _gradient_norms(self, described: Descriptor, skin: Descriptor, pose: Tensor, row: Tensor) -> Tensor:
        """Return |grad d_hat| in the canonical frame at samples (N,) within reach. skin: descriptors before the
        deformation, which give the outward direction."""
        pick = torch.nonzero(described.near)[:, 0]
        away = (skin.y - skin.s)[pick].detach() * skin.d[pick].detach().sign()[:, None]
        outward = nn.functional.normalize(away, dim=-1)
        return self._distance_gradient(described.y[pick], described.d[pick], outward, pose, row[pick]).norm(dim=-1)

    def _distance_gradient(self, y: Tensor, d: Tensor, outward: Tensor, pose: Tensor, row: Tensor) -> Tensor:
        """Return the canonical gradient (N, 3) of d_hat, by forward differences, because grid interpolation has no
        useful second derivative. outward (N, 3): the gradient of d. Gradients flow to the field alone."""
        axes = torch.cat([y.new_zeros(1, 3), torch.eye(3, device=y.device)])  # no step, and one along each axis
        d = d.detach() + GRADIENT_STEP_M * axes @ outward.T
        y = y.detach() + GRADIENT_STEP_M * axes[:, None]
        found = self.field.residual(y.flatten(0, 1), d.flatten(), pose, row.repeat(len(axes))).view_as(d)
        return outward + (found[1:] - found[0]).T / GRADIENT_STEP_M

    def frame_displacements(self, bodies: PosedBodies, points_m: Tensor, frame_row: Tensor) -> Tensor:
        """Return how far the frames of rows `frame_row` (n,) move the surface next to points (N, 3) around the body at
        rest, (n, N, 3)."""
        if self.deformation is None:
            return super().frame_displacements(bodies, points_m, frame_row)
        described = bodies.describe(points_m, frame_row.new_zeros(len(points_m)), FAR_M)
        rows = torch.cat([frame_row, frame_row.new_full((1,), -1)])
        moved_m = torch.stack([self.deformation(described, row.expand(len(points_m)))[0] for row in rows])
        return moved_m[:-1] - moved_m[-1]

    def signed_distance(self, bodies: PosedBodies, points_m: Tensor, conditions: Conditions) -> Tensor:
        """Return d_hat (N,) at points (N, 3) around the first body; beyond the shell it is the body's own distance."""
        return self._at_points(bodies, points_m, conditions, exact_sign=True)[1]

    def colour(self, bodies: PosedBodies, points_m: Tensor, directions: Tensor, conditions: Conditions) -> Tensor:
        """Return c (N, 3) at points around the first body; this field does not depend on the viewing direction."""
        described = self._at_points(bodies, points_m, conditions)[0]
        row = torch.zeros(len(points_m), dtype=torch.long, device=points_m.device)
        return self._colour(bodies, described, conditions.pose, row)

    def _at_points(
        self, bodies: PosedBodies, points_m: Tensor, conditions: Conditions, exact_sign: bool = False
    ) -> tuple[Descriptor, Tensor]:
        """Return descriptors of points (N, 3) around the first body, and d_hat (N,) there."""
        row = torch.zeros(len(points_m), dtype=torch.long, device=points_m.device)
        skin, more = bodies.describe_by_limbs(points_m, row, FAR_M, exact_sign=exact_sign)
        rows = torch.cat([row, row[more]])
        described, _ = self._deformed(skin, conditions.frame_row[rows])
        d_hat = described.d + self._residual(described, conditions.pose, rows)
        chosen = least_of_limbs(d_hat, more)
        return described.pick(chosen), d_hat.index_select(0, chosen)


def least_of_limbs(d_hat: Tensor, more: Tensor) -> Tensor:
    """Return the row of d_hat (N + M,) with the least value at each of N points: the point's own, or one of the last M,
    which are distances to other limbs at points `more` (M,). The person is the union of the limbs."""
    points = len(d_hat) - len(more)
    chosen = torch.arange(points, device=d_hat.device)
    own, other = d_hat.detach().split([points, len(more)])
    least = own.scatter_reduce(0, more, other, "amin")
    better = torch.nonzero((other < own[more]) & (other == least[more]))[:, 0]
    return chosen.index_copy(0, more[better], points + better)


def shown(weights: Tensor) -> Tensor:
    """Return which samples of rays with weights (R, K) are coloured in rendering, bool: those of some weight, and those
    of at least half the greatest on their ray."""
    return weights > (weights.amax(1, keepdim=True) / 2).clamp(max=MIN_SHOWN_WEIGHT)


def on_same_limb(described: Descriptor, ends: Tensor) -> Tensor:
    """Return which of N samples, one ray after another, are on the limb of the next one on their ray, both within
    reach, (N - 1,) bool. ends (N,) bool: the last sample of each ray."""
    y, near = described.y, described.near
    return near[:-1] & near[1:] & ~ends[:-1] & ((y[1:] - y[:-1]).norm(dim=-1) < MAX_NEIGHBOUR_DISTANCE_M)


def least_around(described: Descriptor, d_hat: Tensor, ends: Tensor) -> Tensor:
    """Replace d_hat (N,) at samples that are closer to their limb than both neighbours by the least of the parabola
    through the three, as if they were evenly spaced: a ray that passes a finger is closest to it between two samples.
    ends: as in `on_same_limb`."""
    if len(d_hat) < 3:
        return d_hat
    same_limb = on_same_limb(described, ends)
    before, at, after = d_hat[:-2], d_hat[1:-1], d_hat[2:]
    closest = same_limb[:-1] & same_limb[1:] & (at <= before) & (at <= after)
    deeper_m = (after - before).square() / (8 * (before + after - 2 * at)).clamp(min=MIN_DESCENT_M)
    return d_hat - nn.functional.pad(torch.where(closest, deeper_m, 0.0), (1, 1))


def move_to_surface(described: Descriptor, d_hat: Tensor, depth_m: Tensor, ends: Tensor) -> tuple[Descriptor, Tensor]:
    """Move samples (N,) at depths (N,) along their rays to where d_hat (N,), linear between samples, is zero or closest
    to it; also return the new depths. ends: as in `on_same_limb`.

    A sample's opacity is that of the path to the next sample; its colour is that of the surface that makes this path
    opaque. If the next sample is nearer to another limb's surface, or is the first within reach, it is that surface:
    the sample moves to where its successor moves on that limb. Otherwise limbs would have ghosts of their outlines on
    the limbs behind them. A limb's first sample, unless it is the first of the ray, also moves back if it is already
    inside, by up to the distance to the second. A ray's last sample stays, as do samples whose successor is out of
    reach. Gradients also flow through the position of the zero (as in IDR, Yariv et al. 2020): a body that moves along
    a ray shows the same point to it, and without that term it would be drawn towards or away from its camera.
    """
    same_limb, ahead, after = on_same_limb(described, ends), d_hat[:-1], d_hat[1:]
    descends = described.near[1:] & ~ends[:-1] & (ahead > after)
    descent_m = (ahead - after).clamp(min=MIN_DESCENT_M)
    back = torch.zeros_like(ahead)  # how far a limb's first sample may go
    back[1:] = -(~same_limb[:-1] & ~ends[:-2]).to(d_hat)
    share = torch.where(descends & same_limb, ahead / descent_m, 0.0).clamp(max=1).maximum(back)[:, None]
    skips = torch.zeros_like(ends)
    skips[:-1] = descends & ~same_limb
    source = torch.arange(len(skips), device=skips.device) + skips

    def moved(values: Tensor) -> Tensor:
        return torch.cat([torch.lerp(values[:-1], values[1:], share), values[-1:]]).index_select(0, source)

    corners, barycentric = (t.index_select(0, source) for t in (described.corners, described.barycentric))
    d, depth_m = moved(torch.stack([described.d, depth_m], 1)).unbind(1)
    surface = dataclasses.replace(described, y=moved(described.y), d=d, corners=corners, barycentric=barycentric)
    return surface, depth_m
