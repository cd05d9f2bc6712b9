import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hnerf.asset.bvh_file import require_dense, tips_m, write_body_motion, write_captured_bvh, write_captured_trc
from hnerf.asset.rigs import StagedRig
from hnerf.asset.skinning import Skin
from hnerf.asset.staging import StagedAvatar
from hnerf.body.bvh import read_bvh
from hnerf.body.skeletons import JointNames
from hnerf.capture.capture import Capture
from hnerf.errors import InputError
from tests.asset.figure import FRAMES, bending_body


def with_axes(game: StagedRig, axes: np.ndarray) -> StagedRig:
    """Return the rig with the axes of all joints rotated."""
    turn = np.eye(4)
    turn[:3, :3] = axes
    skeleton = dataclasses.replace(game.skeleton, rotations=game.skeleton.rotations @ axes)
    motions = {}
    for name, motion in game.motions.items():
        local = skeleton.local(game.stage(name) @ turn)
        quaternions = Rotation.from_matrix(local[..., :3, :3].reshape(-1, 3, 3)).as_quat()
        quaternions = quaternions.reshape(motion.quaternions.shape)
        motions[name] = dataclasses.replace(motion, translations_m=local[..., :3, 3], quaternions=quaternions)
    return dataclasses.replace(game, skeleton=skeleton, motions=motions)


def recorded(fps: float) -> Capture:
    """Return a capture without cameras, whose world has Z up."""
    return Capture("ada", Path(), {}, (), (), FRAMES, (), fps, "z", {}, {})


def end_site(path: Path) -> list[float]:
    """Return the offset of the only end site."""
    (end,) = re.findall(r"End Site\n\s*{\n\s*OFFSET (.*)", path.read_text())
    return [float(x) for x in end.split()]


@pytest.mark.parametrize(("joint_names", "pelvis"), [("mixamo", "mixamorig:Hips"), ("ue5", "pelvis"), ("vrm", "hips")])
def test_bvh_has_the_joint_names_of_the_asset(
    joint_names: JointNames, pelvis: str, staged: StagedAvatar, tmp_path: Path
) -> None:
    write_captured_bvh(tmp_path / "avatar.bvh", staged.rigs["game"], staged.rest_points_m, joint_names)
    assert read_bvh(tmp_path / "avatar.bvh").names == (pelvis, "upper_L")


@pytest.mark.parametrize("axes", [np.eye(3), Rotation.from_euler("zx", [40, 90], degrees=True).as_matrix()])
def test_bvh_holds_the_captured_motion_in_centimetres(axes: np.ndarray, staged: StagedAvatar, tmp_path: Path) -> None:
    """The frames 3 to 8, at 10 a second, are rows 0 to 5; the poses of 6 and 7 are interpolated. In frame f the pelvis
    is at (0.1 f, 2, 0.5) of a world with Z up, and the upper joint, 80 cm above it, has turned by 0.1 f about x."""
    write_captured_bvh(tmp_path / "avatar.bvh", with_axes(staged.rigs["game"], axes), staged.rest_points_m, "own")
    file = read_bvh(tmp_path / "avatar.bvh")
    assert (file.names, file.parents.tolist(), len(file.positions)) == (("Hips", "upper_L"), [-1, 0], 6)
    assert file.frame_s == 0.1
    np.testing.assert_allclose(file.offsets, [[0, 0, 0], [0, 80, 0]], atol=1e-4)
    turns, at = file.world()
    for row, frame in enumerate(range(3, 9)):
        np.testing.assert_allclose(at[row], [[10 * frame, 50, -200], [10 * frame, 130, -200]], atol=1e-4)
        c, s = np.cos(0.1 * frame), np.sin(0.1 * frame)
        np.testing.assert_allclose(file.rotations[row, 1], [[1, 0, 0], [0, c, -s], [0, s, c]], atol=1e-6)
        heading = [np.sin(0.8 * frame), 0, np.cos(0.8 * frame)]  # where the axis that faces +Z at rest points
        np.testing.assert_allclose(turns[row, 0] @ [0, 0, 1], heading, atol=1e-6)


def test_trc_holds_the_joints_paths_in_metres(staged: StagedAvatar, tmp_path: Path) -> None:
    """Frame 6, the fourth from frame 3 on, is 0.6 s after frame 0 at 10 a second; its pose is interpolated."""
    write_captured_trc(tmp_path / "avatar.trc", staged.rigs["game"], "own")
    lines = (tmp_path / "avatar.trc").read_text().split("\n")
    assert lines[2:6] == ["10\t10\t6\t2\tm\t10\t3\t6", "Frame#\tTime\tHips\t\t\tupper_L\t\t",
                          "\t\tX1\tY1\tZ1\tX2\tY2\tZ2", ""]  # fmt: skip
    assert len(lines[6:]) == 7 and lines[9].split("\t")[0] == "6"
    found = [float(value) for value in lines[9].split("\t")[1:]]
    np.testing.assert_allclose(found, [0.6, 0.6, 0.5, -2.0, 0.6, 1.3, -2.0], atol=1e-5)


def test_a_fitted_body_moves_as_its_avatar_does(staged: StagedAvatar, tmp_path: Path) -> None:
    """Only the name of the file and the end of the last bone, which the clothes make longer, differ."""
    write_body_motion(tmp_path, recorded(fps=10.0), bending_body(), "own")
    write_captured_bvh(tmp_path / "avatar.bvh", staged.rigs["game"], staged.rest_points_m, "own")
    write_captured_trc(tmp_path / "avatar.trc", staged.rigs["game"], "own")
    for name, differ in (("bvh", ["OFFSET"]), ("trc", ["PathFileType"])):
        found, expected = ((tmp_path / f"{stem}.{name}").read_text().split("\n") for stem in ("motion", "avatar"))
        pairs = zip(found, expected, strict=True)
        assert [a.split()[0] for a, b in pairs if a != b] == differ
    np.testing.assert_allclose(end_site(tmp_path / "motion.bvh"), [0, 80, 0], atol=1e-4)


def test_the_height_of_a_world_with_y_up_is_kept(tmp_path: Path) -> None:
    """In frame 3 the pelvis is at (0.3, 2, 0.5)."""
    write_body_motion(tmp_path, dataclasses.replace(recorded(fps=10.0), up="y"), bending_body(), "own")
    np.testing.assert_allclose(read_bvh(tmp_path / "motion.bvh").positions[0, 0], [30, 200, 50], atol=1e-4)


def test_frames_that_are_far_apart_are_refused() -> None:
    """Four frames, 3 to 8, lie 5 / 3 s apart on average at 1 a second, and 0.67 s at 2.5."""
    require_dense(recorded(fps=2.5))
    with pytest.raises(InputError, match=r"ada: frames are more than 0\.7 s apart.*capture\.max_frames"):
        require_dense(recorded(fps=1.0))


def test_the_tip_of_a_joint_is_the_end_of_its_points() -> None:
    """A toe's points lie 3 and 7 cm in front of its joint, to its left and right; another point, farther off, follows
    it only in part. An eyeball's six points surround its joint at 1 cm. No point follows the third joint most."""
    joints_m = np.array([[0.1, 0.02, 0.0], [0.0, 1.6, 0.1], [0.0, 1.0, 0.0]])
    toe = [[0.08, 0.02, 0.03], [0.12, 0.02, 0.07], [0.1, 0.02, -0.2]]
    eye = joints_m[1] + 0.01 * np.concatenate([np.eye(3), -np.eye(3)])
    joints = np.array([[0, 2], [0, 2], [1, 0], *([[1, 0]] * 6)])
    weights = np.array([[0.6, 0.4], [0.6, 0.4], [0.7, 0.3], *([[1.0, 0.0]] * 6)])
    found = tips_m(joints_m, Skin(joints, weights), np.concatenate([toe, eye]))
    np.testing.assert_allclose(found[[0, 2]], [[0, 0, 0.07], [0, 0, 0]], atol=1e-12)
    eyeball = tips_m(joints_m, Skin(joints[3:], weights[3:]), eye)
    np.testing.assert_allclose(eyeball[1], [0, 0, 0.01], atol=1e-12)


def test_end_sites_are_the_tips_of_the_end_joints(staged: StagedAvatar, tmp_path: Path) -> None:
    """The column's upper joint, at a height of 0.8 m, ends in the middle of its top, with clothes 1.65 m high."""
    write_captured_bvh(tmp_path / "avatar.bvh", staged.rigs["game"], staged.rest_points_m, "own")
    np.testing.assert_allclose(end_site(tmp_path / "avatar.bvh"), [0, 85, 0], atol=0.5)
