"""Angles and distances worked out by hand."""

import dataclasses

import numpy as np
import pytest
import torch

from hnerf.body.fit_result import BodyFit
from hnerf.study.benchmark.training_distance import pose_distances_deg, view_angle_deg
from tests.body.boxes import box_rig
from tests.evaluation.ball import ball_camera


def test_the_view_angle_is_measured_to_the_nearest_training_camera() -> None:
    others = [ball_camera("a", 0.0), ball_camera("b", 80.0)]
    assert view_angle_deg(ball_camera("c", 50.0), others, np.array([0, 0, 1.0])) == pytest.approx(30.0)
    assert view_angle_deg(ball_camera("c", -170.0), others, np.array([0, 0, 1.0])) == pytest.approx(110.0)
    assert view_angle_deg(others[0], others, np.array([0, 0, 1.0])) == pytest.approx(0.0, abs=1e-5)


def test_the_distance_of_a_pose_is_the_mean_turn_of_free_joints_from_the_nearest_pose() -> None:
    """One of two free joints turns. In frame 12 it is 90 degrees from frame 10 and 60 from frame 11: 30 in the mean
    over both joints. Frame 13 is frame 11 at another place. In frame 14 the joint is turned by 90 degrees about x, not
    y: 120 degrees from frame 12 (a third of a turn about the cube's diagonal), 90 from frame 10: 45 in the mean."""
    rig = dataclasses.replace(box_rig(), free=torch.tensor([True, True]))
    theta = torch.zeros(5, 2, 3)
    theta[:4, 1, 1] = torch.tensor([0.0, 30.0, 90.0, 30.0]).deg2rad()
    theta[4, 1, 0] = np.pi / 2
    root = torch.eye(4).repeat(5, 1, 1)
    root[3, :3, 3] = torch.tensor([3.0, 0.0, 0.0])
    body = BodyFit(rig, (10, 11, 12, 13, 14), theta, root)
    found = pose_distances_deg(body, [12, 13, 10, 14], [10, 11])
    assert found == {
        12: pytest.approx(30.0, abs=1e-4),
        13: pytest.approx(0.0, abs=1e-4),
        10: 0.0,
        14: pytest.approx(45.0, abs=1e-4),
    }
    assert pose_distances_deg(body, [14], [12])[14] == pytest.approx(60.0, abs=1e-4)
    one = dataclasses.replace(body, rig=dataclasses.replace(rig, free=torch.tensor([False, True])))
    assert pose_distances_deg(one, [14], [12])[14] == pytest.approx(120.0, abs=1e-4)


def test_the_nearest_pose_is_one_for_all_joints() -> None:
    """Frame 2 bends both joints by 60 degrees, frames 0 and 1 one of them each: either is 60 degrees off in the other
    joint."""
    rig = dataclasses.replace(box_rig(), free=torch.tensor([True, True]))
    theta = torch.zeros(3, 2, 3)
    theta[0, 0, 1] = theta[1, 1, 1] = theta[2, :, 1] = np.pi / 3
    body = BodyFit(rig, (0, 1, 2), theta, torch.eye(4).repeat(3, 1, 1))
    assert pose_distances_deg(body, [2], [0, 1])[2] == pytest.approx(30.0, abs=1e-4)
