import re
from collections import Counter
from pathlib import Path
from typing import get_args

import pytest

from hnerf.body.anny import anny_model
from hnerf.body.skeletons import (
    EQUIVALENTS,
    OWN,
    SKELETONS,
    JointNames,
    exported_from,
    exported_name,
    is_serial,
    name_in,
)
from hnerf.body.smpl import FURTHER_JOINTS, JOINTS
from hnerf.config import AssetSettings


def test_exported_joint_names_are_readable() -> None:
    assert exported_name("root") == "pelvis"
    assert exported_name("upperarm01.L") == "upperarm_L"
    assert exported_name("lowerleg02.R") == "calf_twist_R"
    assert exported_name("finger1-2.R") == "thumb_02_R"
    assert exported_name("metacarpal1.L") == "index_metacarpal_L"
    assert exported_name("toe5-3.L") == "little_toe_03_L"
    assert exported_name("jaw") == "jaw"
    assert exported_name("toes.L") == exported_name("toe3-1.L") and exported_name("toes.L") in EQUIVALENTS


def test_exported_joint_names_are_unique() -> None:
    names = [exported_name(name) for name in anny_model().bone_labels]
    assert max(Counter(names).values()) == 1 and "root" not in names
    assert set(EQUIVALENTS) - {"root"} <= set(names)
    kept = [name for name in names if not is_serial(name)]
    assert len(kept) == 54  # plus the root
    assert {"pelvis", "spine_03", "hand_L", "pinky_03_R", "middle_toe_01_L", "eye_R"} <= set(kept)


def test_equivalent_names_in_other_skeletons() -> None:
    forearm = EQUIVALENTS["forearm_R"]
    assert (forearm.ue5, forearm.mixamo, forearm.humanik) == ("lowerarm_r", "RightForeArm", "RightForeArm")
    assert (forearm.vrm, forearm.smplx, forearm.cmu) == ("rightLowerArm", "right_elbow", "RightForeArm")
    assert [EQUIVALENTS[joint].biovision for joint in ("clavicle_R", "upperarm_R")] == ["RightCollar", "RightShoulder"]
    assert [EQUIVALENTS[joint].smpl for joint in ("foot_L", "middle_toe_01_L")] == ["L_Ankle", "L_Foot"]
    assert EQUIVALENTS["thumb_01_L"].vrm == "leftThumbMetacarpal"
    for skeleton in SKELETONS:
        theirs = [getattr(names, skeleton) for names in EQUIVALENTS.values() if getattr(names, skeleton)]
        assert len(theirs) == len(set(theirs)), skeleton
        assert exported_from(skeleton)[theirs[0]] in EQUIVALENTS


def test_a_joint_without_an_equivalent_keeps_its_name() -> None:
    assert [name_in("mixamo", joint, prefixed=True) for joint in ("pelvis", "spine_02")] == [
        "mixamorig:Hips",
        "spine_02",
    ]
    assert [name_in("mixamo", joint) for joint in ("pelvis", "jaw")] == ["Hips", "jaw"]
    assert [name_in(OWN, "hand_L", prefixed=True), name_in("vrm", "hand_L", prefixed=True)] == ["hand_L", "leftHand"]


@pytest.mark.parametrize("joints", [anny_model().bone_labels, *((*JOINTS, *more) for more in FURTHER_JOINTS.values())])
def test_names_in_other_skeletons_are_unique_in_any_letter_case(joints: tuple[str, ...]) -> None:
    """Unreal Engine ignores case."""
    own = ["root", *map(exported_name, joints)]
    for skeleton in get_args(JointNames):
        assert len({name_in(skeleton, joint, prefixed=True).lower() for joint in own}) == len(own), skeleton


def test_exports_can_name_joints_after_each_skeleton_of_characters() -> None:
    """Three are those of recordings."""
    assert (*get_args(JointNames), "cmu", "biovision", "smpl") == (OWN, *SKELETONS)
    assert get_args(AssetSettings.model_fields["joint_names"].annotation) == get_args(JointNames)


def test_the_documented_table_of_joint_names_is_up_to_date() -> None:
    """The table lists the joints of the middle and of the left side."""
    heads = "exported|Unreal Engine 5|Mixamo|HumanIK|VRM|SMPL-X|CMU (BVH)|Biovision, Xsens (BVH)|SMPL (BVH)"
    titles = heads.split("|")
    shown = ((joint, names) for joint, names in EQUIVALENTS.items() if not joint.endswith("_R"))
    rows = [titles, *((joint, *(getattr(names, s) for s in SKELETONS)) for joint, names in shown)]
    lines = [re.sub(r"\|  (?=\|)", "| ", f"| {' | '.join(row)} |") for row in rows]
    table = "\n".join([lines[0], "|" + "---|" * len(titles), *lines[1:]])
    assert table in (Path(__file__).parents[2] / "docs" / "asset.md").read_text()
