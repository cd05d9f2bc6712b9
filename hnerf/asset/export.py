"""Export of a trained avatar to files that any 3-D program opens."""

import dataclasses
import json
import logging
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch

from hnerf.asset.bvh_file import write_avatar_bvh
from hnerf.asset.correctives import Correctives, correctives_of, frame_surfaces
from hnerf.asset.field_colours import field_colours
from hnerf.asset.glb import write_glb
from hnerf.asset.normal_map import normal_map
from hnerf.asset.package import AssetInfo, write_cache, write_package, write_usdz
from hnerf.asset.photographs import colours_from_photographs
from hnerf.asset.regions import findings, surface_distances_mm
from hnerf.asset.registration import crossing_faces
from hnerf.asset.report import write_report
from hnerf.asset.rigs import FULL, GAME
from hnerf.asset.staging import CAPTURED, StagedAvatar, stage_avatar
from hnerf.asset.texture import rasterise, texture_image
from hnerf.asset.topologies import asset_meshes
from hnerf.asset.validation import validate_package
from hnerf.asset.viewer import write_viewer
from hnerf.avatar.avatar import Avatar
from hnerf.avatar.surface import surface_in_pose
from hnerf.body.fit_result import BodyFit
from hnerf.body.rig import Rig
from hnerf.capture.capture import Capture
from hnerf.config import AssetSettings
from hnerf.evenly_spaced import evenly_spaced
from hnerf.render.motion import Motion, retarget

PACKAGES = ("avatar.usdz", "avatar.usda", "avatar_24.usda", "avatar_30.usda", "avatar_cache.usdz")

log = logging.getLogger("hnerf.asset")


def export_asset(
    capture: Capture,
    avatar: Avatar,
    settings: AssetSettings,
    out: Path,
    digest: str = "",
    further: Mapping[str, Motion] | None = None,
) -> dict[str, Any]:
    """Write the files that docs/asset.md lists into `out`; returns what `report.json` holds.

    digest: of the recording, for the asset's information; further: motions by other bodies to add, by name. Raises
    InputError if the field has no surface or a motion lacks a joint, InvalidAsset if a package does not pass
    validation.
    """
    seconds: dict[str, float] = {}
    tracked_avatar, avatar = avatar, avatar.without_frames()  # one surface and one texture serve all frames
    with _timed("surface", seconds):
        rest = avatar.body.theta.new_zeros(len(avatar.body.rig.joints_m), 3), torch.eye(4).to(avatar.body.theta)
        dense = surface_in_pose(avatar, *rest, settings.grid_cells)
    with _timed("mesh", seconds):
        meshes = asset_meshes(avatar.body.rig.to("cpu"), dense, settings.faces)
        mesh = meshes[settings.topology]
        rig, layout = mesh.rig, mesh.layout(settings.texture_px)
    clothed = _clothed_body(avatar.body, rig, capture.frames)
    with _timed("distances", seconds):
        distances_mm = surface_distances_mm(dense, meshes)
    with _timed("correctives", seconds):
        surfaces_m, displacements_m = frame_surfaces(tracked_avatar, clothed, mesh.settle)
        correctives = correctives_of(displacements_m, settings.correctives)
    with _timed("texture", seconds):
        texels = rasterise(layout, settings.texture_px)
        posed = _clothed_body(avatar.body, rig, tuple(evenly_spaced(capture.train_frames, settings.texture_poses)))
        colours = field_colours(avatar, posed, texels)
        if settings.photograph_frames:
            frames = evenly_spaced(capture.train_frames, settings.photograph_frames)
            photographed = {frame: surfaces_m[clothed.index(frame)] for frame in frames}
            colours = colours_from_photographs(capture, avatar.gains, photographed, rig.faces.numpy(), texels, colours)
        texture = texture_image(texels, colours, settings.texture_px)
    with _timed("normal map", seconds):
        normals = normal_map(avatar, mesh, layout, settings.normal_map_px) if settings.normal_map_px else None
    with _timed("files", seconds):
        own = avatar.body.to("cpu")
        added = {
            name: (_retargeted(own, rig, motion, capture.up), motion.fps) for name, motion in (further or {}).items()
        }
        staged = stage_avatar(
            clothed, surfaces_m, correctives, layout, texture, capture.up, capture.fps, settings.bones, added, normals
        )
        write_files(out, staged, capture, AssetInfo(capture.name, settings.version, settings.licence, digest))
    with _timed("viewer", seconds):
        viewer = write_viewer(out / "viewer.html", out / "avatar.glb", capture, staged.stage_from_world)
    with _timed("validation", seconds):
        validation = {name: validate_package(out / name) for name in PACKAGES}
    report = {
        "surface": {"faces": len(dense.faces), "watertight": dense.is_watertight, "volume_l": 1e3 * dense.volume},
        "mesh": {
            "topology": settings.topology,
            "vertices": len(rig.vertices_m),
            "faces": len(rig.faces),
            "watertight": mesh.trimesh.is_watertight,
            "crossing_faces": int(crossing_faces(mesh.trimesh.vertices, mesh.trimesh.faces[: mesh.skin_faces]).sum()),
            "height_m": float(np.ptp(staged.rest_points_m[:, 1])),
        },
        "to_surface_mm": distances_mm,
        "findings": findings(distances_mm[settings.topology]) if settings.topology == "registered" else [],
        "texture_px": settings.texture_px,
        "normal_map_px": settings.normal_map_px,
        "joints": len(staged.rigs[FULL].skeleton.names),
        "rigs": {name: _rig_figures(staged, name) for name in staged.rigs},
        "motions": {
            name: {"fps": motion.fps, "poses": len(motion.codes)} for name, motion in staged.rigs[FULL].motions.items()
        },
        "frames": len(capture.frames),
        "beyond_skinning_mm": _beyond_skinning_mm(displacements_m, correctives),
        "cameras": len(capture.cameras),
        "viewer": viewer,
        "bytes": {str(p.relative_to(out)): p.stat().st_size for p in sorted(out.rglob("*")) if p.is_file()},
        "seconds": seconds,
        "validation": validation,
    }
    (out / "report.json").write_text(json.dumps(report, indent=1))
    shown = capture.train_frames[0]
    write_report(out / "report.html", capture.name, staged, shown, clothed.root[clothed.index(shown)].numpy(), report)
    return report


def write_files(out: Path, staged: StagedAvatar, capture: Capture, info: AssetInfo) -> None:
    """Write a staged avatar in all formats into the folder `out`."""
    cameras = list(capture.cameras.values())
    write_package(out, staged, cameras, capture.fps, info)
    write_usdz(out / "avatar.usdz", staged, cameras, capture.fps, info)
    write_cache(out / "avatar_cache.usdz", staged, cameras, capture.fps, info)
    write_glb(out / "avatar.glb", staged, staged.rigs[FULL])
    write_glb(out / "avatar_game.glb", staged, staged.rigs[GAME])
    write_avatar_bvh(out / "avatar.bvh", staged)


def _retargeted(own: BodyFit, rig: Rig, motion: Motion, up: str) -> BodyFit:
    """Return a motion on the clothed rig; `own`: the fitted body, beside whose place the motion is put."""
    return dataclasses.replace(retarget(own, motion, up), rig=rig)


def _rig_figures(staged: StagedAvatar, name: str) -> dict[str, float]:
    """Return a rig's size, and how far it moves the captured surfaces from where the full rig has them: what 99 % of
    the points stay below in all frames, and the furthest."""
    rig, full = staged.rigs[name], staged.rigs[FULL]
    pairs = zip(rig.surfaces_m(CAPTURED, staged.rest), full.surfaces_m(CAPTURED, staged.rest), strict=True)
    worst_m = np.max([np.linalg.norm(moved - true, axis=1) for moved, true in pairs], 0)
    return {
        "joints": len(rig.skeleton.names),
        "influences": rig.skin.influences,
        "moved_p99_mm": float(1e3 * np.percentile(worst_m, 99)),
        "moved_max_mm": float(1e3 * worst_m.max()),
    }


def _clothed_body(body: BodyFit, rig: Rig, frames: tuple[int, ...]) -> BodyFit:
    rows = [body.index(frame) for frame in frames]
    return dataclasses.replace(body, rig=rig, frames=frames, theta=body.theta[rows].cpu(), root=body.root[rows].cpu())


def _beyond_skinning_mm(displacements_m: np.ndarray, correctives: Correctives) -> dict[str, float]:
    """Return the root mean square distance of the frames' surfaces from the skinned one, without and with its
    correctives."""
    rebuilt_m = np.einsum("nk,kvd->nvd", correctives.weights, correctives.offsets_m)
    left_m = {"skinned": displacements_m, "with_correctives": displacements_m - rebuilt_m}
    return {name: float(1e3 * np.sqrt((m**2).sum(-1).mean())) for name, m in left_m.items()}


@contextmanager
def _timed(step: str, seconds: dict[str, float]) -> Iterator[None]:
    log.info("asset: %s", step)
    start_s = time.perf_counter()
    yield
    seconds[step] = round(time.perf_counter() - start_s, 3)
