import dataclasses

import numpy as np
import pytest
import torch

from hnerf.asset.correctives import correctives_of
from hnerf.asset.staging import StagedAvatar, stage_avatar, stage_from_world
from hnerf.asset.texture import UvLayout
from hnerf.body.fit_result import BodyFit
from tests.asset.figure import bending_body, column_rig

LAYOUT = UvLayout(np.zeros((1, 2), np.float32), np.zeros((1, 3), np.int64))
TEXTURE = np.zeros((4, 4, 3), np.uint8)


def staged_without_shapes(clothed: BodyFit, up: str) -> StagedAvatar:
    """Return a body staged as it is skinned, without correctives."""
    none = correctives_of(np.zeros((len(clothed.frames), len(clothed.rig.vertices_m), 3), np.float32), 0)
    return stage_avatar(clothed, clothed.vertices_m().numpy(), none, LAYOUT, TEXTURE, up)


def test_z_up_becomes_y_up() -> None:
    np.testing.assert_array_equal(stage_from_world("z") @ [1, 2, 3], [1, 3, -2])
    np.testing.assert_array_equal(stage_from_world("y") @ [1, 2, 3], [1, 2, 3])


def test_joints_by_hand() -> None:
    """Place the root at (1, 2, 3), turned; the upper joint bends 90 degrees about the body's x."""
    theta = torch.tensor([[[0.0, 0, 0], [torch.pi / 2, 0, 0]]])
    root = torch.eye(4)[None].clone()
    root[0, :3, 3] = torch.tensor([1.0, 2, 3])
    staged = staged_without_shapes(BodyFit(column_rig(), (7,), theta, root), "z")
    np.testing.assert_allclose(staged.rest_joints_m, [[0.0, 0.0, 0.0], [0.0, 0.8, 0.0]], atol=1e-7)
    np.testing.assert_allclose(staged.translations_m[0], [[1.0, 3.0, -2.0], [0.0, 0.8, 0.0]], atol=1e-6)
    np.testing.assert_allclose(staged.quaternions[0, 0], [0, 0, 0, 1], atol=1e-7)
    # x is common to both frames, so the bend stays a quarter turn about +x.
    np.testing.assert_allclose(staged.quaternions[0, 1], [np.sqrt(0.5), 0, 0, np.sqrt(0.5)], atol=1e-6)
    # The column's top centre (0, 0, 1.6) swings to (0, -0.8, 0.8) in the body: (1, 1.2, 3.8) in the world.
    top = staged.points_m[0][np.argmin(np.linalg.norm(staged.rest_points_m - [0, 1.6, 0], axis=1))]
    np.testing.assert_allclose(top, [1, 3.8, -1.2], atol=1e-5)


@pytest.mark.parametrize("up", ["y", "z"])
def test_quaternions_do_not_jump(up: str) -> None:
    turns = torch.linspace(0, 4 * torch.pi, 30)  # twice around passes through -q
    body = bending_body()
    root = torch.eye(4).repeat(30, 1, 1)
    root[:, 0, 0], root[:, 0, 1], root[:, 1, 0], root[:, 1, 1] = turns.cos(), -turns.sin(), turns.sin(), turns.cos()
    spin = dataclasses.replace(body, frames=tuple(range(30)), theta=torch.zeros(30, 2, 3), root=root)
    q = staged_without_shapes(spin, up).quaternions
    # A step is 4 pi / 29 = 0.433 rad; neighbours differ by half of that on the sphere.
    np.testing.assert_allclose((q[1:, 0] * q[:-1, 0]).sum(-1), np.cos(0.433 / 2), atol=1e-3)
