import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdSkel
from threadpoolctl import threadpool_info, threadpool_limits
from torch import Tensor

from hnerf.asset.export import _clothed_surface, _rest_meshes, export_asset
from hnerf.asset.pictures import turntable_cameras
from hnerf.body.base_mesh import base_mesh
from hnerf.body.rig import pose_vertices
from hnerf.capture.masks import Masks
from hnerf.config import AssetSettings, overridden
from hnerf.errors import InputError, InvalidAsset
from hnerf.render.motion import Motion, select_poses
from tests.asset.figure import bending_body, capture, column_rig
from tests.asset.stand_in import StandInAvatar
from tests.asset.test_baking import Pictured

SMALL = AssetSettings(
    grid_cells=96,
    topology="registered",  # the figure's mesh is too coarse to follow its surface in every test
    faces=2000,
    level_faces=(500,),
    texture_px=128,
    photograph_frames=0,
    normal_map_px=64,
    correctives=2,
)

TINY = SMALL.model_copy(update={"grid_cells": 32, "texture_px": 32, "faces": 500, "correctives": 0})


class Swelling(StandInAvatar):
    """An avatar whose clothes stand 2, 4, 6 and 12 mm farther out in frames 3, 4, 5 and 8 than without frames, because
    the upper bone bends by 0.1 rad a frame."""

    def without_frames(self) -> StandInAvatar:
        return StandInAvatar(self.body)

    def signed_distance(self, points_m: Tensor, theta: Tensor, root: Tensor) -> Tensor:
        return super().signed_distance(points_m, theta, root) - 0.02 * (theta[1, 0] - 0.2)


def test_the_mesh_has_the_mean_displacement_of_training_frames() -> None:
    """The mean over training frames 3 to 5 is 4 mm. It leaves -2, 0 and 2 mm, and 8 mm in the novel pose of frame 8."""
    mesh = _rest_meshes(StandInAvatar(bending_body()), SMALL, {}).by_topology["captured"]
    found = _clothed_surface(capture(), Swelling(bending_body()), mesh, SMALL)
    still = _clothed_surface(capture(), StandInAvatar(bending_body()), mesh, SMALL)
    rest_m, still_m = found.mesh.rig.vertices_m.numpy(), still.mesh.rig.vertices_m.numpy()
    sides = (np.abs(rest_m[:, 2] - 0.8) > 0.35) & (rest_m[:, 2] > 0.1) & (rest_m[:, 2] < 1.5)
    radius_m = np.linalg.norm(rest_m[sides, :2], axis=1)
    moved_m = radius_m - np.linalg.norm(still_m[sides, :2], axis=1)
    assert np.median(moved_m) == pytest.approx(0.004, abs=0.0002)
    outwards_m = (found.displacements_m[:, sides, :2] * rest_m[sides, :2]).sum(-1) / radius_m
    np.testing.assert_allclose(np.median(outwards_m, 1), [-0.002, 0, 0.002, 0.008], atol=0.0002)
    rig = dataclasses.replace(found.body.rig, vertices_m=found.body.rig.vertices_m + found.displacements_m[2])
    last_m = pose_vertices(rig, found.body.theta[2], found.body.root[2])
    np.testing.assert_allclose(last_m, found.surfaces_m[2], atol=1e-5)


FILES = {"avatar.usda", "avatar_24.usda", "avatar_30.usda", "avatar.usdz", "avatar_cache.usdz", "avatar.glb"}
FILES |= {"avatar_game.glb", "avatar.bvh", "avatar.trc", "filled.png", "avatar/texture.png", "avatar/normal_map.png"}
FILES |= {f"avatar/{name}.usdc" for name in ("look_captured", "cameras", "rig_full", "rig_game")}
FILES |= {"avatar/geometry_lod0.usdc", "avatar/geometry_lod1.usdc", "avatar/shape_stout.usdc"}
FILES |= {"avatar/shape_captured.usdc", "avatar_materialx.usda", "avatar/materialx_captured.usdc"}
FILES |= {f"avatar/motion_{name}.usdc" for name in ("captured", "captured_24", "captured_30", "nod")}


@pytest.mark.usefixtures("small_report")
def test_export_writes_every_file_and_reports_their_contents(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frown_m = np.full((len(column_rig().vertices_m), 3), 0.01, np.float32)
    stout_m = frown_m * np.float32([1, 1, 0])  # no vertical part, so the soles stay on the ground
    frowning = dataclasses.replace(
        base_mesh(column_rig()), face_units_m={"frown": frown_m}, physiques_m={"stout": stout_m}
    )
    monkeypatch.setattr("hnerf.asset.topologies.base_mesh", lambda rig: frowning)
    monkeypatch.setattr("hnerf.asset.extreme_poses.EXPRESSIONS", {"Frown": ("frown",)})
    shown_from: list[np.ndarray] = []
    monkeypatch.setattr(
        "hnerf.asset.report.turntable_cameras",
        lambda points_m, facing, count: shown_from.append(facing) or turntable_cameras(points_m, facing, count),
    )
    nod = Motion(select_poses(bending_body(), (4, 5)), 25.0, "z")
    report = export_asset(
        capture(), Masks({}, {}), StandInAvatar(bending_body()), SMALL, tmp_path, "0123", {"nod": nod}
    )
    assert json.loads((tmp_path / "report.json").read_text()) == report
    assert set(report["bytes"]) == FILES
    assert report["viewer"].startswith("no viewer.html: ") and report["viewer"].endswith("; run `hnerf models`")
    page = (tmp_path / "report.html").read_text()
    # In frame 3 the body, which faces -Y, is turned by 2.4 rad about Z: to (sin, -cos, 0), in the stage (sin, 0, cos).
    np.testing.assert_allclose(shown_from[0], [np.sin(2.4), 0, np.cos(2.4)], atol=1e-6)
    assert report["viewer"] in page and 'href="viewer.html"' not in page
    assert page.count("<img") == 1 + 2 + 7 + 2 + 2 + 3  # turning, stills, surface, an expression, a physique, texture
    assert report["expressions"] == ["frown"] and report["physiques"] == ["stout"]
    assert report["mesh"]["watertight"] and report["mesh"]["faces"] <= 2000
    assert report["mesh"]["height_m"] == pytest.approx(1.62, abs=0.005)
    assert [report["levels"][lod]["triangles"] for lod in ("lod0", "lod1")] == [report["mesh"]["faces"], 500]
    assert report["light"] is None and report["filled_share"] == 1  # no light without photographs
    assert (report["texture_px"], report["source_pixel_mm"]) == (128, None)
    assert (report["frames"], report["joints"], report["cameras"]) == (4, 3, 1)
    assert report["rigs"]["game"]["influences"] == 2 and report["rigs"]["game"]["moved_max_mm"] < 0.01
    assert report["motions"]["nod"] == {"fps": 25.0, "poses": 2}
    assert report["motions"]["captured_30"] == {"fps": 30, "poses": 16}
    for name in ("avatar.usdz", "avatar.usda", "avatar_materialx.usda"):
        assert (report["validation"][name]["variants"], report["validation"][name]["warnings"]) == (12, [])
    assert report["against_field"]["images"] == 0 and list(report["crossing_share"]) == ["Frown", "Stout"]
    assert "Extreme poses" in page and "Asset and field" not in page
    stage = Usd.Stage.Open(str(tmp_path / "avatar.usda"))
    info = stage.GetDefaultPrim().GetAssetInfo()
    assert info["captureDigest"] == "0123" and info["settings"]["grid_cells"] == SMALL.grid_cells
    assert not {"version", "licence"} & set(info["settings"])
    assert info["figures"]["to_surface_mm"] == report["to_surface_mm"]["registered"]["all"]
    assert info["figures"]["against_field"] == {"images": 0, "reason": "no image has a mask of the person"}


@pytest.mark.usefixtures("small_report")
def test_usd_has_both_meshes_with_topology_both(tmp_path: Path) -> None:
    for topology, splats in (("registered", 0), ("both", 300)):
        (tmp_path / topology).mkdir()
        settings = overridden(TINY, [f"topology={topology}", f"splats={splats}"])
        export_asset(capture(), Masks({}, {}), StandInAvatar(bending_body()), settings, tmp_path / topology)
    one, two = (json.loads((tmp_path / name / "report.json").read_text()) for name in ("registered", "both"))
    assert two["mesh"] == one["mesh"] and "captured" not in one
    faces = two["captured"]["mesh"]["faces"]
    assert two["captured"]["mesh"]["topology"] == "captured" and faces != one["mesh"]["faces"]
    assert {"texture", "comparison"} < set(two["captured"]["seconds"])
    assert two["captured"]["against_field"]["images"] == 0
    assert two["splats"]["count"] == 300 and "splats" not in one | two["captured"]
    added = {"avatar_splats.usdc", "avatar_splats.ply"}
    assert added < set(two["bytes"]) and not added & set(one["bytes"])
    assert two["validation"]["avatar_splats.usdc"]["warnings"] == [] and "avatar_splats.usdc" not in one["validation"]
    for path in ("avatar.glb", "avatar_game.glb", "avatar.bvh", "avatar_cache.usdz"):
        assert (tmp_path / "both" / path).read_bytes() == (tmp_path / "registered" / path).read_bytes(), path
    for name in ("avatar.usda", "avatar_24.usda", "avatar_30.usda", "avatar.usdz"):
        stage = Usd.Stage.Open(str(tmp_path / "both" / name))
        triangles = []
        for topology in ("captured", "registered"):
            stage.GetDefaultPrim().GetVariantSet("topology").SetVariantSelection(topology)
            corners = UsdGeom.Mesh(stage.GetPrimAtPath("/Avatar/Body/Surface")).GetFaceVertexCountsAttr().Get()
            triangles.append(int(np.sum(np.array(corners) - 2)))
        assert triangles == [faces, one["mesh"]["faces"]], name


@pytest.mark.usefixtures("small_report")
@pytest.mark.parametrize(("limit_mm", "chosen"), [(100.0, "registered"), (1e-6, "captured")])
def test_the_captured_mesh_replaces_a_registered_one_that_does_not_follow(
    limit_mm: float, chosen: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("hnerf.asset.regions.LIMIT_MM", limit_mm)
    auto = TINY.model_copy(update={"topology": "auto"})
    report = export_asset(capture(), Masks({}, {}), StandInAvatar(bending_body()), auto, tmp_path)
    assert report["mesh"]["topology"] == chosen
    lines = [r.message.removeprefix("column: ") for r in caplog.records if "the registered mesh" in r.message]
    assert lines == report["findings"] and bool(lines) == (chosen == "captured")
    assert all(line.endswith("The asset has the captured mesh") for line in lines)


@pytest.mark.usefixtures("small_report")
def test_the_photographs_decide_on_the_size_of_the_texture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The column's front is 4.85 m from a camera of 500 px: a pixel is 9.7 mm wide. Its surface of 1.6 m² fills about
    half of the texture: half a pixel is a 370th of the texture's width."""
    monkeypatch.setattr("hnerf.asset.texture_size.SMALLEST_PX", 64)
    photographs = dict.fromkeys(range(10), np.zeros((480, 640, 3), np.uint8))
    settings = TINY.model_copy(update={"texture_px": None, "photograph_frames": 2, "topology": "both"})
    recorded = Pictured(**vars(capture()), pictures=photographs)
    with caplog.at_level("INFO"):
        report = export_asset(recorded, Masks({}, {}), StandInAvatar(bending_body()), settings, tmp_path)
    for figures in (report, report["captured"]):
        assert figures["texture_px"] in (256, 512)
        assert figures["source_pixel_mm"] == pytest.approx(9.7, abs=0.1)
        assert figures["texel_mm"] == pytest.approx(1e3 * np.sqrt(1.6 / 0.5) / figures["texture_px"], rel=0.2)
    line = "column: texture of {} px, {:.2g} mm a texel; photographs have pixels down to 9.7 mm"
    assert line.format(report["texture_px"], report["texel_mm"]) in [record.message for record in caplog.records]
    stage = Usd.Stage.Open(str(tmp_path / "avatar.usda"))
    assert stage.GetDefaultPrim().GetAssetInfo()["settings"]["texture_px"] == report["texture_px"]


@pytest.mark.usefixtures("small_report")
def test_files_at_other_rates_are_left_out_if_poses_are_far_apart(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """At one frame a second, the four poses take 5 s."""
    slow, tiny = dataclasses.replace(capture(), fps=1.0), TINY.model_copy(update={"topology": "both"})
    report = export_asset(slow, Masks({}, {}), StandInAvatar(bending_body()), tiny, tmp_path)
    assert list(report["motions"]) == ["captured"]
    assert not {"avatar_24.usda", "avatar_30.usda", "avatar.bvh", "avatar.trc"} & set(report["bytes"])
    assert set(report["validation"]) == {"avatar.usda", "avatar_materialx.usda", "avatar.usdz", "avatar_cache.usdz"}
    assert [r.message for r in caplog.records if "avatar.bvh" in r.message] == [
        "column: no avatar_24.usda, avatar_30.usda, avatar.bvh and avatar.trc: the captured poses are too far apart to "
        "be interpolated; raise capture.max_frames or, if capture.toml lists frames, list more"
    ]


@pytest.mark.usefixtures("small_report")
def test_joints_are_named_as_set(tmp_path: Path) -> None:
    settings = TINY.model_copy(update={"joint_names": "humanik"})
    export_asset(capture(), Masks({}, {}), StandInAvatar(bending_body()), settings, tmp_path)
    stage = Usd.Stage.Open(str(tmp_path / "avatar.usdz"))
    skeleton = stage.GetPrimAtPath("/Avatar/Body/Skeleton")
    assert list(UsdSkel.Skeleton(skeleton).GetJointNamesAttr().Get()) == ["Reference", "Hips", "upper_L"]


def test_a_motion_that_lacks_a_joint_is_refused_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hnerf.asset.export._rest_meshes", lambda *_: pytest.fail("a surface was extracted"))
    body = bending_body()
    names = tuple(f"other {name}" for name in body.rig.joint_names)
    strange = Motion(dataclasses.replace(body, rig=dataclasses.replace(body.rig, joint_names=names)), 25.0, "z")
    with pytest.raises(InputError, match="motion nod: has no joint"):
        export_asset(capture(), Masks({}, {}), StandInAvatar(body), SMALL, tmp_path, "", {"nod": strange})


def test_nothing_is_written_if_the_asset_is_far_below_its_field(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    poor = {"images": 2, "cameras": "training", "asset": {"psnr": 20.0}, "field": {"psnr": 30.0}}
    monkeypatch.setattr("hnerf.asset.export.comparison_figures", lambda compared: poor)
    with pytest.raises(InvalidAsset, match=r"registered mesh is below its field: .* 10\.0 dB"):
        export_asset(capture(), Masks({}, {}), StandInAvatar(bending_body()), TINY, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_export_uses_one_blas_thread_so_results_do_not_depend_on_the_count(monkeypatch: pytest.MonkeyPatch) -> None:
    found: list[int] = []

    def stop(*_: object) -> None:
        found.extend(library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas")
        raise InvalidAsset("stopped")

    monkeypatch.setattr("hnerf.asset.export._rest_meshes", stop)
    with threadpool_limits(2, "blas"), pytest.raises(InvalidAsset):
        export_asset(capture(), Masks({}, {}), StandInAvatar(bending_body()), SMALL, Path("unused"))
    assert found and set(found) == {1}
