"""H-NeRF as published: the networks F and DH, whole rays, background included.

Distances are in scene units (metres / scene_m) inside the networks and losses, in metres outside. One network F serves
the coarse and the fine samples; the fine ones are drawn from the coarse weights without a gradient, and the losses see
both.
"""

import dataclasses

import torch
from torch import Tensor, nn

from hnerf.body.canonical import FAR_M, Descriptor, PosedBodies
from hnerf.body.fit_result import BodyFit
from hnerf.body.rig import Rig
from hnerf.config import PaperFieldSettings
from hnerf.fields.base import Field
from hnerf.fields.compositing import alpha_from_density, occupancy, weights_from_alpha
from hnerf.fields.conditions import Conditions, Draws
from hnerf.fields.mlp import RadianceMLP, ResidualMLP
from hnerf.fields.rays import PosedScene, Rays
from hnerf.fields.samples import RaySamples
from hnerf.fields.shell import Boxes, box_interval, stratified

OUTSIDE_DISTANCE = 1.0  # the constant d of a point outside the person's box


class PaperField(Field):
    """F and DH. Dynamic: conditioned on (s, d) and theta. Static (one frame): on x itself, unconditioned."""

    models_background = True
    settings: PaperFieldSettings
    centre_m: Tensor

    @classmethod
    def build(cls, body: BodyFit, settings: PaperFieldSettings, static: bool) -> "PaperField":
        """Return an untrained field, in the paper's static form if there is one training frame."""
        return cls(body.rig, body.root, settings, static)

    def __init__(self, rig: Rig, root: Tensor, settings: PaperFieldSettings, static: bool):
        """Build an untrained field. root (n, 4, 4): the poses of all fitted frames, on which the scene is centred."""
        super().__init__()
        self.settings, self.static = settings, static
        self.whole_images = settings.rays == "image"
        self.samples, self.gamma, self.unit_m = settings.samples, settings.gamma, settings.scene_m
        self.register_buffer("canonical_m", rig.vertices_m.clone())
        self.register_buffer("centre_m", root[:, :3, 3].mean(0))
        root_inputs = 12 if settings.root_condition else 0
        point, pose, self.root_inputs = (3, 0, 0) if static else (4, 3 * int(rig.free.sum()), root_inputs)
        self.radiance = RadianceMLP(point, pose, self.root_inputs, settings.view_octaves, settings.bf16)
        self.residual = ResidualMLP(point, pose, settings.bf16)

    def compile_networks(self) -> None:
        """Compile F, but not DH: torch does not compile the second derivatives that `eikonal` needs. If compilation
        fails, for example without Python's headers, torch warns and runs F uncompiled."""
        torch._dynamo.config.suppress_errors = True
        self.radiance.compile(dynamic=True)

    def sample(self, scene: PosedScene[Boxes], rays: Rays, draws: Draws) -> tuple[RaySamples, Tensor]:
        """Evaluate rays as Field.sample does, at coarse and fine samples together (K = 2 x samples)."""
        box, half_m, inner = scene.region, self.settings.scene_m, self.settings.box_samples
        # the scene grows to hold a person who walks out of it
        lower_m = torch.minimum(self.centre_m - half_m, box.lower_m[rays.frame])
        upper_m = torch.maximum(self.centre_m + half_m, box.upper_m[rays.frame])
        near, far = box_interval(rays, lower_m, upper_m)
        coarse = stratified(near, far, draws.jitter[:, inner:])
        if inner:
            entry, leave = (t.clamp(near, far) for t in box.interval(rays))
            coarse = torch.cat([coarse, stratified(entry, leave, draws.jitter[:, :inner])], 1).sort(1).values
        with torch.no_grad():
            coarse_samples = self._evaluate(dataclasses.replace(scene, correction=None), rays, draws, coarse)
            fine = sample_pdf(coarse, near, far, weights_from_alpha(coarse_samples.alpha), draws.fine)
            depths = torch.cat([coarse, fine], 1).sort(1).values
        return self._evaluate(scene, rays, draws, depths), depths

    def _evaluate(self, scene: PosedScene[Boxes], rays: Rays, draws: Draws, depths: Tensor) -> RaySamples:
        region, conditions = scene.region, scene.conditions
        points = rays.points(depths).flatten(0, 1)
        row = rays.frame.repeat_interleave(depths.shape[1])
        inside = ((points >= region.lower_m[row]) & (points <= region.upper_m[row])).all(-1)
        inside.view_as(depths)[:, -1] = False  # it is opaque: it stands for all that lies beyond, also where a box ends
        train = draws.probe is not None and torch.is_grad_enabled()
        pick = torch.nonzero(inside)[:, 0]
        queried = points[pick].detach().requires_grad_(train)
        described = scene.bodies.describe(queried, row[pick], FAR_M, scene.correction)
        residual_in = self._residual(queried, described, row[pick], conditions)
        d_in = described.d / self.settings.scene_m
        norms = d_in.new_zeros(0)
        if train:
            gradient = torch.autograd.grad(
                (d_in + residual_in).sum() * self.settings.scene_m, queried, create_graph=True
            )
            norms = gradient[0].norm(dim=-1)
        d = points.new_full((len(points),), OUTSIDE_DISTANCE).index_copy(0, pick, d_in)
        residual = torch.zeros_like(d).index_copy(0, pick, residual_in)
        view = rays.directions if draws.view is None else rays.directions + draws.view
        view = view.repeat_interleave(depths.shape[1], 0)
        density, colour = self._radiance(points, described, pick, row, view, conditions)
        spacing = torch.diff(depths, dim=1, append=depths[:, -1:] + 1e10) / self.settings.scene_m
        density, d, residual = (t.view_as(depths) for t in (density, d, residual))
        return RaySamples(
            alpha=alpha_from_density(density, spacing),
            alpha_dot=occupancy(d + residual, self.gamma),
            in_box=inside.float().view_as(depths),
            colour=colour.view(*depths.shape, 3),
            density=density,
            d=d,
            residual=residual,
            gradient_norm=norms,
        )

    def _scaled(self, points_m: Tensor) -> Tensor:
        return (points_m - self.centre_m) / self.settings.scene_m

    def _residual(self, points_m: Tensor, described: Descriptor, row: Tensor, conditions: Conditions) -> Tensor:
        if self.static:
            return self.residual(self._scaled(points_m), conditions.pose[row, :0])
        scaled = torch.cat([described.s, described.d[:, None]], -1) / self.settings.scene_m
        return self.residual(scaled, conditions.pose[row])

    def _radiance(
        self, points_m: Tensor, described: Descriptor, pick: Tensor, row: Tensor, view: Tensor, conditions: Conditions
    ) -> tuple[Tensor, Tensor]:
        """Return density and colour. Outside the box the input is x with a constant distance, and pose and root are
        zero. The root's translation is relative to the scene's centre."""
        scaled = self._scaled(points_m)
        if self.static:
            return self.radiance(scaled, conditions.pose[row, :0], conditions.root[row, :0], view)
        outside = torch.cat([scaled, torch.full_like(scaled[:, :1], OUTSIDE_DISTANCE)], -1)
        inner = torch.cat([described.s, described.d[:, None]], -1) / self.settings.scene_m
        pose = torch.zeros_like(conditions.pose[row]).index_copy(0, pick, conditions.pose[row[pick]])
        centre = nn.functional.pad(self.centre_m[:, None] / self.settings.scene_m, (3, 0))  # (3, 4), like the rows of T
        root_inputs = (conditions.root - centre.flatten())[:, : self.root_inputs]
        root = torch.zeros_like(root_inputs[row]).index_copy(0, pick, root_inputs[row[pick]])
        return self.radiance(outside.index_copy(0, pick, inner), pose, root, view)

    def coverage(self, samples: RaySamples) -> Tensor:
        """Return the greatest occupancy of the SDF along each ray, which the loss `seg` compares with the mask."""
        return (samples.in_box * samples.alpha_dot).amax(1)

    def signed_distance(self, bodies: PosedBodies, points_m: Tensor, conditions: Conditions) -> Tensor:
        """Return d_hat (N,) in metres at points (N, 3), cut by the box of the first body: DH is not trained outside."""
        row = torch.zeros(len(points_m), dtype=torch.long, device=points_m.device)
        described = bodies.describe(points_m, row, FAR_M, exact_sign=True)
        d_hat_m = described.d + self.settings.scene_m * self._residual(points_m, described, row, conditions)
        return torch.maximum(d_hat_m, self.region(bodies, conditions).signed_distance(points_m))

    def colour(self, bodies: PosedBodies, points_m: Tensor, directions: Tensor, conditions: Conditions) -> Tensor:
        """Return c (N, 3) at points around the first body, seen along directions (N, 3)."""
        every = torch.arange(len(points_m), device=points_m.device)
        row = torch.zeros_like(every)
        described = bodies.describe(points_m, row, FAR_M)
        return self._radiance(points_m, described, every, row, directions, conditions)[1]


def sample_pdf(middles: Tensor, near: Tensor, far: Tensor, weights: Tensor, uniform: Tensor) -> Tensor:
    """Draw depths (R, K) from piecewise constant weights (R, K) by inverse transform sampling (Mildenhall et al. 2020,
    section 5.2).

    middles (R, K): the samples that have these weights; their cells meet half-way between samples. uniform (R, K) in
    [0, 1): position in each stratum.
    """
    edges = torch.cat([near[:, None], (middles[:, 1:] + middles[:, :-1]) / 2, far[:, None]], 1)
    cumulative = torch.cat([torch.zeros_like(near)[:, None], (weights + 1e-5).cumsum(1)], 1)
    cumulative = cumulative / cumulative[:, -1:]
    count = uniform.shape[1]
    wanted = (torch.arange(count, device=near.device) + uniform) / count
    upper = torch.searchsorted(cumulative, wanted.contiguous(), right=True).clamp(1, edges.shape[1] - 1)
    below, above = cumulative.gather(1, upper - 1), cumulative.gather(1, upper)
    start, end = edges.gather(1, upper - 1), edges.gather(1, upper)
    return start + (end - start) * (wanted - below) / (above - below).clamp(min=1e-9)
