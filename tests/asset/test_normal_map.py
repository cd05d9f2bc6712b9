"""The normal map of a small flat square, for a field whose surface is a tilted plane."""

import dataclasses
from dataclasses import dataclass, field

import numpy as np
import pytest
import torch
from torch import Tensor

from hnerf.asset.correctives import as_they_are
from hnerf.asset.normal_map import normal_map
from hnerf.asset.texture import UvLayout
from hnerf.asset.topologies import AssetMesh
from hnerf.body.base_mesh import BaseMesh
from tests.asset.figure import bending_body, column_rig
from tests.asset.stand_in import StandInAvatar

SIDE_M = 1e-4  # so small that the tilted plane is close to it everywhere
CORNERS = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
HALVES = np.array([[0, 1, 2], [0, 2, 3]])


@dataclass
class Plane(StandInAvatar):
    normal: Tensor = field(default_factory=lambda: torch.zeros(3))
    height_m: float = 0.0

    def signed_distance(self, points_m: Tensor, theta: Tensor, root: Tensor) -> Tensor:
        return points_m @ self.normal - self.height_m


def square(hidden: bool = False) -> AssetMesh:
    """Return a square on the ground with one corner at the origin."""
    vertices_m = torch.from_numpy(np.pad(SIDE_M * CORNERS, ((0, 0), (0, 1)))).float()
    rig = dataclasses.replace(column_rig(), vertices_m=vertices_m, faces=torch.from_numpy(HALVES))
    return AssetMesh(rig, as_they_are, 2, BaseMesh(rig, np.full(4, hidden), 2, None, None, {}, {}))


def map_of(
    normal: tuple[float, float, float], uvs: np.ndarray, height_m: float = 0, hidden: bool = False
) -> np.ndarray:
    avatar = Plane(bending_body(), normal=torch.tensor(normal), height_m=height_m)
    return normal_map(avatar, square(hidden), UvLayout(uvs, HALVES), 8)


@pytest.mark.parametrize(
    ("normal", "uvs", "colour"),
    [
        ((0.6, 0, 0.8), CORNERS, (204, 128, 230)),  # (1 + 0.6) / 2, (1 + 0) / 2, (1 + 0.8) / 2 of 255
        ((0, 0.6, 0.8), CORNERS, (128, 204, 230)),  # v points up
        ((0.6, 0, 0.8), CORNERS * (-1, 1) + (1, 0), (51, 128, 230)),  # mirrored: u decreases along x
        ((0, 0.6, 0.8), CORNERS * (-1, 1) + (1, 0), (128, 204, 230)),  # and v rises along y
        ((0.6, 0, 0.8), CORNERS[:, ::-1] * (1, -1) + (0, 1), (128, 51, 230)),  # rotated: v decreases along x
    ],
)
def test_normal_map_of_a_tilted_plane(
    normal: tuple[float, float, float], uvs: np.ndarray, colour: tuple[int, int, int]
) -> None:
    found = map_of(normal, uvs)
    assert found.shape == (8, 8, 3) and found.dtype == np.uint8
    np.testing.assert_allclose(found, np.broadcast_to(colour, found.shape), atol=1)


@pytest.mark.parametrize(
    ("normal", "height_m", "hidden"),
    [
        ((1.0, 0, 0), 0, False),  # perpendicular to the mesh
        ((0.6, 0, 0.8), 0.02, False),  # a step of 20 (2 - 2 x 20 / 30) = 13.3 mm leaves 20 - 0.8 x 13.3 = 9.3 mm
        ((0.6, 0, 0.8), 0, True),
    ],
)
def test_normal_map_is_flat_where_the_field_is_no_match(
    normal: tuple[float, float, float], height_m: float, hidden: bool
) -> None:
    found = map_of(normal, CORNERS, height_m, hidden)
    np.testing.assert_array_equal(found, np.broadcast_to((128, 128, 255), found.shape))


def test_half_trust_blends_the_normals_half_way() -> None:
    # A step of 12.5 mm leaves 12.5 - 0.8 x 12.5 = 2.5 mm, where trust is one half. Half-way between (0, 0, 1) and
    # (0.6, 0, 0.8) is (0.3, 0, 0.9), or (0.316, 0, 0.949) at unit length.
    found = map_of((0.6, 0, 0.8), CORNERS, 0.0125)
    np.testing.assert_allclose(found, np.broadcast_to((168, 128, 248), found.shape), atol=1)
