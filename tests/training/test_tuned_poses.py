"""The mean change over all frames moves into the rest body; worked out by hand for a column of two bones."""

import math

import torch
from torch import Tensor

from hnerf.body.rig import pose_vertices, rotation_from_axis_angle
from hnerf.training.tuned_poses import with_common_rest
from tests.body.boxes import box_rig

RIG = box_rig(bend_segments=6)
RIGID = (RIG.skin_weights == 1).any(1)
TURN = 0.1
BEND_RAD = (0.0, 0.4)  # in each of two frames


def bent(angles_rad: tuple[float, ...]) -> Tensor:
    """Return theta (n, 2, 3) in which the upper bone turns about x."""
    theta = torch.zeros(len(angles_rad), 2, 3)
    theta[:, 1, 0] = torch.tensor(angles_rad)
    return theta


def placed(moved_m: Tensor) -> Tensor:
    """Return roots (2, 4, 4) of an upright body and of one turned to the left by a quarter, each moved along its own
    axes."""
    root = torch.eye(4).repeat(2, 1, 1)
    root[1, :3, :3] = rotation_from_axis_angle(torch.tensor([0.0, 0.0, math.pi / 2]))
    root[:, :3, 3] = (root[:, :3, :3] @ moved_m[..., None])[..., 0]
    return root


def test_the_rest_body_takes_the_mean_joint_rotation() -> None:
    """Turns of 0.05 and 0.15 bend the rest body by 0.1 and leave -0.05 and 0.05 in the frames. A corner 0.5 m in front
    of the joint and 1 m above it turns about the joint."""
    root = placed(torch.zeros(2, 3))
    after = bent((BEND_RAD[0] + TURN - 0.05, BEND_RAD[1] + TURN + 0.05)), root
    rig, theta, stands = with_common_rest(RIG, (bent(BEND_RAD), root), after)
    corner = (RIG.vertices_m == torch.tensor([0.0, 0.0, 2.0])).all(1)
    y, z = 0.5 - 0.5 * math.cos(TURN) - math.sin(TURN), 1 - 0.5 * math.sin(TURN) + math.cos(TURN)
    torch.testing.assert_close(rig.vertices_m[corner], torch.tensor([[0.0, y, z]]))
    torch.testing.assert_close(rig.joints_m, RIG.joints_m)
    torch.testing.assert_close(theta, bent((BEND_RAD[0] - 0.05, BEND_RAD[1] + 0.05)), atol=1e-6, rtol=0)
    torch.testing.assert_close(stands, root)


def test_the_rest_body_takes_the_mean_translation_in_body_axes() -> None:
    """1 cm and 3 cm to the left have a mean of 2 cm. The second body faces along another axis of the world."""
    left_m = torch.tensor([[0.01, 0.0, 0.0], [0.03, 0.0, 0.0]])
    before, theta = placed(torch.zeros(2, 3)), bent(BEND_RAD)
    rig, own, root = with_common_rest(RIG, (theta, before), (theta, placed(left_m)))
    torch.testing.assert_close(rig.vertices_m, RIG.vertices_m + torch.tensor([0.02, 0.0, 0.0]))
    torch.testing.assert_close(rig.joints_m, RIG.joints_m + torch.tensor([0.02, 0.0, 0.0]))
    torch.testing.assert_close(root, placed(left_m - torch.tensor([0.02, 0.0, 0.0])), atol=1e-6, rtol=0)
    torch.testing.assert_close(own, theta, atol=1e-6, rtol=0)


def test_posed_bodies_do_not_change() -> None:
    """Vertices on one bone stay exactly in place; those between bones move by at most (0.1 rad)^2 times half a
    metre."""
    generator = torch.Generator().manual_seed(0)
    before = bent(BEND_RAD), placed(torch.zeros(2, 3))
    after = before[0] + 0.0, placed(0.1 * torch.randn(2, 3, generator=generator))
    after[0][:, 1] += 0.1 * torch.randn(2, 3, generator=generator)
    turn = rotation_from_axis_angle(0.1 * torch.randn(2, 3, generator=generator))
    after[1][:, :3, :3] = after[1][:, :3, :3] @ turn
    rig, theta, root = with_common_rest(RIG, before, after)
    there, here = pose_vertices(RIG, *after), pose_vertices(rig, theta, root)
    torch.testing.assert_close(here[:, RIGID], there[:, RIGID], atol=1e-5, rtol=0)
    torch.testing.assert_close(here, there, atol=0.005, rtol=0)
