import numpy as np
import pytest
import torch

from hnerf.body.fit_result import BodyFit
from hnerf.config import load_settings
from hnerf.study.degradations.catalogue import Degradation, degrade_settings
from hnerf.study.degradations.fit import extreme_poses
from tests.body.boxes import box_rig

FRAMES = tuple(range(400))


@pytest.fixture(scope="module")
def body() -> BodyFit:
    rig = box_rig()
    theta = torch.zeros(len(FRAMES), len(rig.joint_names), 3)
    return BodyFit(rig, FRAMES, theta, torch.eye(4).repeat(len(FRAMES), 1, 1))


def test_pose_noise_is_the_rms_angle_of_moving_joints(body: BodyFit) -> None:
    turned = Degradation(kind="pose_noise", strength=5, seed=0).apply(body).theta
    moves = body.rig.free & (body.rig.parents >= 0)
    angles_deg = torch.rad2deg(turned.norm(dim=-1))
    assert float(angles_deg[:, moves].square().mean().sqrt()) == pytest.approx(5, rel=0.05)
    assert not angles_deg[:, ~moves].any()


def test_a_wrong_shape_moves_vertices_by_the_given_millimetres(body: BodyFit) -> None:
    bad = Degradation(kind="wrong_shape", strength=20, seed=3).apply(body)
    moved_m = bad.rig.vertices_m - body.rig.vertices_m
    assert float(moved_m.square().sum(-1).mean().sqrt()) == pytest.approx(0.020, rel=1e-4)
    assert torch.equal(bad.theta, body.theta)


def test_extreme_poses_start_from_recorded_ones(body: BodyFit) -> None:
    theta, root = extreme_poses(body, 60, 300, np.random.default_rng(0))
    moves = body.rig.free & (body.rig.parents >= 0)
    assert theta.shape == (300, *body.theta.shape[1:])
    assert float(torch.rad2deg(theta[:, moves].norm(dim=-1)).square().mean().sqrt()) == pytest.approx(60, rel=0.05)
    assert torch.equal(root, torch.eye(4).repeat(300, 1, 1))


def test_only_learning_rates_change() -> None:
    fast = load_settings("fast").training
    changed = degrade_settings(fast, Degradation(kind="learning_rate_up", strength=10, seed=0))
    assert (changed.field.grid_learning_rate, changed.field.network_learning_rate) == pytest.approx((0.5, 0.1))
    assert changed.pose_learning_rate == pytest.approx(5e-3)
    back = {"field": fast.field, "pose_learning_rate": fast.pose_learning_rate}
    assert changed.model_copy(update=back) == fast
    paper = degrade_settings(load_settings("paper").training, Degradation(kind="x", strength=0.1, seed=0))
    assert paper.field.learning_rate == pytest.approx(1e-4)
