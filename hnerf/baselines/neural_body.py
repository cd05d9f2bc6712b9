"""NeuralBody (Peng et al., Neural Body: Implicit Neural Representations with Structured Latent Codes for Novel View
Synthesis of Dynamic Humans, CVPR 2021)."""

from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn

from hnerf.baselines.box import DynamicField
from hnerf.baselines.nerf import DENSITY_GAIN
from hnerf.baselines.voxels import Voxels
from hnerf.body.canonical import PosedBodies
from hnerf.body.fit_result import BodyFit
from hnerf.config import NeuralBodySettings
from hnerf.fields.conditions import Conditions, Draws
from hnerf.fields.encoding import positional_encoding
from hnerf.fields.rays import PosedScene, Rays
from hnerf.fields.samples import RaySamples
from hnerf.fields.shell import Boxes, stratified

LEVELS = 5  # the finest takes the codes, the other four give the features (section 3.2 of the paper)
POSITION_OCTAVES, VIEW_OCTAVES = 10, 4
APPEARANCE_WIDTH = 16  # width of a frame's code
INITIAL_CODE_STD = 0.1  # of the vertices' codes


@dataclass(frozen=True)
class NeuralBodyRegion:
    """Region by body row: box, root (n, 4, 4), voxels around the body in its root frame, and the codes diffused over
    them at the levels that are read; diffused is None in training, where it changes with every step."""

    box: Boxes
    root: Tensor
    voxels: list[Voxels]
    diffused: list[list[Tensor]] | None


class SparseConvolution(nn.Module):
    """3 x 3 x 3 convolution over active voxels, with normalisation and ReLU."""

    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        self.linear = nn.Linear(27 * inputs, outputs, bias=False)
        self.norm = nn.LayerNorm(outputs)

    def forward(self, values: Tensor, rows: Tensor) -> Tensor:
        """Convolve values (N + 1, inputs) at stencils rows (M, 27): (M + 1, outputs). The last row of input and output
        is zero."""
        found = self.norm(self.linear(nn.functional.embedding(rows, values).flatten(1))).relu()
        return torch.cat([found, torch.zeros_like(found[:1])])


class Diffusion(nn.Module):
    """Diffusion of vertex codes to features around the body, at LEVELS - 1 resolutions."""

    def __init__(self, code_width: int, channels: int):
        super().__init__()
        inputs = [code_width] + [channels] * (LEVELS - 2)
        self.first = SparseConvolution(code_width, code_width)
        self.coarser = nn.ModuleList(SparseConvolution(n, channels) for n in inputs)
        self.beside = nn.ModuleList(SparseConvolution(channels, channels) for _ in inputs)

    def forward(self, codes: Tensor, voxels: Voxels) -> list[Tensor]:
        """Diffuse codes (V, C): (N + 1, channels) at each level that is read, the last row zero."""
        total = codes.new_zeros(len(voxels.count) + 1, codes.shape[1]).index_add(0, voxels.vertex, codes)
        values = total / torch.cat([voxels.count, voxels.count.new_ones(1)])[:, None]
        values = self.first(values, voxels.levels[0].neighbours)
        found = []
        for level, coarser, beside in zip(voxels.levels[1:], self.coarser, self.beside, strict=True):
            values = beside(coarser(values, level.finer_neighbours), level.neighbours)
            found.append(values)
        return found


class NeuralBodyField(DynamicField):
    """Dynamic field: a code on every vertex of the body, diffused by sparse convolutions in the root frame of the posed
    body. Density depends on the diffused codes at a point; colour also on the view, the world position, and a code of
    the frame's appearance, which is zero for poses that were not trained.

    Simplified: voxels of `voxel_m` (5 mm in the paper), one convolution between those of stride 2 where the paper has
    two or three, fewer channels, narrower networks, shorter frame codes (128 wide in the paper) and fewer samples (64
    in the paper), so that minutes on two CPU cores are meaningful; layers are normalised by voxel, not by batch, so
    that a frame does not depend on what else is in its batch; Swish instead of ReLU, and softplus for the density, as
    in NerfField; the mean absolute colour error as for all compared methods, not the squared one; codes of a voxel's
    vertices are averaged.

    In evaluation mode `region` runs the convolutions; in training each `sample` runs them once for every frame in its
    batch.
    """

    def __init__(self, body: BodyFit, settings: NeuralBodySettings):
        super().__init__(body, settings, APPEARANCE_WIDTH)
        width, features = settings.width, settings.channels * (LEVELS - 1)
        self.vertex_codes = nn.Parameter(INITIAL_CODE_STD * torch.randn(len(body.rig.vertices_m), settings.code_width))
        self.diffusion = Diffusion(settings.code_width, settings.channels)
        sizes = [features, width, width, width]
        self.trunk = nn.Sequential(*(m for a, b in pairwise(sizes) for m in (nn.Linear(a, b), nn.SiLU())))
        self.density = nn.Linear(width, 1)
        encoded = 3 * (2 + 2 * (POSITION_OCTAVES + VIEW_OCTAVES))
        self.radiance = nn.Sequential(
            nn.Linear(width + APPEARANCE_WIDTH + encoded, width), nn.SiLU(), nn.Linear(width, 3), nn.Sigmoid()
        )

    def region(self, bodies: PosedBodies, conditions: Conditions) -> NeuralBodyRegion:
        """Return box and voxels of each body and, in evaluation mode, the diffused codes."""
        local_m = _to_root_frame(bodies.vertices_m, bodies.root)
        voxels = [Voxels.around(points_m, self.settings.voxel_m, LEVELS) for points_m in local_m]
        diffused = None if self.training else [self.diffusion(self.vertex_codes, v) for v in voxels]
        return NeuralBodyRegion(super().region(bodies, conditions), bodies.root, voxels, diffused)

    def sample(self, scene: PosedScene[NeuralBodyRegion], rays: Rays, draws: Draws) -> tuple[RaySamples, Tensor]:
        """Evaluate rays as Field.sample does, at `samples` depths in the body's box."""
        near, far = scene.region.box.interval(rays)
        depths = stratified(near, far, draws.jitter)
        points = rays.points(depths).flatten(0, 1)
        row, view = (x.repeat_interleave(self.samples, 0) for x in (rays.frame, rays.directions))
        features = self.trunk(self._features(scene.region, points, row))
        density = self._density(features).view_as(depths)
        colour = self._colour(features, points, view, row, scene.conditions).view(*depths.shape, 3)
        return self.to_samples(density, colour, depths, far), depths

    def _features(self, region: NeuralBodyRegion, points_m: Tensor, row: Tensor) -> Tensor:
        """Return the diffused codes at points (N, 3) around bodies of rows (N,), concatenated over all levels."""
        found = points_m.new_zeros(len(points_m), self.settings.channels * (LEVELS - 1))
        for body in row.unique().tolist():
            voxels = region.voxels[body]
            diffused = region.diffused[body] if region.diffused else self.diffusion(self.vertex_codes, voxels)
            pick = torch.nonzero(row == body)[:, 0]
            local_m = _to_root_frame(points_m[pick][None], region.root[body][None])[0]
            read = [
                level.interpolate(values, voxels.coordinates(local_m, k))
                for k, (level, values) in enumerate(zip(voxels.levels[1:], diffused, strict=True), 1)
            ]
            found = found.index_copy(0, pick, torch.cat(read, 1))
        return found

    def _density(self, features: Tensor) -> Tensor:
        return nn.functional.softplus(DENSITY_GAIN * self.density(features)[:, 0])

    def _colour(self, features: Tensor, points_m: Tensor, view: Tensor, row: Tensor, conditions: Conditions) -> Tensor:
        encoded = positional_encoding(self.scaled(points_m), POSITION_OCTAVES)
        inputs = [features, self.code(conditions)[row], encoded, positional_encoding(view, VIEW_OCTAVES)]
        return self.radiance(torch.cat(inputs, 1))

    def signed_distance(self, bodies: PosedBodies, points_m: Tensor, conditions: Conditions) -> Tensor:
        """Return the pseudo-distance (N,) to the surface of density sigma_h (as NerfField) around the first body, cut
        and closed by the box."""
        region = self.region(bodies, conditions)
        row = torch.zeros(len(points_m), dtype=torch.long, device=points_m.device)
        density = self._density(self.trunk(self._features(region, points_m, row)))
        return torch.maximum(self.pseudo_distance(density), region.box.signed_distance(points_m))

    def colour(self, bodies: PosedBodies, points_m: Tensor, directions: Tensor, conditions: Conditions) -> Tensor:
        """Return c (N, 3) at points around the first body, seen along directions (N, 3)."""
        row = torch.zeros(len(points_m), dtype=torch.long, device=points_m.device)
        features = self.trunk(self._features(self.region(bodies, conditions), points_m, row))
        return self._colour(features, points_m, directions, row, conditions)


def _to_root_frame(points_m: Tensor, root: Tensor) -> Tensor:
    """Transform world points (n, N, 3) to the frames of roots (n, 4, 4), world from body."""
    return (points_m - root[:, None, :3, 3]) @ root[:, :3, :3]
