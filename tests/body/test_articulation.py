import dataclasses
import math
from collections.abc import Callable

import numpy as np
import torch

from hnerf.body.anny import ADULT, anny_rig
from hnerf.body.articulation import Articulation, Pose, left_jacobian, with_offsets
from hnerf.body.normal_equations import NormalEquations
from hnerf.body.rig import Rig, pose_vertices, rotation_from_axis_angle
from tests.body.two_bone import two_bone_rig


def random_pose(rig: Rig, frames: int) -> Pose:
    generator = torch.Generator().manual_seed(1)
    theta = 0.4 * torch.randn(frames, len(rig.joints_m), 3, generator=generator, dtype=torch.float64)
    theta[:, ~rig.free] = 0
    root = torch.eye(4, dtype=torch.float64).repeat(frames, 1, 1)
    root[:, :3, :3] = rotation_from_axis_angle(torch.randn(frames, 3, generator=generator, dtype=torch.float64))
    root[:, :3, 3] = torch.randn(frames, 3, generator=generator, dtype=torch.float64)
    return Pose(rig, theta, root, 0.01 * torch.randn(25, 3, generator=generator, dtype=torch.float64))


def check_gradient(pose: Pose, add: Callable[[NormalEquations, Pose], float], rtol: float, least: float) -> None:
    """Assert that the gradient that a term adds, along a random direction, matches the finite difference of the cost it
    returns, and is larger than `least`."""
    articulation, frames = Articulation(pose.rig), len(pose.theta)
    generator = torch.Generator().manual_seed(0)
    direction = torch.randn(frames, articulation.unknowns, generator=generator, dtype=torch.float64)
    here, *around = (NormalEquations(frames, articulation.unknowns, len(pose.rig.beta)) for _ in range(3))
    moved = (articulation.apply_step(pose, sign * 1e-6 * direction) for sign in (1, -1))
    above, below = map(add, around, moved)
    add(here, pose)
    slope = (here.frame_gradient * direction.numpy()).sum()
    assert abs(slope) > least
    np.testing.assert_allclose(slope, (above - below) / 2e-6, rtol=rtol)


def numeric_jacobian(pose: Pose, points: torch.Tensor) -> torch.Tensor:
    """Return the derivative (n, P, 3, U) of vertices by central differences of the plain rig."""
    rig, articulation, columns = pose.rig, Articulation(pose.rig), []
    few = dataclasses.replace(
        rig,
        vertices_m=rig.vertices_m[points],
        skin_joints=rig.skin_joints[points],
        skin_weights=rig.skin_weights[points],
    )
    for u in range(articulation.unknowns):
        step = torch.zeros(len(pose.theta), articulation.unknowns, dtype=torch.float64)
        step[:, u] = 1e-5
        ends = [articulation.apply_step(pose, sign * step) for sign in (1, -1)]
        above, below = (pose_vertices(few, end.theta, end.root) for end in ends)
        columns.append((above - below) / 2e-5)
    return torch.stack(columns, -1)


def test_locked_joints_are_merged_into_their_free_ancestor() -> None:
    articulation = Articulation(two_bone_rig())
    assert articulation.joints.tolist() == [0, 1] and articulation.unknowns == 9
    expected = [[1.0, 0], [0.5, 0.5], [0, 1], [0, 1], [0, 1]]
    assert articulation.vertex_weights.tolist() == expected
    assert articulation.subtree.tolist() == [[1, 1], [0, 1]]


def test_left_jacobian_turns_a_change_of_the_vector_into_a_rotation() -> None:
    vector, change = torch.tensor([0.4, -0.9, 1.3], dtype=torch.float64), torch.tensor([2e-6, 1e-6, -3e-6])
    exact = rotation_from_axis_angle(vector + change)
    turned = rotation_from_axis_angle(left_jacobian(vector) @ change.double()) @ rotation_from_axis_angle(vector)
    torch.testing.assert_close(turned, exact, atol=1e-10, rtol=0)
    torch.testing.assert_close(left_jacobian(torch.zeros(3, dtype=torch.float64)), torch.eye(3, dtype=torch.float64))


def test_vertices_and_their_derivatives_agree_with_the_plain_rig() -> None:
    rig = anny_rig(torch.tensor(ADULT) + 0.05).to(dtype=torch.float64)
    pose, articulation = random_pose(rig, 2), Articulation(rig)
    skin = articulation.skin(pose)
    vertices = pose_vertices(rig, pose.theta, pose.root)
    other = pose_vertices(rig.reshaped(rig.beta + 0.1), pose.theta, pose.root)
    by_shape = (other - vertices) / 0.1  # exact: beta acts linearly
    ids = torch.arange(0, len(rig.vertices_m), 331)
    numeric = numeric_jacobian(pose, ids)
    torch.testing.assert_close(articulation.surface(skin, 1), vertices[1])
    for axis, direction in enumerate(torch.eye(3, dtype=torch.float64)):
        rows, shape = articulation.directional_jacobian(ids, direction.expand(len(ids), 3), skin, 1)
        torch.testing.assert_close(rows, numeric[1, :, axis], atol=1e-6, rtol=0)
        torch.testing.assert_close(shape.sum(1), by_shape[1, ids, axis], atol=1e-8, rtol=0)


def test_keypoints_and_their_derivatives_agree_with_the_plain_rig() -> None:
    rig = anny_rig(torch.tensor(ADULT) + 0.05).to(dtype=torch.float64)
    pose, articulation = random_pose(rig, 2), Articulation(rig)
    vertices = pose_vertices(rig, pose.theta, pose.root)
    moved = pose_vertices(rig.reshaped(rig.beta + 0.1), pose.theta, pose.root)
    keypoints, by_frame, by_shape = articulation.jacobian(articulation.keypoints(), articulation.pose(pose))
    torch.testing.assert_close(keypoints, rig.keypoint_weights @ vertices)
    torch.testing.assert_close(by_shape.sum(-1), rig.keypoint_weights @ (moved - vertices) / 0.1, atol=1e-8, rtol=0)
    wrist = rig.keypoint_weights[4]
    used = wrist.nonzero()[:, 0]
    numeric = torch.einsum("v,nvcu->ncu", wrist[used], numeric_jacobian(pose, used))
    torch.testing.assert_close(by_frame[:, 4], numeric, atol=1e-6, rtol=0)


def test_an_offset_turns_with_its_bone() -> None:
    """v2 is attached to the elbow. With the elbow bent by a quarter turn about y, an offset along z points along x."""
    rig = two_bone_rig()
    offsets = torch.zeros(25, 3, dtype=torch.float64)
    offsets[2, 2] = 0.25
    theta = torch.zeros(1, 3, 3, dtype=torch.float64)
    theta[0, 1, 1] = math.pi / 2
    pose = Pose(rig, theta, torch.eye(4, dtype=torch.float64)[None], offsets)
    articulation = Articulation(rig)
    points = with_offsets(articulation.keypoints(), offsets)
    where = articulation.jacobian(points, articulation.pose(pose))[0][0]
    torch.testing.assert_close(where[2], torch.tensor([0.75, 0, 1.0], dtype=torch.float64))
    torch.testing.assert_close(where[7], torch.tensor([0.5, 0, 1.0], dtype=torch.float64))  # same vertex, no offset


def test_root_rotation_keeps_the_root_joint_in_place() -> None:
    rig = dataclasses.replace(two_bone_rig(), joints_m=two_bone_rig().joints_m + torch.tensor([0, 0, 1.0]))
    pose = random_pose(rig, 1)
    articulation = Articulation(rig)
    before = articulation.pose(pose).positions_m[0, 0]
    step = torch.tensor([[0.1, 0.2, 0.3, 0.5, -0.4, 0.6, 0, 0, 0]], dtype=torch.float64)
    after = articulation.pose(articulation.apply_step(pose, step)).positions_m[0, 0]
    torch.testing.assert_close(after - before, step[0, :3])


def test_bent_fingers_stay_bent_while_the_body_moves() -> None:
    """Check the surface, and its derivatives by the body's unknowns, with rotations of locked joints below the
    wrist."""
    rig = anny_rig().to(dtype=torch.float64)
    pose = random_pose(rig, 2)
    pose.theta[:, [j for j, name in enumerate(rig.joint_names) if name.startswith("finger")]] = 0.3
    articulation = Articulation(rig)
    skin = articulation.skin(pose)
    torch.testing.assert_close(articulation.surface(skin, 1), pose_vertices(rig, pose.theta, pose.root)[1])
    ids = skin.bent[::97]
    direction = torch.randn(len(ids), 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    by_frame, _ = articulation.directional_jacobian(ids, direction, skin, 1)
    numeric = torch.einsum("pcu,pc->pu", numeric_jacobian(pose, ids)[1], direction)
    torch.testing.assert_close(by_frame, numeric, atol=1e-7, rtol=0)
