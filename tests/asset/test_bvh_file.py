import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hnerf.asset.bvh_file import write_avatar_bvh
from hnerf.asset.staging import StagedAvatar
from hnerf.body.bvh import read_bvh
from hnerf.body.skeletons import JointNames
from tests.asset.figure import FRAMES


def with_axes(staged: StagedAvatar, axes: np.ndarray) -> StagedAvatar:
    """Return the avatar with the axes of all joints of its game rig rotated."""
    game, turn = staged.rigs["game"], np.eye(4)
    turn[:3, :3] = axes
    skeleton = dataclasses.replace(game.skeleton, rotations=game.skeleton.rotations @ axes)
    motions = {}
    for name, motion in game.motions.items():
        local = skeleton.local(game.stage(name) @ turn)
        quaternions = Rotation.from_matrix(local[..., :3, :3].reshape(-1, 3, 3)).as_quat()
        quaternions = quaternions.reshape(motion.quaternions.shape)
        motions[name] = dataclasses.replace(motion, translations_m=local[..., :3, 3], quaternions=quaternions)
    return dataclasses.replace(
        staged, rigs=staged.rigs | {"game": dataclasses.replace(game, skeleton=skeleton, motions=motions)}
    )


@pytest.mark.parametrize(("joint_names", "pelvis"), [("mixamo", "mixamorig:Hips"), ("ue5", "pelvis"), ("vrm", "hips")])
def test_bvh_has_the_joint_names_of_the_asset(
    joint_names: JointNames, pelvis: str, staged: StagedAvatar, tmp_path: Path
) -> None:
    write_avatar_bvh(tmp_path / "avatar.bvh", dataclasses.replace(staged, joint_names=joint_names))
    assert read_bvh(tmp_path / "avatar.bvh").names == (pelvis, "upper_L")


@pytest.mark.parametrize("axes", [np.eye(3), Rotation.from_euler("zx", [40, 90], degrees=True).as_matrix()])
def test_bvh_holds_the_captured_motion_in_centimetres(axes: np.ndarray, staged: StagedAvatar, tmp_path: Path) -> None:
    """At 30 frames a second, the captured frames 3 to 8, at 10 a second, are rows 0 to 15. In frame f the pelvis is at
    (0.1 f, 2, 0.5) of a world with Z up, and the upper joint, 80 cm above it, has turned by 0.1 f about x."""
    write_avatar_bvh(tmp_path / "avatar.bvh", with_axes(staged, axes))
    file = read_bvh(tmp_path / "avatar.bvh")
    assert (file.names, file.parents.tolist(), len(file.positions)) == (("Hips", "upper_L"), [-1, 0], 16)
    assert abs(file.frame_s - 1 / 30) < 1e-9
    np.testing.assert_allclose(file.offsets, [[0, 0, 0], [0, 80, 0]], atol=1e-4)
    turns, at = file.world()
    for frame in FRAMES:
        row = 3 * (frame - 3)
        np.testing.assert_allclose(at[row], [[10 * frame, 50, -200], [10 * frame, 130, -200]], atol=1e-4)
        c, s = np.cos(0.1 * frame), np.sin(0.1 * frame)
        np.testing.assert_allclose(file.rotations[row, 1], [[1, 0, 0], [0, c, -s], [0, s, c]], atol=1e-6)
        heading = [np.sin(0.8 * frame), 0, np.cos(0.8 * frame)]  # where the axis that faces +Z at rest points
        np.testing.assert_allclose(turns[row, 0] @ [0, 0, 1], heading, atol=1e-6)
