import math

import pytest
import torch

from hnerf.fields.rays import Rays
from hnerf.fields.shell import EMPTY, SHELL, SLACK, SOLID, ShellGrid, _classify_cells, box_interval, surface_points
from tests.body.boxes import box_faces, box_vertices


def sphere(radius_m: float) -> torch.Tensor:
    """Return densely sampled points (1, N, 3) on a sphere about the origin."""
    points = torch.randn(40000, 3, generator=torch.Generator().manual_seed(0))
    return radius_m * torch.nn.functional.normalize(points, dim=-1)[None]


def shell_around(surface: torch.Tensor, outer: torch.Tensor, inner: torch.Tensor, cell_m: float) -> ShellGrid:
    """Return the shell around surfaces whose vertices are dense enough to serve as the only surface points."""
    corners = torch.arange(surface.shape[1])[:, None].expand(-1, 3)
    points = corners, torch.tensor([1.0, 0.0, 0.0]).expand(len(corners), -1)
    return ShellGrid.around(surface, outer, inner, points, cell_m)


def even_shell(surface: torch.Tensor, outer_m: float, inner_m: float, cell_m: float) -> ShellGrid:
    """Return a shell of the same thickness everywhere."""
    outer, inner = (torch.full(surface.shape[:2], thickness) for thickness in (outer_m, inner_m))
    return shell_around(surface, outer, inner, cell_m)


def along_x(grid: ShellGrid, x_m: list[float]) -> list[int]:
    """Return the states of the first frame's cells on the x axis."""
    axis = Rays(torch.zeros(1, 3), torch.eye(3)[:1], torch.zeros(1).long())
    return grid.cell_states(axis, torch.tensor([x_m]))[0].tolist()


def test_box_interval_by_hand():
    """A ray along x is in [1, 2] from depth 1 to 2. For those that miss, 4 m beside in y, the interval is empty: at the
    origin, or at depth 2, where the ray leaves the slab in x. It enters the one in y at 4e9 m, which no network should
    see."""
    origins = torch.tensor([[0.0, 0.5, 0.5], [0.0, 5.0, 0.5], [0.0, -4.0, 0.5]])
    rays = Rays(origins, torch.tensor([[1.0, 0.0, 0.0]]).expand(3, 3), torch.zeros(3).long())
    lower, upper = torch.tensor([[1.0, 0.0, 0.0]]).expand(3, 3), torch.tensor([[2.0, 1.0, 1.0]]).expand(3, 3)
    near, far = box_interval(rays, lower, upper)
    assert (near[0].item(), far[0].item()) == (1.0, 2.0)
    assert near[1:].tolist() == far[1:].tolist() == [0.0, 2.0]


def test_box_interval_of_a_ray_that_starts_inside():
    """Inside [1, 2] along x, the interval is from 0 to the side half a metre ahead, or to y = 0.74, 0.24 / 0.6 away. A
    box behind the camera gives an empty interval."""
    origins = torch.tensor([[1.5, 0.5, 0.5], [1.5, 0.5, 0.5], [4.0, 0.5, 0.5]])
    directions = torch.tensor([[1.0, 0, 0], [0.8, 0.6, 0], [1, 0, 0]])
    lower, upper = torch.tensor([[1.0, 0.0, 0.0]]).expand(3, 3), torch.tensor([[2.0, 0.74, 1.0]]).expand(3, 3)
    near, far = box_interval(Rays(origins, directions, torch.zeros(3).long()), lower, upper)
    torch.testing.assert_close(near, torch.zeros(3))
    torch.testing.assert_close(far, torch.tensor([0.5, 0.4, 0.0]))


def test_cell_states_around_a_sphere():
    grid = even_shell(sphere(0.3), outer_m=0.05, inner_m=0.04, cell_m=0.02)
    assert along_x(grid, [0.0, 0.27, 0.33, 0.42, 5.0]) == [SOLID, SHELL, SHELL, EMPTY, EMPTY]


def test_shell_cells_are_those_within_reach_of_any_surface_point():
    """Every cell is compared with each of 60 points of different thickness."""
    random = torch.Generator().manual_seed(0)
    points = (torch.rand(60, 3, generator=random) * torch.tensor([6, 7, 8]) + 4).long()
    outer, inner = 1 + torch.rand(2, 60, generator=random)
    cells = torch.cartesian_prod(*map(torch.arange, (14, 15, 16)))
    apart = torch.cdist(cells.float(), points.float())
    reached = [(apart <= reach + SLACK).any(1).view(14, 15, 16) for reach in (outer, inner)]
    found = _classify_cells([14, 15, 16], points, outer, inner)
    assert (found == SHELL)[found != SOLID].equal(reached[0][found != SOLID])
    assert ((found == SHELL) >= (reached[0] & reached[1])).all() and (found == SHELL).sum() > 500


def test_every_frame_has_its_own_surface_and_thickness():
    """A sphere of 0.3 m with a shell of 2 cm and one of 0.2 m with a shell of 8 cm are checked 5 cm outside their
    surfaces."""
    outer = torch.tensor([0.02, 0.08])[:, None].expand(-1, 40000)
    surfaces = torch.cat([sphere(0.3), sphere(0.2)])
    grid = shell_around(surfaces, outer, torch.full_like(outer, 0.04), 0.01)
    rays = Rays(torch.zeros(4, 3), torch.eye(3)[[0, 0, 0, 0]], torch.tensor([0, 1, 1, 0]))
    found = grid.cell_states(rays, torch.tensor([[0.35], [0.25], [0.35], [0.25]]))[:, 0].tolist()
    assert found == [EMPTY, SHELL, EMPTY, SOLID]


def test_the_shell_covers_faces_between_vertices():
    """A unit box about the origin has a thick shell at the corners with x > 0. It is checked at the centres of its
    faces."""
    corners_m = box_vertices() - 0.5
    outer = torch.where(corners_m[None, :, 0] > 0, 0.2, 0.02)
    points = surface_points(corners_m, box_faces(), 0.01)
    grid = ShellGrid.around(corners_m[None], outer, torch.full_like(outer, 0.02), points, 0.02)
    assert along_x(grid, [0.5, 0.65, -0.5, -0.65]) == [SHELL, SHELL, SHELL, EMPTY]


def test_surface_points_subdivide_long_edges():
    """For a right triangle with legs of 3, a spacing of 1.5 divides the longest edge (4.24) into three, which gives 10
    points in all."""
    vertices = torch.tensor([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [0.0, 3.0, 0.0]])
    corners, weights = surface_points(vertices, torch.tensor([[0, 1, 2]]), 1.5)
    points = (vertices[corners] * weights[..., None]).sum(1)
    expected = {(x, y, 0) for x in range(4) for y in range(4) if x + y <= 3}
    assert {tuple(p) for p in points.round().int().tolist()} == expected and len(points) == 10
    torch.testing.assert_close(points, points.round())


def test_samples_lie_in_the_shell_in_front_of_the_solid_core():
    """A ray through the centre of a sphere of 0.3 m, from 1 m away, enters the shell 5 cm before the surface and ends
    at the solid core."""
    grid = even_shell(sphere(0.3), outer_m=0.05, inner_m=0.04, cell_m=0.01)
    origins_m, directions = torch.tensor([[-1.0, 0.0, 0.0], [-1.0, 0.6, 0.0]]), torch.eye(3)[[0, 0]]
    rays = Rays(origins_m, directions, torch.zeros(2, dtype=torch.long))
    depths, count, ended = grid.sample_rays(rays, torch.full((2, 16), 0.5))
    length_m, start_m = grid.path_m(rays)
    assert length_m[0].item() == pytest.approx(0.09, abs=0.03) and length_m[1] == 0
    assert start_m[0].item() == pytest.approx(0.63, abs=0.01)  # two cells before the shell
    assert count.tolist() == [16, 0] and ended.tolist() == [True, False]
    assert (depths[0].diff() > 0).all()
    assert depths[0, 0].item() == pytest.approx(0.65, abs=0.03)
    assert depths[0, -1].item() == pytest.approx(0.74, abs=0.03)
    jitter = torch.full((2, 20), 1 - 2**-24)  # the largest below 1; 19 plus it rounds to 20 in single precision
    assert grid.sample_rays(rays, jitter)[0][0, -1].item() == pytest.approx(0.74, abs=0.03)


def test_a_ray_gets_as_many_samples_as_its_path_requires():
    """The path of 9 cm, give or take two cells, has a sample every 4.7 mm or less: as if it had been given so many.
    Every 3 cm, it would have 3, but no ray has fewer than 6; every millimetre 90, but there are random numbers for
    32."""
    grid = even_shell(sphere(0.3), outer_m=0.05, inner_m=0.04, cell_m=0.01)
    rays = Rays(torch.tensor([[-1.0, 0.0, 0.0], [-1.0, 0.6, 0.0]]), torch.eye(3)[[0, 0]], torch.zeros(2).long())
    jitter = torch.rand(2, 32, generator=torch.Generator().manual_seed(0))
    depths, (count, missing), _ = grid.sample_rays(rays, jitter, torch.full((2,), 0.0047))
    length_m = grid.path_m(rays)[0][0].item()
    assert count == math.ceil(length_m / 0.0047) > length_m / 0.0047 + 0.1 and 15 <= count <= 26 and missing == 0
    torch.testing.assert_close(depths[0, :count], grid.sample_rays(rays, jitter[:, :count])[0][0])
    assert (depths[0, count:] >= depths[0, count - 1]).all()
    few, many = (grid.sample_rays(rays, jitter, torch.full((2,), spacing_m))[1] for spacing_m in (0.03, 0.001))
    assert (few[0], many[0]) == (6, 32)


def test_a_gap_between_two_shells_is_not_sampled():
    """Beside the solid core a ray crosses the shell twice; nothing is sampled outside it."""
    grid = even_shell(torch.cat([sphere(0.1) - 0.3, sphere(0.1) + 0.3], 1), 0.03, 0.2, 0.01)
    diagonal = Rays(torch.full((1, 3), -1.0), torch.full((1, 3), 3**-0.5), torch.zeros(1, dtype=torch.long))
    depths, *_ = grid.sample_rays(diagonal, torch.rand(1, 64))
    position = (-1 + depths[0] * 3**-0.5)[:, None].expand(-1, 3)
    distance = torch.minimum((position - 0.3).norm(dim=1), (position + 0.3).norm(dim=1))
    assert (distance < 0.1 + 0.03 + 0.03).all()
    assert (position[:, 0] < 0).any() and (position[:, 0] > 0).any()
