import dataclasses
import math

import numpy as np
import pytest
import torch

from hnerf.asset.extreme_poses import (
    ARMS_UP,
    DEEP_SQUAT,
    EXPRESSIONS,
    TURNED_HEAD,
    extreme_poses,
    fist,
    moved_by,
    posed_m,
    turned,
    with_expressions,
)
from hnerf.asset.rig_transfer import clothed_rig
from hnerf.asset.staging import StagedAvatar
from hnerf.body.rig import Rig, joint_transforms
from tests.asset.figure import column_rig, upright_column

CLOTHED = clothed_rig(column_rig(), upright_column(0.18, -0.05, 1.65))  # as the fixture `staged`


def joints_m(rig: Rig, theta: torch.Tensor | None) -> dict[str, np.ndarray]:
    assert theta is not None
    at = joint_transforms(rig, theta, torch.eye(4))[:, :3, 3].numpy()
    return dict(zip(rig.joint_names, at, strict=True))


def test_joint_turns_are_about_stage_axes_and_mirrored_to_the_other_side() -> None:
    arms = dataclasses.replace(column_rig(), joint_names=("upper.R", "upper.L"))
    theta = turned(arms, {"upper.L": (0, 0, 90)})  # about the stage's front axis, which is -Y of the body
    assert theta is not None
    torch.testing.assert_close(theta, torch.tensor([[0, math.pi / 2, 0], [0, -math.pi / 2, 0]]))
    assert turned(arms, {"lower.L": (0, 0, 90)}) is None


def test_a_bent_joint_moves_the_columns_top_to_the_front(staged: StagedAvatar) -> None:
    upright = posed_m(staged, CLOTHED, torch.zeros(2, 3))
    np.testing.assert_allclose(upright - upright[0], staged.rest_points_m - staged.rest_points_m[0], atol=1e-6)
    bowed = posed_m(staged, CLOTHED, torch.tensor([[0.0, 0, 0], [math.pi / 2, 0, 0]]))
    top = staged.rest_points_m[:, 1].argmax()  # 85 cm above the joint, which is at 0.85 m
    np.testing.assert_allclose(bowed[top] - upright[top], [0, -0.85, 0.85], atol=1e-4)


def test_a_body_without_the_needed_joints_has_no_extreme_poses(staged: StagedAvatar) -> None:
    faceless = dataclasses.replace(staged, expressions_m={}, physiques_m={})
    assert extreme_poses(faceless, CLOTHED, 0) == []


def test_a_pose_that_would_frame_no_point_is_left_out(staged: StagedAvatar, monkeypatch: pytest.MonkeyPatch) -> None:
    """The clothes have no point that follows a head, as a captured mesh without hands has none that follows a hand."""
    monkeypatch.setattr("hnerf.asset.extreme_poses.TURNED_HEAD", {"root": (0, 20, 0)})
    shown = extreme_poses(dataclasses.replace(staged, expressions_m={}), CLOTHED, len(staged.faces))
    assert [pose.name for pose in shown] == ["Stout"]


def test_an_expression_is_the_sum_of_its_units(staged: StagedAvatar) -> None:
    units = {name: np.zeros((len(staged.rest_points_m), 3)) for parts in EXPRESSIONS.values() for name in parts}
    units["mouthSmileLeft"][0], units["mouthSmileRight"][1], units["jawOpen"][1] = (0.01, 0, 0), (0.02, 0, 0), (0, 1, 0)
    shown = with_expressions(dataclasses.replace(staged, expressions_m=units))
    assert list(shown) == list(EXPRESSIONS)
    smile_m, face = shown["Smile"]
    np.testing.assert_allclose(
        (smile_m - staged.rest_points_m)[:3], [[0.01, 0, 0], [0.02, 0, 0], [0, 0, 0]], atol=1e-12
    )
    np.testing.assert_array_equal(np.flatnonzero(face), [0, 1])
    assert with_expressions(dataclasses.replace(staged, expressions_m={})) == {}


def test_expressions_and_physiques_are_shown_with_the_poses(staged: StagedAvatar) -> None:
    units = {name: np.full((len(staged.rest_points_m), 3), 0.01) for parts in EXPRESSIONS.values() for name in parts}
    shown = extreme_poses(dataclasses.replace(staged, expressions_m=units), CLOTHED, len(staged.faces))
    assert [pose.name for pose in shown] == [*EXPRESSIONS, "Stout"]
    np.testing.assert_array_equal(shown[-1].points_m, staged.rest_points_m + staged.physiques_m["stout"])
    assert shown[-1].shown.all()


def test_poses_match_their_names(rig: Rig) -> None:
    """In body axes Z is up, -Y is to the front and +X to the left."""
    up = joints_m(rig, turned(rig, ARMS_UP))
    squat = joints_m(rig, turned(rig, DEEP_SQUAT))
    for side, sign in (("L", 1), ("R", -1)):
        assert up[f"wrist.{side}"][2] > up["head"][2] + 0.2 and sign * up[f"wrist.{side}"][0] > 0
        hip, knee, ankle = (squat[f"{name}.{side}"] for name in ("upperleg01", "lowerleg01", "foot"))
        assert knee[1] < hip[1] - 0.2 and abs(knee[2] - hip[2]) < 0.25
        assert ankle[2] < knee[2] - 0.25 and sign * knee[0] > sign * hip[0] + 0.05
    head = turned(rig, TURNED_HEAD)
    assert head is not None
    turn = joint_transforms(rig, head, torch.eye(4))[rig.joint_names.index("head"), :3, :3].numpy()
    forward = turn @ [0, -1, 0]
    assert math.degrees(math.atan2(forward[0], -forward[1])) == pytest.approx(70, abs=0.1)  # to the left


def test_a_fist_brings_finger_ends_to_the_palm(rig: Rig) -> None:
    open_hand, closed = joints_m(rig, torch.zeros(len(rig.joint_names), 3)), joints_m(rig, fist(rig))
    for side in ("L", "R"):
        for finger in range(2, 6):
            before, after = (
                np.linalg.norm(at[f"finger{finger}-3.{side}"] - at[f"wrist.{side}"]) for at in (open_hand, closed)
            )
            assert after < 0.75 * before
    assert fist(column_rig()) is None


def test_moved_by_selects_vertices_by_their_strongest_joint(rig: Rig) -> None:
    hands = rig.vertices_m[moved_by(rig, ("wrist.L", "metacarpal", "finger")).nonzero()[0]]
    assert hands[:, 0].abs().min() > 0.3 and len(hands) > 200
