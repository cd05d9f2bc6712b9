import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from hnerf.body.anny import anny_rig
from hnerf.body.articulation import Articulation, Pose
from hnerf.body.fit import fit_body
from hnerf.body.fit_result import BodyFit
from hnerf.body.ground import FEET
from hnerf.body.keypoint_fit import Problem, levenberg_marquardt
from hnerf.body.normal_equations import NormalEquations
from hnerf.body.observations import runs
from hnerf.body.standing_feet import StandingFeet, _speeds_mps
from hnerf.config import FitSettings
from tests.body.recorded_body import (
    RING,
    moving_body,
    of_linear_model,
    problem_at,
    record,
    silhouettes,
    true_pose,
)
from tests.body.test_articulation import check_gradient, random_pose
from tests.body.two_bone import two_bone_rig
from tests.calibration.synthetic import edited_keypoints

LEFT, RIGHT = slice(0, 3), slice(3, 6)


def prior(per_s: list[float], stands: list[bool]) -> StandingFeet:
    """Return the prior for frames that follow one another."""
    pairs = len(per_s)
    return StandingFeet(np.arange(pairs), torch.tensor(per_s).double(), torch.tensor([stands] * pairs))


def carried(metres_a_frame: float, frames: int) -> Pose:
    """Return the rest body that moves sideways."""
    rig = anny_rig().to(dtype=torch.float64)
    root = torch.eye(4, dtype=torch.float64).repeat(frames, 1, 1)
    root[:, 0, 3] = metres_a_frame * torch.arange(frames)
    theta = torch.zeros(frames, len(rig.joints_m), 3, dtype=torch.float64)
    return Pose(rig, theta, root, torch.zeros(25, 3, dtype=torch.float64))


def add(equations: NormalEquations, pose: Pose, feet: StandingFeet) -> float:
    articulation = Articulation(pose.rig)
    x, by_frame, _ = articulation.jacobian(articulation.keypoints(), articulation.pose(pose))
    return feet.add(equations, x, by_frame)


def standing(frames: tuple[int, ...]) -> BodyFit:
    """Return a body in the same pose in all frames."""
    body, rows = moving_body(frames), [0] * len(frames)
    return BodyFit(body.rig, frames, body.theta[rows], body.root[rows])


def test_speeds_are_those_of_a_line_through_half_a_second() -> None:
    """At 10 frames a second, five frames are within a quarter of a second on either side. A point that moves by 2 cm a
    frame has 0.2 m/s. For one that trembles by + 1, - 1, + 1, - 1, + 1 cm, the line is level: - 2 + 1 - 1 + 2 = 0 in
    the middle. From two frames that are a second apart, - 1 and + 1 cm make 2 cm/s."""
    at_s, tremble_m = np.arange(5) / 10, 0.01 * np.array([1, -1, 1, -1, 1.0])
    points_m = np.zeros((5, 2, 3))
    points_m[:, 0, 1], points_m[:, 1, 2] = 0.2 * at_s, tremble_m
    speeds_mps = _speeds_mps(points_m, at_s)
    np.testing.assert_allclose(speeds_mps[:, 0], 0.2)
    assert math.isclose(speeds_mps[2, 1], 0, abs_tol=1e-12)
    far = _speeds_mps(np.array([[[0, 0, -0.01]], [[0, 0, 0.01]]]), np.array([0, 1.0]))
    np.testing.assert_allclose(far, 0.02)
    assert _speeds_mps(np.zeros((1, 6, 3)), np.zeros(1)).tolist() == [[0] * 6]


def test_the_foot_of_a_leg_that_swings_does_not_stand_and_the_other_does() -> None:
    """The leg turns by 0.3 radians a frame."""
    pose = carried(0.0, 4)
    pose.theta[:, pose.rig.joint_names.index("upperleg01.R"), 0] = -0.3 * torch.arange(4)
    feet = StandingFeet.of_pose(pose, [(0, 1, 2, 3)], 10.0)
    assert feet.stands[:, LEFT].all() and not feet.stands[:, RIGHT].any()


def test_feet_that_a_treadmill_carries_do_not_stand() -> None:
    """2 cm a frame are 0.2 m/s at 10 frames a second, and 1 cm a frame is 0.1 m/s. Numbers that rise by 2 are half as
    many frames a second."""
    stands = [StandingFeet.of_pose(carried(m, 4), [(0, 2, 4, 6)], 20.0).stands for m in (0.02, 0.01)]
    assert not stands[0].any() and stands[1].all()


def test_a_foot_is_held_between_two_frames_if_it_stands_in_both() -> None:
    """Frames are half a second apart, so that each is judged by its neighbours. The body leaves after the third frame,
    by 1 m a frame: that frame, and those after it, are fast."""
    pose = carried(0.0, 5)
    pose.root[:, 0, 3] = torch.tensor([0, 0, 0, 1, 2])
    stands = StandingFeet.of_pose(pose, [(0, 1, 2, 3, 4)], 2.0).stands
    assert stands.all(1).tolist() == stands.any(1).tolist() == [True, False, False, False]


def test_runs_of_frames_are_not_linked() -> None:
    """A body that jumps between two runs stands in both."""
    pose = carried(0.0, 5)
    pose.root[3:, 0, 3] = 1.0
    feet = StandingFeet.of_pose(pose, [(0, 1, 2), (3, 5)], 10.0)
    assert feet.first.tolist() == [0, 1, 3] and feet.stands.all()
    np.testing.assert_allclose(feet.per_s, [10, 10, 5])


def test_one_standard_deviation_costs_about_a_half() -> None:
    """3 mm in a tenth of a second are .03 m/s: half of 1 / (1 + (3/20)^2) for each point that stands. So are 6 mm in a
    fifth of a second."""
    left = [True] * 3 + [False] * 3
    for metres, per_s in ((0.003, 10.0), (0.006, 5.0)):
        x = torch.zeros(2, 25, 3, dtype=torch.float64)
        x[1, :, 1] = metres
        cost = prior([per_s], left).add(NormalEquations(2, 9, 0), x, torch.zeros(2, 25, 3, 9, dtype=torch.float64))
        assert math.isclose(cost, 3 * 0.5 / 1.0225, rel_tol=1e-6)


def test_the_gradient_matches_the_cost() -> None:
    """Feet of random poses are far apart, so that the frames count as a minute apart."""
    stands = [True, False, True, True, True, True]
    pose = random_pose(anny_rig().to(dtype=torch.float64), 3)
    check_gradient(pose, partial(add, feet=prior([1 / 60, 1 / 90], stands)), rtol=1e-5, least=1e-3)


def test_blocks_match_the_dense_normal_matrix() -> None:
    """Feet that do not move have a weight of (.03 m/s)^-2. Their differences over 0.5 and 0.25 s make the blocks of J^T
    W J, all of which couple frames."""
    rig = two_bone_rig()
    pose = random_pose(rig, 1)
    pose = Pose(rig, pose.theta.repeat(3, 1, 1), pose.root.repeat(3, 1, 1), pose.offsets_m)
    articulation = Articulation(rig)
    _, by_frame, _ = articulation.jacobian(articulation.keypoints(), articulation.pose(pose))
    equations = NormalEquations(3, 9, 0)
    add(equations, pose, prior([2.0, 4.0], [True, True, False, True, True, True]))
    stands = [keypoint for k, keypoint in enumerate(FEET) if k != 2]
    j = by_frame[:, stands].flatten(1, 2).numpy()
    velocity = np.array([[-2, 2, 0], [0, -4, 4.0]])
    for k in range(3):
        for t in range(3 - k):
            expected = (velocity.T @ velocity)[t, t + k] * j[t].T @ j[t + k] / 0.03**2
            np.testing.assert_allclose(equations.frame[k][t], expected, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(equations.coupling_diagonal, np.einsum("nuu->nu", equations.frame[0]))


def test_errors_of_keypoints_no_longer_move_standing_feet(tmp_path: Path) -> None:
    """Keypoints of a single camera are off by 2 px, some 2 cm. The rest of the body still follows them."""
    truth, noise = standing((0, 2, 4, 6)), np.random.default_rng(0)
    capture = record(tmp_path, truth, RING, ("0",))
    with edited_keypoints(tmp_path) as keypoints:
        keypoints["0"][..., :2] += noise.normal(0, 2, keypoints["0"][..., :2].shape)
    pose = true_pose(truth)
    free = of_linear_model(problem_at(pose, capture, 1e3, 1), pose.rig)
    held = replace(free, standing_feet=StandingFeet.of_pose(pose, runs(capture), capture.fps))
    moved_mm = []
    for problem in (free, held):
        fitted = levenberg_marquardt(problem, pose, 8)
        articulation = Articulation(fitted.rig)
        x_m = articulation.jacobian(articulation.keypoints(), articulation.pose(fitted))[0]
        moved_mm.append(1e3 * (x_m[1:] - x_m[:-1]).norm(dim=-1).mean(0))
    (free_mm, held_mm), wrists = moved_mm, [4, 7]
    assert free_mm[list(FEET)].mean() > 8 and held_mm[list(FEET)].mean() < 2
    assert held_mm[wrists].mean() > 0.7 * free_mm[wrists].mean()


def test_a_fit_holds_the_feet_that_stand_before_it_uses_outlines(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A leg of the moving body swings by up to 4 radians a second."""
    monkeypatch.setattr("hnerf.body.fit.KEYPOINT_STEPS", 8)
    refined: list[Problem] = []
    for name in ("refine_with_outlines", "refine_with_clothing"):
        monkeypatch.setattr(f"hnerf.body.fit.{name}", lambda problem, pose, *_: refined.append(problem) or pose)
    for body, stand in ((standing((0, 1, 2)), True), (moving_body((0, 1, 2)), False)):
        capture = record(tmp_path, body, RING, tuple(RING))
        fit_body(capture, silhouettes(capture, body), FitSettings())
        found = [problem.standing_feet for problem in refined]
        assert len(found) == 2 and all(feet and bool(feet.stands[:, LEFT].all()) == stand for feet in found)
        refined.clear()
