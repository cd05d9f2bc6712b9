import numpy as np

from hnerf.asset.skeleton import along_bones, full_skeleton, game_skeleton
from hnerf.body.rig import Rig


def stage_joints(rig: Rig) -> np.ndarray:
    at = rig.joints_m.double().numpy() @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]).T
    return at - [0, rig.vertices_m[:, 2].min().item(), at[0, 2]]


def test_joint_axes_along_bones_by_hand() -> None:
    """The skeleton has an arm to the left with a finger at its end, a foot to the front, and a head with a jaw in front
    of it."""
    names = ("root", "upperarm_L", "hand_L", "foot_L", "toe_L", "head", "jaw")
    parents = np.array([-1, 0, 1, 0, 3, 0, 5])
    at = np.array([[0.0, 0, 0], [1, 1, 0], [2, 1, 0], [0.1, 0, 0], [0.1, 0, 0.2], [0, 1.5, 0], [0, 1.5, 0.1]])
    found = along_bones(names, parents, at)
    np.testing.assert_allclose(found[1], np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]), atol=1e-12)  # y left, z to front
    np.testing.assert_allclose(found[2], found[1])  # the last joint of a chain continues the direction
    np.testing.assert_allclose(found[3], np.array([[-1, 0, 0], [0, 0, 1], [0, 1, 0]]), atol=1e-12)  # y to front, z up
    np.testing.assert_allclose(found[5], np.eye(3), atol=1e-12)  # the head points up


def test_joint_y_axes_point_along_their_bones(rig: Rig) -> None:
    skeleton = full_skeleton(rig.joint_names, rig.parents.numpy(), stage_joints(rig), "along")
    y = dict(zip(skeleton.names, skeleton.rotations[:, :, 1], strict=True))
    at = dict(zip(skeleton.names, skeleton.positions_m, strict=True))
    for above, below in (("thigh_twist_L", "calf_L"), ("calf_twist_R", "foot_R"), ("forearm_twist_L", "hand_L"),
                         ("index_01_R", "index_02_R"), ("spine_04", "spine_05")):  # fmt: skip
        bone = at[below] - at[above]
        np.testing.assert_allclose(y[above], bone / np.linalg.norm(bone), atol=1e-6)
    np.testing.assert_allclose(y["pelvis"], y["spine_01"])  # the two joints coincide
    assert y["head"] @ [0, 1, 0] > 0.99 and y["eye_L"] @ [0, 0, 1] > 0.99
    determinants = np.linalg.det(skeleton.rotations)
    np.testing.assert_allclose(determinants, 1)
    np.testing.assert_array_equal(skeleton.rotations[0], np.eye(3))


def test_joints_of_both_skeletons_have_the_same_axes(rig: Rig) -> None:
    """The clavicle points to the arm, past the shoulder between them, which the game skeleton lacks."""
    full = full_skeleton(rig.joint_names, rig.parents.numpy(), stage_joints(rig), "along")
    game, _ = game_skeleton(full, "along")
    clavicle, arm = (full.names.index(name) for name in ("clavicle_L", "upperarm_L"))
    bone = full.positions_m[arm] - full.positions_m[clavicle]
    np.testing.assert_allclose(full.rotations[clavicle, :, 1], bone / np.linalg.norm(bone), atol=1e-6)
    for name, axes in zip(game.names, game.rotations, strict=True):
        np.testing.assert_allclose(full.rotations[full.names.index(name)], axes, atol=1e-12)


def test_identity_axes_have_no_rotation(rig: Rig) -> None:
    skeleton = full_skeleton(rig.joint_names, rig.parents.numpy(), stage_joints(rig), "identity")
    np.testing.assert_array_equal(skeleton.rotations, np.tile(np.eye(3), (105, 1, 1)))


def test_the_game_skeleton_merges_serial_joints(rig: Rig) -> None:
    full = full_skeleton(rig.joint_names, rig.parents.numpy(), stage_joints(rig), "along")
    game, taken_by = game_skeleton(full, "along")
    assert len(game.names) == 55
    goes = {name: game.names[taken_by[j]] for j, name in enumerate(full.names)}
    assert goes["upperarm_twist_L"] == "upperarm_L" and goes["hip_R"] == "pelvis" and goes["spine_04"] == "spine_03"
    assert goes["ring_metacarpal_L"] == "hand_L" and goes["shoulder_L"] == "clavicle_L" and goes["neck_03"] == "neck_01"
    assert goes["little_toe_02_R"] == "middle_toe_01_R" and goes["hand_R"] == "hand_R"
    parent = {name: game.names[p] for name, p in zip(game.names[1:], game.parents[1:], strict=True)}
    assert parent["thigh_L"] == "pelvis" and parent["calf_L"] == "thigh_L" and parent["forearm_R"] == "upperarm_R"
    assert (game.parents[1:] < np.arange(1, 55)).all()
    bone = game.positions_m[game.names.index("calf_L")] - game.positions_m[game.names.index("thigh_L")]
    np.testing.assert_allclose(
        game.rotations[game.names.index("thigh_L"), :, 1], bone / np.linalg.norm(bone), atol=1e-6
    )


def test_local_transforms_compose_to_the_bind_transforms(rig: Rig) -> None:
    skeleton = full_skeleton(rig.joint_names, rig.parents.numpy(), stage_joints(rig), "along")
    local, composed = skeleton.local(skeleton.bind), skeleton.bind.copy()
    for j, parent in enumerate(skeleton.parents[1:], 1):
        composed[j] = composed[parent] @ local[j]
    np.testing.assert_allclose(composed, skeleton.bind, atol=1e-12)
