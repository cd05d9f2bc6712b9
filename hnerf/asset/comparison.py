"""Comparison of the asset's looks and splats with the field that they were made from: all in the same views, scored
against the masked photograph."""

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch

from hnerf.asset.pictures import looks_on_black, splats_on_black
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

IMAGES = 6  # few: on two cores, the field takes about a second to render one
LONGEST_PX = 300  # of the person's box, for the same reason; larger boxes are scaled down
SHORTEST_PX = 12  # SSIM needs 11; the box of a person at the image's edge may have fewer
POOR_DB = 4.0  # further below its field, an asset has lost what the field knew
LOOKS = {"captured look": "asset", "albedo in its own light": "albedo"}  # by the names of their renders

log = logging.getLogger("hnerf.asset")


@dataclass(frozen=True)
class Compared:
    """One view, cropped to the person's box. photograph (H, W, 3) and renders (H, W, 4), with their coverage, are uint8
    over black. Renders and their scores are of "field", "asset" (the captured look), and, if there are any, "albedo"
    (in the light that was estimated with it) and "splats"."""

    view: View
    photograph: np.ndarray
    renders: dict[str, np.ndarray]
    scores: dict[str, dict[str, float]]


def compare_with_field(
    capture: Capture, masks: Masks, avatar: Avatar, staged: StagedAvatar, splats: Splats | None = None
) -> list[Compared]:
    """Compare at most IMAGES views of training frames: from test cameras if the recording has masks for them and these
    show the person, else from training cameras. The list is empty if no chosen view has a mask of the person."""
    tested = [view for view in all_views(capture, NOVEL_VIEW) if capture.has_given_mask(view.camera, view.frame)]
    trained = [view for view in all_views(capture, TRAINING_VIEW) if (view.camera, view.frame) in masks]
    seen = _showing_the_person(tested, capture.given_mask) or _showing_the_person(trained, masks.get)
    surfaces = _skinned_surfaces(staged, [view.frame for view in seen])

    def compare(view: View) -> Compared:
        mask, surface = seen[view], surfaces[view.frame]
        box = mask_box(mask)
        camera = camera_of_box(capture.cameras[view.camera], box)
        small = camera.scaled(min(1.0, max(LONGEST_PX / max(camera.size_px), SHORTEST_PX / min(camera.size_px))))
        cast = camera.scaled(min(1.0, 2 * max(small.size_px) / max(camera.size_px)))  # a large box has millions of rays
        photograph = capture.image(view.camera, view.frame)[box] * mask[box][..., None]
        photograph = cv2.resize(photograph, small.size_px, interpolation=cv2.INTER_AREA)
        shown = cv2.resize(255 * mask[box].astype(np.uint8), small.size_px, interpolation=cv2.INTER_AREA) > 127
        with torch.no_grad():
            field = rgba(avatar.render(small, *avatar.body.pose(view.frame)))
        gain = avatar.gains.get(view.camera, (1.0, 1.0, 1.0))
        renders = {"field": field} | looks_on_black(surface, staged, cast, small.size_px, gain)
        if splats:
            points_m = np.asarray(surface.mesh.vertices)
            renders["splats"] = splats_on_black(splats, points_m, cast, small.size_px, gain)
        scores = {name: _scores(render, photograph, shown) for name, render in renders.items()}
        if splats:
            drawn, by_field = (renders[name][..., :3].astype(np.float32) / 255 for name in ("splats", "field"))
            scores["splats"]["psnr_to_field"] = psnr(drawn, by_field)
        return Compared(view, photograph, renders, scores)

    compared = side_by_side(compare, list(seen), avatar.body.theta.device)
    return list(tracked(compared, "asset against field", len(seen)))


def _showing_the_person(
    views: list[View], read_mask: Callable[[str, int], np.ndarray | None]
) -> dict[View, np.ndarray]:
    """Return at most IMAGES views with their masks (H, W) bool, without those whose mask is empty."""
    found = {view: read_mask(view.camera, view.frame) for view in sample_views(views, IMAGES)}
    return {view: mask for view, mask in found.items() if mask is not None and mask.any()}


def comparison_figures(compared: list[Compared]) -> dict[str, Any]:
    """Return the mean scores of the field, the looks and the splats, how far the captured look is below the field, and
    the scores of each image."""
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
    """Raise InvalidAsset if every look of the asset is more than POOR_DB below its field. If only one is, or with
    `allow_poor`, warn instead.

    name: of the capture; topology: of the mesh; figures: see `comparison_figures`.
    """
    if not figures["images"]:
        return
    below_db = {
        look: figures["field"]["psnr"] - figures[shown]["psnr"] for look, shown in LOOKS.items() if shown in figures
    }
    poor = {look: below for look, below in below_db.items() if below > POOR_DB}
    if not poor:
        return
    looks = " and ".join(f"{look} {below:.1f} dB" for look, below in below_db.items())
    found = (
        f"{name}: the asset with the {topology} mesh is below its field: {looks} (field {figures['field']['psnr']:.1f} "
        f"dB, mean of {figures['images']} images from {figures['cameras']} cameras)"
    )
    if len(poor) < len(below_db):
        (good,) = below_db.keys() - poor.keys()
        log.warning("%s; use the %s", found, good)
    elif allow_poor:
        log.warning("%s", found)
    else:
        raise InvalidAsset(
            f"{found}; at most {POOR_DB:.0f} dB are allowed. Try another asset.topology or a larger asset.texture_px, "
            "or take it as it is: asset.allow_poor=true (`hnerf export --allow-poor`)"
        )


def _skinned_surfaces(staged: StagedAvatar, frames: list[int]) -> dict[int, Surface]:
    """Return the asset's surface in the world in some frames, with correctives, as other programs skin it."""
    wanted = sorted(set(frames))
    rows = [list(staged.frames).index(frame) for frame in wanted]
    moved = staged.rigs[FULL].surfaces_m(CAPTURED, staged.rest, rows)
    surfaces = (Surface.of(points_m @ staged.stage_from_world, staged.faces) for points_m in moved)
    return dict(zip(wanted, surfaces, strict=True))


def _scores(rendered: np.ndarray, photograph: np.ndarray, mask: np.ndarray) -> dict[str, float]:
    a, b = rendered[..., :3].astype(np.float32) / 255, photograph.astype(np.float32) / 255
    return {"psnr": psnr(a, b), "ssim": ssim(a, b), "mask_iou": mask_iou(rendered[..., 3], mask)}
