import math
from dataclasses import replace

import numpy as np
import torch

from hnerf.body.anny import anny_rig
from hnerf.body.articulation import Articulation, Pose
from hnerf.body.normal_equations import NormalEquations
from hnerf.body.pose_prior import PosePrior, Smoothness
from tests.body.test_articulation import check_gradient, random_pose
from tests.body.two_bone import two_bone_rig


def resting(articulation: Articulation) -> Pose:
    joints = len(articulation.rig.joints_m)
    root = torch.eye(4, dtype=torch.float64)[None]
    theta = torch.zeros(1, joints, 3, dtype=torch.float64)
    theta[:, articulation.joints[1:]] = PosePrior(articulation).mean_pose()
    return Pose(articulation.rig, theta, root, torch.zeros(25, 3, dtype=torch.float64))


def cost_and_equations(pose: Pose) -> tuple[float, NormalEquations]:
    articulation = Articulation(pose.rig)
    equations = NormalEquations(len(pose.theta), articulation.unknowns, 0)
    return PosePrior(articulation).add(equations, pose), equations


def cost_of(pose: Pose) -> float:
    return cost_and_equations(pose)[0]


def test_the_most_likely_pose_costs_nothing() -> None:
    articulation = Articulation(anny_rig().to(dtype=torch.float64))
    assert cost_of(resting(articulation)) < 1e-12


def test_one_standard_deviation_of_flexion_costs_one_half() -> None:
    """A foot flexes about the left-right axis, perpendicular to the foot, with a standard deviation of 20 degrees."""
    articulation = Articulation(anny_rig().to(dtype=torch.float64))
    pose, prior = resting(articulation), PosePrior(articulation)
    foot = articulation.joints[1:].tolist().index(articulation.rig.joint_names.index("foot.L"))
    pose.theta[0, articulation.joints[1 + foot]] += math.radians(20) * prior.axes[foot, 0]
    assert math.isclose(cost_of(pose), 0.5, rel_tol=1e-9)


def test_knees_and_elbows_do_not_bend_backwards_nor_arms_swing_behind() -> None:
    """75 degrees in the free direction are cheap. The same angle in the other direction exceeds the limit, which has a
    softness of 2 degrees."""
    articulation = Articulation(anny_rig().to(dtype=torch.float64))
    prior = PosePrior(articulation)
    names = [articulation.rig.joint_names[int(j)] for j in articulation.joints[1:]]
    for name, forwards in (("lowerleg01.L", 1), ("lowerarm01.R", 1), ("upperarm01.R", -1)):
        m = names.index(name)
        costs = []
        for sign in (forwards, -forwards):
            pose = resting(articulation)
            pose.theta[0, articulation.joints[1 + m]] = sign * math.radians(75) * prior.axes[m, 0]
            costs.append(cost_of(pose))
        assert costs[0] < 2 and costs[1] > 20, name


def test_thighs_bend_forwards_but_not_far_backwards() -> None:
    """A thigh 100 degrees forwards is 100/45 standard deviations from rest. 60 degrees backwards are 60/45, and 20
    beyond the limit of 40, which has a softness of 2. Arms hang 10 degrees to the front."""
    articulation = Articulation(anny_rig().to(dtype=torch.float64))
    prior, pose = PosePrior(articulation), resting(articulation)
    names = [articulation.rig.joint_names[int(j)] for j in articulation.joints[1:]]
    for side in "LR":
        thigh, arm = (names.index(f"{name}.{side}") for name in ("upperleg01", "upperarm01"))
        for turn_deg, cost in ((-100, 0.5 * (100 / 45) ** 2), (60, 0.5 * ((60 / 45) ** 2 + 10**2))):
            pose.theta[0, articulation.joints[1 + thigh]] = math.radians(turn_deg) * prior.axes[thigh, 0]
            assert math.isclose(cost_of(pose), cost, rel_tol=1e-9)
        pose.theta[0, articulation.joints[1 + thigh]] = 0
        assert math.isclose(prior.mean_pose()[arm] @ prior.axes[arm, 0], math.radians(-10), rel_tol=1e-6)


def test_hinges_fold_the_limb() -> None:
    """Turning an elbow by positive flexion brings the wrist nearer to the shoulder."""
    articulation = Articulation(anny_rig().to(dtype=torch.float64))
    rig, prior = articulation.rig, PosePrior(articulation)
    names = [rig.joint_names[int(j)] for j in articulation.joints[1:]]
    for hinge, above, below in (
        ("lowerarm01.L", "upperarm01.L", "wrist.L"),
        ("lowerleg01.R", "upperleg01.R", "foot.R"),
    ):
        ends = [articulation.joints.tolist().index(rig.joint_names.index(name)) for name in (above, below)]
        lengths = []
        for angle in (0.0, 1.0):
            pose = resting(articulation)
            pose.theta[0, rig.joint_names.index(hinge)] = angle * prior.axes[names.index(hinge), 0]
            where = articulation.pose(pose).positions_m[0, ends]
            lengths.append(float((where[0] - where[1]).norm()))
        assert lengths[1] < lengths[0] - 0.05, hinge


def test_the_gradient_matches_the_cost() -> None:
    check_gradient(random_pose(anny_rig().to(dtype=torch.float64), 2), cost_and_equations, rtol=1e-5, least=1e-3)


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
