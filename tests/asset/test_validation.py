from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom, UsdSkel, Vt

from hnerf.asset.staging import StagedAvatar
from hnerf.asset.usd import write_cache, write_skinned
from hnerf.asset.validation import data_defects, validate_package
from hnerf.errors import InvalidAsset
from tests.asset.figure import side_camera


@pytest.fixture
def stage(staged: StagedAvatar, tmp_path: Path) -> Usd.Stage:
    write_skinned(tmp_path / "avatar.usdz", staged, [side_camera()], 10.0)
    return Usd.Stage.Open(str(tmp_path / "avatar.usdz"))


def mesh(stage: Usd.Stage) -> UsdGeom.Mesh:
    return UsdGeom.Mesh(stage.GetPrimAtPath("/Avatar/Body/Surface"))


def change(attribute: Usd.Attribute, index: int, value: object) -> None:
    values = attribute.Get()
    values[index] = value
    attribute.Set(values)


def heavy_weight(stage: Usd.Stage) -> None:
    change(UsdSkel.BindingAPI(mesh(stage)).GetJointWeightsAttr(), 0, 0.3)


def joint_out_of_range(stage: Usd.Stage) -> None:
    change(UsdSkel.BindingAPI(mesh(stage)).GetJointIndicesAttr(), 0, 2)  # there are two joints


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
    UsdSkel.Skeleton(stage.GetPrimAtPath("/Avatar/Body/Skeleton")).GetJointsAttr().Set(["root", "root/upper.L"])


def stretched_quaternion(stage: Usd.Stage) -> None:
    rotations = UsdSkel.Animation(stage.GetPrimAtPath("/Avatar/Body/Skeleton/Motion")).GetRotationsAttr()
    rotations.Set(Vt.QuatfArray([Gf.Quatf(2, 0, 0, 0)] * 2), 5.0)


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
    ],
)
def test_each_defect_is_named(stage: Usd.Stage, damage: Callable[[Usd.Stage], None], message: str) -> None:
    assert data_defects(stage) == []
    stage.SetEditTarget(stage.GetSessionLayer() if damage is not centimetres else stage.GetRootLayer())
    damage(stage)
    assert message in "; ".join(data_defects(stage))


def test_what_we_write_passes_every_validator(staged: StagedAvatar, tmp_path: Path) -> None:
    write_skinned(tmp_path / "avatar.usdz", staged, [side_camera()], 10.0)
    write_cache(tmp_path / "avatar_cache.usdz", staged, [side_camera()], 10.0)
    for name in ("avatar.usdz", "avatar_cache.usdz"):
        report = validate_package(tmp_path / name)
        assert report["validators"] >= 30
        assert report["warnings"] == []


def test_an_error_of_usd_itself_raises(stage: Usd.Stage, tmp_path: Path) -> None:
    """Give a loose layer without its texture beside it."""
    stage.GetRootLayer().Export(str(tmp_path / "loose.usdc"))
    with pytest.raises(InvalidAsset, match=r"loose\.usdc"):
        validate_package(tmp_path / "loose.usdc")
