import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from hnerf.body import fingers
from hnerf.body.anny import anny_rig
from hnerf.body.articulation import Articulation, Pose
from hnerf.body.fingers import FingerPrior, add_median_prior, add_persistence, fit_fingers
from hnerf.body.hand_points import finger_joints, hand_points
from hnerf.body.normal_equations import NormalEquations
from hnerf.body.rig import Rig, joint_transforms
from tests.body.test_articulation import random_pose
from tests.body.test_hand_points import views_of

RIG = anny_rig().to(dtype=torch.float64)
FINGERS = [RIG.joint_names.index(name) for name in finger_joints()]


def posed(turns: torch.Tensor, frames: int = 3) -> Pose:
    pose = random_pose(RIG, frames)
    pose.root[:, :3, 3] = 0
    pose.theta[:, FINGERS] = turns
    return pose


def seen_points(pose: Pose) -> torch.Tensor:
    free = RIG.free.clone()
    free[FINGERS] = True
    articulation = Articulation(replace(RIG, free=free))
    return articulation.jacobian(hand_points(articulation), articulation.pose(pose))[0]


def wrist_to_last_joints_m(rig: Rig, turns: torch.Tensor) -> torch.Tensor:
    """Return the distance (2, 5) of each finger's last joint from the wrist."""
    theta = torch.zeros(len(rig.joint_names), 3, dtype=torch.float64)
    theta[FINGERS] = turns
    at = joint_transforms(rig, theta, torch.eye(4, dtype=torch.float64))[:, :3, 3]
    wrists = at[[rig.joint_names.index(f"wrist.{side}") for side in "LR"]]
    return (at[FINGERS].reshape(2, 5, 3, 3)[:, :, 2] - wrists[:, None]).norm(dim=-1)


def test_fingers_of_both_hands_bend_towards_the_wrist() -> None:
    prior = FingerPrior.of(RIG)
    bent = wrist_to_last_joints_m(RIG, math.radians(60) * prior.axes[:, 0])
    straight = wrist_to_last_joints_m(RIG, torch.zeros(30, 3, dtype=torch.float64))
    assert (bent < 0.8 * straight).all()
    torch.testing.assert_close(bent[0], bent[1], atol=1e-3, rtol=0)


def test_finger_angles_are_relative_to_straight_fingers() -> None:
    """The left index finger is straight at rest except for its second joint, which is bent by 30 degrees towards the
    palm. Relaxed, that joint is at 25 degrees, so 5 back from rest. Its range is -10 to 100 degrees, so 40 back and 70
    on from rest."""
    wrist, first, second, third, little = (
        RIG.joint_names.index(f"{name}.L") for name in ("wrist", "finger2-1", "finger2-2", "finger2-3", "finger5-1")
    )
    joints_m = RIG.joints_m.clone()
    ahead = joints_m[first] - joints_m[wrist]
    palm = torch.linalg.cross(joints_m[little] - joints_m[wrist], ahead)  # downwards, for an arm held out to the left
    ahead, palm = ahead / ahead.norm(), palm / palm.norm()
    joints_m[second] = joints_m[first] + 0.04 * ahead
    joints_m[third] = joints_m[second] + 0.03 * (math.sqrt(0.75) * ahead + 0.5 * palm)
    prior = FingerPrior.of(replace(RIG, joints_m=joints_m))
    index = slice(3, 6)  # the index finger comes after the thumb
    found_deg = torch.stack([prior.mean[index], prior.low[index, 0], prior.high[index, 0]]).rad2deg()
    expected_deg = torch.tensor([[20.0, -5, 15], [-10, -40, -10], [100, 70, 100]], dtype=torch.float64)
    torch.testing.assert_close(found_deg, expected_deg)


def test_one_standard_deviation_of_finger_flexion_costs_a_half() -> None:
    """The second joint of an index finger has a standard deviation of 25 degrees. The relaxed hand costs nothing. 4
    degrees beyond a limit are two standard deviations of the limit, and cost 2 more."""
    prior = FingerPrior.of(RIG)
    turns = prior.relaxed()[None].clone()
    equations = NormalEquations(1, 90, 0)
    assert prior.add(equations, turns) < 1e-20
    turns[0, 4] += math.radians(25) * prior.axes[4, 0]
    np.testing.assert_allclose(prior.add(equations, turns), 0.5)
    beyond = prior.high[4, 0] + math.radians(4)
    turns[0, 4] = beyond * prior.axes[4, 0]
    expected = 0.5 * float((beyond - prior.mean[4]) / math.radians(25)) ** 2 + 2
    np.testing.assert_allclose(prior.add(equations, turns), expected)


def test_finger_spread_is_limited() -> None:
    """24 degrees at the knuckle of the left index finger are two standard deviations of 12, and two of 2 beyond the
    limit of 20. 39 degrees at the thumb's base are 2.6 of 15, and two beyond 35. 9 degrees at the last joint of the
    index finger are 4.5 of 2, and two beyond 5."""
    prior = FingerPrior.of(RIG)
    for joint, sign, angle_deg, std in ((3, 1, 24, 2.0), (3, -1, 24, 2.0), (0, 1, 39, 2.6), (5, -1, 9, 4.5)):
        turns = prior.relaxed()[None].clone()
        turns[0, joint] += sign * math.radians(angle_deg) * prior.axes[joint, 2]
        np.testing.assert_allclose(prior.add(NormalEquations(1, 90, 0), turns), 0.5 * std**2 + 2)


def test_a_change_between_frames_of_one_standard_deviation_costs_a_half() -> None:
    turns = torch.zeros(3, 30, 3, dtype=torch.float64)
    turns[1:, 7, 1] = 0.2
    both = np.array([0, 1]), 0.2
    assert math.isclose(add_persistence(NormalEquations(3, 90, 0), turns, *both, np.ones(2)), 0.5)
    gap = add_persistence(NormalEquations(3, 90, 0), turns, np.array([1]), 0.2, np.ones(1))
    assert gap == 0  # the change is between the first two frames, which are not linked here
    twice_as_late = np.array([2.0, 1.0])  # two time steps allow twice the change
    assert math.isclose(add_persistence(NormalEquations(3, 90, 0), turns, *both, twice_as_late), 0.125)


def test_persistence_couples_each_frame_to_the_next() -> None:
    """The cost is a quadratic form, so its gradient is the matrix times the turns: a frame's own block, and the blocks
    that couple it to the previous and next frame. The whole diagonal is coupling."""
    turns = torch.randn(3, 2, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    equations, x = NormalEquations(3, 6, 0), turns.flatten(1).numpy()
    cost = add_persistence(equations, turns, np.array([0, 1]), 0.1, np.array([1.0, 1.5]))
    own, coupled = equations.frame[:2]
    by_matrix = np.einsum("tij,tj->ti", own, x)
    by_matrix[:-1] += np.einsum("tij,tj->ti", coupled, x[1:])
    by_matrix[1:] += np.einsum("tji,tj->ti", coupled, x[:-1])
    np.testing.assert_allclose(equations.frame_gradient, by_matrix, rtol=1e-12)
    np.testing.assert_allclose((x * by_matrix).sum() / 2, cost)
    np.testing.assert_allclose(equations.coupling_diagonal, np.einsum("tii->ti", own))


def test_persistence_links_frames_within_runs_at_the_frame_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames 0 and 1 are a run, and 5, 6 and 8 another; consecutive numbers are a tenth of a second apart. 200 degrees
    a second are 20 per time step, and there are two steps from 6 to 8."""
    asked = []
    monkeypatch.setattr(fingers, "STEPS_M", (0.2,))
    monkeypatch.setattr(fingers, "add_persistence", lambda _, __, *given: asked.append(given))
    pose = posed(FingerPrior.of(RIG).relaxed(), 5)
    fit_fingers(pose, views_of(seen_points(pose)), torch.full((2, 5), 0.0045), [(0, 1), (5, 6, 8)], 0.1)
    ((following, std, steps),) = asked
    assert following.tolist() == [0, 2, 3] and math.isclose(std, math.radians(20)) and steps.tolist() == [1, 1, 2]


def test_the_finger_fit_starts_relaxed_unless_fingers_are_given(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fingers, "STEPS_M", ())
    relaxed = FingerPrior.of(RIG).relaxed()
    for given, begun in ((0 * relaxed, relaxed), (2 * relaxed, 2 * relaxed)):
        pose = posed(given, 1)
        found = fit_fingers(pose, views_of(seen_points(pose)), torch.full((2, 1), 0.009), [(0,)], 0.1)
        torch.testing.assert_close(found.theta[0, FINGERS], begun)


SHOWN = torch.tensor([[True, False], [True, True], [True, True], [False, False]])


def test_the_cost_of_deviating_from_the_median_hand_is_bounded() -> None:
    """A joint of the left hand is 5 degrees off its median over the three frames that show the hand: 0.5 / (1 + (5 /
    20)^2). 300 degrees off, the cost is nearly (20 / 5)^2 / 2. Only two frames show the right hand, too few for a
    median."""
    for off_deg, cost in ((5.0, 0.5 / (1 + 1 / 16)), (300.0, 0.5 * 60**2 / (1 + 15**2))):
        turns = torch.full((4, 30, 3), 0.1, dtype=torch.float64)
        turns[2, 4, 0] += math.radians(off_deg)
        turns[1, 20, 0] += 1.0
        np.testing.assert_allclose(add_median_prior(NormalEquations(4, 90, 0), turns, SHOWN), cost)


def test_the_median_hand_uses_only_frames_that_show_it() -> None:
    """Half of the frames do not show the hands and have another hand pose. They are pulled to the pose of the other
    frames, not half-way."""
    turns = torch.zeros(6, 30, 3, dtype=torch.float64)
    turns[3:, :, 0] = 0.2
    equations = NormalEquations(6, 90, 0)
    add_median_prior(equations, turns, torch.tensor([[True, True]] * 3 + [[False, False]] * 3))
    assert not equations.frame_gradient[:3].any() and (equations.frame_gradient[3:, ::3] > 0).all()


def test_the_median_priors_gradient_matches_its_cost_for_fixed_medians() -> None:
    turns = torch.zeros(3, 30, 3, dtype=torch.float64)
    turns[2] = torch.rand(30, 3, generator=torch.Generator().manual_seed(0)).double()
    shown, step = torch.ones(3, 2, dtype=torch.bool), torch.zeros_like(turns)
    step[2] = 1e-6
    ends = [add_median_prior(NormalEquations(3, 90, 0), turns + sign * step, shown) for sign in (1, -1)]
    equations = NormalEquations(3, 90, 0)
    add_median_prior(equations, turns, shown)
    np.testing.assert_allclose(equations.frame_gradient[2].sum(), (ends[0] - ends[1]) / 2e-6, rtol=1e-6)


def test_gradients_of_finger_priors_match_their_costs() -> None:
    prior, generator = FingerPrior.of(RIG), torch.Generator().manual_seed(0)
    turns, direction = (torch.randn(3, 30, 3, generator=generator, dtype=torch.float64) for _ in range(2))

    def cost_and_equations(at: torch.Tensor) -> tuple[float, NormalEquations]:
        equations = NormalEquations(3, 90, 0)
        cost = prior.add(equations, at) + add_persistence(equations, at, np.array([0, 1]), 0.1, np.ones(2))
        return cost, equations

    ends = [cost_and_equations(turns + sign * 1e-6 * direction)[0] for sign in (1, -1)]
    slope = (cost_and_equations(turns)[1].frame_gradient * direction.flatten(1).numpy()).sum()
    np.testing.assert_allclose(slope, (ends[0] - ends[1]) / 2e-6, rtol=1e-6)


def test_bent_fingers_are_fitted_and_unseen_ones_relax() -> None:
    """Two cameras see a left hand with all fingers bent 40 degrees more than relaxed. No camera sees the right hand."""
    prior = FingerPrior.of(RIG)
    turns = prior.relaxed() + math.radians(40) * prior.axes[:, 0] * (torch.arange(30) % 15 >= 3)[:, None]
    true = posed(turns)
    views = views_of(seen_points(true))
    views.confidence[..., 21:] = 0
    start = posed(torch.zeros(30, 3, dtype=torch.float64))
    found = fit_fingers(start, views, torch.full((2, 3), 0.009), [(0, 1, 2)], 0.1)
    off_m = (seen_points(found) - seen_points(true))[:, :21].norm(dim=-1)
    assert off_m.mean() < 0.004
    torch.testing.assert_close(found.theta[:, FINGERS[15:]], prior.relaxed()[15:].expand(3, -1, -1))
    rest = [j for j in range(len(RIG.joint_names)) if j not in FINGERS]
    torch.testing.assert_close(found.theta[:, rest], true.theta[:, rest])


def test_a_hidden_hand_takes_the_median_pose_and_a_seen_gesture_is_kept() -> None:
    """In frames far apart, the left hand is bent by 30 degrees. One frame hides it. In another it is bent by 65
    degrees, where the points of the median hand would be 3 cm off. No view is sure of the wrist."""
    prior = FingerPrior.of(RIG)
    bend = torch.deg2rad(torch.tensor([30, 30, 30, 30, 65], dtype=torch.float64))[:, None, None]
    true = posed(prior.relaxed() + bend * prior.axes[:, 0] * (torch.arange(30) % 15 >= 3)[:, None], 5)
    views = views_of(seen_points(true))
    views.confidence[..., [0, 21]] = 0.4
    views.confidence[:, 1] = 0
    start = posed(torch.zeros(30, 3, dtype=torch.float64), 5)
    found = fit_fingers(start, views, torch.full((2, 5), 0.009), [(t,) for t in range(0, 50, 10)], 0.1)
    off_m = (seen_points(found) - seen_points(true))[:, :21].norm(dim=-1).mean(1)
    usual_off_m = (seen_points(true)[0] - seen_points(true)[4])[:21].norm(dim=-1).mean()
    assert off_m[1] < 0.004 and off_m[4] < 0.012 and usual_off_m > 0.03
