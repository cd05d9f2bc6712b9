import math
from dataclasses import replace

import numpy as np
import torch

from hnerf.body.anny import anny_rig
from hnerf.body.articulation import Articulation, Pose, with_offsets
from hnerf.body.ground import FEET, Ground
from hnerf.body.normal_equations import NormalEquations
from tests.body.test_articulation import random_pose


def cost_and_equations(pose: Pose) -> tuple[float, NormalEquations]:
    articulation = Articulation(pose.rig)
    x, by_frame, by_shape = articulation.jacobian(
        with_offsets(articulation.keypoints(), pose.offsets_m), articulation.pose(pose)
    )
    equations = NormalEquations(len(x), articulation.unknowns, by_shape.shape[-1])
    return Ground(2).add(equations, pose, x, by_frame, by_shape), equations


def standing(height_m: float) -> Pose:
    """Return the rest body with its lowest vertex at a height."""
    rig = anny_rig().to(dtype=torch.float64)
    root = torch.eye(4, dtype=torch.float64)[None].clone()
    root[0, 2, 3] = height_m - float(rig.vertices_m[:, 2].min())
    theta = torch.zeros(1, len(rig.joints_m), 3, dtype=torch.float64)
    return Pose(rig, theta, root, torch.zeros(25, 3, dtype=torch.float64))


def test_who_stands_costs_nothing_and_two_centimetres_a_half() -> None:
    """Less what fades: 0.5 / (1 + (2/25)^2); alike below the ground. One foot in the air costs nothing."""
    assert cost_and_equations(standing(0.0))[0] < 1e-9
    for height_m in (0.02, -0.02):
        assert math.isclose(cost_and_equations(standing(height_m))[0], 0.5 / (1 + 0.0064), rel_tol=1e-4)
    raised = standing(0.0)
    raised.theta[0, raised.rig.joint_names.index("lowerleg01.R"), 0] = 1.0
    assert cost_and_equations(raised)[0] < 1e-9 and len(FEET) == 6


def test_a_keypoint_that_is_seen_higher_up_stands_no_higher() -> None:
    """A detector that sees toes and heels 4 cm above the model's does not lift the body."""
    pose = standing(0.0)
    pose.offsets_m[FEET, 2] = 0.04
    assert cost_and_equations(pose)[0] < 1e-9


def test_the_gradient_of_the_ground_is_that_of_its_cost() -> None:
    pose = random_pose(anny_rig().to(dtype=torch.float64), 2)
    pose = replace(pose, offsets_m=torch.zeros(25, 3, dtype=torch.float64))
    articulation = Articulation(pose.rig)
    direction = torch.randn(2, articulation.unknowns, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    ends = [cost_and_equations(articulation.apply_step(pose, sign * 1e-6 * direction))[0] for sign in (1, -1)]
    slope = (cost_and_equations(pose)[1].frame_gradient * direction.numpy()).sum()
    assert abs(slope) > 1e-2
    np.testing.assert_allclose(slope, (ends[0] - ends[1]) / 2e-6, rtol=1e-4)
