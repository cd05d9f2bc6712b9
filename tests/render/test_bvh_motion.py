from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from hnerf.body.anny import anny_model
from hnerf.body.bvh import Bvh, write_bvh
from hnerf.body.fit_result import BodyFit
from hnerf.body.rig import Rig, joint_transforms
from hnerf.body.skeletons import EQUIVALENTS, SKELETONS, JointNames, exported_name, is_serial, name_in
from hnerf.errors import InputError
from hnerf.render.bvh_motion import joints_by_name, retargeted
from hnerf.render.motion import read_motion

# A T pose in centimetres, Y up, facing +Z, with legs of 80 cm: parent and offset; x of pairs is to their side.
_TRUNK = {
    "pelvis": ("", (0, 90, 0)),
    "spine_01": ("pelvis", (0, 10, 0)),
    "spine_03": ("spine_01", (0, 20, 0)),
    "neck_01": ("spine_03", (0, 20, 0)),
    "head": ("neck_01", (0, 10, 0)),
}
_PAIRS = {
    "clavicle": ("spine_03", (5, 15, 0)),
    "upperarm": ("clavicle", (10, 0, 0)),
    "forearm": ("upperarm", (30, 0, 0)),
    "hand": ("forearm", (25, 0, 0)),
    "thigh": ("pelvis", (10, -5, 0)),
    "calf": ("thigh", (0, -40, 0)),
    "foot": ("calf", (0, -40, 0)),
}
T_POSE = _TRUNK | {
    f"{name}_{side}": (f"{parent}_{side}" if parent in _PAIRS else parent, (sign * x, y, z))
    for side, sign in (("L", 1), ("R", -1))
    for name, (parent, (x, y, z)) in _PAIRS.items()
}


def t_pose(frames: int, skeleton: str = "mixamo", prefix: str = "mixamorig:") -> Bvh:
    """Return a file whose body stands in its rest pose, with the joint names of a skeleton."""
    ours = list(T_POSE)
    names = tuple(prefix + getattr(EQUIVALENTS[name], skeleton) for name in ours)
    parents = np.array([ours.index(parent) if parent else -1 for parent, _ in T_POSE.values()])
    offsets = np.array([offset for _, offset in T_POSE.values()], float)
    turns = np.tile(np.eye(3), (frames, len(ours), 1, 1))
    return Bvh(names, parents, offsets, 1 / 30, np.tile(offsets, (frames, 1, 1)), turns)


def directions(rig: Rig, body: BodyFit, start: str, end: str) -> np.ndarray:
    """Return the unit directions (n, 3) from one joint to another in the world."""
    names = [exported_name(name) for name in rig.joint_names]
    at = joint_transforms(rig, body.theta, body.root)[:, :, :3, 3].numpy()
    off = at[:, names.index(end)] - at[:, names.index(start)]
    return off / np.linalg.norm(off, axis=1, keepdims=True)


def test_limbs_point_as_in_the_file(rig: Rig) -> None:
    """In frame 1 the left elbow turns a quarter about Y, so that the forearm points to the back, and the left hip a
    quarter about -X, so that the leg points to the front. In frame 2 the whole body turns a quarter about Y."""
    file = t_pose(3)
    names = list(T_POSE)
    file.rotations[1, names.index("forearm_L")] = Rotation.from_euler("Y", 90, degrees=True).as_matrix()
    file.rotations[1, names.index("thigh_L")] = Rotation.from_euler("X", -90, degrees=True).as_matrix()
    file.rotations[2, 0] = Rotation.from_euler("Y", 90, degrees=True).as_matrix()
    body = retargeted(Path("a.bvh"), file, rig)
    arm, fore = directions(rig, body, "upperarm_L", "forearm_L"), directions(rig, body, "forearm_L", "hand_L")
    leg = directions(rig, body, "thigh_L", "calf_L")
    np.testing.assert_allclose(arm, [[1, 0, 0], [1, 0, 0], [0, 0, -1]], atol=1e-5)
    np.testing.assert_allclose(fore, [[1, 0, 0], [0, 0, -1], [0, 0, -1]], atol=1e-5)
    np.testing.assert_allclose(leg, [[0, -1, 0], [0, 0, 1], [0, -1, 0]], atol=1e-5)
    shin = directions(rig, body, "calf_R", "foot_R")
    np.testing.assert_allclose(shin, [[0, -1, 0]] * 3, atol=1e-5)
    assert body.theta[:, ~rig.free].count_nonzero() == 0
    assert body.theta[:, rig.joint_names.index("wrist.L")].abs().max() < 1e-5  # hands continue the forearms


def test_lengths_are_scaled_by_the_legs(rig: Rig) -> None:
    """The body in the file moves by 80 cm, the length of its legs, to the left along x."""
    file = t_pose(2)
    file.positions[1, 0, 0] += 80
    names = [exported_name(name) for name in rig.joint_names]
    at = {limb: rig.joints_m[names.index(f"{limb}_L")].numpy() for limb in ("thigh", "calf", "foot")}
    leg_m = np.linalg.norm(at["thigh"] - at["calf"]) + np.linalg.norm(at["calf"] - at["foot"])
    body = retargeted(Path("a.bvh"), file, rig)
    np.testing.assert_allclose(body.root[1, :3, 3] - body.root[0, :3, 3], [leg_m, 0, 0], atol=2e-3)


@pytest.mark.parametrize(
    "turned", [Rotation.from_euler("Y", 130, degrees=True), Rotation.from_euler("X", 90, degrees=True)]
)
def test_a_rest_pose_may_face_any_direction_or_have_z_up(turned: Rotation, rig: Rig) -> None:
    file, axes = t_pose(1), turned.as_matrix()
    file = Bvh(file.names, file.parents, file.offsets @ axes.T, file.frame_s, file.positions @ axes.T, file.rotations)
    body = retargeted(Path("a.bvh"), file, rig)
    np.testing.assert_allclose(directions(rig, body, "upperarm_L", "forearm_L"), [[1, 0, 0]], atol=1e-5)
    np.testing.assert_allclose(directions(rig, body, "thigh_L", "calf_L"), [[0, -1, 0]], atol=1e-5)


@pytest.mark.parametrize(("skeleton", "prefix"), [("mixamo", "mixamorig:"), *((name, "") for name in SKELETONS)])
def test_joints_are_found_by_name(skeleton: str, prefix: str) -> None:
    file = t_pose(1, skeleton, prefix)
    assert joints_by_name(Path("a.bvh"), file.names) == {name: j for j, name in enumerate(T_POSE)}


@pytest.mark.parametrize("joint_names", get_args(JointNames))
def test_joints_of_exported_motions_are_found_whatever_they_are_named_after(joint_names: JointNames) -> None:
    """Joints that the other skeleton lacks have exported names in these files, which are ignored."""
    exported = [exported_name(name) for name in anny_model().bone_labels if not is_serial(exported_name(name))]
    names = tuple(name_in(joint_names, joint, prefixed=True) for joint in exported)
    found = joints_by_name(Path("a.bvh"), names)
    assert all(exported[j] == joint for joint, j in found.items())
    assert {"pelvis", "spine_01", "spine_03", "spine_05", "head", "clavicle_L", "hand_R", "foot_L"} <= set(found)


def test_a_file_of_the_cmu_database_is_not_taken_for_another_skeleton() -> None:
    """Its fingers and both neck joints are named like HumanIK's, but its trunk is LowerBack, Spine and Spine1."""
    sided = ("UpLeg", "Leg", "Foot", "ToeBase", "Shoulder", "Arm", "ForeArm", "Hand", "FingerBase", "HandIndex1")
    trunk = ("Hips", "LHipJoint", "RHipJoint", "LowerBack", "Spine", "Spine1", "Neck", "Neck1", "Head", "LThumb")
    names = (*trunk, *(side + name for side in ("Left", "Right") for name in sided))
    found = {ours: names[j] for ours, j in joints_by_name(Path("a.bvh"), names).items()}
    assert [found[f"spine_0{k}"] for k in (1, 3, 5)] == ["LowerBack", "Spine", "Spine1"]
    assert (found["neck_01"], found["head"], found["middle_toe_01_L"]) == ("Neck1", "Head", "LeftToeBase")


def test_a_file_without_arms_is_refused() -> None:
    with pytest.raises(
        InputError, match=r"a\.bvh: no joint for upperarm_L, forearm_L, hand_L; name them as one of ue5"
    ):
        joints_by_name(Path("a.bvh"), tuple(n for n in t_pose(1).names if "Arm" not in n and "Hand" not in n))


def test_a_rest_pose_that_lies_down_is_refused(rig: Rig) -> None:
    file = t_pose(1)
    lying = Bvh(file.names, file.parents, file.offsets[:, [1, 0, 2]], file.frame_s, file.positions, file.rotations)
    with pytest.raises(InputError, match="does not stand upright"):
        retargeted(Path("a.bvh"), lying, rig)


def test_an_arm_without_length_is_refused(rig: Rig) -> None:
    """It has no direction, so it could not be aligned."""
    file = t_pose(1)
    file.offsets[list(T_POSE).index("hand_R")] = 0
    with pytest.raises(InputError, match=r"a\.bvh: forearm_R and hand_R coincide at rest; export it in a T pose"):
        retargeted(Path("a.bvh"), file, rig)


def test_a_missing_motion_file_is_refused(tmp_path: Path) -> None:
    for name in ("walk.bvh", "walk.npz", "ada"):
        with pytest.raises(InputError, match=rf"{name}: no such file; give a \.bvh"):
            read_motion(tmp_path / name)


def test_the_suffix_decides_how_a_motion_is_read(tmp_path: Path) -> None:
    write_bvh(tmp_path / "walk.BVH", t_pose(5), np.zeros((len(T_POSE), 3)))
    motion = read_motion(tmp_path / "walk.BVH", "1:4")
    assert (motion.body.frames, motion.fps, motion.up) == ((1, 2, 3), 30.0, "y")
    assert isinstance(motion.body.theta, torch.Tensor) and len(motion.body.theta) == 3
