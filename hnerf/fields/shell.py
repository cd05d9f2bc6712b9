"""Sampling regions: per frame a voxel grid of empty, shell and solid cells, with rays sampled in the shell alone; or,
for the published methods, a box."""

# mypy: disable-error-code="no-untyped-def"

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import torch
from scipy import ndimage
from torch import Tensor

from hnerf.body.canonical import weighted_sum
from hnerf.fields.rays import Rays
from hnerf.warp_import import wp

EMPTY, SHELL, SOLID = 0, 1, 2
MIN_SAMPLES = 6  # on a ray that gets as many as its path requires
SLACK = 0.5  # cells: most of a cell then lies in the shell; thicknesses leave more room than its corners need


@dataclass(frozen=True)
class ShellGrid:
    """Voxel grid around each body. cells (n, X, Y, Z) uint8 of EMPTY, SHELL, SOLID; lower_m (n, 3): corner of each
    frame's grid; cell_m: edge length."""

    cells: Tensor
    lower_m: Tensor
    cell_m: float

    @staticmethod
    def around(
        vertices_m: Tensor, outer_m: Tensor, inner_m: Tensor, points: tuple[Tensor, Tensor], cell_m: float
    ) -> "ShellGrid":
        """Build the shell around closed surfaces with vertices (n, V, 3); outer_m, inner_m (n, V): thickness in metres
        outside and inside; points: dense surface points, as `surface_points` returns them.

        From each surface point's cell the shell extends by the thickness there plus half a cell, measured between cell
        centres, so it is up to a cell thicker or thinner than requested.
        """
        wp.init()
        corners, weights = points
        margin_m = float(outer_m.max()) + 2 * cell_m
        lower = vertices_m.amin(1) - margin_m
        sizes = ((vertices_m.amax(1) + margin_m - lower) / cell_m).ceil().long()
        shape = len(sizes), *sizes.amax(0).tolist()
        cells = torch.full(shape, EMPTY, dtype=torch.uint8, device=vertices_m.device)

        def fill(row_and_size: tuple[int, list[int]]) -> None:
            row, size = row_and_size
            index = ((weighted_sum(vertices_m[row], corners, weights) - lower[row]) / cell_m).long()
            thickness = (side[row][corners].amax(-1) / cell_m for side in (outer_m, inner_m))
            cells[row][tuple(map(slice, size))] = _classify_cells(size, index, *thickness)

        with ThreadPoolExecutor(torch.get_num_threads()) as threads:  # one frame per thread, which bounds memory
            list(threads.map(fill, enumerate(sizes.tolist())))
        return ShellGrid(cells, lower, cell_m)

    def cell_states(self, rays: Rays, depths_m: Tensor) -> Tensor:
        """Return the state of the cells at depths (R, K) along R rays: (R, K) uint8. Outside the grid, the state is
        that of the outermost cells, which are EMPTY."""
        origins = (rays.origins_m - self.lower_m[rays.frame]) / self.cell_m
        directions = rays.directions / self.cell_m
        flat = rays.frame[:, None].to(torch.int32 if self.cells.numel() < 2**31 else torch.int64)
        for axis, size in enumerate(self.cells.shape[1:]):
            index = torch.addcmul(origins[:, axis, None], directions[:, axis, None], depths_m)
            flat = flat * size + index.clamp_(0, size - 1).to(flat.dtype)
        return self.cells.flatten().index_select(0, flat.flatten()).view_as(flat)

    def sample_rays(self, rays: Rays, jitter: Tensor, spacing_m: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Return sorted depths (R, K) in metres, evenly distributed over the shell up to the first solid cell; how many
        of them count, (R,) long, 0 if the ray misses the shell; and whether a solid cell ends it, (R,) bool.

        jitter (R, K) in [0, 1): position in each stratum. spacing_m (R,): path for each sample, of which a ray gets at
        least MIN_SAMPLES, at most K; without it, a ray gets K. Depths that do not count lie at the end of the path.
        """
        edges, cumulative, ends = self._march(rays)
        most = jitter.shape[1]
        strata = torch.arange(most, device=edges.device, dtype=edges.dtype)
        count = torch.full_like(edges[:, 0], most)
        if spacing_m is not None:
            count = (self.cell_m * cumulative[:, -1] / spacing_m).ceil().clamp(min(MIN_SAMPLES, most), most)
        share = ((strata + jitter) / count[:, None]).clamp(max=1 - 2**-24)  # below 1, which rounding might reach
        wanted = share * cumulative[:, -1:]
        upper = torch.searchsorted(cumulative, wanted.contiguous(), right=True).clamp(1, edges.shape[1] - 1)
        inside = wanted - cumulative.gather(1, upper - 1)
        count = torch.where(cumulative[:, -1] > 0, count, 0.0).long()
        return edges.gather(1, upper - 1) + inside * self.cell_m, count, ends

    def path_m(self, rays: Rays) -> tuple[Tensor, Tensor]:
        """Return the length of the path over which `sample_rays` distributes the samples, and the depth at which rays
        enter the grid, (R,) each, in metres."""
        edges, cumulative, _ = self._march(rays)
        return self.cell_m * cumulative[:, -1], edges[:, 0]

    def _march(self, rays: Rays) -> tuple[Tensor, Tensor, Tensor]:
        """Return depths (R, B + 1) of equal steps through the grid; the number of steps before each that are in the
        shell and before the first solid cell, (R, B + 1); and whether there is a solid cell, (R,) bool."""
        lower_m = self.lower_m[rays.frame]
        size_m = self.cell_m * torch.tensor(self.cells.shape[1:], device=lower_m.device)
        near, far = box_interval(rays, lower_m, lower_m + size_m)
        bins = max(1, math.ceil(float((far - near).max()) / self.cell_m))
        edges = near[:, None] + self.cell_m * torch.arange(bins + 1, device=near.device)  # independent of the batch
        middles = (edges[:, 1:] + edges[:, :-1]) / 2
        state = self.cell_states(rays, middles)
        deepest = state.cummax(1).values  # EMPTY < SHELL < SOLID
        weight = ((state == SHELL) & (deepest < SOLID)).float()
        cumulative = torch.cat([torch.zeros_like(near)[:, None], weight.cumsum(1)], 1)
        return edges, cumulative, deepest[:, -1] == SOLID


def surface_points(vertices_m: Tensor, faces: Tensor, spacing_m: float) -> tuple[Tensor, Tensor]:
    """Return points on a surface, vertices included, at most `spacing_m` apart along edges: corner indices (P, 3) and
    barycentric weights (P, 3), valid in any pose."""
    corners_m = vertices_m[faces]
    longest_m = (corners_m - corners_m.roll(1, 1)).norm(dim=-1).amax(1)
    parts = (longest_m / spacing_m).ceil().long().clamp(min=1)
    corners, weights = [], []
    for n in parts.unique().tolist():
        steps = torch.cartesian_prod(torch.arange(n + 1), torch.arange(n + 1))
        steps = steps[steps.sum(1) <= n]
        inside = torch.cat([steps, n - steps.sum(1, keepdim=True)], 1).to(vertices_m) / n
        split = faces[parts == n]
        corners.append(split.repeat_interleave(len(inside), 0))
        weights.append(inside.repeat(len(split), 1))
    return torch.cat(corners), torch.cat(weights)


def _classify_cells(size: list[int], points: Tensor, outer: Tensor, inner: Tensor) -> Tensor:
    """Return the states of a frame's cells around surface points (V, 3) with thicknesses (V,), all in cells."""
    beside = _within(size, points, torch.ones_like(outer))  # a cell thicker than the surface: the inside has no leaks
    away, _ = ndimage.label(~beside.cpu().numpy())
    inside = torch.from_numpy(away != away[0, 0, 0]).to(points.device)
    shell = torch.where(inside, _within(size, points, inner + SLACK), _within(size, points, outer + SLACK))
    return (SOLID * inside.to(torch.uint8)).masked_fill_(shell, SHELL)  # EMPTY is 0


def _within(size: list[int], points: Tensor, reach: Tensor) -> Tensor:
    """Return the cells whose centres lie within a point's reach of the centre of its cell, as a bool tensor of this
    size; points (V, 3), reach (V,)."""
    index = (points[:, 0] * size[1] + points[:, 1]) * size[2] + points[:, 2]
    farthest = torch.zeros(math.prod(size), device=points.device).scatter_reduce_(0, index, reach.float(), "amax")
    centres = torch.nonzero(farthest.view(size))
    within = torch.zeros(size, dtype=torch.uint8, device=points.device)
    _launch(centres.int().contiguous(), farthest[farthest > 0], within)
    return within.bool()


def _launch(centres: Tensor, radii: Tensor, cells: Tensor) -> None:
    inputs = [wp.from_torch(centres, dtype=wp.vec3i), wp.from_torch(radii), wp.from_torch(cells)]
    wp.launch(_fill_balls, len(centres), inputs, device=wp.device_from_torch(cells.device))


@wp.kernel
def _fill_balls(centres: wp.array(dtype=wp.vec3i), radii: wp.array(dtype=float), cells: wp.array3d(dtype=wp.uint8)):
    """Set all cells with centres within `radii` of the centres' own to 1."""
    i = wp.tid()
    centre, squared = centres[i], radii[i] * radii[i]
    reach = int(radii[i])
    for x in range(wp.max(centre[0] - reach, 0), wp.min(centre[0] + reach + 1, cells.shape[0])):
        beyond_x = squared - float((x - centre[0]) * (x - centre[0]))
        for y in range(wp.max(centre[1] - reach, 0), wp.min(centre[1] + reach + 1, cells.shape[1])):
            beyond_y = beyond_x - float((y - centre[1]) * (y - centre[1]))
            if beyond_y >= 0.0:
                depth = int(wp.sqrt(beyond_y))
                for z in range(wp.max(centre[2] - depth, 0), wp.min(centre[2] + depth + 1, cells.shape[2])):
                    cells[x, y, z] = wp.uint8(1)


@dataclass(frozen=True)
class Boxes:
    """Bounding box of the person by body row: lower_m, upper_m (n, 3)."""

    lower_m: Tensor
    upper_m: Tensor

    @staticmethod
    def around(vertices_m: Tensor, margin_m: float) -> "Boxes":
        """Return the extents of bodies (n, V, 3), enlarged by a margin."""
        return Boxes(vertices_m.amin(1) - margin_m, vertices_m.amax(1) + margin_m)

    def interval(self, rays: Rays) -> tuple[Tensor, Tensor]:
        """Return entry and exit depths (R,) of R rays in the boxes of their bodies; equal where the box is missed."""
        return box_interval(rays, self.lower_m[rays.frame], self.upper_m[rays.frame])

    def signed_distance(self, points_m: Tensor) -> Tensor:
        """Return the signed distance (N,) in metres of points (N, 3) to the first box, negative inside."""
        outside_m = torch.maximum(self.lower_m[0] - points_m, points_m - self.upper_m[0])
        return outside_m.clamp(min=0).norm(dim=-1) + outside_m.amax(-1).clamp(max=0)


def box_interval(rays: Rays, lower_m: Tensor, upper_m: Tensor) -> tuple[Tensor, Tensor]:
    """Return entry and exit depths (R,) of rays in axis-aligned boxes (R, 3) by the slab method. Where the box is
    missed, both are the first exit from a slab: the last entry may be at infinity."""
    inverse = 1 / torch.where(rays.directions.abs() < 1e-9, torch.full_like(rays.directions, 1e-9), rays.directions)
    a, b = (lower_m - rays.origins_m) * inverse, (upper_m - rays.origins_m) * inverse
    far = torch.maximum(a, b).amin(-1).clamp(min=0)
    return torch.minimum(torch.minimum(a, b).amax(-1).clamp(min=0), far), far


def stratified(near: Tensor, far: Tensor, jitter: Tensor) -> Tensor:
    """Return depths (R, K), one in each of K equal parts of [near, far] (R,), at position jitter (R, K) in [0, 1) of
    its part."""
    strata = torch.arange(jitter.shape[1], device=near.device)
    return near[:, None] + (far - near)[:, None] * (strata + jitter) / jitter.shape[1]
