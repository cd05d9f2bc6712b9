import numpy as np
import pytest
import torch
from skimage.measure import marching_cubes
from torch import Tensor

from hnerf.avatar.surface import extract_surface
from hnerf.errors import InputError

LOWER_M, UPPER_M = torch.tensor([-0.5, -0.6, -1.0]), torch.tensor([0.5, 0.6, 1.0])


def sphere(points_m: Tensor, radius_m: float = 0.4) -> Tensor:
    return points_m.norm(dim=1) - radius_m


def test_sphere_has_its_radius_and_volume_and_turns_outwards() -> None:
    mesh = extract_surface(sphere, LOWER_M, UPPER_M, 64)
    assert mesh.is_watertight
    # A chord of one cell (31 mm) sags (31 mm)^2 / (8 x 0.4 m) = 0.3 mm between the grid's nodes.
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 0.4).max() < 4e-4
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * 0.4**3, rel=0.01)


def test_skipping_empty_space_finds_the_dense_surface_with_a_fraction_of_the_queries() -> None:
    queries = 0

    def bumpy(points_m: Tensor) -> Tensor:  # slope up to 1 + 0.03 x 25 = 1.75: not a true distance
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


def test_only_the_largest_component_stays() -> None:
    def two_spheres(points_m: Tensor) -> Tensor:
        return torch.minimum(sphere(points_m, 0.3), sphere(points_m - torch.tensor([0, 0, 0.7]), 0.1))

    mesh = extract_surface(two_spheres, LOWER_M, UPPER_M, 48)
    assert mesh.vertices[:, 2].max() == pytest.approx(0.3, abs=0.002)


@pytest.mark.parametrize(
    ("offset_m", "message"),
    [(10.0, "everything is outside"), (-10.0, "everything is inside"), (-0.2, "fills its box"), (np.nan, "not finite")],
)
def test_a_field_without_a_closed_surface_is_refused(offset_m: float, message: str) -> None:
    with pytest.raises(InputError, match=message):
        extract_surface(lambda p: sphere(p) + offset_m, LOWER_M, UPPER_M, 32)
