import dataclasses
import math
from pathlib import Path

import torch

from hnerf.body.anny import anny_rig
from hnerf.body.rig import Rig, joint_transforms, pose_vertices, posed_joint_basis, rotation_from_axis_angle
from tests.body.two_bone import two_bone_rig

HALF_PI = math.pi / 2


def bent() -> torch.Tensor:
    """Return a quarter turn of the elbow about y."""
    theta = torch.zeros(3, 3, dtype=torch.float64)
    theta[1, 1] = HALF_PI
    return theta


def test_axis_angle_of_a_quarter_turn_about_each_axis() -> None:
    turns = rotation_from_axis_angle(HALF_PI * torch.eye(3, dtype=torch.float64))
    x, y, z = torch.eye(3, dtype=torch.float64)
    torch.testing.assert_close(turns[0] @ y, z)
    torch.testing.assert_close(turns[1] @ z, x)
    torch.testing.assert_close(turns[2] @ x, y)


def test_rotation_gradients_are_correct_at_zero_and_where_the_series_ends() -> None:
    vectors = [[0.0, 0, 0], [0.3, -0.2, 1.1], [9e-5, 0, 0], [0, 1.1e-4, 0], [0, 0, 3.1]]
    values = torch.tensor(vectors, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(rotation_from_axis_angle, values)


def test_the_elbow_bends_and_the_blended_vertex_lies_halfway() -> None:
    """A quarter turn about y at (0, 0, 1) takes (x, 0, z) to (z - 1, 0, 1 - x)."""
    rig = two_bone_rig()
    vertices = pose_vertices(rig, bent(), torch.eye(4, dtype=torch.float64))
    expected = [[0.1, 0, 0.5], [0.05, 0, 0.95], [0.5, 0, 1.0], [1.5, 0, 1.0], [1.5, 0, 0.9]]
    torch.testing.assert_close(vertices, torch.tensor(expected, dtype=torch.float64))


def test_the_root_transform_is_applied_after_the_joints() -> None:
    rig = two_bone_rig()
    root = torch.eye(4, dtype=torch.float64)
    root[:3, :3] = rotation_from_axis_angle(torch.tensor([0, 0, HALF_PI], dtype=torch.float64))  # takes x to y
    root[:3, 3] = torch.tensor([10.0, 20, 30])
    tip = joint_transforms(rig, bent(), root)[2, :3, 3]
    torch.testing.assert_close(tip, torch.tensor([10.0, 21, 31], dtype=torch.float64))
    vertex = pose_vertices(rig, bent(), root)[4]
    torch.testing.assert_close(vertex, torch.tensor([10, 21.5, 30.9], dtype=torch.float64))


def test_shape_moves_vertices_and_the_joints_they_turn_about() -> None:
    """The upper bone is 0.2 longer: the elbow is at z = 1.2, and v3, 1.5 beyond it, swings to (1.5, 0, 1.2)."""
    rig = two_bone_rig()
    beta = rig.beta + 0.2
    vertices = pose_vertices(rig.reshaped(beta), bent(), torch.eye(4, dtype=torch.float64))
    torch.testing.assert_close(vertices[3], torch.tensor([1.5, 0, 1.2], dtype=torch.float64))


def test_posing_has_correct_gradients() -> None:
    rig = two_bone_rig()
    generator = torch.Generator().manual_seed(0)
    theta = torch.randn(2, 3, 3, generator=generator, dtype=torch.float64).requires_grad_()
    root = torch.randn(2, 4, 4, generator=generator, dtype=torch.float64).requires_grad_()
    beta = rig.beta.clone().requires_grad_()

    def posed(theta: torch.Tensor, root: torch.Tensor, beta: torch.Tensor) -> torch.Tensor:
        return pose_vertices(rig.reshaped(beta), theta, root)

    assert torch.autograd.gradcheck(posed, (theta, root, beta))


def test_joint_transforms_match_the_kinematic_chain() -> None:
    """Each joint turns about its rest position after its ancestors did. The shape moves joints to first order."""
    rig = anny_rig(None).to(dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    theta = 0.5 * torch.randn(2, len(rig.joints_m), 3, generator=generator, dtype=torch.float64)
    root = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    root[:, :3, :3] = rotation_from_axis_angle(torch.randn(2, 3, generator=generator, dtype=torch.float64))
    root[:, :3, 3] = torch.tensor([1.0, 2.0, 3.0])
    world = joint_transforms(rig, theta, root)
    for joint, parent in enumerate(rig.parents.tolist()):
        own = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
        own[:, :3, :3] = rotation_from_axis_angle(theta[:, joint])
        own[:, :3, 3] = rig.joints_m[joint] - (rig.joints_m[parent] if parent >= 0 else 0)
        torch.testing.assert_close(world[:, joint], (world[:, parent] if parent >= 0 else root) @ own)
    more = torch.linspace(-0.2, 0.2, len(rig.beta), dtype=torch.float64)
    moved = joint_transforms(rig.reshaped(rig.beta + more), theta, root) - world
    torch.testing.assert_close(posed_joint_basis(rig, world, root) @ more, moved[..., :3, 3])


def test_a_saved_rig_is_read_back_identically(tmp_path: Path) -> None:
    rig = two_bone_rig()
    rig.save(tmp_path / "rig.npz")
    loaded = Rig.load(tmp_path / "rig.npz")
    for field in dataclasses.fields(Rig):
        was, now = getattr(rig, field.name), getattr(loaded, field.name)
        if isinstance(was, tuple):
            assert was == now
        else:
            assert was.dtype == now.dtype and torch.equal(was, now), field.name
