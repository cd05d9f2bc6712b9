import math
from dataclasses import replace
from functools import partial

import numpy as np
import torch

from hnerf.body.anny import anny_rig
from hnerf.body.articulation import Articulation, Pose, with_offsets
from hnerf.body.ground import FEET, Ground, is_ground
from hnerf.body.normal_equations import NormalEquations
from tests.body.recorded_body import moving_body, ring_camera
from tests.body.test_articulation import check_gradient, random_pose

LOWER, EACH = Ground(2), Ground(2, each_foot=True)


def add(equations: NormalEquations, pose: Pose, ground: Ground = LOWER) -> float:
    articulation = Articulation(pose.rig)
    points = with_offsets(articulation.keypoints(), pose.offsets_m)
    return ground.add(equations, pose, *articulation.jacobian(points, articulation.pose(pose)))


def cost_of(pose: Pose, ground: Ground = LOWER) -> float:
    return add(NormalEquations(1, Articulation(pose.rig).unknowns, len(pose.rig.beta)), pose, ground)


def standing(height_m: float) -> Pose:
    """Return the rest body with its lowest vertex at a height."""
    rig = anny_rig().to(dtype=torch.float64)
    root = torch.eye(4, dtype=torch.float64)[None].clone()
    root[0, 2, 3] = height_m - float(rig.vertices_m[:, 2].min())
    theta = torch.zeros(1, len(rig.joints_m), 3, dtype=torch.float64)
    return Pose(rig, theta, root, torch.zeros(25, 3, dtype=torch.float64))


def test_standing_costs_nothing_and_two_centimetres_off_about_a_half() -> None:
    """With the robust cost it is 0.5 / (1 + (2/25)^2), above and below the ground. One foot in the air costs
    nothing."""
    assert cost_of(standing(0.0)) < 1e-9
    for height_m in (0.02, -0.02):
        assert math.isclose(cost_of(standing(height_m)), 0.5 / (1 + 0.0064), rel_tol=1e-4)
    raised = standing(0.0)
    raised.theta[0, raised.rig.joint_names.index("lowerleg01.R"), 0] = 1.0
    assert cost_of(raised) < 1e-9 and len(FEET) == 6


def test_each_low_foot_is_pulled_to_the_ground_and_a_swinging_one_released() -> None:
    """At a height of four centimetres, each foot costs 0.5 / (1 + (4/5)^2) in addition to the cost of the lower one. A
    shank lifted by a right angle costs at most (5/4)^2 / 2."""
    lower = cost_of(standing(0.04))
    assert math.isclose(cost_of(standing(0.04), EACH), lower + 2 * 0.5 / 1.64, rel_tol=1e-3)
    for side in "LR":
        raised = standing(0.0)
        raised.theta[0, raised.rig.joint_names.index(f"lowerleg01.{side}"), 0] = math.pi / 2
        assert 0.7 < cost_of(raised, EACH) < 25 / 32


def test_keypoint_offsets_do_not_change_the_height_above_ground() -> None:
    """A detector that sees toes and heels 4 cm above the model's does not lift the body."""
    pose = standing(0.0)
    pose.offsets_m[FEET, 2] = 0.04
    assert cost_of(pose) < 1e-9


def test_the_gradient_of_the_ground_term_matches_its_cost() -> None:
    pose = random_pose(anny_rig().to(dtype=torch.float64), 2)
    pose = replace(pose, offsets_m=torch.zeros(25, 3, dtype=torch.float64))
    for ground in (LOWER, EACH):
        check_gradient(pose, partial(add, ground=ground), rtol=1e-4, least=1e-2)


def test_height_0_is_the_ground_if_the_person_then_has_a_plausible_stature() -> None:
    """The camera is one metre above the floor. If height 0 is 0.7 m below the floor, the ray to a foot reaches it 1.7
    times as far away, so the person would be 1.7 times as tall; 0.7 m above it, 0.3 times. Ankles suffice instead of
    soles; without either, the answer is no."""
    body, camera = moving_body((0,)), ring_camera("0", 0.0)
    keypoints_m = torch.einsum("kv,nvd->nkd", body.rig.keypoint_weights, body.vertices_m()).double().numpy()
    keypoints = np.concatenate([camera.project(keypoints_m)[0], np.ones((1, 25, 1))], -1)
    soleless, footless = keypoints.copy(), keypoints.copy()
    soleless[:, FEET, 2] = footless[:, [*FEET, 11, 14], 2] = 0
    for raised_m, found in ((0.0, True), (0.7, False), (-0.7, False), (-1.0, False)):
        shifted = replace(camera, t_m=camera.t_m - camera.R @ [0, 0, raised_m])
        assert is_ground(shifted, keypoints, "z", None) == is_ground(shifted, soleless, "z", None) == found
        assert not is_ground(shifted, footless, "z", None)
    assert not is_ground(camera, keypoints, "z", 1.2)


def test_the_ground_term_acts_on_the_shape_too() -> None:
    """At a height of two centimetres, the residual of .02 m has a weight of (.02 m x 1.0064)^-2."""
    pose, articulation = standing(0.02), Articulation(anny_rig().to(dtype=torch.float64))
    x, by_frame, by_shape = articulation.jacobian(articulation.keypoints(), articulation.pose(pose))
    by_shape = torch.zeros_like(by_shape)
    by_shape[..., 2, 0] = 1
    equations = NormalEquations(1, articulation.unknowns, by_shape.shape[-1])
    LOWER.add(equations, pose, x, by_frame, by_shape)
    assert math.isclose(equations.shared_gradient[0], 0.02 / (0.02 * 1.0064) ** 2, rel_tol=1e-4)
    assert math.isclose(equations.shared[0, 0], (0.02 * 1.0064) ** -2, rel_tol=1e-4)
