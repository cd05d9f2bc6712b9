import dataclasses
import itertools
import tempfile
import time
from pathlib import Path
from zipfile import ZipFile

import cv2
import numpy as np
import pytest
from pxr import Ar, Sdf, Usd, UsdGeom, UsdLux, UsdShade, UsdSkel, Vt

from hnerf.asset.correctives import correctives_of
from hnerf.asset.dome import dome
from hnerf.asset.package import _everywhere, write_cache, write_usdz
from hnerf.asset.quads import polygon_corners
from hnerf.asset.srgb import to_linear
from hnerf.asset.staging import StagedAvatar, stage_avatar
from hnerf.asset.texture import unwrap
from hnerf.asset.validation import each_variant, validate_package
from hnerf.body.descriptor import normals_of
from hnerf.body.fit_result import BodyFit
from tests.asset.figure import FRAMES, INFO, bending_body, write_all
from tests.full_disk import files_up_to


def skinned_points(stage: Usd.Stage, code: float) -> np.ndarray:
    """Return the points of the only mesh at a time code as OpenUSD evaluates them: blend shapes, then UsdSkel
    skinning."""
    root = UsdSkel.Root(stage.GetPrimAtPath("/Avatar/Body"))
    (mesh,) = (UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh))
    cache = UsdSkel.Cache()
    cache.Populate(root, Usd.PrimDefaultPredicate)
    skeleton = cache.GetSkelQuery(UsdSkel.Skeleton(stage.GetPrimAtPath("/Avatar/Body/Skeleton")))
    motion = skeleton.GetAnimQuery()
    weights = dict(zip(motion.GetBlendShapeOrder(), motion.ComputeBlendShapeWeights(code), strict=True))
    binding, points = UsdSkel.BindingAPI(mesh.GetPrim()), np.array(mesh.GetPointsAttr().Get())
    targets = binding.GetBlendShapeTargetsRel().GetTargets()
    for name, path in zip(binding.GetBlendShapesAttr().Get(), targets, strict=True):
        if name in weights:
            points += weights[name] * np.array(UsdSkel.BlendShape(stage.GetPrimAtPath(path)).GetOffsetsAttr().Get())
    moved = Vt.Vec3fArray.FromNumpy(points)
    skinning = cache.GetSkinningQuery(mesh.GetPrim())
    assert skinning.ComputeSkinnedPoints(skeleton.ComputeSkinningTransforms(code), moved, code)
    return np.array(moved)


def selected(stage: Usd.Stage, *sets: str) -> list[str]:
    """Return the selections of variant sets."""
    return [stage.GetDefaultPrim().GetVariantSet(name).GetVariantSelection() for name in sets]


@pytest.mark.parametrize("name", ["avatar.usda", "avatar.usdz"])
@pytest.mark.parametrize("topologies", [[""], ["registered", "captured"]], ids=["one", "both"])
def test_usd_skinning_matches_ours_in_every_variant(
    name: str, topologies: list[str], package: Path, both: Path, staged: StagedAvatar, captured: StagedAvatar
) -> None:
    """Compare the first and the last pose of each motion. The extents of the captured mesh are not its own."""
    stage = Usd.Stage.Open(str((both if len(topologies) > 1 else package) / name))
    seen = set()
    for _ in each_variant(stage):
        topology, rig, motion, lod, shape = selected(stage, "topology", "rig", "motion", "lod", "shape")
        seen.add((topology, rig, motion, lod, shape))
        avatar = captured if topology == "captured" else staged
        moving, shown = avatar.rigs[rig].motions[motion], avatar.levels[int(lod[-1])].vertices
        moved_m = avatar.physiques_m.get(shape, np.zeros((1, 3)))
        rest = dataclasses.replace(avatar.rest, points_m=avatar.rest_points_m + moved_m)
        expected = list(avatar.rigs[rig].surfaces_m(motion, rest))
        for k in (0, len(moving.codes) - 1):
            code = moving.codes[k] * 10 / moving.fps
            np.testing.assert_allclose(skinned_points(stage, code), expected[k][shown], atol=1e-5)
            box = UsdSkel.Root(stage.GetPrimAtPath("/Avatar/Body")).GetExtentAttr().Get(code)
            tight = np.stack([expected[k].min(0), expected[k].max(0)])
            if avatar is staged and shape == "captured":
                np.testing.assert_allclose(box, tight, atol=1e-5)
            elif avatar is staged:
                assert (box[0] <= tight[0] + 1e-6).all() and (box[1] >= tight[1] - 1e-6).all()
    rigs, motions = ("full", "game"), ("captured", "captured_24", "captured_30")
    assert seen == {
        *itertools.product(topologies, rigs, motions, ["lod0"], ["captured"]),
        *itertools.product(topologies[:1], rigs, motions[:1], ["lod1"], ["captured"]),
        *itertools.product(topologies[:1], rigs, motions[:1], ["lod0"], ["stout"]),
    }


@pytest.mark.parametrize(("name", "motion"), [("avatar.usda", "captured"), ("avatar_30.usda", "captured_30")])
def test_each_topology_selects_full_detail_and_the_motion_of_the_file(name: str, motion: str, both: Path) -> None:
    stage = Usd.Stage.Open(str(both / name))
    for topology in ("registered", "captured"):
        stage.GetDefaultPrim().GetVariantSet("topology").SetVariantSelection(topology)
        sets = ("shape", "lod", "look", "rig", "motion")
        assert selected(stage, *sets) == ["captured", "lod0", "captured", "full", motion]


@pytest.mark.parametrize("name", ["avatar.usda", "avatar.usdz", "avatar_30.usda"])
@pytest.mark.parametrize("lod", ["lod0", "lod1"])
def test_shape_variants_move_the_mesh_at_every_level_of_detail(
    name: str, lod: str, package: Path, staged: StagedAvatar
) -> None:
    stage = Usd.Stage.Open(str(package / name))
    stage.SetEditTarget(stage.GetSessionLayer())
    root, kept = stage.GetDefaultPrim(), staged.levels[int(lod[-1])].vertices
    root.GetVariantSet("lod").SetVariantSelection(lod)
    shape = root.GetVariantSet("shape")
    assert (shape.GetVariantNames(), shape.GetVariantSelection()) == (["captured", "stout"], "captured")
    for choice, moved_m in (("captured", 0), ("stout", staged.physiques_m["stout"])):
        shape.SetVariantSelection(choice)
        (mesh,) = (UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh))
        points_m = staged.rest_points_m + moved_m
        np.testing.assert_allclose(mesh.GetPointsAttr().Get(), points_m[kept], atol=1e-6)
        np.testing.assert_allclose(mesh.GetNormalsAttr().Get(), normals_of(points_m, staged.faces)[kept], atol=1e-6)
        box = [points_m[kept].min(0), points_m[kept].max(0)]
        np.testing.assert_allclose(mesh.GetExtentAttr().Get(), box, atol=1e-6)
    hint = np.array(UsdGeom.ModelAPI(root).GetExtentsHintAttr().Get())
    body = np.array(UsdSkel.Root(stage.GetPrimAtPath("/Avatar/Body")).GetExtentAttr().Get())
    assert (hint[0] <= body[0]).all() and (hint[1] >= body[1]).all()


@pytest.mark.parametrize("name", ["avatar.usda", "avatar.usdz", "avatar_24.usda"])
def test_full_detail_is_the_default(name: str, package: Path, staged: StagedAvatar) -> None:
    stage = Usd.Stage.Open(str(package / name))
    stage.SetEditTarget(stage.GetSessionLayer())
    detail = stage.GetDefaultPrim().GetVariantSet("lod")
    assert (detail.GetVariantNames(), detail.GetVariantSelection()) == (["lod0", "lod1"], "lod0")
    for choice, path in (("lod0", "/Avatar/Body/Surface"), ("lod1", "/Avatar/Body/Surface_lod1")):
        detail.SetVariantSelection(choice)
        (mesh,) = (UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh))
        assert mesh.GetPath() == path
        assert bound_surface(stage).GetPath() == "/Avatar/Materials/Captured/Surface"
        level = staged.levels[int(choice[-1])]
        corners = polygon_corners(level.layout.face_uvs)
        np.testing.assert_array_equal(mesh.GetFaceVertexIndicesAttr().Get(), level.faces.ravel()[corners].ravel())
        st = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").ComputeFlattened()
        np.testing.assert_allclose(st, level.layout.uvs[level.layout.face_uvs.ravel()[corners].ravel()], atol=1e-7)
        normals = normals_of(staged.rest_points_m, staged.faces)[level.vertices]
        np.testing.assert_allclose(mesh.GetNormalsAttr().Get(), normals, atol=1e-6)
        colours = to_linear(staged.vertex_colours[level.vertices] / 255)
        np.testing.assert_allclose(mesh.GetDisplayColorAttr().Get(), colours, atol=1e-6)


@pytest.mark.parametrize("lod", ["lod0", "lod1"])
def test_expressions_are_sparse_blend_shapes_that_no_motion_uses(lod: str, package: Path, staged: StagedAvatar) -> None:
    stage = Usd.Stage.Open(str(package / "avatar.usda"))
    stage.SetEditTarget(stage.GetSessionLayer())
    stage.GetDefaultPrim().GetVariantSet("lod").SetVariantSelection(lod)
    (mesh,) = (prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh))
    used = UsdSkel.Animation(stage.GetPrimAtPath("/Avatar/Body/Motion/full")).GetBlendShapesAttr().Get()
    assert list(UsdSkel.BindingAPI(mesh).GetBlendShapesAttr().Get()) == [*used, "frown"]
    frown = UsdSkel.BlendShape(stage.GetPrimAtPath(mesh.GetPath().AppendChild("frown")))
    moved_m = np.zeros((len(UsdGeom.Mesh(mesh).GetPointsAttr().Get()), 3))
    moved_m[np.array(frown.GetPointIndicesAttr().Get())] = frown.GetOffsetsAttr().Get()
    np.testing.assert_allclose(moved_m, staged.expressions_m["frown"][staged.levels[int(lod[-1])].vertices], atol=1e-7)
    assert 0 < len(frown.GetOffsetsAttr().Get()) < len(moved_m) / 2
    frowning_m = staged.rest_points_m + staged.expressions_m["frown"]
    expected, rest = (normals_of(points_m, staged.faces) for points_m in (frowning_m, staged.rest_points_m))
    kept = staged.levels[int(lod[-1])].vertices[np.array(frown.GetPointIndicesAttr().Get())]
    np.testing.assert_allclose(frown.GetNormalOffsetsAttr().Get(), (expected - rest)[kept], atol=1e-6)
    assert np.abs(expected - rest)[kept].max() > 0.01


def test_correctives_change_the_normals(package: Path, staged: StagedAvatar) -> None:
    stage = Usd.Stage.Open(str(package / "avatar.usda"))
    shape = UsdSkel.BlendShape(stage.GetPrimAtPath("/Avatar/Body/Surface/corrective_01"))
    moved = np.array(shape.GetPointIndicesAttr().Get())
    expected = staged.normal_changes["corrective_01"][moved]
    np.testing.assert_allclose(shape.GetNormalOffsetsAttr().Get(), expected, atol=1e-6)
    assert np.abs(expected).max() > 0.01


def test_a_level_that_lacks_an_expressions_points_still_has_the_expression(
    staged: StagedAvatar, tmp_path: Path
) -> None:
    gone = np.setdiff1d(staged.levels[0].vertices, staged.levels[1].vertices)[0]
    wink_m = np.zeros((len(staged.rest_points_m), 3), np.float32)
    wink_m[gone] = 0.01
    write_usdz(
        tmp_path / "wink.usdz", {"": dataclasses.replace(staged, expressions_m={"wink": wink_m})}, [], 10.0, INFO
    )
    stage = Usd.Stage.Open(str(tmp_path / "wink.usdz"))
    stage.GetDefaultPrim().GetVariantSet("lod").SetVariantSelection("lod1")
    wink = UsdSkel.BlendShape(stage.GetPrimAtPath("/Avatar/Body/Surface_lod1/wink"))
    assert list(wink.GetPointIndicesAttr().Get()) == [0]
    assert list(wink.GetOffsetsAttr().Get()) == [(0, 0, 0)]


@pytest.mark.parametrize(
    ("name", "motion", "rate"),
    [
        ("avatar.usda", "captured", 10),
        ("avatar.usdz", "captured", 10),
        ("avatar_24.usda", "captured_24", 24),
        ("avatar_30.usda", "captured_30", 30),
    ],
)
def test_frames_are_whole_time_codes(name: str, motion: str, rate: int, package: Path, staged: StagedAvatar) -> None:
    stage, codes = Usd.Stage.Open(str(package / name)), staged.rigs["full"].motions[motion].codes.tolist()
    assert (stage.GetTimeCodesPerSecond(), stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (
        rate, codes[0], codes[-1],
    )  # fmt: skip
    animation = UsdSkel.Animation(stage.GetPrimAtPath("/Avatar/Body/Motion/full"))
    assert animation.GetRotationsAttr().GetTimeSamples() == codes
    # 0.5 s, the capture's frame 5, is a whole time code at each rate.
    np.testing.assert_allclose(skinned_points(stage, rate / 2), staged.points_m[2], atol=1e-5)


def test_further_motions_start_with_the_captured_one_and_none_is_truncated(tmp_path: Path) -> None:
    """The captured motion runs from 0.3 to 0.8 s. The further one has 31 poses at 20 a second, which take 1.5 s
    whatever their frame numbers: from 0.3 to 1.8 s, which is codes 3 to 18 at 10 a second and 7.2 to 43.2 at 24."""
    body = bending_body()
    rows = [0] * 31
    dance = BodyFit(body.rig, tuple(range(7, 38)), body.theta[rows], body.root[rows])
    none = correctives_of(np.zeros((4, len(body.rig.vertices_m), 3), np.float32), 0)
    layout = unwrap(body.rig.vertices_m.numpy(), body.rig.faces.numpy(), 64)
    texture, further = np.zeros((64, 64, 3), np.uint8), {"dance": (dance, 20.0)}
    staged = stage_avatar(body, body.vertices_m().numpy(), none, layout, texture, "z", 10.0, further=further)
    write_all(tmp_path, staged)
    ranges = {"avatar.usda": (3, 18), "avatar.usdz": (3, 18), "avatar_24.usda": (8, 44), "avatar_cache.usdz": (3, 8)}
    for name, expected in ranges.items():
        stage = Usd.Stage.Open(str(tmp_path / name))
        assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == expected, name
    stage = Usd.Stage.Open(str(tmp_path / "avatar.usda"))
    stage.GetDefaultPrim().GetVariantSet("motion").SetVariantSelection("dance")
    motion = UsdSkel.Animation(stage.GetPrimAtPath("/Avatar/Body/Motion/full"))
    np.testing.assert_allclose(motion.GetRotationsAttr().GetTimeSamples(), np.arange(3, 18.1, 0.5), atol=1e-9)


def test_packing_an_avatar_again_later_gives_identical_bytes_and_no_output(
    package: Path, staged: StagedAvatar, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """ZIP timestamps have a resolution of two seconds, so wait for the next step."""
    time.sleep(max(0.0, (package / "avatar_cache.usdz").stat().st_mtime + 2.0 - time.time()))
    capfd.readouterr()
    write_all(tmp_path, staged)
    assert capfd.readouterr() == ("", "")
    written = [path for path in sorted(tmp_path.rglob("*")) if path.is_file()]
    # Interfaces, images, shapes, levels of detail, cameras, looks, MaterialX, rigs, motions, .usdz.
    assert len(written) == 4 + 4 + 2 + 2 + 1 + 2 + 2 + 2 + 3 + 2
    for path in written:
        assert path.read_bytes() == (package / path.relative_to(tmp_path)).read_bytes(), path.name
    with ZipFile(tmp_path / "avatar.usdz") as archive:
        assert set(archive.namelist()) == {"avatar.usdc", "texture.png", "albedo.png", "light.png", "normal_map.png"}
        assert archive.testzip() is None
        assert {entry.date_time for entry in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}


@pytest.mark.parametrize("name", ["avatar.usda", "avatar.usdz", "avatar_24.usda", "avatar_cache.usdz"])
def test_the_root_prim_says_what_the_asset_is(name: str, package: Path) -> None:
    stage = Usd.Stage.Open(str(package / name))
    root, model = stage.GetDefaultPrim(), Usd.ModelAPI(stage.GetDefaultPrim())
    assert (model.GetKind(), model.GetAssetName(), model.GetAssetVersion()) == ("component", "column", "7")
    assert model.GetAssetIdentifier().path == f"./{name}"
    assert (root.GetAssetInfoByKey("captureDigest"), root.GetAssetInfoByKey("licence")) == ("0123abcd", "CC0-1.0")


@pytest.mark.parametrize("name", ["avatar.usda", "avatar.usdz", "avatar_24.usda"])
def test_the_root_prim_says_how_the_asset_was_made(name: str, package: Path) -> None:
    """USD refuses an empty tuple as it is."""
    stage = Usd.Stage.Open(str(package / name))
    info = stage.GetDefaultPrim().GetAssetInfo()
    settings = {key: value if isinstance(value, str) else list(value) for key, value in info["settings"].items()}
    assert settings == {"topology": "auto", "level_faces": [500], "none": []}
    assert info["figures"] == {"field": {"psnr": 32.5}}


def test_the_skeleton_names_its_rest_pose_and_joints_of_other_skeletons(package: Path) -> None:
    stage = Usd.Stage.Open(str(package / "avatar.usda"))
    skeleton = UsdSkel.Skeleton(stage.GetPrimAtPath("/Avatar/Body/Skeleton"))
    assert list(skeleton.GetJointsAttr().Get()) == ["root", "root/pelvis", "root/pelvis/upper_L"]
    assert list(skeleton.GetJointNamesAttr().Get()) == ["root", "pelvis", "upper_L"]
    data = skeleton.GetPrim().GetCustomData()
    assert data["restPose"] == "A"
    assert data["jointNamesIn"]["mixamo"] == {"pelvis": "Hips"}
    assert "own" not in data["jointNamesIn"]


def test_joints_can_have_the_names_of_another_skeleton(staged: StagedAvatar, tmp_path: Path) -> None:
    """Mixamo has no root and no upper joint; USD allows no colon, so its prefix is left out."""
    write_all(tmp_path, dataclasses.replace(staged, joint_names="mixamo"))
    stage = Usd.Stage.Open(str(tmp_path / "avatar.usda"))
    skeleton = UsdSkel.Skeleton(stage.GetPrimAtPath("/Avatar/Body/Skeleton"))
    for rig in ("full", "game"):
        stage.GetDefaultPrim().GetVariantSet("rig").SetVariantSelection(rig)
        joints = ["root", "root/Hips", "root/Hips/upper_L"]
        assert list(skeleton.GetJointsAttr().Get()) == joints
        assert list(skeleton.GetJointNamesAttr().Get()) == ["root", "Hips", "upper_L"]
        assert (
            list(UsdSkel.Animation(stage.GetPrimAtPath(f"/Avatar/Body/Motion/{rig}")).GetJointsAttr().Get()) == joints
        )
    names = skeleton.GetPrim().GetCustomData()["jointNamesIn"]
    assert (names["own"], names["vrm"]) == ({"Hips": "pelvis"}, {"Hips": "hips"})
    for name in ("avatar.usda", "avatar.usdz"):
        assert validate_package(tmp_path / name)["warnings"] == []


def test_without_payloads_only_the_interface_is_loaded(package: Path) -> None:
    stage = Usd.Stage.Open(str(package / "avatar.usda"), Usd.Stage.LoadNone)
    assert stage.GetDefaultPrim().GetChildren() == []
    assert len(UsdGeom.ModelAPI(stage.GetDefaultPrim()).GetExtentsHintAttr().Get()) == 2


def test_the_extents_hint_contains_every_motion(staged: StagedAvatar, tmp_path: Path) -> None:
    boxes = {name: 100 * boxes for name, boxes in staged.extents_m.items()}
    far = dataclasses.replace(staged, extents_m=boxes, physiques_m={})  # physiques' boxes contain motions too
    write_usdz(tmp_path / "far.usdz", {"": far}, [], 10.0, INFO)
    stage = Usd.Stage.Open(str(tmp_path / "far.usdz"))
    hint = np.array(UsdGeom.ModelAPI(stage.GetDefaultPrim()).GetExtentsHintAttr().Get())
    corners = np.concatenate([boxes.reshape(-1, 3) for boxes in far.extents_m.values()])
    assert (hint[1] >= corners.max(0) - 1e-4).all() and (hint[0] <= corners.min(0) + 1e-4).all()


def test_the_extents_hint_is_made_from_boxes(staged: StagedAvatar) -> None:
    """Boxes of 4, 12 and 16 poses at 10, 24 and 30 frames a second, and of the rest, the cache and the physique."""
    corners_m = _everywhere(staged)
    assert len(corners_m) == 2 * (4 + 12 + 16 + 3)
    assert (corners_m.min(0) <= staged.points_m.min((0, 1))).all()


def bound_surface(stage: Usd.Stage) -> UsdShade.Shader:
    """Return the shader of the mesh's bound material."""
    mesh = next(prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh))
    return UsdShade.MaterialBindingAPI(mesh).ComputeBoundMaterial()[0].ComputeSurfaceSource()[0]


def texture_of(surface: UsdShade.Shader, given: str) -> UsdShade.Shader:
    """Return the texture that an input of a surface is connected to."""
    return UsdShade.Shader(surface.GetInput(given).GetConnectedSources()[0][0].source.GetPrim())


def pixels(path: Sdf.AssetPath) -> np.ndarray:
    """Return the image (H, W, 3) in a file of the package."""
    file = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(path.resolvedPath))
    picture = cv2.imdecode(np.frombuffer(file.GetBuffer(), np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    return picture[..., ::-1]


@pytest.mark.parametrize("name", ["avatar.usda", "avatar.usdz", "avatar_24.usda"])
def test_the_albedo_look_comes_with_the_light_that_was_removed(name: str, package: Path, staged: StagedAvatar) -> None:
    stage = Usd.Stage.Open(str(package / name))
    look = stage.GetDefaultPrim().GetVariantSet("look")
    assert (look.GetVariantNames(), look.GetVariantSelection()) == (["albedo", "captured"], "captured")
    assert not stage.GetPrimAtPath("/Avatar/Light")
    look.SetVariantSelection("albedo")
    surface, light = bound_surface(stage), UsdLux.DomeLight(stage.GetPrimAtPath("/Avatar/Light"))
    assert surface.GetPath() == "/Avatar/Materials/Albedo/Surface"
    assert not stage.GetPrimAtPath("/Avatar/Materials/Captured")
    assert staged.albedo is not None
    shown = pixels(texture_of(surface, "diffuseColor").GetInput("file").Get())
    picture, intensity = dome(staged.albedo.light)
    np.testing.assert_array_equal(shown, staged.albedo.texture)
    np.testing.assert_array_equal(pixels(light.GetTextureFileAttr().Get()), picture)
    assert surface.GetInput("ior").Get() == 1
    assert light.GetIntensityAttr().Get() == pytest.approx(intensity)
    assert int(picture[0].min()) > 100 + int(picture[-1].max())  # up is Z in the world and Y in the stage


@pytest.mark.parametrize("name", ["avatar.usda", "avatar.usdz", "avatar_cache.usdz"])
def test_the_surface_has_a_texture_and_a_normal_map(name: str, package: Path, staged: StagedAvatar) -> None:
    stage = Usd.Stage.Open(str(package / name))
    surface = bound_surface(stage)
    assert surface.GetPath() == "/Avatar/Materials/Captured/Surface"
    for given, expected, space in (("diffuseColor", staged.texture, "sRGB"), ("normal", staged.normal_map, "raw")):
        texture = texture_of(surface, given)
        assert texture.GetInput("sourceColorSpace").Get() == space
        np.testing.assert_array_equal(pixels(texture.GetInput("file").Get()), expected)
    # Scale and bias map values from 0 to 1 to components from -1 to 1.
    assert texture.GetInput("scale").Get() == (2, 2, 2, 1) and texture.GetInput("bias").Get() == (-1, -1, -1, 0)


@pytest.mark.parametrize("name", ["avatar.usda", "avatar.usdz", "avatar_24.usda"])
def test_each_topology_has_its_own_textures(
    name: str, both: Path, staged: StagedAvatar, captured: StagedAvatar
) -> None:
    stage = Usd.Stage.Open(str(both / name))
    topology = stage.GetDefaultPrim().GetVariantSet("topology")
    assert (topology.GetVariantNames(), topology.GetVariantSelection()) == (["captured", "registered"], "registered")
    for choice, shown in (("captured", captured), ("registered", staged)):
        assert shown.albedo is not None
        topology.SetVariantSelection(choice)
        assert len(stage.GetPrimAtPath("/Avatar/Cameras").GetChildren()) == 1
        for look, expected in (("captured", shown.texture), ("albedo", shown.albedo.texture)):
            stage.GetDefaultPrim().GetVariantSet("look").SetVariantSelection(look)
            for given, picture in (("diffuseColor", expected), ("normal", shown.normal_map)):
                file = texture_of(bound_surface(stage), given).GetInput("file").Get()
                np.testing.assert_array_equal(pixels(file), picture)
        light = UsdLux.DomeLight(stage.GetPrimAtPath("/Avatar/Light")).GetTextureFileAttr().Get()
        np.testing.assert_array_equal(pixels(light), dome(shown.albedo.light)[0])


def test_normal_map_albedo_and_physiques_can_be_left_out(staged: StagedAvatar, tmp_path: Path) -> None:
    bare = dataclasses.replace(staged, normal_map=None, albedo=None, physiques_m={})
    write_usdz(tmp_path / "bare.usdz", {"": bare}, [], 10.0, INFO)
    stage = Usd.Stage.Open(str(tmp_path / "bare.usdz"))
    for name in ("look", "shape"):
        assert stage.GetDefaultPrim().GetVariantSet(name).GetVariantNames() == ["captured"]
    surface = UsdShade.Shader(stage.GetPrimAtPath("/Avatar/Materials/Captured/Surface"))
    assert [given.GetBaseName() for given in surface.GetInputs() if given.HasConnectedSource()] == ["diffuseColor"]


def test_units_and_camera_names(package: Path) -> None:
    stage = Usd.Stage.Open(str(package / "avatar.usdz"))
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Y", 1.0)
    prims = stage.GetPrimAtPath("/Avatar/Cameras").GetChildren()
    assert [p.GetName() for p in prims] == ["cam_1", "cam_1_", "_01"]
    assert [p.GetDisplayName() for p in prims] == ["cam 1", "cam.1", "01"]


def test_cache_holds_the_posed_points(package: Path, staged: StagedAvatar) -> None:
    stage = Usd.Stage.Open(str(package / "avatar_cache.usdz"))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/Avatar/Surface"))
    assert mesh.GetPointsAttr().GetTimeSamples() == list(FRAMES)
    np.testing.assert_array_equal(np.array(mesh.GetPointsAttr().Get(8)), staged.points_m[3])
    assert len(mesh.GetFaceVertexIndicesAttr().GetTimeSamples()) == 0


@pytest.mark.parametrize("missing", [0.5, 1e-4], ids=["the layer", "the package"])
def test_a_full_disk_is_named_as_such(missing: float, staged: StagedAvatar, tmp_path: Path) -> None:
    """The packed file is the largest."""
    path = tmp_path / "avatar.usdz"
    write_usdz(path, {"": staged}, [], 10.0, INFO)
    with files_up_to(int((1 - missing) * path.stat().st_size)), pytest.raises(OSError, match="is the disk full"):
        write_usdz(path, {"": staged}, [], 10.0, INFO)


def test_packages_need_no_room_in_the_folder_of_temporary_files(
    staged: StagedAvatar, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is often small, or full, on a machine whose store is elsewhere."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "missing"))
    monkeypatch.setenv("TMPDIR", str(tmp_path / "missing"))
    write_usdz(tmp_path / "avatar.usdz", {"": staged}, [], 10.0, INFO)
    write_cache(tmp_path / "avatar_cache.usdz", staged, [], 10.0, INFO)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["avatar.usdz", "avatar_cache.usdz"]
