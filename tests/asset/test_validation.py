import shutil
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdShade, UsdSkel, Vt

from hnerf.asset.validation import data_defects, each_variant, validate_package
from hnerf.errors import InvalidAsset

BODY = "/Avatar/Body"


@pytest.fixture
def stage(package: Path) -> Usd.Stage:
    """Return a stage whose session layer, and whose root layer's metadata, a test can damage."""
    layer = Sdf.Layer.CreateAnonymous()
    layer.TransferContent(Sdf.Layer.FindOrOpen(str(package / "avatar.usdz")))
    opened = Usd.Stage.Open(layer)
    opened.SetEditTarget(opened.GetSessionLayer())
    return opened


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


def points(stage: Usd.Stage) -> Usd.Attribute:
    return mesh(stage).GetPointsAttr()


def shape(stage: Usd.Stage, name: str) -> UsdSkel.BlendShape:
    return UsdSkel.BlendShape(stage.GetPrimAtPath(f"{BODY}/Surface/{name}"))


def joints(stage: Usd.Stage, *names: str) -> None:
    skeleton(stage).GetJointsAttr().Set(names)


def turned(stage: Usd.Stage, *quaternions: Gf.Quatf) -> None:
    motion(stage).GetRotationsAttr().Set(Vt.QuatfArray(quaternions), 5.0)


def giant(stage: Usd.Stage) -> None:
    points(stage).Set(Vt.Vec3fArray.FromNumpy(np.array(points(stage).Get()) * 100))


def uvs(stage: Usd.Stage) -> UsdGeom.Primvar:
    return UsdGeom.PrimvarsAPI(mesh(stage)).GetPrimvar("st")


def shorten(attribute: Usd.Attribute) -> None:
    attribute.Set(attribute.Get()[:-1])


def floating(stage: Usd.Stage) -> None:
    for attribute in (points(stage), mesh(stage).GetExtentAttr()):
        raised = np.array(attribute.Get()) + np.array([0, 0.3, 0])
        attribute.Set(Vt.Vec3fArray.FromNumpy(raised.astype(np.float32)))


def one_eye(stage: Usd.Stage) -> None:
    joints(stage, "root", "root/pelvis", "root/pelvis/eye_L")


def small_hint(stage: Usd.Stage) -> None:
    UsdGeom.ModelAPI(stage.GetDefaultPrim()).SetExtentsHint([Gf.Vec3f(0), Gf.Vec3f(1)])


# Functions that damage a stage of three joints, by the message that reports the defect.
DAMAGE = {
    "do not sum to 1": lambda s: change(UsdSkel.BindingAPI(mesh(s)).GetJointWeightsAttr(), 0, 0.3),
    "joint index out of range": lambda s: change(UsdSkel.BindingAPI(mesh(s)).GetJointIndicesAttr(), 0, 3),
    "points are not finite": lambda s: change(points(s), 5, Gf.Vec3f(np.nan, 0, 0)),
    "face index out of range": lambda s: change(mesh(s).GetFaceVertexIndicesAttr(), 0, len(points(s).Get())),
    "not a person's size": giant,
    "extent does not contain the points": lambda s: mesh(s).GetExtentAttr().Set([Gf.Vec3f(0), Gf.Vec3f(0)]),
    "face corners but": lambda s: shorten(mesh(s).GetFaceVertexIndicesAttr()),
    "has no mesh and no splats": lambda s: mesh(s).GetPrim().SetActive(False),
    "outside [0, 1]": lambda s: change(uvs(s).GetAttr(), 0, Gf.Vec2f(1.5, 0)),
    "texture coordinates for": lambda s: shorten(uvs(s).GetIndicesAttr()),
    "texture coordinate index out of range": lambda s: change(uvs(s).GetIndicesAttr(), 0, 10**6),
    "no face-varying texture coordinates": lambda s: uvs(s).SetInterpolation(UsdGeom.Tokens.vertex),
    "bound to no skeleton": lambda s: UsdSkel.BindingAPI(mesh(s)).CreateSkeletonRel().SetTargets([]),
    "joint indices and": lambda s: shorten(UsdSkel.BindingAPI(mesh(s)).GetJointWeightsAttr()),
    "joint names are not unique": lambda s: joints(s, "root", "root/pelvis", "root/pelvis"),
    "joint names are not identifiers": lambda s: joints(s, "root", "root/pelvis", "root/pelvis/upper.L"),
    "quaternions are not finite or not of unit length": lambda s: turned(s, *[Gf.Quatf(2, 0, 0, 0)] * 3),
    "does not have one transform per joint": lambda s: turned(s, *[Gf.Quatf(1, 0, 0, 0)] * 2),
    "restTransforms is not finite or does": lambda s: shorten(skeleton(s).GetRestTransformsAttr()),
    "bindTransforms is not finite or does": lambda s: shorten(skeleton(s).GetBindTransformsAttr()),
    "bindTransforms are no rotations": lambda s: change(skeleton(s).GetBindTransformsAttr(), 2, Gf.Matrix4d(2)),
    "restTransforms do not compose to bindTransforms": lambda s: change(
        skeleton(s).GetRestTransformsAttr(), 2, Gf.Matrix4d(1)
    ),
    "no root on the ground with a pelvis below it": lambda s: joints(s, "hips", "hips/spine", "hips/spine/upper_L"),
    "root does not stand below pelvis at rest": lambda s: change(
        skeleton(s).GetBindTransformsAttr(), 1, Gf.Matrix4d().SetTranslate(Gf.Vec3d(0.1, 0, 0))
    ),
    "does not name its rest pose": lambda s: skeleton(s).GetPrim().SetCustomDataByKey("restPose", ""),
    "its lowest point at rest is at height 0.3 m": floating,
    "skin follows one eye and not the other": one_eye,
    "eye_L does not turn about the middle of its ball": one_eye,
    "corrective_01: offsets are not finite or not one a point": lambda s: (
        shape(s, "corrective_01").GetOffsetsAttr().Set([Gf.Vec3f(0)] * 5)
    ),
    "1 blend shapes but 4 targets": lambda s: UsdSkel.BindingAPI(mesh(s)).GetBlendShapesAttr().Set(["smile"]),
    "frown: point index out of range": lambda s: change(
        shape(s, "frown").GetPointIndicesAttr(), 0, len(points(s).Get())
    ),
    "frown: offsets are not finite or not one a point": lambda s: shorten(shape(s, "frown").GetOffsetsAttr()),
    "blend shape weights are not one a shape from 0 to 1 at time 5": lambda s: change(
        motion(s).GetBlendShapeWeightsAttr(), 0, -0.5, 5.0
    ),
    "1 display colours for its points": lambda s: mesh(s).GetDisplayColorAttr().Set([Gf.Vec3f(1)]),
    "/Avatar/Body/Surface: no material is bound": lambda s: UsdShade.MaterialBindingAPI(mesh(s)).UnbindDirectBinding(),
    "kind is assembly, not component": lambda s: Usd.ModelAPI(s.GetDefaultPrim()).SetKind("assembly"),
    "extentsHint does not contain /Avatar/Body at time": small_hint,
    "has no extentsHint": lambda s: UsdGeom.ModelAPI(s.GetDefaultPrim()).GetExtentsHintAttr().Block(),
}
OF_ROOT_LAYER = {  # likewise, for metadata that only the root layer has
    "metersPerUnit is 0.01": lambda s: UsdGeom.SetStageMetersPerUnit(s, 0.01),
    "up axis is Z": lambda s: UsdGeom.SetStageUpAxis(s, UsdGeom.Tokens.z),
    "assetInfo has no identifier": lambda s: s.GetDefaultPrim().ClearAssetInfoByKey("identifier"),
    "timeCodesPerSecond and framesPerSecond differ": lambda s: s.SetFramesPerSecond(24),
    "ends before it starts": lambda s: s.SetEndTimeCode(-1),
    "has no default prim": lambda s: s.ClearDefaultPrim(),
}


@pytest.mark.parametrize("message", [*DAMAGE, *OF_ROOT_LAYER])
def test_each_defect_is_reported(stage: Usd.Stage, message: str) -> None:
    assert data_defects(stage) == []
    if message in OF_ROOT_LAYER:
        stage.SetEditTarget(stage.GetRootLayer())
    (DAMAGE | OF_ROOT_LAYER)[message](stage)
    assert message in "; ".join(data_defects(stage))


def test_an_eye_joint_off_the_centre_of_its_eyeball_is_reported(stage: Usd.Stage) -> None:
    """The vertices that follow the upper joint are 36 cm wide, so the joint may be off their centre by 10 % of 18
    cm."""
    binding = UsdSkel.BindingAPI(mesh(stage))
    bound, weights = (np.array(a.Get()) for a in (binding.GetJointIndicesPrimvar(), binding.GetJointWeightsPrimvar()))
    on_eye = ((bound == 2) & (weights > 0)).reshape(len(points(stage).Get()), -1).any(1)
    ball = np.array(points(stage).Get())[on_eye]
    one_eye(stage)
    for off_m, wrong in ((0.017, False), (0.019, True)):
        middle = (ball.min(0) + ball.max(0)) / 2 + (off_m, 0, 0)
        change(skeleton(stage).GetBindTransformsAttr(), 2, Gf.Matrix4d().SetTranslate(Gf.Vec3d(*middle.tolist())))
        assert ("does not turn about" in "; ".join(data_defects(stage))) is wrong


def test_eyes_are_checked_whatever_their_joints_are_called(stage: Usd.Stage) -> None:
    joints(stage, "root", "root/hips", "root/hips/leftEye")
    own = {"hips": "pelvis", "leftEye": "eye_L"}
    skeleton(stage).GetPrim().SetCustomDataByKey("jointNamesIn", {"own": own})
    defects = "; ".join(data_defects(stage))
    assert "skin follows one eye and not the other" in defects and "eye_L does not turn about" in defects
    assert "no root on the ground" not in defects


def test_a_small_child_may_squat(package: Path) -> None:
    """The cache of a column of 1.7 m, at a quarter of its size, has only posed surfaces, which may have any size."""
    stage = Usd.Stage.Open(str(package / "avatar_cache.usdz"))
    stage.SetEditTarget(stage.GetSessionLayer())
    surface = UsdGeom.Mesh(stage.GetPrimAtPath("/Avatar/Surface"))
    for attribute in (surface.GetPointsAttr(), surface.GetExtentAttr()):
        for time in attribute.GetTimeSamples():
            attribute.Set(Vt.Vec3fArray.FromNumpy(np.array(attribute.Get(time)) / 4), time)
    assert data_defects(stage) == []


def test_an_albedo_without_its_light_is_reported(stage: Usd.Stage) -> None:
    stage.GetDefaultPrim().GetVariantSet("look").SetVariantSelection("albedo")
    assert data_defects(stage) == []
    UsdLux.DomeLight(stage.GetPrimAtPath("/Avatar/Light")).GetTextureFileAttr().Block()
    assert data_defects(stage) == ["/Avatar: the albedo has no light with a picture"]


def test_a_game_rig_with_more_than_4_influences_is_reported(stage: Usd.Stage) -> None:
    stage.GetDefaultPrim().GetVariantSet("rig").SetVariantSelection("game")
    assert data_defects(stage) == []
    binding, count = UsdSkel.BindingAPI(mesh(stage)), len(points(stage).Get())
    binding.CreateJointIndicesPrimvar(False, 5).Set([0, 1, 2, 2, 2] * count)
    binding.CreateJointWeightsPrimvar(False, 5).Set([0.2] * 5 * count)
    assert "5 influences; the game rig has at most 4" in "; ".join(data_defects(stage))


@pytest.mark.parametrize(
    ("lod", "shape", "allowed_m"), [("lod0", "captured", 0.001), ("lod1", "captured", 0.01), ("lod0", "stout", 0.01)]
)
def test_coarse_levels_and_other_shapes_may_be_1_cm_off_the_ground(
    stage: Usd.Stage, lod: str, shape: str, allowed_m: float
) -> None:
    stage.GetDefaultPrim().GetVariantSet("lod").SetVariantSelection(lod)
    stage.GetDefaultPrim().GetVariantSet("shape").SetVariantSelection(shape)
    (shown,) = (UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh))
    points_m = np.array(shown.GetPointsAttr().Get())
    shown.GetExtentAttr().Set(Vt.Vec3fArray([Gf.Vec3f(-3), Gf.Vec3f(3)]))
    for height_m, off in ((0.9 * allowed_m, False), (1.1 * allowed_m, True)):
        raised_m = points_m - [0, points_m[:, 1].min() - height_m, 0]
        shown.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(raised_m.astype(np.float32)))
        assert ("not on the ground" in "; ".join(data_defects(stage))) is off


def test_a_motion_not_sampled_at_its_whole_frames_is_reported(stage: Usd.Stage) -> None:
    stage.GetDefaultPrim().GetVariantSet("motion").SetVariantSelection("captured_24")
    assert data_defects(stage) == []
    stage.SetEditTarget(stage.GetRootLayer())
    stage.SetTimeCodesPerSecond(12.5)
    stage.SetFramesPerSecond(12.5)
    assert "Motion/full: is not sampled at every frame of 24 a second" in "; ".join(data_defects(stage))


def test_other_shapes_are_checked_in_the_motion_that_the_file_selects() -> None:
    """USD sorts names, so Ben's motion comes before the captured one. Of the two by two combinations, Ben's motion with
    the stout shape is skipped because it differs from the default in both."""
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


def test_both_topologies_pass_every_validator_and_a_defect_names_its_topology(both: Path, tmp_path: Path) -> None:
    for name in ("avatar.usdz", "avatar.usda", "avatar_24.usda"):
        report = validate_package(both / name)
        assert (report["variants"], report["warnings"]) == (20 + 12, [])
        assert report["validators"] >= 30
    shutil.copytree(both, tmp_path / "copy")
    shape = Usd.Stage.Open(str(tmp_path / "copy/avatar/captured_shape_captured.usdc"))
    change(UsdGeom.Mesh(shape.GetPrimAtPath(f"{BODY}/Surface")).GetPointsAttr(), 0, Gf.Vec3f(np.nan))
    shape.GetRootLayer().Save()
    with pytest.raises(
        InvalidAsset, match=r"avatar\.usda: topology=captured shape=captured lod=lod0 .* not finite"
    ) as e:
        validate_package(tmp_path / "copy/avatar.usda")
    assert "topology=registered" not in str(e.value)


def test_a_defect_is_reported_with_its_variant(package: Path, tmp_path: Path) -> None:
    shutil.copytree(package, tmp_path / "copy")
    motion = Usd.Stage.Open(str(tmp_path / "copy/avatar/motion_captured_30.usdc"))
    UsdSkel.Animation(motion.GetPrimAtPath(f"{BODY}/Motion/game")).GetBlendShapeWeightsAttr().Set([2.0] * 3, 9.0)
    motion.GetRootLayer().Save()
    with pytest.raises(
        InvalidAsset,
        match=r"usda: shape=captured lod=lod0 look=albedo rig=full motion=captured_30: /Avatar/Body/Motion/game: blend",
    ):
        validate_package(tmp_path / "copy/avatar.usda")


def test_errors_of_usds_own_validators_are_raised(package: Path, tmp_path: Path) -> None:
    """The layer is exported without its texture next to it."""
    whole = Usd.Stage.Open(str(package / "avatar.usdz"))
    whole.GetRootLayer().Export(str(tmp_path / "loose.usdc"))
    with pytest.raises(InvalidAsset, match=r"loose\.usdc"):
        validate_package(tmp_path / "loose.usdc")
