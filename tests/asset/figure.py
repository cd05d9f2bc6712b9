"""A body for tests of the asset: a two-bone column 1.6 m tall, small enough to work out results by hand."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import torch
import trimesh

from hnerf.asset.package import AssetInfo, write_cache, write_package, write_usdz
from hnerf.asset.rig_transfer import clothed_rig
from hnerf.asset.staging import StagedAvatar
from hnerf.body.fit_result import BodyFit
from hnerf.body.rig import Rig, pose_vertices
from hnerf.capture.capture import Capture
from hnerf.geometry.camera import Camera
from tests.body.boxes import hinged

FRAMES = (3, 4, 5, 8)  # with a gap
INFO = AssetInfo(
    "column",
    "7",
    "CC0-1.0",
    "0123abcd",
    {"level_faces": (500,), "none": (), "topology": "auto"},
    {"field": {"psnr": 32.5}},
)


def column_rig() -> Rig:
    """Return a column of radius 15 cm, z from 0 to 1.6 m, with joints at z = 0 and z = 0.8. The upper joint's skinning
    weight rises from 0 at z = 0.7 to 1 at z = 0.9."""
    column = upright_column(0.15, 0.0, 1.6)
    vertices_m = torch.from_numpy(column.vertices).float()
    faces, joints_m = torch.from_numpy(column.faces).long(), torch.tensor([[0.0, 0, 0], [0, 0, 0.8]])
    return hinged(vertices_m, faces, joints_m, ("root", "upper.L"), upper_weight(vertices_m[:, 2]))


def upright_column(radius_m: float, bottom_m: float, top_m: float, storeys: int = 16) -> trimesh.Trimesh:
    """Return a closed column around the z axis: a stack of `storeys` rings with 24 sides each."""
    rings = [[radius_m, z] for z in np.linspace(bottom_m, top_m, storeys + 1)]
    return trimesh.creation.revolve([[0, bottom_m], *rings, [0, top_m]], sections=24)


def twice(mesh: trimesh.Trimesh, apart_m: tuple[float, float, float]) -> trimesh.Trimesh:
    """Return one mesh that contains a mesh and a copy of it shifted by `apart_m`."""
    return trimesh.util.concatenate([mesh, mesh.copy().apply_translation(apart_m)])


def upper_weight(z_m: torch.Tensor) -> torch.Tensor:
    """Return the upper bone's skinning weight at given heights."""
    return ((z_m - 0.7) / 0.2).clamp(0, 1)


def bending_body() -> BodyFit:
    """Return a fit in which the column bends at its joint about x and turns about z while it moves along x."""
    theta, root = torch.zeros(len(FRAMES), 2, 3), torch.eye(4).repeat(len(FRAMES), 1, 1)
    for row, frame in enumerate(FRAMES):
        theta[row, 1, 0] = 0.1 * frame
        c, s = math.cos(0.8 * frame), math.sin(0.8 * frame)
        root[row, :2, :2] = torch.tensor([[c, -s], [s, c]])
        root[row, :3, 3] = torch.tensor([0.1 * frame, 2.0, 0.5])
    return BodyFit(column_rig(), FRAMES, theta, root)


def dressed(body: BodyFit, clothes: trimesh.Trimesh) -> BodyFit:
    """Return a fit whose surface is clothes around the body."""
    return dataclasses.replace(body, rig=clothed_rig(body.rig, clothes))


def posed_with_displacements(clothed: BodyFit, moved_m: np.ndarray) -> np.ndarray:
    """Return the surfaces (n, V, 3) of a fit whose rest vertices are displaced by moved_m (n, V, 3), frame by frame."""
    rigs = [dataclasses.replace(clothed.rig, vertices_m=clothed.rig.vertices_m + torch.from_numpy(m)) for m in moved_m]
    posed = zip(rigs, clothed.theta, clothed.root, strict=True)
    return np.stack([pose_vertices(rig, theta, root).numpy() for rig, theta, root in posed])


def no_cavities(clothed: BodyFit) -> np.ndarray:
    """Return a mask (V,) bool that marks no vertex as lining a cavity."""
    return np.zeros(len(clothed.rig.vertices_m), bool)


def side_camera() -> Camera:
    """Return a camera at (0, -3, 1) m that looks along +y of the world; the image's right is +x."""
    R = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    K = np.array([[500.0, 0, 300], [0, 400, 200], [0, 0, 1]])
    return Camera("01", K, R, -R @ np.array([0, -3.0, 1.0]), 640, 480)


def capture() -> Capture:
    """Return a capture of one camera, three training frames and one novel pose, without pixels."""
    cameras = {"01": side_camera()}
    return Capture("column", Path(), cameras, ("01",), (), FRAMES[:3], FRAMES[3:], 10.0, "z", {}, {})


def write_all(out: Path, staged: StagedAvatar) -> None:
    """Write the package, `avatar.usdz` and `avatar_cache.usdz`, of the column at 10 frames a second."""
    cameras = [dataclasses.replace(side_camera(), name=name) for name in ("cam 1", "cam.1", "01")]
    write_package(out, {"": staged}, cameras, 10.0, INFO)
    write_usdz(out / "avatar.usdz", {"": staged}, cameras, 10.0, INFO)
    write_cache(out / "avatar_cache.usdz", staged, cameras, 10.0, INFO)
