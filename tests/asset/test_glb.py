from pathlib import Path

import numpy as np
import pygltflib
import trimesh

from hnerf.asset.glb import write_glb
from hnerf.asset.staging import StagedAvatar
from tests.asset.figure import FRAMES


def accessor(document: pygltflib.GLTF2, index: int) -> np.ndarray:
    """Return the float32 numbers of an accessor."""
    item = document.accessors[index]
    view = document.bufferViews[item.bufferView]
    data = document.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength]
    return np.frombuffer(data, np.float32).reshape(item.count, -1)


def test_another_reader_finds_mesh_texture_and_joints(staged: StagedAvatar, tmp_path: Path) -> None:
    write_glb(tmp_path / "avatar.glb", staged, 10.0)
    scene = trimesh.load_scene(tmp_path / "avatar.glb")
    (mesh,) = scene.geometry.values()
    np.testing.assert_allclose(np.asarray(mesh.triangles), staged.rest_points_m[staged.faces], atol=1e-6)
    np.testing.assert_array_equal(np.asarray(mesh.visual.material.baseColorTexture), staged.texture)
    corners = mesh.visual.uv[mesh.faces]  # trimesh turns v up again
    np.testing.assert_allclose(corners, staged.uvs[staged.face_uvs], atol=1e-6)
    document = pygltflib.GLTF2.load(str(tmp_path / "avatar.glb"))
    inverse_bind = accessor(document, document.skins[0].inverseBindMatrices).reshape(-1, 4, 4).swapaxes(1, 2)
    for name, matrix in zip(staged.joint_names, inverse_bind, strict=True):
        assert np.abs(matrix @ scene.graph.get(name)[0] - np.eye(4)).max() < 1e-6


def test_motion_is_in_seconds_from_the_first_frame(staged: StagedAvatar, tmp_path: Path) -> None:
    write_glb(tmp_path / "avatar.glb", staged, 10.0)
    document = pygltflib.GLTF2.load(str(tmp_path / "avatar.glb"))
    animation = document.animations[0]
    assert [(c.target.node, c.target.path) for c in animation.channels] == [
        (0, "translation"),
        (0, "rotation"),
        (1, "rotation"),
        (2, "weights"),
    ]
    np.testing.assert_allclose(accessor(document, animation.samplers[0].input)[:, 0], [0, 0.1, 0.2, 0.5])
    translation = accessor(document, animation.samplers[0].output)
    # World (0.1 frame, 2, 0.5) is stage (0.1 frame, 0.5, -2).
    np.testing.assert_allclose(translation, [[0.1 * f, 0.5, -2] for f in FRAMES], atol=1e-6)


def test_correctives_are_morph_targets_with_a_weight_a_frame(staged: StagedAvatar, tmp_path: Path) -> None:
    write_glb(tmp_path / "avatar.glb", staged, 10.0)
    document = pygltflib.GLTF2.load(str(tmp_path / "avatar.glb"))
    (primitive,) = document.meshes[0].primitives
    vertex = np.zeros(len(staged.uvs), int)
    vertex[staged.face_uvs] = staged.faces
    for target, shape_m in zip(primitive.targets, staged.shapes_m, strict=True):
        np.testing.assert_allclose(accessor(document, target["POSITION"]), shape_m[vertex], atol=1e-7)
    weights = accessor(document, document.animations[0].samplers[-1].output)
    np.testing.assert_allclose(weights.reshape(len(FRAMES), 2), staged.shape_weights)
