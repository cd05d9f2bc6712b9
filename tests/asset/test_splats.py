import dataclasses
from pathlib import Path

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom, UsdVol, Vt
from scipy.spatial.transform import Rotation

from hnerf.asset.figures import splat_figures
from hnerf.asset.package import write_splats
from hnerf.asset.rigs import FULL, GAME
from hnerf.asset.skinning import Skin, skinned
from hnerf.asset.splat_ply import write_splat_ply
from hnerf.asset.splats import OPACITY, SPREAD, Splats, evenly_on_faces, surface_splats, turned_to
from hnerf.asset.staging import CAPTURED, StagedAvatar
from hnerf.asset.validation import data_defects, validate_package
from hnerf.body.descriptor import normals_of
from tests.asset.figure import INFO

COUNT = 500
SPLATS = "/Avatar/Splats"


@pytest.fixture(scope="module")
def splats(staged: StagedAvatar) -> Splats:
    return surface_splats(staged, COUNT)


@pytest.fixture(scope="module")
def layer(staged: StagedAvatar, splats: Splats, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("splats") / "avatar_splats.usdc"
    write_splats(path, staged, splats, 10.0, INFO)
    return path


def read_ply(path: Path) -> dict[str, np.ndarray]:
    header, _, body = path.read_bytes().partition(b"end_header\n")
    lines = header.decode().splitlines()
    assert lines[:3] == ["ply", "format binary_little_endian 1.0", f"element vertex {COUNT}"]
    names = [line.removeprefix("property float ") for line in lines[3:]]
    return dict(zip(names, np.frombuffer(body, "<f4").reshape(COUNT, -1).T, strict=True))


def test_points_are_spread_over_faces_evenly_by_area() -> None:
    face, barycentric = evenly_on_faces(np.array([3.0, 0, 1]), 4000)
    assert np.bincount(face).tolist() == [3000, 0, 1000]
    np.testing.assert_allclose(barycentric.sum(1), 1)
    assert (barycentric >= 0).all()
    for k in (0, 2):
        inside = barycentric[face == k]
        np.testing.assert_allclose(inside.mean(0), 1 / 3, atol=2e-3)
        # The medial triangle splits a triangle into four equal parts: one at each corner and one in the middle.
        quarters = [(inside[:, c] > 0.5).mean() for c in range(3)] + [(inside < 0.5).all(1).mean()]
        np.testing.assert_allclose(quarters, 0.25, atol=0.01)


def test_one_layer_of_splats_is_nearly_opaque() -> None:
    """The surface is a square metre of 800 faces. At random places, 0.4 % of the light passes on average; with splats
    at random positions it would be 2 %."""
    row, rng = np.arange(20), np.random.default_rng(0)
    low = np.stack(np.meshgrid(row, row), -1).reshape(-1, 1, 2)
    corners_m = (
        np.concatenate([low + np.array(half) for half in ([(0, 0), (1, 0), (1, 1)], [(0, 0), (1, 1), (0, 1)])]) / 20
    )
    for count in (600, 3000, 12_000):
        face, barycentric = evenly_on_faces(np.full(800, 1 / 800), count)
        middles_m = np.einsum("nk,nkc->nc", barycentric, corners_m[face])
        off_m = np.linalg.norm(middles_m - rng.uniform(0.2, 0.8, (400, 1, 2)), axis=2)
        alpha = OPACITY * np.exp(-(off_m**2) / 2 / (SPREAD**2 / (np.pi * count)))
        through = (1 - alpha).prod(1)
        assert through.mean() < 0.006 and np.quantile(through, 0.99) < 0.05


def test_splats_are_sized_by_area_and_coloured_by_the_texture(staged: StagedAvatar, splats: Splats) -> None:
    """The column has 24 sides, a radius of 18 cm and a height of 1.7 m. Its circumference is 48 sin(7.5°) radii, and
    each end has an area of 12 sin(15°) r²."""
    area_m2 = 48 * np.sin(np.pi / 24) * 0.18 * 1.7 + 2 * 12 * np.sin(np.pi / 12) * 0.18**2
    assert splats.sigma_m == pytest.approx(1.4 * np.sqrt(area_m2 / (np.pi * COUNT)), rel=1e-6)
    np.testing.assert_allclose(splats.scales_m, splats.sigma_m * np.array([1, 1, 0.1]))
    top = dataclasses.replace(staged, texture=np.full((64, 64, 3), (255, 51, 0), np.uint8))
    np.testing.assert_allclose(surface_splats(top, 7).colours, np.tile([1, 0.2, 0], (7, 1)), atol=1e-9)
    ramp = dataclasses.replace(staged, texture=np.tile(np.arange(64, dtype=np.uint8)[:, None, None], (1, 64, 3)))
    found = surface_splats(ramp, COUNT)
    v = np.einsum("nk,nk->n", found.barycentric, staged.uvs[staged.face_uvs[found.face]][..., 1])
    np.testing.assert_allclose(found.colours[:, 0] * 255, ((1 - v) * 64 - 0.5).clip(0, 63), atol=1e-6)


def test_orientations_turn_z_to_the_normals() -> None:
    normals = np.array([[0.0, 0, 1], [1, 0, 0], [0, -0.6, 0.8], [0, 0, -1], [0, 1e-5, -1]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    quaternions = turned_to(normals)
    np.testing.assert_allclose(quaternions[:2], [[1, 0, 0, 0], [0.5**0.5, 0, 0.5**0.5, 0]], atol=1e-12)
    turned = Rotation.from_quat(quaternions, scalar_first=True).apply([0, 0, 1])
    np.testing.assert_allclose(turned, normals, atol=2e-5)  # nearly opposite normals are taken as exactly opposite


def test_the_ply_has_the_layout_of_3d_gaussian_splatting_at_rest(
    staged: StagedAvatar, splats: Splats, tmp_path: Path
) -> None:
    write_splat_ply(tmp_path / "a.ply", staged, splats)
    write_splat_ply(tmp_path / "b.ply", staged, surface_splats(staged, COUNT))
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
    found = read_ply(tmp_path / "a.ply")
    assert list(found)[:17] == [
        "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity",
        "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3",
    ]  # fmt: skip
    x, y, z, nx, nz = (found[name].astype(float) for name in ("x", "y", "z", "nx", "nz"))
    assert y.min() == pytest.approx(0, abs=1e-6) and y.max() == pytest.approx(1.7, abs=1e-6)
    side = (y > 0.2) & (y < 1.5)
    np.testing.assert_allclose((nx * x + nz * z)[side] / np.hypot(x, z)[side], 1, atol=0.02)  # outwards
    colour = [0.5 + 0.28209479177387814 * found[f"f_dc_{k}"] for k in range(3)]
    np.testing.assert_allclose(np.stack(colour, 1), splats.colours, atol=1e-6)
    np.testing.assert_allclose(1 / (1 + np.exp(-found["opacity"])), 0.99, atol=1e-6)
    scales_m = np.exp(np.stack([found[f"scale_{k}"] for k in range(3)], 1))
    np.testing.assert_allclose(scales_m, np.tile(splats.scales_m, (COUNT, 1)), rtol=1e-6)
    turned = Rotation.from_quat(np.stack([found[f"rot_{k}"] for k in range(4)], 1), scalar_first=True)
    np.testing.assert_allclose(turned.apply([0, 0, 1])[:, [0, 2]], np.stack([nx, nz], 1), atol=1e-5)


def test_ply_skinning_matches_the_game_rigs_surface(staged: StagedAvatar, splats: Splats, tmp_path: Path) -> None:
    """The column has two bones, so no weight is dropped. Inside a face, weights differ by at most one half, and the
    displacements by either bone differ by at most 10 cm, the face's height, times 2 sin(angle / 2). Their covariance is
    at most a quarter of the product."""
    write_splat_ply(tmp_path / "a.ply", staged, splats)
    found, rig = read_ply(tmp_path / "a.ply"), staged.rigs[GAME]
    joints = np.stack([found[f"joint_{k}"] for k in range(4)], 1).astype(int)
    weights = np.stack([found[f"weight_{k}"] for k in range(4)], 1)
    names = np.array(rig.skeleton.names)
    y = found["y"]
    assert (names[joints[y < 0.6, 0]] == "pelvis").all() and (names[joints[y > 1.1, 0]] == "upper_L").all()
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-6)
    at_rest_m = np.stack([found[axis] for axis in "xyz"], 1).astype(float)
    transforms = rig.stage(CAPTURED)[2] @ np.linalg.inv(rig.skeleton.bind)
    blended = np.einsum("nk,nkab->nab", weights, transforms[joints])
    moved_m = np.einsum("nab,nb->na", blended[:, :3, :3], at_rest_m) + blended[:, :3, 3]
    surface_m = splats.at(skinned(transforms, rig.skin, staged.rest_points_m))
    assert np.linalg.norm(moved_m - surface_m, axis=1).max() < 0.5 * 0.1 * 2 * np.sin(0.5 / 2) / 4
    on_one_bone = weights[:, 0] > 1 - 1e-6
    assert on_one_bone.mean() > 0.4
    np.testing.assert_allclose(moved_m[on_one_bone], surface_m[on_one_bone], atol=1e-5)
    figures = splat_figures(staged, splats)
    assert figures["count"] == COUNT and figures["sigma_mm"] == pytest.approx(1e3 * splats.sigma_m)
    assert 5 < figures["moved_p99_mm"] < figures["moved_max_mm"] < 12  # bent by 0.8 rad, with noise of 1 cm on points


def test_ply_skinning_keeps_the_four_strongest_joints(staged: StagedAvatar, splats: Splats, tmp_path: Path) -> None:
    """All points follow five of six joints; the weakest, with a weight of 0.1, is dropped."""
    rig, points = staged.rigs[GAME], len(staged.rest_points_m)
    skin = Skin(np.tile([5, 1, 0, 4, 2], (points, 1)), np.tile([0.1, 0.3, 0.2, 0.25, 0.15], (points, 1)))
    six = dataclasses.replace(rig, skeleton=dataclasses.replace(rig.skeleton, names=tuple("abcdef")), skin=skin)
    write_splat_ply(tmp_path / "a.ply", dataclasses.replace(staged, rigs=staged.rigs | {GAME: six}), splats)
    found = read_ply(tmp_path / "a.ply")
    assert [found[f"joint_{k}"].tolist() for k in range(4)] == [[joint] * COUNT for joint in (1, 4, 0, 2)]
    for k, weight in enumerate((0.3, 0.25, 0.2, 0.15)):
        np.testing.assert_allclose(found[f"weight_{k}"], weight / 0.9, rtol=1e-6)


def test_usd_splats_lie_on_the_skinned_surface_in_each_frame(staged: StagedAvatar, splats: Splats, layer: Path) -> None:
    stage = Usd.Stage.Open(str(layer))
    assert UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y and UsdGeom.GetStageMetersPerUnit(stage) == 1
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (3, 8, 10)
    prim = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath(SPLATS))
    assert prim.GetPositionsAttr().GetTimeSamples() == prim.GetOrientationshAttr().GetTimeSamples() == [3, 4, 5, 8]
    assert prim.GetRadianceSphericalHarmonicsDegreeAttr().Get() == 0
    coefficients = np.array(prim.GetRadianceSphericalHarmonicsCoefficientsAttr().Get())
    np.testing.assert_allclose(0.5 + 0.28209479177387814 * coefficients, splats.colours, atol=1e-6)
    assert np.array(prim.GetOpacitiesAttr().Get()) == pytest.approx(0.99)
    np.testing.assert_allclose(prim.GetScalesAttr().Get(), np.tile(splats.scales_m, (COUNT, 1)), rtol=1e-6)
    for frame, surface_m in zip(staged.frames, staged.rigs[FULL].surfaces_m(CAPTURED, staged.rest), strict=True):
        corners_m = surface_m[staged.faces[splats.face]]
        found_m = np.array(prim.GetPositionsAttr().Get(float(frame)))
        np.testing.assert_allclose(found_m, np.einsum("nk,nkc->nc", splats.barycentric, corners_m), atol=1e-5)
        turned = [[*q.GetImaginary(), q.GetReal()] for q in prim.GetOrientationshAttr().Get(float(frame))]
        normals = splats.at(normals_of(surface_m, staged.faces))
        cosine = (Rotation.from_quat(turned).apply([0, 0, 1]) * normals).sum(1) / np.linalg.norm(normals, axis=1)
        assert cosine.min() > 1 - 1e-5  # half precision resolves about a milliradian
        box_m = np.array(prim.GetExtentAttr().Get(float(frame)))
        np.testing.assert_allclose(box_m[0], found_m.min(0) - 3 * splats.sigma_m, atol=1e-5)


def test_the_splat_layer_passes_every_validator_and_is_reproducible(
    staged: StagedAvatar, splats: Splats, layer: Path, tmp_path: Path
) -> None:
    report = validate_package(layer)
    assert (report["variants"], report["warnings"]) == (1, [])
    write_splats(tmp_path / layer.name, staged, surface_splats(staged, COUNT), 10.0, INFO)
    assert (tmp_path / layer.name).read_bytes() == layer.read_bytes()


@pytest.mark.parametrize(
    ("attribute", "value", "message"),
    [
        ("scales", Vt.Vec3fArray(COUNT, (0.01, 0.01, 0)), "scales are not finite or not above 0"),
        ("opacities", Vt.FloatArray(COUNT, 1.5), "opacities are not one a splat, above 0 and at most 1"),
        ("opacities", Vt.FloatArray(COUNT - 1, 0.9), "opacities are not one a splat"),
        ("radiance:sphericalHarmonicsDegree", 1, "coefficients are not finite or not those of degree 1"),
        ("positions", Vt.Vec3fArray(COUNT, (np.nan, 0, 0)), "positions are not finite or not one a splat at time 4"),
        ("positions", Vt.Vec3fArray(COUNT, (0, 9, 0)), "extent does not contain the positions at time 4"),
        ("orientationsh", Vt.QuathArray(COUNT), "orientations are not unit quaternions, one a splat, at time 4"),
        ("extent", Vt.Vec3fArray(2, (0, 0, 0)), "extent does not contain the positions at time 4"),
    ],
)
def test_each_defect_of_splats_is_reported(layer: Path, attribute: str, value: object, message: str) -> None:
    copy = Sdf.Layer.CreateAnonymous()
    copy.TransferContent(Sdf.Layer.FindOrOpen(str(layer)))
    stage = Usd.Stage.Open(copy)
    assert data_defects(stage) == []
    found = stage.GetPrimAtPath(SPLATS).GetAttribute(attribute)
    found.Set(value, 4.0 if found.GetNumTimeSamples() else Usd.TimeCode.Default())
    assert message in "; ".join(data_defects(stage))
