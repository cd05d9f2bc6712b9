from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from skimage.measure import marching_cubes
from torch import Tensor

from hnerf.avatar.surface import _largest_component, extract_surface, normals_and_distances, surface_in_pose
from hnerf.errors import InputError
from tests.body.boxes import box_rig

LOWER_M, UPPER_M = torch.tensor([-0.5, -0.6, -1.0]), torch.tensor([0.5, 0.6, 1.0])


def sphere(points_m: Tensor, radius_m: float = 0.4) -> Tensor:
    return points_m.norm(dim=1) - radius_m


def test_an_extracted_sphere_has_its_radius_and_outward_faces() -> None:
    mesh = extract_surface(sphere, LOWER_M, UPPER_M, 64)
    assert mesh.is_watertight
    # A chord of one cell (31 mm) sags (31 mm)^2 / (8 x 0.4 m) = 0.3 mm between the grid's nodes.
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 0.4).max() < 4e-4
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * 0.4**3, rel=0.01)


def test_skipping_empty_space_gives_the_dense_surface_with_fewer_queries() -> None:
    queries = 0

    def bumpy(points_m: Tensor) -> Tensor:  # its slope is up to 1 + 0.03 x 25 = 1.75, so it is no true distance
        nonlocal queries
        queries += len(points_m)
        return sphere(points_m) + 0.03 * torch.sin(25 * points_m[:, 0])

    mesh = extract_surface(bumpy, LOWER_M, UPPER_M, 96)
    assert queries < 0.3 * 49 * 59 * 97
    grid = torch.meshgrid(*(torch.arange(n) for n in (49, 59, 97)), indexing="ij")
    dense = bumpy(LOWER_M + torch.stack(grid, -1).reshape(-1, 3) * (2 / 96)).reshape(49, 59, 97).numpy()
    vertices, faces, _, _ = marching_cubes(dense, 0.0, gradient_direction="descent")
    np.testing.assert_allclose(mesh.vertices, vertices * (2 / 96) + LOWER_M.numpy(), atol=1e-5)
    np.testing.assert_array_equal(mesh.faces, faces)


def test_only_the_largest_component_is_kept() -> None:
    def two_spheres(points_m: Tensor) -> Tensor:
        return torch.minimum(sphere(points_m, 0.3), sphere(points_m - torch.tensor([0, 0, 0.7]), 0.1))

    mesh = extract_surface(two_spheres, LOWER_M, UPPER_M, 48)
    assert mesh.vertices[:, 2].max() == pytest.approx(0.3, abs=0.002)


def test_the_largest_component_is_chosen_by_area() -> None:
    """A cube with 12 faces and 6 m2 next to a ball with 80 faces and about 0.12 m2."""
    cube, ball = trimesh.creation.box((1, 1, 1)), trimesh.creation.icosphere(1, 0.1).apply_translation([3, 0, 0])
    assert _largest_component(trimesh.util.concatenate([ball, cube])).area == pytest.approx(6)


def test_clothes_18_cm_off_the_body_are_meshed() -> None:
    """The surface lies 18 cm outside the unit box that is the body."""

    def distance(points_m: Tensor, theta: Tensor, root: Tensor) -> Tensor:
        return torch.maximum(-points_m, points_m - 1).amax(-1) - 0.18

    avatar: Any = SimpleNamespace(body=SimpleNamespace(rig=box_rig()), signed_distance=distance)
    mesh = surface_in_pose(avatar, torch.zeros(2, 3), torch.eye(4), 64)
    np.testing.assert_allclose(mesh.extents, 1.36, atol=0.01)


@pytest.mark.parametrize(
    ("offset_m", "message"),
    [(10.0, "everything is outside"), (-10.0, "everything is inside"), (-0.2, "fills its box"), (np.nan, "not finite")],
)
def test_a_field_without_a_closed_surface_is_refused(offset_m: float, message: str) -> None:
    with pytest.raises(InputError, match=message):
        extract_surface(lambda p: sphere(p) + offset_m, LOWER_M, UPPER_M, 32)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("side", [-1, 1])
def test_a_surface_that_one_side_of_the_box_cuts_is_refused(axis: int, side: int) -> None:
    """Its middle is on that side of the box."""
    middle_m = torch.zeros(3)
    middle_m[axis] = (LOWER_M if side < 0 else UPPER_M)[axis]
    with pytest.raises(InputError, match="fills its box"):
        extract_surface(lambda points_m: sphere(points_m - middle_m), LOWER_M, UPPER_M, 32)


def test_normals_and_distances_by_hand() -> None:
    """The first function is 6 + 3 y + 4 z at (1, 2, 3). The second is the squared distance from the origin at (0, 0,
    2): sampled half a metre away in four directions that cancel out, its mean is 2^2 + (1/2)^2."""

    def plane(points_m: Tensor, theta: Tensor, root: Tensor) -> Tensor:
        return 6 + points_m @ torch.tensor([0.0, 3, 4])

    def square(points_m: Tensor, theta: Tensor, root: Tensor) -> Tensor:
        return points_m.square().sum(1)

    pose = torch.zeros(1, 3), torch.eye(4)
    for function, point_m, normal, distance_m in (
        (plane, [1.0, 2, 3], [0, 0.6, 0.8], 24.0),
        (square, [0.0, 0, 2], [0.0, 0, 1], 4.25),
    ):
        avatar: Any = SimpleNamespace(signed_distance=function)
        found = normals_and_distances(avatar, torch.tensor([point_m]), *pose, 0.5)
        torch.testing.assert_close(found, (torch.tensor([normal]), torch.tensor([distance_m])))


@pytest.mark.parametrize("count", [0, 3])
def test_normals_need_a_single_query(count: int) -> None:
    asked: list[int] = []

    def height(points_m: Tensor, theta: Tensor, root: Tensor) -> Tensor:
        asked.append(len(points_m))
        return points_m[:, 2]

    avatar: Any = SimpleNamespace(signed_distance=height)
    normals, _ = normals_and_distances(avatar, torch.rand(count, 3), torch.zeros(1, 3), torch.eye(4), 0.5)
    torch.testing.assert_close(normals, torch.tensor([0.0, 0, 1]).expand(count, 3))
    assert asked == [4 * count]
