import dataclasses
import math
import re

import pytest
import torch

from hnerf.body.anny import ADULT, BETA_NAMES, anny_rig
from hnerf.body.rig import Rig
from hnerf.errors import InputError
from hnerf.render.motion import HIPS, lowest_points_m, middle_of_hips_m
from hnerf.render.shape import offsets_from_bones_m, transfer_poses, volume_m3, with_shape_values, with_volume
from tests.asset.figure import bending_body, column_rig
from tests.body.two_bone import two_bone_rig


def changeable_rig() -> Rig:
    """Return the column with two shape values: "weight" widens it by its radius per unit, so its volume grows with
    (1 + weight) squared; "length" stretches it away from z = 0.8 by its length per unit."""
    rig = column_rig()
    weight = rig.vertices_m * torch.tensor([1.0, 1, 0])
    length = (rig.vertices_m - torch.tensor([0, 0, 0.8])) * torch.tensor([0.0, 0, 1])
    return dataclasses.replace(
        rig,
        beta=torch.tensor([0.3, 0.6]),
        beta_names=("weight", "length"),
        shape_basis=torch.stack([weight, length]),
        joint_basis=torch.zeros(2, 2, 3),
    )


def bone_rig(upper: str) -> Rig:
    """Return the column with bones along its whole axis."""
    joints_m = torch.tensor([[0.0, 0, 0], [0, 0, 0.8], [0, 0, 1.6]])
    changes = {"joints_m": joints_m, "joint_names": ("root", upper, "tip"), "parents": torch.tensor([-1, 0, 1])}
    return dataclasses.replace(changeable_rig(), **changes)


@pytest.mark.parametrize("change", [0.44, -0.51, 0.0])
def test_volume_changes_as_requested(change: float) -> None:
    """Expect the radius to grow with the square root of the column's volume, and its ends to stay."""
    rig = bone_rig("upper")
    found = with_volume(rig, change)
    radius = math.sqrt(1 + change)
    torch.testing.assert_close(found.vertices_m, rig.vertices_m * torch.tensor([radius, radius, 1]), atol=1e-4, rtol=0)
    assert volume_m3(found) == pytest.approx((1 + change) * volume_m3(rig), rel=1e-3)


def test_head_hands_and_feet_keep_their_thickness() -> None:
    """Expect skin of the neck's bone, above z = 0.9, to stay; below z = 0.7 all of it moves away from the axis."""
    rig = bone_rig("neck01")
    z = rig.vertices_m[:, 2]
    away_m = offsets_from_bones_m(rig)
    assert not away_m[z > 0.91].any()
    lower = z < 0.69
    torch.testing.assert_close(away_m[lower], rig.vertices_m[lower] * torch.tensor([1.0, 1, 0]))


@pytest.mark.parametrize("gender", [0.0, 0.5, 1.0])
def test_whole_bodies_lose_and_gain_volume_without_folds(gender: float) -> None:
    beta = torch.tensor(ADULT)
    beta[BETA_NAMES.index("gender")] = gender
    rig = anny_rig(beta)
    for change in (-0.4, 0.8):
        found = with_volume(rig, change)
        assert volume_m3(found) == pytest.approx((1 + change) * volume_m3(rig), rel=1e-3)
        tall = [float(r.vertices_m[:, 2].max() - r.vertices_m[:, 2].min()) for r in (rig, found)]
        assert tall[1] == pytest.approx(tall[0])


@pytest.mark.parametrize("change", [20.0, -1.2, math.nan])
def test_a_volume_out_of_reach_is_refused(change: float) -> None:
    with pytest.raises(InputError, match="cannot be reached with this body"):
        with_volume(bone_rig("upper"), change)


def test_shape_values_are_added_by_name() -> None:
    rig = changeable_rig()
    found = with_shape_values(rig, {"length": 0.5})
    torch.testing.assert_close(found.beta, torch.tensor([0.3, 1.1]))
    assert found.vertices_m[:, 2].aminmax() == (pytest.approx(-0.4), pytest.approx(2.0))


def test_a_shape_that_turns_its_skin_inside_out_is_refused() -> None:
    for change in (-2.0, math.nan):
        with pytest.raises(InputError, match=re.escape(f"weight {change:+.2f}: folds ")):
            with_shape_values(changeable_rig(), {"weight": change})


def test_an_unknown_shape_value_is_refused_with_a_list_of_known_ones() -> None:
    with pytest.raises(InputError, match="--shape fat: no such value; this body's are weight, length"):
        with_shape_values(changeable_rig(), {"fat": 1.0})


def test_another_shape_stands_on_the_same_floor() -> None:
    body = dataclasses.replace(bending_body(), rig=changeable_rig())
    longer = transfer_poses(with_shape_values(body.rig, {"length": 0.5}), body, "z")
    torch.testing.assert_close(lowest_points_m(longer, "z"), torch.full((4,), 0.5))
    torch.testing.assert_close(longer.root[:, :2], body.root[:, :2])


def test_hips_of_another_shape_stay_in_place_while_the_trunk_pitches() -> None:
    """The hip is 0.8 m above the origin of the body frame, or 1.2 m in the longer body. A quarter turn about x takes it
    from (0, 0, z) to (0, -z, 0): without a shift, the longer body's is 0.4 m further back."""
    body, rig = bending_body(), changeable_rig()
    rig = dataclasses.replace(rig, joint_names=("root", HIPS[0]))
    rig.joint_basis[1, 1, 2] = 0.8
    body.root[0, :3, :3] = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    body = dataclasses.replace(body, rig=rig)
    longer = transfer_poses(with_shape_values(rig, {"length": 0.5}), body, "z")
    torch.testing.assert_close(middle_of_hips_m(longer)[:, :2], middle_of_hips_m(body)[:, :2])
    assert longer.root[0, 1, 3] - body.root[0, 1, 3] == pytest.approx(0.4, abs=1e-5)


def test_the_offset_of_a_vertex_beyond_its_bone_is_from_the_bones_end() -> None:
    """The forearm reaches from 1 m to 2 m; its vertex at 2.3 m is 30 cm beyond its end and 10 cm to the side."""
    rig = two_bone_rig()
    rig.vertices_m[2] = torch.tensor([0.1, 0, 2.3])
    torch.testing.assert_close(offsets_from_bones_m(rig)[2], torch.tensor([0.1, 0, 0.3], dtype=torch.float64))
