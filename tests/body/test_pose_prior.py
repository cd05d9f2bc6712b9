import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from hnerf.body.anny import anny_rig
from hnerf.body.articulation import Articulation, Pose
from hnerf.body.normal_equations import NormalEquations
from hnerf.body.pose_prior import PosePrior, Smoothness
from tests.body.test_articulation import check_gradient, random_pose
from tests.body.two_bone import two_bone_rig

ARTICULATION = Articulation(anny_rig().to(dtype=torch.float64))
PRIOR = PosePrior(ARTICULATION)
NAMES = [ARTICULATION.rig.joint_names[joint] for joint in ARTICULATION.joints.tolist()]


def resting() -> Pose:
    root = torch.eye(4, dtype=torch.float64)[None]
    theta = torch.zeros(1, len(ARTICULATION.rig.joints_m), 3, dtype=torch.float64)
    theta[:, ARTICULATION.joints[1:]] = PRIOR.mean_pose()
    return Pose(ARTICULATION.rig, theta, root, torch.zeros(25, 3, dtype=torch.float64))


def flexed(name: str, turn_rad: float) -> Pose:
    """Return the most likely pose, except for one joint that is flexed from rest."""
    pose, place = resting(), NAMES.index(name)
    pose.theta[0, ARTICULATION.joints[place]] = turn_rad * PRIOR.axes[place - 1, 0]
    return pose


def cost_of(pose: Pose) -> float:
    return PRIOR.add(NormalEquations(1, ARTICULATION.unknowns, 0), pose)


def test_the_most_likely_pose_costs_nothing_and_one_standard_deviation_of_flexion_one_half() -> None:
    """A foot flexes about the left-right axis, perpendicular to the foot, with a standard deviation of 20 degrees."""
    assert cost_of(resting()) < 1e-12
    assert math.isclose(cost_of(flexed("foot.L", math.radians(20))), 0.5, rel_tol=1e-9)


@pytest.mark.parametrize(("name", "forwards"), [("lowerleg01.L", 1), ("lowerarm01.R", 1), ("upperarm01.R", -1)])
def test_knees_and_elbows_do_not_bend_backwards_nor_arms_swing_behind(name: str, forwards: int) -> None:
    """75 degrees in the free direction are cheap. The same angle in the other direction exceeds the limit, which has a
    softness of 2 degrees."""
    assert cost_of(flexed(name, forwards * math.radians(75))) < 2
    assert cost_of(flexed(name, -forwards * math.radians(75))) > 20


@pytest.mark.parametrize("side", ["L", "R"])
def test_thighs_bend_forwards_but_not_far_backwards(side: str) -> None:
    """A thigh 100 degrees forwards is 100/45 standard deviations from rest. 60 degrees backwards are 60/45, and 20
    beyond the limit of 40, which has a softness of 2. Arms hang 10 degrees to the front."""
    for turn_deg, cost in ((-100, 0.5 * (100 / 45) ** 2), (60, 0.5 * ((60 / 45) ** 2 + 10**2))):
        assert math.isclose(cost_of(flexed(f"upperleg01.{side}", math.radians(turn_deg))), cost, rel_tol=1e-9)
    arm = NAMES.index(f"upperarm01.{side}") - 1
    assert math.isclose(PRIOR.mean_pose()[arm] @ PRIOR.axes[arm, 0], math.radians(-10), rel_tol=1e-6)


@pytest.mark.parametrize(
    ("hinge", "above", "below"),
    [("lowerarm01.L", "upperarm01.L", "wrist.L"), ("lowerleg01.R", "upperleg01.R", "foot.R")],
)
def test_hinges_fold_the_limb(hinge: str, above: str, below: str) -> None:
    """Turning an elbow by positive flexion brings the wrist nearer to the shoulder."""
    ends = [NAMES.index(name) for name in (above, below)]
    straight, bent = (ARTICULATION.pose(flexed(hinge, turn)).positions_m[0, ends] for turn in (0.0, 1.0))
    assert (bent[0] - bent[1]).norm() < (straight[0] - straight[1]).norm() - 0.05


def test_the_gradient_matches_the_cost() -> None:
    check_gradient(random_pose(ARTICULATION.rig, 2), PRIOR.add, rtol=1e-5, least=1e-3)


def test_constant_velocity_is_free_and_acceleration_has_a_robust_cost() -> None:
    """At 10 frames a second, 5 mm off a straight line is a second difference of -10 mm: 1 m/s^2, one sigma of 1 m/s^2.
    Geman-McClure with 3 sigma gives half of 1 / (1 + 1/9) for each of 25 keypoints."""
    smoothness = Smoothness([(0, 1, 2)], 10.0, np.ones(25))
    x = torch.zeros(3, 25, 3, dtype=torch.float64)
    x[:, :, 0] = torch.tensor([0.0, 0.1, 0.2])[:, None]
    jacobian = torch.zeros(3, 25, 3, 9, dtype=torch.float64)
    assert smoothness.add(NormalEquations(3, 9, 0), x, jacobian) < 1e-20
    x[1, :, 0] += 0.005
    assert math.isclose(smoothness.add(NormalEquations(3, 9, 0), x, jacobian), 25 * 0.5 * 0.9, rel_tol=1e-6)


def test_smoothness_does_not_depend_on_the_frame_stride() -> None:
    """Every fifth frame at 50 a second is ten frames a second: the same acceleration costs the same."""
    x = torch.randn(3, 25, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    jacobian = torch.zeros(3, 25, 3, 9, dtype=torch.float64)
    each, fifth = Smoothness([(0, 1, 2)], 10.0, np.ones(25)), Smoothness([(0, 5, 10)], 50.0, np.ones(25))
    costs = [smoothness.add(NormalEquations(3, 9, 0), x, jacobian) for smoothness in (each, fifth)]
    assert math.isclose(*costs, rel_tol=1e-12)


def test_smoothness_of_uneven_frames_uses_their_instants() -> None:
    """x = t^2 / 2 accelerates by 1 m/s^2, one sigma, whatever the instants: here 0, 0.1, 0.3 and 0.4 s."""
    frames = (0, 1, 3, 4)
    smoothness = Smoothness([frames], 10.0, np.ones(25))
    x = torch.zeros(4, 25, 3, dtype=torch.float64)
    x[:, :, 0] = torch.tensor(frames, dtype=torch.float64)[:, None] / 10
    equations, jacobian = (
        NormalEquations(4, 75, 0),
        torch.eye(75, dtype=torch.float64).view(1, 25, 3, 75).repeat(4, 1, 1, 1),
    )
    assert smoothness.add(equations, x, jacobian) < 1e-20
    x[:, :, 0] = x[:, :, 0] ** 2 / 2
    assert math.isclose(smoothness.add(equations, x, jacobian), 2 * 25 * 0.5 * 0.9, rel_tol=1e-6)
    equations = NormalEquations(4, 75, 0)
    far = Smoothness([frames], 10.0, np.full(25, 1e9))  # far from the outlier scale, so quadratic
    cost = far.add(equations, x, jacobian)
    assert math.isclose((equations.frame_gradient * x.flatten(1).numpy()).sum(), 2 * cost, rel_tol=1e-9)
    own = np.einsum("nuu->nu", equations.frame[0])[:, 0] * 1e18 / 1e4  # (2/3, -1, 1/3), (1/3, -1, 2/3) per step^2
    np.testing.assert_allclose(own, [4 / 9, 1 + 1 / 9, 1 / 9 + 1, 4 / 9])


def test_smoothness_does_not_link_separate_runs_of_frames() -> None:
    smoothness = Smoothness([(0, 1), (5, 6)], 10.0, np.ones(25))
    x = torch.randn(4, 25, 3, dtype=torch.float64)
    assert smoothness.add(NormalEquations(4, 9, 0), x, torch.zeros(4, 25, 3, 9, dtype=torch.float64)) == 0


def test_smoothness_blocks_match_the_dense_normal_matrix() -> None:
    """The blocks equal the dense J^T W J of the second differences, which are small enough for the robust weight to be
    one."""
    rig = two_bone_rig()
    articulation, pose = Articulation(rig), random_pose(rig, 4)
    pose = replace(pose, theta=1e-6 * pose.theta, root=torch.eye(4, dtype=torch.float64).repeat(4, 1, 1))
    x, by_frame, _ = articulation.jacobian(articulation.keypoints(), articulation.pose(pose))
    equations = NormalEquations(4, 9, 0)
    Smoothness([(0, 1, 2, 3)], 1.0, np.full(25, 2.0)).add(equations, x, by_frame)
    second = np.array([[1, -2, 1, 0], [0, 1, -2, 1.0]])
    j = by_frame.flatten(1, 2).numpy()
    for k in range(3):
        for t in range(4 - k):
            expected = (second.T @ second)[t, t + k] * j[t].T @ j[t + k] / 4
            np.testing.assert_allclose(equations.frame[k][t], expected, atol=1e-6)
    np.testing.assert_allclose(equations.coupling_diagonal, np.einsum("nuu->nu", equations.frame[0]))
