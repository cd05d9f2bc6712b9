"""Export of a trained avatar to files for other programs: USD, glTF, BVH and, with Blender, FBX and Alembic."""

import dataclasses
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from threadpoolctl import threadpool_limits

from hnerf.asset.baking import Filled, baked_textures
from hnerf.asset.blender import write_with_blender
from hnerf.asset.bvh_file import write_captured_bvh, write_captured_trc
from hnerf.asset.comparison import Compared, compare_with_field, comparison_figures, require_close
from hnerf.asset.correctives import Correctives, correctives_of, frame_surfaces
from hnerf.asset.extreme_poses import extreme_poses
from hnerf.asset.figures import beyond_skinning_mm, level_figures, mesh_figures, rig_figures, splat_figures
from hnerf.asset.glb import write_glb
from hnerf.asset.normal_map import normal_map
from hnerf.asset.package import AssetInfo, Avatars, write_cache, write_package, write_splats, write_usdz
from hnerf.asset.regions import chosen_topology, crossing_findings, findings, surface_distances_mm
from hnerf.asset.report import write_report
from hnerf.asset.rigs import FULL, GAME
from hnerf.asset.splat_ply import write_splat_ply
from hnerf.asset.splats import Splats, surface_splats
from hnerf.asset.staging import StagedAvatar, stage_avatar
from hnerf.asset.texture_size import TextureSize, texture_size
from hnerf.asset.topologies import AssetMesh, captured_mesh, registered_mesh
from hnerf.asset.validation import validate_package
from hnerf.asset.viewer import write_viewer
from hnerf.avatar.avatar import Avatar
from hnerf.avatar.surface import surface_in_pose
from hnerf.body.fit_result import BodyFit
from hnerf.capture.capture import Capture, write_image
from hnerf.capture.masks import Masks
from hnerf.config import AssetSettings
from hnerf.evenly_spaced import evenly_spaced
from hnerf.progress import timed
from hnerf.render.motion import Motion, retarget, select_poses
from hnerf.results.asset import AssetReport
from hnerf.results.files import write_result

SPLATS = "avatar_splats.usdc"

log = logging.getLogger("hnerf.asset")


@dataclass(frozen=True)
class RestMeshes:
    """Meshes in the rest pose. dense: the field's surface; by_topology: the meshes made from it; distances_mm: how far
    these are from it after registration or decimation."""

    dense: trimesh.Trimesh
    by_topology: dict[str, AssetMesh]
    distances_mm: dict[str, Any]


@dataclass(frozen=True)
class ClothedSurface:
    """The surface of the asset. mesh: moved by the mean displacement of the training frames; body: in every frame;
    surfaces_m (n, V, 3): in the world; displacements_m (n, V, 3): those from which skinning produces these surfaces;
    correctives: blend shapes that approximate the displacements."""

    mesh: AssetMesh
    body: BodyFit
    surfaces_m: np.ndarray
    displacements_m: np.ndarray
    correctives: Correctives


@dataclass(frozen=True)
class MeshAsset:
    """The asset of one mesh: what is written of it, the size of its texture, what of it the field fills, its views next
    to the field's with their figures, and the seconds of each step."""

    surface: ClothedSurface
    staged: StagedAvatar
    texture_size: TextureSize
    filled: Filled
    splats: Splats | None
    compared: list[Compared]
    against_field: dict[str, Any]
    seconds: dict[str, float]


@threadpool_limits.wrap(limits=1, user_api="blas")  # with more threads, sums round differently and bytes change
def export_asset(
    capture: Capture,
    masks: Masks,
    avatar: Avatar,
    settings: AssetSettings,
    out: Path,
    digest: str = "",
    further: Mapping[str, Motion] = {},
    blender: str | None = None,
) -> dict[str, Any]:
    """Write the files that docs/asset.md lists into `out`; return the content of `report.json`.

    digest: of the recording, for the asset's information; further: motions of other bodies to add, by name; blender:
    program that adds FBX and Alembic (`write_with_blender`). Raises InputError if the field has no surface, a motion
    lacks a joint, or that program fails, and InvalidAsset if a package fails validation or the asset is far below its
    field (`require_close`).
    """
    seconds: dict[str, float] = {}
    own = avatar.without_frames().body.to("cpu")  # the unclothed body, to which further motions are retargeted
    added = {n: (retarget(own, motion, capture.up, f"motion {n}"), motion.fps) for n, motion in further.items()}
    meshes = _rest_meshes(avatar, settings, seconds)
    topology = chosen_topology(settings.topology, meshes.distances_mm["registered"])
    found = findings(settings.topology, meshes.distances_mm["registered"])
    found += crossing_findings(meshes.by_topology[topology])
    for line in found:
        log.warning("%s: %s", capture.name, line)
    asset, captured = _mesh_asset(capture, masks, avatar, meshes, topology, settings, added), None
    if settings.topology == "both":
        bare = settings.model_copy(update={"splats": 0})  # the first mesh alone has splats
        captured = _mesh_asset(capture, masks, avatar, meshes, "captured", bare, added)
    surface, staged, splats = asset.surface, asset.staged, asset.splats
    seconds |= asset.seconds
    with timed("poses", seconds, log):
        poses = extreme_poses(staged, surface.mesh.rig, surface.mesh.skin_faces)
    with timed("files", seconds, log):
        chosen = settings.model_dump(exclude={"version", "licence"}) | {"texture_px": asset.texture_size.px}
        close = _closeness(meshes, asset, topology)
        info = AssetInfo(capture.name, settings.version, settings.licence, digest, chosen, close)
        avatars = {"registered": staged, "captured": captured.staged} if captured else {"": staged}
        write_files(out, avatars, capture, info, splats)
        write_image(out / "filled.png", asset.filled.mask)
    with timed("viewer", seconds, log):
        viewer = write_viewer(out / "viewer.html", out / "avatar.glb", capture, staged.stage_from_world, staged.levels)
    with timed("validation", seconds, log):
        interfaces = ["avatar.usda", "avatar_materialx.usda", *(f"avatar_{rate}.usda" for rate in staged.rates)]
        packages = ["avatar.usdz", *interfaces, "avatar_cache.usdz", *([SPLATS] if splats else [])]
        validation = {name: validate_package(out / name) for name in packages}
    if blender:
        with timed("blender", seconds, log):
            write_with_blender(out, blender, capture.fps)
    report = _figures(capture, meshes, asset, topology, settings) | {
        "findings": found,
        "crossing_share": {pose.name: pose.crossing for pose in poses},
        "viewer": viewer,
        "bytes": {str(p.relative_to(out)): p.stat().st_size for p in sorted(out.rglob("*")) if p.is_file()},
        "seconds": seconds,
        "validation": validation,
    }
    if captured:
        report["captured"] = _mesh_asset_figures(captured, "captured") | {"seconds": captured.seconds}
    if splats:
        report["splats"] = splat_figures(staged, splats)
    write_result(out / "report.json", AssetReport, report)
    shown = capture.train_frames[0]
    root = surface.body.root[surface.body.index(shown)].numpy()
    write_report(out / "report.html", capture.name, staged, asset.filled, shown, root, asset.compared, poses, report)
    return report


def _rest_meshes(avatar: Avatar, settings: AssetSettings, seconds: dict[str, float]) -> RestMeshes:
    """Mesh the avatar in the rest pose. seconds: receives the time of each step."""
    timeless = avatar.without_frames()  # one mesh serves all frames
    with timed("surface", seconds, log):
        rest = avatar.body.theta.new_zeros(len(avatar.body.rig.joints_m), 3), torch.eye(4).to(avatar.body.theta)
        dense = surface_in_pose(timeless, *rest, settings.grid_cells)
    with timed("mesh", seconds, log):
        rig = timeless.body.rig.to("cpu")
        meshes = {"registered": registered_mesh(rig, dense), "captured": captured_mesh(rig, dense, settings.faces)}
    with timed("distances", seconds, log):
        return RestMeshes(dense, meshes, surface_distances_mm(dense, meshes))


def _mesh_asset(
    capture: Capture,
    masks: Masks,
    avatar: Avatar,
    meshes: RestMeshes,
    topology: str,
    settings: AssetSettings,
    added: Mapping[str, tuple[BodyFit, float]],
) -> MeshAsset:
    """Texture, rig and animate one of the meshes, and compare it with the field. Raises InvalidAsset if it is far
    below. added: further motions of the unclothed body with their frame rates, by name."""
    seconds: dict[str, float] = {}
    timeless = avatar.without_frames()  # one texture serves all frames
    with timed("correctives", seconds, log):
        surface = _clothed_surface(capture, avatar, meshes.by_topology[topology], settings)
    mesh = surface.mesh
    with timed("texture", seconds, log):
        frames = evenly_spaced(capture.train_frames, settings.photograph_frames)
        photographed_m = [surface.surfaces_m[surface.body.index(frame)] for frame in frames]
        size, layout = texture_size(capture, photographed_m, mesh, settings.texture_px)
        texture, albedo, filled = baked_textures(
            capture,
            timeless,
            surface.body,
            surface.surfaces_m,
            layout,
            size.px,
            settings,
            mesh.cavities,
            mesh.face_units_m,
        )
    with timed("normal map", seconds, log):
        px = settings.normal_map_px
        normals = normal_map(timeless, mesh, layout, px) if px else None
    with timed("staging", seconds, log):
        staged = stage_avatar(
            surface.body,
            surface.surfaces_m,
            surface.correctives,
            layout,
            texture,
            capture.up,
            capture.fps,
            bones=settings.bones,
            further={name: (dataclasses.replace(body, rig=mesh.rig), fps) for name, (body, fps) in added.items()},
            albedo=albedo,
            normal_map=normals,
            level_faces=settings.level_faces,
            expressions_m=mesh.face_units_m,
            physiques_m=mesh.physiques_m,
            joint_names=settings.joint_names,
        )
    splats = surface_splats(staged, settings.splats) if settings.splats else None
    with timed("comparison", seconds, log):
        compared = compare_with_field(capture, masks, avatar, staged, splats)
        against_field = comparison_figures(compared)
    require_close(capture.name, topology, against_field, settings.allow_poor)
    return MeshAsset(surface, staged, size, filled, splats, compared, against_field, seconds)


def _clothed_surface(capture: Capture, avatar: Avatar, mesh: AssetMesh, settings: AssetSettings) -> ClothedSurface:
    """Track a rest-pose mesh through the frames."""
    poses = select_poses(avatar.without_frames().body, capture.frames).to("cpu")
    body = dataclasses.replace(poses, rig=mesh.rig)
    surfaces_m, displacements_m = frame_surfaces(avatar, body, mesh.settle)
    centred = mesh.moved(displacements_m[[body.index(frame) for frame in capture.train_frames]].mean(0))
    displacements_m -= (centred.rig.vertices_m - mesh.rig.vertices_m).numpy()
    correctives = correctives_of(displacements_m, settings.correctives)
    body = dataclasses.replace(body, rig=centred.rig)
    return ClothedSurface(centred, body, surfaces_m, displacements_m, correctives)


def _figures(
    capture: Capture, meshes: RestMeshes, asset: MeshAsset, topology: str, settings: AssetSettings
) -> dict[str, Any]:
    """Return the figures of the surface, the rigs and the motions."""
    staged, dense = asset.staged, meshes.dense
    light, motions = staged.albedo and staged.albedo.light, staged.rigs[FULL].motions
    return {
        "surface": {"faces": len(dense.faces), "watertight": dense.is_watertight, "volume_l": 1e3 * dense.volume},
        **_mesh_asset_figures(asset, topology),
        "to_surface_mm": meshes.distances_mm,
        "normal_map_px": settings.normal_map_px,
        "light": light and {"coefficients": light.coefficients.round(4).tolist(), "normals_turned_deg": light.turn_deg},
        "expressions": list(staged.expressions_m),
        "physiques": list(staged.physiques_m),
        "joints": len(staged.rigs[FULL].skeleton.names),
        "rigs": {name: rig_figures(staged, name) for name in staged.rigs},
        "motions": {name: {"fps": motion.fps, "poses": len(motion.codes)} for name, motion in motions.items()},
        "frames": len(capture.frames),
        "cameras": len(capture.cameras),
    }


def _closeness(meshes: RestMeshes, asset: MeshAsset, topology: str) -> dict[str, Any]:
    """Return the figures of the mesh against the field's surface, and of the asset against the field, as in the
    report."""
    against_field = {name: value for name, value in asset.against_field.items() if name != "per_image"}
    return {"topology": topology, "to_surface_mm": meshes.distances_mm[topology]["all"], "against_field": against_field}


def _mesh_asset_figures(asset: MeshAsset, topology: str) -> dict[str, Any]:
    """Return the figures in which the assets of two meshes differ."""
    surface = asset.surface
    return {
        "mesh": mesh_figures(topology, surface.mesh, asset.staged),
        "levels": level_figures(asset.staged),
        **asset.texture_size.figures(),
        "filled_share": asset.filled.share,
        "beyond_skinning_mm": beyond_skinning_mm(surface.displacements_m, surface.correctives),
        "against_field": asset.against_field,
    }


def write_files(out: Path, avatars: Avatars, capture: Capture, info: AssetInfo, splats: Splats | None) -> None:
    """Write a staged avatar in all formats into the folder `out`. USD files with variants contain the meshes of all
    topologies, other files only the first. splats: on its surface, written to separate files."""
    cameras, staged = list(capture.cameras.values()), next(iter(avatars.values()))
    write_package(out, avatars, cameras, capture.fps, info)
    write_usdz(out / "avatar.usdz", avatars, cameras, capture.fps, info)
    write_cache(out / "avatar_cache.usdz", staged, cameras, capture.fps, info)
    write_glb(out / "avatar.glb", staged, staged.rigs[FULL], info)
    write_glb(out / "avatar_game.glb", staged, staged.rigs[GAME], info)
    if staged.rates:
        write_captured_bvh(out / "avatar.bvh", staged.rigs[GAME], staged.rest_points_m, staged.joint_names)
        write_captured_trc(out / "avatar.trc", staged.rigs[GAME], staged.joint_names)
    else:
        log.warning(
            "%s: no avatar_24.usda, avatar_30.usda, avatar.bvh and avatar.trc: the captured poses are too far apart to "
            "be interpolated; raise capture.max_frames or, if capture.toml lists frames, list more",
            capture.name,
        )
    if splats:
        write_splats(out / SPLATS, staged, splats, capture.fps, info)
        write_splat_ply(out / "avatar_splats.ply", staged, splats)
