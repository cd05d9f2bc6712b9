"""Export of a trained avatar to files that any 3-D program opens."""

import dataclasses
import json
import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch

from hnerf.asset.correctives import Correctives, correctives_of, frame_surfaces
from hnerf.asset.glb import write_glb
from hnerf.asset.photographs import colours_from_photographs
from hnerf.asset.report import write_report
from hnerf.asset.rig_transfer import clothed_rig
from hnerf.asset.simplify import simplify
from hnerf.asset.staging import stage_avatar
from hnerf.asset.texture import field_colours, rasterise, texture_image, unwrap
from hnerf.asset.usd import write_cache, write_skinned
from hnerf.asset.validation import validate_package
from hnerf.asset.viewer import write_viewer
from hnerf.avatar.avatar import Avatar
from hnerf.avatar.surface import surface_in_pose
from hnerf.body.fit_result import BodyFit
from hnerf.body.rig import Rig
from hnerf.capture.capture import Capture
from hnerf.config import AssetSettings
from hnerf.evenly_spaced import evenly_spaced

log = logging.getLogger("hnerf.asset")


def export_asset(capture: Capture, avatar: Avatar, settings: AssetSettings, out: Path) -> dict[str, Any]:
    """Write `avatar.usdz`, `avatar_cache.usdz`, `avatar.glb`, `viewer.html`, `report.json` and `report.html` into
    `out`; returns the report.

    Raises InputError if the field has no surface, InvalidAsset if a package does not pass validation.
    """
    seconds: dict[str, float] = {}
    tracked_avatar, avatar = avatar, avatar.without_frames()  # one surface and one texture serve all frames
    with _timed("surface", seconds):
        rest = avatar.body.theta.new_zeros(len(avatar.body.rig.joints_m), 3), torch.eye(4).to(avatar.body.theta)
        dense = surface_in_pose(avatar, *rest, settings.grid_cells)
    with _timed("mesh", seconds):
        surface = simplify(dense, settings.faces)
        layout = unwrap(surface.vertices, surface.faces, settings.texture_px)
        rig = clothed_rig(avatar.body.rig.to("cpu"), surface)
    clothed = _clothed_body(avatar.body, rig, capture.frames)
    with _timed("correctives", seconds):
        surfaces_m, displacements_m = frame_surfaces(tracked_avatar, clothed)
        correctives = correctives_of(displacements_m, settings.correctives)
    with _timed("texture", seconds):
        texels = rasterise(layout, settings.texture_px)
        posed = _clothed_body(avatar.body, rig, tuple(evenly_spaced(capture.train_frames, settings.texture_poses)))
        colours = field_colours(avatar, posed, texels)
        if settings.photograph_frames:
            frames = evenly_spaced(capture.train_frames, settings.photograph_frames)
            photographed = {frame: surfaces_m[clothed.index(frame)] for frame in frames}
            colours = colours_from_photographs(capture, avatar.gains, photographed, surface.faces, texels, colours)
        texture = texture_image(texels, colours, settings.texture_px)
    with _timed("files", seconds):
        staged = stage_avatar(clothed, surfaces_m, correctives, layout, texture, capture.up)
        cameras = list(capture.cameras.values())
        write_skinned(out / "avatar.usdz", staged, cameras, capture.fps)
        write_cache(out / "avatar_cache.usdz", staged, cameras, capture.fps)
        write_glb(out / "avatar.glb", staged, capture.fps)
    with _timed("viewer", seconds):
        viewer = write_viewer(out / "viewer.html", out / "avatar.glb", capture, staged.stage_from_world)
    with _timed("validation", seconds):
        validation = {name: validate_package(out / name) for name in ("avatar.usdz", "avatar_cache.usdz")}
    report = {
        "surface": {"faces": len(dense.faces), "watertight": dense.is_watertight, "volume_l": 1e3 * dense.volume},
        "mesh": {
            "vertices": len(surface.vertices),
            "faces": len(surface.faces),
            "watertight": surface.is_watertight,
            "height_m": float(np.ptp(staged.rest_points_m[:, 1])),
        },
        "texture_px": settings.texture_px,
        "joints": len(rig.joint_names),
        "frames": len(capture.frames),
        "beyond_skinning_mm": _beyond_skinning_mm(displacements_m, correctives),
        "cameras": len(cameras),
        "viewer": viewer,
        "bytes": {path.name: path.stat().st_size for path in sorted([*out.glob("avatar*"), *out.glob("viewer.html")])},
        "seconds": seconds,
        "validation": validation,
    }
    (out / "report.json").write_text(json.dumps(report, indent=1))
    shown = capture.train_frames[0]
    write_report(out / "report.html", capture.name, staged, shown, clothed.root[clothed.index(shown)].numpy(), report)
    return report


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
