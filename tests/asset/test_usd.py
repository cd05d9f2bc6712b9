import dataclasses
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, Vt

from hnerf.asset.staging import StagedAvatar, stage_from_world
from hnerf.asset.usd import define_camera, write_cache, write_skinned
from tests.asset.figure import FRAMES, side_camera


def test_camera_numbers() -> None:
    stage = Usd.Stage.CreateInMemory()
    camera = define_camera(stage, Sdf.Path("/Camera"), side_camera(), stage_from_world("z"))
    # fx = 500 px of 640 across a gate of 0.36: 0.28125. H / fy x focal = 480 / 400 x 0.28125 = 0.3375.
    assert camera.GetHorizontalApertureAttr().Get() == pytest.approx(0.36)
    assert camera.GetFocalLengthAttr().Get() == pytest.approx(0.28125)
    assert camera.GetVerticalApertureAttr().Get() == pytest.approx(0.3375)
    # 0.36 (1/2 - 300.5 / 640) and 0.3375 (200.5 / 480 - 1/2)
    assert camera.GetHorizontalApertureOffsetAttr().Get() == pytest.approx(0.01096875)
    assert camera.GetVerticalApertureOffsetAttr().Get() == pytest.approx(-0.0277734375)
    pose = np.array(UsdGeom.Xformable(camera).GetLocalTransformation())
    # It stands at world (0, -3, 1) = stage (0, 1, 3) and looks along world +y = stage -z: USD's own camera axes.
    np.testing.assert_allclose(pose, [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 1, 3, 1]], atol=1e-12)


def test_camera_projects_where_ours_does() -> None:
    ours, world = side_camera(), np.array([0.4, 0.7, 1.3])
    stage = Usd.Stage.CreateInMemory()
    frustum = define_camera(stage, Sdf.Path("/Camera"), ours, stage_from_world("z")).GetCamera().frustum
    ndc = (frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()).Transform(
        Gf.Vec3d(*(stage_from_world("z") @ world).tolist())
    )
    pixel = np.array([(ndc[0] + 1) / 2 * 640 - 0.5, (1 - ndc[1]) / 2 * 480 - 0.5])
    np.testing.assert_allclose(pixel, ours.project(world)[0], atol=1e-4)


def with_shapes(mesh: UsdGeom.Mesh, motion: UsdSkel.AnimQuery, frame: int) -> np.ndarray:
    """Return the points of a mesh at rest with its blend shapes, by the weights of the motion."""
    weights = dict(zip(motion.GetBlendShapeOrder(), motion.ComputeBlendShapeWeights(frame), strict=True))
    binding = UsdSkel.BindingAPI(mesh.GetPrim())
    points = np.array(mesh.GetPointsAttr().Get())
    targets = binding.GetBlendShapeTargetsRel().GetTargets()
    for name, path in zip(binding.GetBlendShapesAttr().Get(), targets, strict=True):
        shape = UsdSkel.BlendShape(mesh.GetPrim().GetStage().GetPrimAtPath(path))
        points += weights[name] * np.array(shape.GetOffsetsAttr().Get())
    return points


def test_usd_skins_as_we_do(staged: StagedAvatar, tmp_path: Path) -> None:
    write_skinned(tmp_path / "avatar.usdz", staged, [side_camera()], 10.0)
    stage = Usd.Stage.Open(str(tmp_path / "avatar.usdz"))
    root = UsdSkel.Root(stage.GetPrimAtPath("/Avatar/Body"))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/Avatar/Body/Surface"))
    cache = UsdSkel.Cache()
    cache.Populate(root, Usd.PrimDefaultPredicate)
    skinning = cache.GetSkinningQuery(mesh.GetPrim())
    skeleton = cache.GetSkelQuery(UsdSkel.Skeleton(stage.GetPrimAtPath("/Avatar/Body/Skeleton")))
    assert skeleton.GetAnimQuery().GetJointTransformTimeSamples() == list(FRAMES)
    for frame, expected in zip(FRAMES, staged.points_m, strict=True):
        points = Vt.Vec3fArray.FromNumpy(with_shapes(mesh, skeleton.GetAnimQuery(), frame))
        assert skinning.ComputeSkinnedPoints(skeleton.ComputeSkinningTransforms(frame), points, frame)
        np.testing.assert_allclose(np.array(points), expected, atol=1e-5)
        extent = np.array(root.GetExtentAttr().Get(frame))
        np.testing.assert_allclose(extent, [expected.min(0), expected.max(0)], atol=1e-5)


def test_stage_says_its_units_time_and_names(staged: StagedAvatar, tmp_path: Path) -> None:
    cameras = [dataclasses.replace(side_camera(), name=name) for name in ("cam 1", "cam.1", "01")]
    write_skinned(tmp_path / "avatar.usdz", staged, cameras, 12.5)
    stage = Usd.Stage.Open(str(tmp_path / "avatar.usdz"))
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Y", 1.0)
    assert (stage.GetTimeCodesPerSecond(), stage.GetFramesPerSecond()) == (12.5, 12.5)
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (3.0, 8.0)
    prims = stage.GetPrimAtPath("/Avatar/Cameras").GetChildren()
    assert [p.GetName() for p in prims] == ["cam_1", "cam_1_", "_01"]
    assert [p.GetDisplayName() for p in prims] == ["cam 1", "cam.1", "01"]
    skeleton = UsdSkel.Skeleton(stage.GetPrimAtPath("/Avatar/Body/Skeleton"))
    assert list(skeleton.GetJointsAttr().Get()) == ["root", "root/upper_L"]
    assert list(skeleton.GetJointNamesAttr().Get()) == ["root", "upper.L"]


def test_cache_holds_the_posed_points(staged: StagedAvatar, tmp_path: Path) -> None:
    write_cache(tmp_path / "avatar_cache.usdz", staged, [], 10.0)
    stage = Usd.Stage.Open(str(tmp_path / "avatar_cache.usdz"))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/Avatar/Surface"))
    assert mesh.GetPointsAttr().GetTimeSamples() == list(FRAMES)
    np.testing.assert_array_equal(np.array(mesh.GetPointsAttr().Get(8)), staged.points_m[3])
    assert len(mesh.GetFaceVertexIndicesAttr().GetTimeSamples()) == 0
