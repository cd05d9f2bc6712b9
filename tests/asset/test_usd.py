import dataclasses

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom

from hnerf.asset.levels import Level
from hnerf.asset.staging import StagedAvatar
from hnerf.asset.texture import UvLayout
from hnerf.asset.usd import define_camera, define_mesh
from hnerf.geometry.axes import y_up_from
from tests.asset.figure import side_camera


def test_usd_camera_parameters_by_hand() -> None:
    stage = Usd.Stage.CreateInMemory()
    camera = define_camera(stage, Sdf.Path("/Camera"), side_camera(), y_up_from("z"))
    # fx = 500 px of 640 across a gate of 0.36: 0.28125. H / fy x focal = 480 / 400 x 0.28125 = 0.3375.
    assert camera.GetHorizontalApertureAttr().Get() == pytest.approx(0.36)
    assert camera.GetFocalLengthAttr().Get() == pytest.approx(0.28125)
    assert camera.GetVerticalApertureAttr().Get() == pytest.approx(0.3375)
    # 0.36 (1/2 - 300.5 / 640) and 0.3375 (200.5 / 480 - 1/2)
    assert camera.GetHorizontalApertureOffsetAttr().Get() == pytest.approx(0.01096875)
    assert camera.GetVerticalApertureOffsetAttr().Get() == pytest.approx(-0.0277734375)
    assert [camera.GetPrim().GetCustomDataByKey(side) for side in ("imageWidth", "imageHeight")] == [640, 480]
    pose = np.array(UsdGeom.Xformable(camera).GetLocalTransformation())
    # It stands at world (0, -3, 1) = stage (0, 1, 3) and looks along world +y = stage -z: USD's own camera axes.
    np.testing.assert_allclose(pose, [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 1, 3, 1]], atol=1e-12)


def test_usd_camera_projects_like_ours() -> None:
    ours, world = side_camera(), np.array([0.4, 0.7, 1.3])
    stage = Usd.Stage.CreateInMemory()
    frustum = define_camera(stage, Sdf.Path("/Camera"), ours, y_up_from("z")).GetCamera().frustum
    ndc = (frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()).Transform(
        Gf.Vec3d(*(y_up_from("z") @ world).tolist())
    )
    pixel = np.array([(ndc[0] + 1) / 2 * 640 - 0.5, (1 - ndc[1]) / 2 * 480 - 0.5])
    np.testing.assert_allclose(pixel, ours.project(world)[0], atol=1e-4)


def test_a_texture_seam_on_the_diagonal_prevents_a_quad(staged: StagedAvatar) -> None:
    """A polygon has one texture coordinate per corner, so across the seam it would show the texture between two
    charts."""
    faces = np.array([[0, 1, 2], [2, 1, 3]])
    uvs = np.random.default_rng(0).random((6, 2)).astype(np.float32)
    for face_uvs, count in ((faces, 4), (np.arange(6).reshape(2, 3), 3)):
        level = Level(np.arange(4), faces, UvLayout(uvs, face_uvs))
        stage, avatar = Usd.Stage.CreateInMemory(), dataclasses.replace(staged, levels=[level])
        mesh = define_mesh(stage, Sdf.Path("/Mesh"), avatar, level=0)
        counts, corners = mesh.GetFaceVertexCountsAttr().Get(), mesh.GetFaceVertexIndicesAttr().Get()
        assert set(counts) == {count} and len(counts) == (1 if count == 4 else 2)
        st = np.array(UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").ComputeFlattened())
        own = {(v, *uvs[row]) for v, row in zip(faces.ravel(), face_uvs.ravel(), strict=True)}
        assert {(v, *at) for v, at in zip(corners, st, strict=True)} == own
