import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdShade, UsdSkel, Vt

from hnerf.asset.package import AssetInfo, write_package, write_usdz
from hnerf.asset.staging import StagedAvatar
from hnerf.asset.validation import data_defects, each_variant, validate_package
from hnerf.errors import InvalidAsset
from tests.asset.figure import side_camera

INFO = AssetInfo("column", "1", "", "")
BODY = "/Avatar/Body"


@pytest.fixture(scope="module")
def package(staged: StagedAvatar, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the package and `avatar.usdz`."""
    out = tmp_path_factory.mktemp("package")
    write_package(out, {"": staged}, [side_camera()], 10.0, INFO)
    write_usdz(out / "avatar.usdz", {"": staged}, [side_camera()], 10.0, INFO)
    return out


@pytest.fixture
def stage(package: Path) -> Usd.Stage:
    """Return a stage whose session layer can be damaged, and the metadata of its root layer."""
    layer = Sdf.Layer.CreateAnonymous()
    whole = Sdf.Layer.FindOrOpen(str(package / "avatar.usdz"))
    layer.TransferContent(whole)
    return Usd.Stage.Open(layer)


def mesh(stage: Usd.Stage) -> UsdGeom.Mesh:
    return UsdGeom.Mesh(stage.GetPrimAtPath("/Avatar/Body/Surface"))


def skeleton(stage: Usd.Stage) -> UsdSkel.Skeleton:
    return UsdSkel.Skeleton(stage.GetPrimAtPath(f"{BODY}/Skeleton"))


def motion(stage: Usd.Stage) -> UsdSkel.Animation:
    return UsdSkel.Animation(stage.GetPrimAtPath(f"{BODY}/Motion/full"))


def change(attribute: Usd.Attribute, index: int, value: object, time: float | None = None) -> None:
    at = Usd.TimeCode.Default() if time is None else Usd.TimeCode(time)
    values = attribute.Get(at)
    values[index] = value
    attribute.Set(values, at)


def heavy_weight(stage: Usd.Stage) -> None:
    change(UsdSkel.BindingAPI(mesh(stage)).GetJointWeightsAttr(), 0, 0.3)


def joint_out_of_range(stage: Usd.Stage) -> None:
    change(UsdSkel.BindingAPI(mesh(stage)).GetJointIndicesAttr(), 0, 3)  # there are three joints


def point_not_a_number(stage: Usd.Stage) -> None:
    change(mesh(stage).GetPointsAttr(), 5, Gf.Vec3f(np.nan, 0, 0))


def face_out_of_range(stage: Usd.Stage) -> None:
    change(mesh(stage).GetFaceVertexIndicesAttr(), 0, len(mesh(stage).GetPointsAttr().Get()))


def centimetres(stage: Usd.Stage) -> None:
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)


def giant(stage: Usd.Stage) -> None:
    points = mesh(stage).GetPointsAttr()
    points.Set(Vt.Vec3fArray.FromNumpy(np.array(points.Get()) * 100))


def no_extent(stage: Usd.Stage) -> None:
    mesh(stage).GetExtentAttr().Set(Vt.Vec3fArray([Gf.Vec3f(0), Gf.Vec3f(0)]))


def uv_outside(stage: Usd.Stage) -> None:
    change(UsdGeom.PrimvarsAPI(mesh(stage)).GetPrimvar("st").GetAttr(), 0, Gf.Vec2f(1.5, 0))


def uvs_missing(stage: Usd.Stage) -> None:
    st = UsdGeom.PrimvarsAPI(mesh(stage)).GetPrimvar("st")
    st.SetIndices(Vt.IntArray(list(st.GetIndices())[:-1]))


def dotted_joint(stage: Usd.Stage) -> None:
    skeleton(stage).GetJointsAttr().Set(["root", "root/pelvis", "root/pelvis/upper.L"])


def stretched_quaternion(stage: Usd.Stage) -> None:
    motion(stage).GetRotationsAttr().Set(Vt.QuatfArray([Gf.Quatf(2, 0, 0, 0)] * 3), 5.0)


def joint_without_transform(stage: Usd.Stage) -> None:
    motion(stage).GetRotationsAttr().Set(Vt.QuatfArray([Gf.Quatf(1, 0, 0, 0)] * 2), 5.0)


def sheared_bind(stage: Usd.Stage) -> None:
    change(skeleton(stage).GetBindTransformsAttr(), 2, Gf.Matrix4d(2))


def rest_elsewhere(stage: Usd.Stage) -> None:
    change(skeleton(stage).GetRestTransformsAttr(), 2, Gf.Matrix4d(1))


def no_ground_root(stage: Usd.Stage) -> None:
    skeleton(stage).GetJointsAttr().Set(["hips", "hips/spine", "hips/spine/upper_L"])


def nameless_rest_pose(stage: Usd.Stage) -> None:
    skeleton(stage).GetPrim().SetCustomDataByKey("restPose", "")


def floating(stage: Usd.Stage) -> None:
    points = mesh(stage).GetPointsAttr()
    points.Set(Vt.Vec3fArray.FromNumpy((np.array(points.Get()) + np.array([0, 0.3, 0])).astype(np.float32)))
    extent = np.array(mesh(stage).GetExtentAttr().Get()) + np.array([0, 0.3, 0])
    mesh(stage).GetExtentAttr().Set(Vt.Vec3fArray.FromNumpy(extent.astype(np.float32)))


def one_eye(stage: Usd.Stage) -> None:
    skeleton(stage).GetJointsAttr().Set(["root", "root/pelvis", "root/pelvis/eye_L"])


def short_shape(stage: Usd.Stage) -> None:
    shape = UsdSkel.BlendShape(stage.GetPrimAtPath(f"{BODY}/Surface/corrective_01"))
    shape.GetOffsetsAttr().Set([Gf.Vec3f(0)] * 5)


def shape_of_no_point(stage: Usd.Stage) -> None:
    frown = UsdSkel.BlendShape(stage.GetPrimAtPath(f"{BODY}/Surface/frown"))
    change(frown.GetPointIndicesAttr(), 0, len(mesh(stage).GetPointsAttr().Get()))


def short_expression(stage: Usd.Stage) -> None:
    frown = UsdSkel.BlendShape(stage.GetPrimAtPath(f"{BODY}/Surface/frown"))
    frown.GetOffsetsAttr().Set(frown.GetOffsetsAttr().Get()[:-1])


def shape_without_target(stage: Usd.Stage) -> None:
    UsdSkel.BindingAPI(mesh(stage)).GetBlendShapesAttr().Set(["smile"])


def negative_weight(stage: Usd.Stage) -> None:
    change(motion(stage).GetBlendShapeWeightsAttr(), 0, -0.5, 5.0)


def no_colours(stage: Usd.Stage) -> None:
    mesh(stage).GetDisplayColorAttr().Set([Gf.Vec3f(1)])


def no_material(stage: Usd.Stage) -> None:
    UsdShade.MaterialBindingAPI(mesh(stage)).UnbindDirectBinding()


def no_kind(stage: Usd.Stage) -> None:
    Usd.ModelAPI(stage.GetDefaultPrim()).SetKind("assembly")


def no_identifier(stage: Usd.Stage) -> None:
    stage.GetDefaultPrim().ClearAssetInfoByKey("identifier")


def small_hint(stage: Usd.Stage) -> None:
    UsdGeom.ModelAPI(stage.GetDefaultPrim()).SetExtentsHint([Gf.Vec3f(0), Gf.Vec3f(1)])


def no_hint(stage: Usd.Stage) -> None:
    UsdGeom.ModelAPI(stage.GetDefaultPrim()).GetExtentsHintAttr().Block()


def two_rates(stage: Usd.Stage) -> None:
    stage.SetFramesPerSecond(24)


def backwards(stage: Usd.Stage) -> None:
    stage.SetEndTimeCode(-1)


def no_default_prim(stage: Usd.Stage) -> None:
    stage.ClearDefaultPrim()


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (heavy_weight, "do not sum to 1"),
        (joint_out_of_range, "joint index out of range"),
        (point_not_a_number, "points are not finite"),
        (face_out_of_range, "face index out of range"),
        (centimetres, "metersPerUnit is 0.01"),
        (giant, "not a person's size"),
        (no_extent, "extent does not contain the points"),
        (uv_outside, "outside [0, 1]"),
        (uvs_missing, "texture coordinates for"),
        (dotted_joint, "joint names are not identifiers"),
        (stretched_quaternion, "quaternions are not finite or not of unit length"),
        (joint_without_transform, "does not have one transform per joint"),
        (sheared_bind, "bindTransforms are no rotations"),
        (rest_elsewhere, "restTransforms do not compose to bindTransforms"),
        (no_ground_root, "no root on the ground with a pelvis below it"),
        (nameless_rest_pose, "does not name its rest pose"),
        (floating, "its lowest point at rest is at height 0.3 m"),
        (one_eye, "skin follows one eye and not the other"),
        (one_eye, "eye_L does not turn about the middle of its ball"),
        (short_shape, "corrective_01: offsets are not finite or not one a point"),
        (shape_without_target, "1 blend shapes but 4 targets"),
        (shape_of_no_point, "frown: point index out of range"),
        (short_expression, "frown: offsets are not finite or not one a point"),
        (negative_weight, "blend shape weights are not one a shape from 0 to 1 at time 5"),
        (no_colours, "1 display colours for its points"),
        (no_material, "/Avatar/Body/Surface: no material is bound"),
        (no_kind, "kind is assembly, not component"),
        (no_identifier, "assetInfo has no identifier"),
        (small_hint, "extentsHint does not contain /Avatar/Body at time"),
        (no_hint, "has no extentsHint"),
        (two_rates, "timeCodesPerSecond and framesPerSecond differ"),
        (backwards, "ends before it starts"),
        (no_default_prim, "has no default prim"),
    ],
)
def test_each_defect_is_named(stage: Usd.Stage, damage: Callable[[Usd.Stage], None], message: str) -> None:
    assert data_defects(stage) == []
    of_root_layer = (centimetres, two_rates, backwards, no_default_prim, no_identifier)
    stage.SetEditTarget(stage.GetRootLayer() if damage in of_root_layer else stage.GetSessionLayer())
    damage(stage)
    assert message in "; ".join(data_defects(stage))


def test_eyes_turn_about_the_middle_of_their_balls(stage: Usd.Stage) -> None:
    """What follows the upper joint is 36 cm wide: its joint may be 10 % of 18 cm off the middle."""
    stage.SetEditTarget(stage.GetSessionLayer())
    binding = UsdSkel.BindingAPI(mesh(stage))
    joints, weights = (np.array(a.Get()) for a in (binding.GetJointIndicesPrimvar(), binding.GetJointWeightsPrimvar()))
    on_eye = ((joints == 2) & (weights > 0)).reshape(len(mesh(stage).GetPointsAttr().Get()), -1).any(1)
    ball = np.array(mesh(stage).GetPointsAttr().Get())[on_eye]
    one_eye(stage)
    for off_m, wrong in ((0.017, False), (0.019, True)):
        middle = (ball.min(0) + ball.max(0)) / 2 + (off_m, 0, 0)
        change(skeleton(stage).GetBindTransformsAttr(), 2, Gf.Matrix4d().SetTranslate(Gf.Vec3d(*middle.tolist())))
        assert ("does not turn about" in "; ".join(data_defects(stage))) is wrong


def test_an_albedo_needs_its_light(stage: Usd.Stage) -> None:
    stage.SetEditTarget(stage.GetSessionLayer())
    stage.GetDefaultPrim().GetVariantSet("look").SetVariantSelection("albedo")
    assert data_defects(stage) == []
    UsdLux.DomeLight(stage.GetPrimAtPath("/Avatar/Light")).GetTextureFileAttr().Block()
    assert data_defects(stage) == ["/Avatar: the albedo has no light with a picture"]


def test_a_game_rig_has_few_influences(stage: Usd.Stage) -> None:
    stage.SetEditTarget(stage.GetSessionLayer())
    stage.GetDefaultPrim().GetVariantSet("rig").SetVariantSelection("game")
    assert data_defects(stage) == []
    binding, points = UsdSkel.BindingAPI(mesh(stage)), len(mesh(stage).GetPointsAttr().Get())
    binding.CreateJointIndicesPrimvar(False, 5).Set([0, 1, 2, 2, 2] * points)
    binding.CreateJointWeightsPrimvar(False, 5).Set([0.2] * 5 * points)
    assert "5 influences; the game rig has at most 4" in "; ".join(data_defects(stage))


@pytest.mark.parametrize(
    ("lod", "shape", "allowed_m"), [("lod0", "captured", 0.001), ("lod1", "captured", 0.01), ("lod0", "stout", 0.01)]
)
def test_less_detail_and_other_shapes_may_stand_a_centimetre_off_the_ground(
    stage: Usd.Stage, lod: str, shape: str, allowed_m: float
) -> None:
    stage.SetEditTarget(stage.GetSessionLayer())
    stage.GetDefaultPrim().GetVariantSet("lod").SetVariantSelection(lod)
    stage.GetDefaultPrim().GetVariantSet("shape").SetVariantSelection(shape)
    (shown,) = (UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh))
    points_m = np.array(shown.GetPointsAttr().Get())
    shown.GetExtentAttr().Set(Vt.Vec3fArray([Gf.Vec3f(-3), Gf.Vec3f(3)]))
    for height_m, off in ((0.9 * allowed_m, False), (1.1 * allowed_m, True)):
        raised_m = points_m - [0, points_m[:, 1].min() - height_m, 0]
        shown.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(raised_m.astype(np.float32)))
        assert ("not on the ground" in "; ".join(data_defects(stage))) is off


def test_a_motion_at_another_rate_is_at_its_whole_frames(stage: Usd.Stage) -> None:
    stage.SetEditTarget(stage.GetSessionLayer())
    stage.GetDefaultPrim().GetVariantSet("motion").SetVariantSelection("captured_24")
    assert data_defects(stage) == []
    stage.SetEditTarget(stage.GetRootLayer())
    stage.SetTimeCodesPerSecond(12.5)
    stage.SetFramesPerSecond(12.5)
    assert "Motion/full: is not sampled at every frame of 24 a second" in "; ".join(data_defects(stage))


def test_other_shapes_are_checked_in_the_motion_that_the_file_selects() -> None:
    """USD sorts names: a motion of Ben's comes before the captured one. Of two by two combinations, that of his motion
    and the stout shape differs twice."""
    stage = Usd.Stage.CreateInMemory()
    stage.SetDefaultPrim(stage.DefinePrim("/Avatar"))
    for name, variants in {"shape": ("captured", "stout"), "motion": ("captured", "ben")}.items():
        added = stage.GetDefaultPrim().GetVariantSets().AddVariantSet(name)
        for variant in variants:
            added.AddVariant(variant)
        added.SetVariantSelection("captured")
    assert list(each_variant(stage)) == [
        "shape=captured motion=ben: ", "shape=captured motion=captured: ", "shape=stout motion=captured: ",
    ]  # fmt: skip


def test_what_we_write_passes_every_validator(package: Path) -> None:
    for name in ("avatar.usdz", "avatar.usda", "avatar_24.usda"):
        report = validate_package(package / name)
        assert (report["variants"], report["warnings"]) == (20, [])
        assert report["validators"] >= 30


def test_both_topologies_pass_every_validator_and_a_defect_of_one_says_of_which(
    staged: StagedAvatar, captured: StagedAvatar, tmp_path: Path
) -> None:
    write_package(tmp_path, {"registered": staged, "captured": captured}, [side_camera()], 10.0, INFO)
    write_usdz(tmp_path / "avatar.usdz", {"registered": staged, "captured": captured}, [side_camera()], 10.0, INFO)
    for name in ("avatar.usdz", "avatar.usda", "avatar_24.usda"):
        report = validate_package(tmp_path / name)
        assert (report["variants"], report["warnings"]) == (20 + 12, [])
    shape = Usd.Stage.Open(str(tmp_path / "avatar/captured_shape_captured.usdc"))
    change(UsdGeom.Mesh(shape.GetPrimAtPath(f"{BODY}/Surface")).GetPointsAttr(), 0, Gf.Vec3f(np.nan))
    shape.GetRootLayer().Save()
    with pytest.raises(
        InvalidAsset, match=r"avatar\.usda: topology=captured shape=captured lod=lod0 .* not finite"
    ) as e:
        validate_package(tmp_path / "avatar.usda")
    assert "topology=registered" not in str(e.value)


def test_a_defect_in_one_variant_says_in_which(package: Path, tmp_path: Path) -> None:
    shutil.copytree(package, tmp_path / "copy")
    motion = Usd.Stage.Open(str(tmp_path / "copy/avatar/motion_captured_30.usdc"))
    UsdSkel.Animation(motion.GetPrimAtPath(f"{BODY}/Motion/game")).GetBlendShapeWeightsAttr().Set([2.0] * 3, 9.0)
    motion.GetRootLayer().Save()
    with pytest.raises(
        InvalidAsset,
        match=r"usda: shape=captured lod=lod0 look=albedo rig=full motion=captured_30: /Avatar/Body/Motion/game: blend",
    ):
        validate_package(tmp_path / "copy/avatar.usda")


def test_an_error_of_usd_itself_raises(package: Path, tmp_path: Path) -> None:
    """Give a loose layer without its texture beside it."""
    whole = Usd.Stage.Open(str(package / "avatar.usdz"))
    whole.GetRootLayer().Export(str(tmp_path / "loose.usdc"))
    with pytest.raises(InvalidAsset, match=r"loose\.usdc"):
        validate_package(tmp_path / "loose.usdc")
