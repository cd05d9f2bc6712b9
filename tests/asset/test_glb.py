import dataclasses
import json
import os
import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pygltflib
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from hnerf.asset.glb import SPECULAR, UNLIT, VARIANTS, write_glb
from hnerf.asset.staging import StagedAvatar, moved_points
from hnerf.asset.tangents import uv_tangents
from hnerf.asset.texture import UvLayout
from hnerf.asset.usd import SKELETON, surface_path
from hnerf.body.descriptor import normals_of
from hnerf.body.skeletons import JointNames
from tests.asset.figure import FRAMES, INFO

KHRONOS = """
const fs = require("fs"), validator = require("gltf-validator");
validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[1])))
  .then(report => console.log(JSON.stringify(report.issues)));
"""
TYPES = {5123: np.uint16, 5125: np.uint32, 5126: np.float32}


@pytest.fixture(scope="module", params=["full", "game"])
def rig(request: pytest.FixtureRequest) -> str:
    """Return the name of each rig in turn."""
    return str(request.param)


@pytest.fixture(scope="module")
def glb(rig: str, staged: StagedAvatar, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the glTF file of a rig."""
    path = tmp_path_factory.mktemp("glb") / "avatar.glb"
    write_glb(path, staged, staged.rigs[rig], INFO)
    return path


def test_the_file_says_what_the_asset_is(staged: StagedAvatar, tmp_path: Path) -> None:
    for licence in ("CC-BY-4.0", ""):
        write_glb(tmp_path / "avatar.glb", staged, staged.rigs["game"], dataclasses.replace(INFO, licence=licence))
        asset = pygltflib.GLTF2().load(tmp_path / "avatar.glb").asset
        assert (asset.generator, asset.copyright) == ("hnerf", licence or None)
        assert asset.extras == {"version": "7", "captureDigest": "0123abcd"}


def accessor(document: pygltflib.GLTF2, index: int) -> np.ndarray:
    """Return the values of an accessor."""
    item = document.accessors[index]
    if item.sparse:
        at = numbers(document, item.sparse.indices.bufferView, item.sparse.indices.componentType)
        values = np.zeros((item.count, 3), np.float32)
        values[at] = numbers(document, item.sparse.values.bufferView, item.componentType).reshape(-1, 3)
        return values
    return numbers(document, item.bufferView, item.componentType).reshape(item.count, -1)


def numbers(document: pygltflib.GLTF2, buffer_view: int, component_type: int) -> np.ndarray:
    """Return the contents of a buffer view as an array."""
    view = document.bufferViews[buffer_view]
    data = document.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength]
    return np.frombuffer(data, TYPES[component_type])


def played(document: pygltflib.GLTF2, key: int) -> np.ndarray:
    """Return the mesh's points (N, 3) at a key of the first animation, skinned as the glTF specification says."""
    nodes = document.nodes
    place = {n: (np.array(node.translation or [0, 0, 0]), np.array(node.rotation or [0, 0, 0, 1.0]))
             for n, node in enumerate(nodes)}  # fmt: skip
    weights = np.array(document.meshes[0].weights)
    animation = document.animations[0]
    for channel in animation.channels:
        output = accessor(document, animation.samplers[channel.sampler].output)
        node, path = channel.target.node, channel.target.path
        if path == "weights":
            weights = output.reshape(-1, len(weights))[key]
        else:
            kept = place[node]
            place[node] = (output[key], kept[1]) if path == "translation" else (kept[0], output[key])
    world: dict[int, np.ndarray] = {}

    def visit(node: int, above: np.ndarray) -> None:
        own = np.eye(4)
        own[:3, :3], own[:3, 3] = Rotation.from_quat(place[node][1]).as_matrix(), place[node][0]
        world[node] = above @ own
        for child in nodes[node].children or []:
            visit(child, world[node])

    for node in document.scenes[0].nodes:
        visit(node, np.eye(4))
    (primitive,) = document.meshes[0].primitives
    points = accessor(document, primitive.attributes.POSITION).astype(float)
    for weight, target in zip(weights, primitive.targets, strict=True):
        points = points + weight * accessor(document, target["POSITION"])
    inverse = accessor(document, document.skins[0].inverseBindMatrices).reshape(-1, 4, 4).swapaxes(1, 2)
    joints = np.stack([world[j] @ m for j, m in zip(document.skins[0].joints, inverse, strict=True)])
    moved = np.zeros_like(points)
    for group in (0, 1):
        if getattr(primitive.attributes, f"JOINTS_{group}", None) is None:
            continue
        index = accessor(document, getattr(primitive.attributes, f"JOINTS_{group}"))
        share = accessor(document, getattr(primitive.attributes, f"WEIGHTS_{group}"))
        blended = (share[..., None, None] * joints[index]).sum(1)
        moved += (blended[:, :3, :3] @ points[..., None])[..., 0] + blended[:, :3, 3]
    return moved


def test_gltf_skinning_matches_ours(glb: Path, staged: StagedAvatar) -> None:
    document = pygltflib.GLTF2.load(str(glb))
    vertex = np.zeros(len(staged.uvs), int)
    vertex[staged.face_uvs] = staged.faces
    for key, expected in enumerate(staged.points_m):
        np.testing.assert_allclose(played(document, key), expected[vertex], atol=1e-5)


def test_another_reader_finds_mesh_texture_and_joints(glb: Path, rig: str, staged: StagedAvatar) -> None:
    scene = trimesh.load_scene(glb)
    (mesh,) = scene.geometry.values()
    np.testing.assert_allclose(np.asarray(mesh.triangles), staged.rest_points_m[staged.faces], atol=1e-6)
    np.testing.assert_array_equal(np.asarray(mesh.visual.material.baseColorTexture), staged.texture)
    corners = mesh.visual.uv[mesh.faces]  # trimesh flips v back to pointing up
    np.testing.assert_allclose(corners, staged.uvs[staged.face_uvs], atol=1e-6)
    document = pygltflib.GLTF2.load(str(glb))
    inverse_bind = accessor(document, document.skins[0].inverseBindMatrices).reshape(-1, 4, 4).swapaxes(1, 2)
    for name, matrix in zip(staged.rigs[rig].skeleton.names, inverse_bind, strict=True):
        assert np.abs(matrix @ scene.graph.get(name)[0] - np.eye(4)).max() < 1e-6


def test_mesh_and_skin_have_the_names_of_their_prims_in_usd(glb: Path) -> None:
    document = pygltflib.GLTF2.load(str(glb))
    assert (document.meshes[0].name, document.skins[0].name) == (surface_path(0).name, SKELETON.name)


@pytest.mark.parametrize(
    ("joint_names", "names"), [("mixamo", ["root", "mixamorig:Hips"]), ("humanik", ["Reference", "Hips"])]
)
def test_nodes_have_the_joint_names_of_the_asset(
    joint_names: JointNames, names: list[str], staged: StagedAvatar, tmp_path: Path
) -> None:
    renamed = dataclasses.replace(staged, joint_names=joint_names)
    write_glb(tmp_path / "avatar.glb", renamed, renamed.rigs["full"], INFO)
    nodes = pygltflib.GLTF2.load(str(tmp_path / "avatar.glb")).nodes
    assert [node.name for node in nodes] == [*names, "upper_L", "Surface"]


def test_a_normal_map_comes_with_tangents(glb: Path, staged: StagedAvatar) -> None:
    document = pygltflib.GLTF2.load(str(glb))
    (primitive,) = document.meshes[0].primitives
    normals = normals_of(staged.rest_points_m, staged.faces)
    expected = uv_tangents(staged.rest_points_m, normals, staged.faces, UvLayout(staged.uvs, staged.face_uvs))
    np.testing.assert_allclose(accessor(document, primitive.attributes.TANGENT), expected, atol=1e-6)
    (mesh,) = trimesh.load_scene(glb).geometry.values()
    np.testing.assert_array_equal(np.asarray(mesh.visual.material.normalTexture), staged.normal_map)


def test_a_normal_map_and_an_albedo_can_be_left_out(staged: StagedAvatar, tmp_path: Path) -> None:
    bare = dataclasses.replace(staged, normal_map=None, albedo=None)
    write_glb(tmp_path / "smooth.glb", bare, staged.rigs["full"], INFO)
    document = pygltflib.GLTF2.load(str(tmp_path / "smooth.glb"))
    assert document.meshes[0].primitives[0].attributes.TANGENT is None
    assert document.extensionsUsed == [UNLIT] and len(document.materials) == 1
    assert document.materials[0].normalTexture is None and len(document.images) == 1


def test_the_albedo_is_another_variant_of_the_material(glb: Path, staged: StagedAvatar) -> None:
    document = pygltflib.GLTF2.load(str(glb))
    names = [variant["name"] for variant in document.extensions[VARIANTS]["variants"]]
    (primitive,) = document.meshes[0].primitives
    shown = {}
    for mapping in primitive.extensions[VARIANTS]["mappings"]:
        material = document.materials[mapping["material"]]
        image = document.images[document.textures[material.pbrMetallicRoughness.baseColorTexture.index].source]
        view = document.bufferViews[image.bufferView]
        png = np.frombuffer(document.binary_blob()[view.byteOffset :][: view.byteLength], np.uint8)
        (variant,) = mapping["variants"]
        picture = cv2.imdecode(png, cv2.IMREAD_COLOR)
        assert picture is not None
        shown[names[variant]] = picture[..., ::-1]
    assert primitive.material == names.index("captured") and staged.albedo is not None
    np.testing.assert_array_equal(shown["captured"], staged.texture)
    np.testing.assert_array_equal(shown["albedo"], staged.albedo.texture)


def test_the_captured_look_is_unlit_and_the_albedo_has_no_sheen(glb: Path) -> None:
    """Programs without the extension show a matte material."""
    document = pygltflib.GLTF2.load(str(glb))
    assert set(document.extensionsUsed) == {UNLIT, SPECULAR, VARIANTS}
    found = {material.name: material.extensions for material in document.materials}
    assert found == {"Captured": {UNLIT: {}}, "Albedo": {SPECULAR: {"specularFactor": 0}}}
    matte = [material.pbrMetallicRoughness for material in document.materials]
    assert [(m.metallicFactor, m.roughnessFactor) for m in matte] == [(0, 1)] * 2


def test_motion_is_in_seconds_from_the_first_frame(glb: Path) -> None:
    document = pygltflib.GLTF2.load(str(glb))
    (animation,) = document.animations  # at other rates it would be the same motion
    assert animation.name == "captured"
    assert [(c.target.node, c.target.path) for c in animation.channels] == [
        (0, "translation"),
        (0, "rotation"),
        (1, "translation"),
        (2, "rotation"),
        (3, "weights"),
    ]  # the root has the rotation, so the pelvis needs none
    np.testing.assert_allclose(accessor(document, animation.samplers[0].input)[:, 0], [0, 0.1, 0.2, 0.5])
    translation = accessor(document, animation.samplers[0].output)
    # World (0.1 frame, 2, floor) is stage (0.1 frame, floor, -2).
    np.testing.assert_allclose(translation[:, [0, 2]], [[0.1 * f, -2] for f in FRAMES], atol=1e-6)
    assert len(np.unique(translation[:, 1])) == 1


def test_correctives_are_morph_targets_with_one_weight_per_frame(glb: Path, staged: StagedAvatar) -> None:
    document = pygltflib.GLTF2.load(str(glb))
    (primitive,) = document.meshes[0].primitives
    vertex = np.zeros(len(staged.uvs), int)
    vertex[staged.face_uvs] = staged.faces
    for target, shape_m in zip(primitive.targets[:-2], staged.shapes_m, strict=True):
        np.testing.assert_allclose(accessor(document, target["POSITION"]), shape_m[vertex], atol=1e-7)
    weights = accessor(document, document.animations[0].samplers[-1].output).reshape(len(FRAMES), -1)
    expected = staged.rigs["full"].motions["captured"].shape_weights
    np.testing.assert_allclose(weights[:, :-2], expected)
    assert (weights[:, -2:] == 0).all()  # the motion does not use the expression and the physique


def test_weights_that_stay_zero_have_two_keys(staged: StagedAvatar, tmp_path: Path) -> None:
    full = staged.rigs["full"]
    still = {
        name: dataclasses.replace(motion, shape_weights=0 * motion.shape_weights)
        for name, motion in full.motions.items()
    }
    write_glb(tmp_path / "still.glb", staged, dataclasses.replace(full, motions=still), INFO)
    document = pygltflib.GLTF2.load(str(tmp_path / "still.glb"))
    *_, joint, weights = document.animations[0].samplers
    np.testing.assert_allclose(accessor(document, weights.input)[:, 0], [0, 0.5])
    np.testing.assert_array_equal(accessor(document, weights.output), np.zeros((2 * 5, 1)))
    assert document.accessors[joint.input].count == len(FRAMES)


def test_a_joint_that_one_motion_moves_is_put_back_by_the_others(staged: StagedAvatar, tmp_path: Path) -> None:
    """In Blender, joints without keys keep the pose that another motion left."""
    full = staged.rigs["full"]
    captured = full.motions["captured"]
    rest = Rotation.from_matrix(full.skeleton.local(full.skeleton.bind)[2, :3, :3]).as_quat()
    quaternions = captured.quaternions.copy()
    quaternions[:, 2] = rest
    motions = {"captured": captured, "stiff": dataclasses.replace(captured, quaternions=quaternions)}
    write_glb(tmp_path / "two.glb", staged, dataclasses.replace(full, motions=motions), INFO)
    document = pygltflib.GLTF2.load(str(tmp_path / "two.glb"))
    moved, stiff = ([(c.target.node, c.target.path) for c in a.channels] for a in document.animations)
    assert moved == stiff
    sampler = document.animations[1].samplers[stiff.index((2, "rotation"))]
    np.testing.assert_allclose(accessor(document, sampler.input)[:, 0], [0, 0.5])
    np.testing.assert_allclose(accessor(document, sampler.output), [rest, rest], atol=1e-7)


def test_expressions_and_physiques_are_morph_targets_after_the_correctives(glb: Path, staged: StagedAvatar) -> None:
    document = pygltflib.GLTF2.load(str(glb))
    (mesh,) = document.meshes
    assert mesh.extras["targetNames"] == ["corrective_01", "corrective_02", "corrective_03", "frown", "stout"]
    assert len(mesh.primitives[0].targets) == len(mesh.weights) == 5
    vertex = np.zeros(len(staged.uvs), int)
    vertex[staged.face_uvs] = staged.faces
    item = document.accessors[mesh.primitives[0].targets[-2]["POSITION"]]
    frown_m, stout_m = (accessor(document, target["POSITION"]) for target in mesh.primitives[0].targets[-2:])
    np.testing.assert_allclose(frown_m, staged.expressions_m["frown"][vertex], atol=1e-7)
    for target, (name, shape_m) in zip(mesh.primitives[0].targets, staged.blend_shapes_m.items(), strict=False):
        at = moved_points(shape_m[vertex])
        expected = staged.normal_changes[name][vertex][at]
        np.testing.assert_allclose(accessor(document, target["NORMAL"])[at], expected, atol=1e-6)
    np.testing.assert_allclose(stout_m, staged.physiques_m["stout"][vertex], atol=1e-5)
    assert item.sparse
    assert not document.accessors[mesh.primitives[0].targets[0]["POSITION"]].sparse  # a corrective moves nearly all
    np.testing.assert_allclose((item.min, item.max), ([0, 0, -0.02], [0.01, 0.03, 0]), atol=1e-7)


def test_the_khronos_validator_finds_no_issues(glb: Path) -> None:
    """Needs `npm install gltf-validator` in a parent folder or in one that NODE_PATH names."""
    node = shutil.which("node")
    if not node or subprocess.run([node, "-e", "require('gltf-validator')"], capture_output=True).returncode:
        pytest.skip(f"no npm package gltf-validator (NODE_PATH={os.environ.get('NODE_PATH', '')})")
    found = subprocess.run([node, "-e", KHRONOS, str(glb)], capture_output=True, text=True, check=True)
    issues = json.loads(found.stdout)
    assert (issues["numErrors"], issues["numWarnings"], issues["messages"]) == (0, 0, [])
