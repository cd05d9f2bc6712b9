"""The asset, and its splats, against the field it was made from: all in the same views, scored by the photograph under
its mask."""

import logging
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
import trimesh

from hnerf.asset.pictures import on_black, splats_on_black
from hnerf.asset.rigs import FULL
from hnerf.asset.splats import Splats
from hnerf.asset.staging import CAPTURED, StagedAvatar
from hnerf.avatar.avatar import Avatar
from hnerf.capture.capture import Capture
from hnerf.capture.masks import Masks
from hnerf.errors import InvalidAsset
from hnerf.evaluation.images import rgba
from hnerf.evaluation.metrics import mask_box, mask_iou, psnr, ssim
from hnerf.evaluation.pictures import camera_of_box
from hnerf.evaluation.views import NOVEL_VIEW, TRAINING_VIEW, View, all_views, sample_views
from hnerf.geometry.mesh_queries import Surface
from hnerf.progress import tracked
from hnerf.side_by_side import side_by_side

IMAGES = 6  # few: a field on two cores renders one in about a second
LONGEST_PX = 300  # of the person's box, for the same reason; larger boxes are scaled down
POOR_DB = 4.0  # below its field, an asset lost what the field knew

log = logging.getLogger("hnerf.asset")


@dataclass(frozen=True)
class Compared:
    """One view, in the person's box: photograph (H, W, 3) over black; field, asset and splats, if there are any, (H, W,
    4), over black and their coverage; uint8. scores: of "asset", "field" and "splats", by name."""

    view: View
    photograph: np.ndarray
    field: np.ndarray
    asset: np.ndarray
    scores: dict[str, dict[str, float]]
    splats: np.ndarray | None = None


def compare_with_field(
    capture: Capture, masks: Masks, avatar: Avatar, staged: StagedAvatar, splats: Splats | None = None
) -> list[Compared]:
    """Return at most IMAGES views of training frames, from test cameras if the recording has masks of these, else from
    training cameras. None if no view has a mask."""
    tested = sample_views(all_views(capture, NOVEL_VIEW), IMAGES)
    trained = [view for view in all_views(capture, TRAINING_VIEW) if (view.camera, view.frame) in masks]
    with_mask = [view for view in tested if _mask(capture, masks, view) is not None]
    chosen = with_mask or sample_views(trained, IMAGES)
    surfaces = _skinned_surfaces(staged, [view.frame for view in chosen])

    def compare(view: View) -> Compared | None:
        mask = _mask(capture, masks, view)
        if mask is None or not mask.any():
            return None
        return _compared(capture, view, mask, avatar, staged, surfaces[view.frame], splats)

    compared = side_by_side(compare, chosen, avatar.body.theta.device)
    return [one for one in tracked(compared, "asset against field", len(chosen)) if one]


def comparison_figures(compared: list[Compared]) -> dict[str, Any]:
    """Return the mean scores of asset, field and splats, by how much the asset is below, and those of each image."""
    if not compared:
        return {"images": 0, "reason": "no image has a mask of the person"}
    means = {
        shown: {name: float(np.mean([c.scores[shown][name] for c in compared])) for name in compared[0].scores[shown]}
        for shown in compared[0].scores
    }
    cameras = "test" if compared[0].view.split == NOVEL_VIEW else "training"
    below = {name: means["field"][name] - means["asset"][name] for name in means["field"]}
    return {"images": len(compared), "cameras": cameras, **means, "below_field": below} | {
        "per_image": [
            {"camera": c.view.camera, "frame": c.view.frame}
            | {f"{shown}_{name}": value for shown, found in c.scores.items() for name, value in found.items()}
            for c in compared
        ]
    }


def require_close(name: str, topology: str, figures: dict[str, Any], allow_poor: bool) -> None:
    """Raise InvalidAsset if the asset of a capture called `name`, with the mesh of that topology, is more than POOR_DB
    below its field; figures: see `comparison_figures`."""
    below_db = figures["below_field"]["psnr"] if figures["images"] else 0.0
    if below_db <= POOR_DB:
        return
    found = (
        f"{name}: the asset with the {topology} mesh is {below_db:.1f} dB below its field "
        f"({figures['asset']['psnr']:.1f} against {figures['field']['psnr']:.1f} dB, "
        f"mean of {figures['images']} images from {figures['cameras']} cameras)"
    )
    if not allow_poor:
        raise InvalidAsset(
            f"{found}; at most {POOR_DB:.0f} dB are allowed. Try another asset.topology or a larger asset.texture_px, "
            "or take it as it is, as for somebody who turns in light from one side, which one texture cannot show: "
            "asset.allow_poor=true (`hnerf export --allow-poor`)"
        )
    log.warning("%s", found)


def _mask(capture: Capture, masks: Masks, view: View) -> np.ndarray | None:
    """Return a view's mask (H, W) bool: of training cameras the segmentation's, of test cameras the recording's own;
    None where there is none."""
    if view.split == NOVEL_VIEW:
        return capture.given_mask(view.camera, view.frame)
    return masks.get(view.camera, view.frame) if (view.camera, view.frame) in masks else None


def _skinned_surfaces(staged: StagedAvatar, frames: list[int]) -> dict[int, Surface]:
    """Return the asset's surface in the world in some frames, with correctives, as programs skin it."""
    wanted = sorted(set(frames))
    rows = [list(staged.frames).index(frame) for frame in wanted]
    moved = staged.rigs[FULL].surfaces_m(CAPTURED, staged.rest, rows)
    return {
        frame: Surface(trimesh.Trimesh(points_m @ staged.stage_from_world, staged.faces, process=False))
        for frame, points_m in zip(wanted, moved, strict=True)
    }


def _compared(
    capture: Capture,
    view: View,
    mask: np.ndarray,
    avatar: Avatar,
    staged: StagedAvatar,
    surface: Surface,
    splats: Splats | None,
) -> Compared:
    box = mask_box(mask)
    camera = camera_of_box(capture.cameras[view.camera], box)
    small = camera.scaled(min(1.0, LONGEST_PX / max(camera.size_px)))
    photograph = capture.image(view.camera, view.frame)[box] * mask[box][..., None]
    photograph = cv2.resize(photograph, small.size_px, interpolation=cv2.INTER_AREA)
    shown = cv2.resize(255 * mask[box].astype(np.uint8), small.size_px, interpolation=cv2.INTER_AREA) > 127
    k = avatar.body.index(view.frame)
    with torch.no_grad():
        field = rgba(avatar.render(small, avatar.body.theta[k], avatar.body.root[k]))
    gain = avatar.gains.get(view.camera, (1.0, 1.0, 1.0))
    asset = on_black(surface, staged, camera, small.size_px, gain)
    scores = {"asset": _scores(asset, photograph, shown), "field": _scores(field, photograph, shown)}
    if splats is None:
        return Compared(view, photograph, field, asset, scores)
    drawn = splats_on_black(splats, np.asarray(surface.mesh.vertices), camera, small.size_px, gain)
    to_field = psnr(drawn[..., :3].astype(np.float32) / 255, field[..., :3].astype(np.float32) / 255)
    scores["splats"] = _scores(drawn, photograph, shown) | {"psnr_to_field": to_field}
    return Compared(view, photograph, field, asset, scores, drawn)


def _scores(rendered: np.ndarray, photograph: np.ndarray, mask: np.ndarray) -> dict[str, float]:
    a, b = rendered[..., :3].astype(np.float32) / 255, photograph.astype(np.float32) / 255
    return {"psnr": psnr(a, b), "ssim": ssim(a, b), "mask_iou": mask_iou(rendered[..., 3], mask)}
