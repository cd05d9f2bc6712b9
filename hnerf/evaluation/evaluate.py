"""Render, mesh and score a trained avatar by the evaluation protocol of docs/method.md, and report what was found."""

import dataclasses
import itertools
import json
import logging
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh

from hnerf.asset.surface import POSED_CELLS, posed_surface
from hnerf.capture.capture import Capture, read_rgb, write_image
from hnerf.config import EvaluationSettings
from hnerf.evaluation import geometry, metrics
from hnerf.evaluation.ground_truth import GroundTruth
from hnerf.evaluation.inputs import EvaluationInputs
from hnerf.evaluation.report import write_report
from hnerf.evaluation.views import SPLITS, TRAINING_VIEW, View, all_views, some_views, split_frames
from hnerf.render.avatar import Avatar
from hnerf.spread import spread

log = logging.getLogger("hnerf.evaluation")

LOG_EVERY_S = 10.0
MEANS = ("psnr", "ssim", "mask_iou", "empty_psnr", "one_colour_psnr")  # over a split's images
PROTOCOL = (
    "Images: PSNR, SSIM (Gaussian window of 11 px, sigma 1.5) of 8-bit images over black, data range 1, inside the box "
    "of the true mask padded by 20 px; mask IoU of pixels brighter than 8/255. Mean over images. "
    "novel_view: training frames from test cameras; novel_pose: frames kept from training, from test cameras, or from "
    "training cameras where there are no test cameras; their poses, and with `fast` their deformations, are fitted "
    "from training cameras. "
    f"Geometry: zero surface of the signed distance by marching cubes, {POSED_CELLS} cells on the longest side; "
    f"{geometry.SAMPLES} samples a surface before those that cannot be seen from outside are dropped, fixed seed; "
    "Chamfer: mean of both directions of the mean squared distance from sample to surface, m^2 x 1e3, and of the mean "
    "distance in mm; normal consistency: mean |cos| at nearest points; IoU by winding number on a "
    f"{geometry.OCCUPANCY_NODES}^3 grid."
)
LPIPS = "not available: the AlexNet weights it needs come with no package, and none are fetched at run time"


def evaluate(inputs: EvaluationInputs, settings: EvaluationSettings, out: Path) -> dict[str, Any]:
    """Write `renders/`, `meshes/`, `metrics.json`, charts and `report.html` into `out`; what metrics.json holds.

    A figure that cannot be had is null, and a reason stands beside it.
    """
    started = time.perf_counter()
    capture = inputs.capture
    truth = GroundTruth(inputs.capture_folder, capture) if (inputs.capture_folder / "ground_truth").is_dir() else None
    views = {split: scored_views(capture, split, truth, settings.max_images) for split in SPLITS}
    shown = [some_views(all_views(capture, split), settings.report_rows) for split in (TRAINING_VIEW, *SPLITS)]
    wanted = dict.fromkeys(itertools.chain(*views.values(), *shown))
    image_seconds = render(inputs.avatar, capture, list(wanted), out)
    rendered = time.perf_counter()
    found: dict[str, Any] = {"protocol": PROTOCOL, "lpips": LPIPS, "seconds_per_image": image_seconds}
    found |= {split: score_split(split, views[split], truth, out) for split in SPLITS}
    true_meshes = {} if truth is None else truth.meshes()
    for split in SPLITS:
        frames = mesh_frames(split_frames(capture, split), true_meshes, settings.max_meshes)
        found[split] |= score_meshes(inputs.avatar, frames, true_meshes, out)
    found["seconds"] = {"rendering": rendered - started, "scores and meshes": time.perf_counter() - rendered}
    write_report(inputs, settings, truth, true_meshes, found, out)
    found["seconds"]["all"] = time.perf_counter() - started
    (out / "metrics.json").write_text(json.dumps(found, indent=1))
    log.info("evaluation took %.0f s, %.0f s of them rendering", found["seconds"]["all"], rendered - started)
    return found


def scored_views(capture: Capture, split: str, truth: GroundTruth | None, count: int | None) -> list[View]:
    """All images of a split, or at most `count` of those whose true mask is known; of all where none is."""
    views = all_views(capture, split)
    if count is None:
        return views
    return some_views(known_views(views, truth) or views, count)


def known_views(views: list[View], truth: GroundTruth | None) -> list[View]:
    """Those whose true mask is known."""
    return [view for view in views if truth and truth.has_mask(view.camera, view.frame)]


def render(avatar: Avatar, capture: Capture, views: list[View], out: Path) -> float:
    """Write the 8-bit rendering of every view; the median seconds of one image, without writing it."""
    seconds: list[float] = []
    next_log = time.perf_counter() + LOG_EVERY_S
    for view in views:
        started = time.perf_counter()
        k = avatar.body.index(view.frame)
        with torch.no_grad():
            rgb = avatar.render(capture.cameras[view.camera], avatar.body.theta[k], avatar.body.root[k]).rgb
            pixels = (rgb.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
        seconds.append(time.perf_counter() - started)
        write_image(view.path(out), pixels)
        if time.perf_counter() > next_log:
            log.info("rendered %d of %d images", len(seconds), len(views))
            next_log = time.perf_counter() + LOG_EVERY_S
    return float(np.median(seconds))


def score_split(split: str, views: list[View], truth: GroundTruth | None, out: Path) -> dict[str, Any]:
    """Mean image figures of a split's renderings, and each image's; null with a reason where there are none."""
    nothing: dict[str, Any] = {"n": 0, "per_image": []} | dict.fromkeys(MEANS)
    if not views:
        missing = "test cameras" if split == "novel_view" else "novel-pose frames"
        return nothing | {"reason": f"the capture has no {missing}"}
    if truth is None or not truth.has_masks:
        return nothing | {"reason": "the capture has no ground-truth masks"}
    rows, references = [], set()
    known = known_views(views, truth)
    for view in known:
        mask = truth.mask(view.camera, view.frame)
        if not mask.any():
            continue
        reference, source = truth.on_black(view.camera, view.frame)
        score = metrics.score_image(read_rgb(view.path(out)), reference, mask)
        references.add(source)
        row: dict[str, Any] = {"camera": view.camera, "frame": view.frame} | dataclasses.asdict(score)
        rows.append(row | metrics.floors(reference, mask))
    if not rows:
        why = "no image of this split shows the person" if known else "no image of this split has a ground-truth mask"
        return nothing | {"reason": why}
    means = {name: float(np.mean([row[name] for row in rows])) for name in MEANS}
    without = {"without_mask": len(views) - len(known), "without_person": len(known) - len(rows)}
    return {"n": len(rows)} | means | without | {"reference": " and ".join(sorted(references)), "per_image": rows}


def mesh_frames(frames: tuple[int, ...], true_meshes: dict[int, trimesh.Trimesh], count: int) -> list[int]:
    """The frames to mesh: at most `count`, spread over those with a true surface, or over all where none has one."""
    return spread([f for f in frames if f in true_meshes] or frames, count)


def score_meshes(
    avatar: Avatar, frames: list[int], true_meshes: dict[int, trimesh.Trimesh], out: Path
) -> dict[str, Any]:
    """Write `meshes/<frame>.ply` of the frames; their mean geometry figures, or null with a reason."""
    (out / "meshes").mkdir(exist_ok=True)
    scores = []
    for frame in frames:
        mesh = posed_surface(avatar, frame)
        mesh.export(out / "meshes" / f"{frame:06d}.ply")
        if frame in true_meshes:
            rng = np.random.default_rng(0)
            score = dataclasses.asdict(geometry.score_geometry(mesh, true_meshes[frame], rng))
            scores.append({"frame": frame} | score)
        log.info("meshed frame %d: %d faces", frame, len(mesh.faces))
    if not scores:
        return {"geometry": None, "geometry_reason": "the capture has no ground-truth surface in these frames"}
    means = {name: float(np.mean([score[name] for score in scores])) for name in scores[0] if name != "frame"}
    return {"geometry": means | {"n": len(scores), "per_surface": scores}}
