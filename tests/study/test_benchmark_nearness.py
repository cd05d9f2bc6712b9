"""Angles and distances worked out by hand."""

import numpy as np
import pytest
import torch

from hnerf.body.fit_result import BodyFit
from hnerf.body.rig import pose_vertices
from hnerf.study.nearness import pose_distances_mm, view_angle_deg
from tests.body.boxes import box_rig
from tests.evaluation.ball import ball_camera


def test_the_angle_is_that_to_the_nearest_camera() -> None:
    others = [ball_camera("a", 0.0), ball_camera("b", 80.0)]
    assert view_angle_deg(ball_camera("c", 50.0), others, np.array([0, 0, 1.0])) == pytest.approx(30.0)
    assert view_angle_deg(ball_camera("c", -170.0), others, np.array([0, 0, 1.0])) == pytest.approx(110.0)
    assert view_angle_deg(others[0], others, np.array([0, 0, 1.0])) == pytest.approx(0.0, abs=1e-5)


def test_a_pose_is_as_far_as_its_vertices_from_the_nearest_pose_wherever_the_body_stands() -> None:
    rig = box_rig(bend_segments=6, splits=4)
    theta = torch.zeros(4, 2, 3)
    theta[:, 1, 1] = torch.tensor([0.0, 0.2, 0.5, 0.2])
    root = torch.eye(4).repeat(4, 1, 1)
    root[3, :3, 3] = torch.tensor([3.0, 0.0, 0.0])
    found = pose_distances_mm(BodyFit(rig, (10, 11, 12, 13), theta, root), [12, 13, 10], [10, 11])
    bent, more = (pose_vertices(rig, theta[k], torch.eye(4)) for k in (1, 2))
    assert found[12] == pytest.approx(1e3 * float((bent - more).norm(dim=1).mean()), rel=1e-5)
    assert found[12] > 10
    assert found[13] == pytest.approx(0.0, abs=1e-3)
    assert found[10] == 0.0
