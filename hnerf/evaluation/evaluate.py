"""Evaluation of a trained avatar by the protocol of docs/method.md: renderings, meshes, scores and a report."""

import itertools
import logging
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh

from hnerf.avatar.avatar import Avatar
from hnerf.avatar.surface import NO_SURFACE, POSED_CELLS, POSED_MARGIN_M, posed_surface
from hnerf.config import EvaluationSettings
from hnerf.errors import InputError
from hnerf.evaluation import geometry
from hnerf.evaluation.columns import avatar_for_split, reason_unavailable
from hnerf.evaluation.ground_truth import UNDER_GIVEN_MASKS, GivenMasks, GroundTruth, truth_of
from hnerf.evaluation.holdout import LABEL, collect_held_out
from hnerf.evaluation.images import render, score_split, scored_views, unscored
from hnerf.evaluation.inputs import EvaluationInputs
from hnerf.evaluation.lpips import lpips_availability
from hnerf.evaluation.report import write_report
from hnerf.evaluation.views import (
    POSED,
    PRIMARY_SPLITS,
    SPLITS,
    TRACKED,
    TRAINING_VIEW,
    all_views,
    sample_views,
    split_frames,
)
from hnerf.evenly_spaced import evenly_spaced
from hnerf.progress import tracked
from hnerf.results.files import write_result
from hnerf.results.scores import Metrics
from hnerf.side_by_side import side_by_side

log = logging.getLogger("hnerf.evaluation")

PROTOCOL = (
    "Images: PSNR, SSIM (Gaussian window of 11 px, sigma 1.5) of 8-bit images over black, data range 1, inside the box "
    "of the true mask padded by 20 px, and LPIPS (0.1, AlexNet) there; mask IoU of pixels that are covered by more "
    "than a half. Mean over images, all from test cameras: without one, none is scored. novel_view: training frames. "
    "New poses are of frames that the field was not trained on, in three columns: novel_pose (animated), in poses as "
    "fitted from the training cameras before training, nothing tuned, no deformation of a frame's own; "
    "novel_pose_posed, in poses tuned on the training cameras; novel_pose_tracked, with these frames' deformations, "
    "too. All methods get the same fitted poses. "
    f"holdout: {LABEL}; new poses animated. "
    "Geometry, of novel_view and novel_pose: largest component of the zero surface of the signed distance, within "
    f"{100 * POSED_MARGIN_M:.0f} cm of the body's box, by marching cubes, {POSED_CELLS} cells on the longest side; "
    f"{geometry.SAMPLES} samples a surface before those that cannot be seen from outside are dropped, fixed seed; "
    "Chamfer: mean of both directions of the mean squared distance from sample to surface, m^2 x 1e3, and of the mean "
    "distance in mm; normal consistency: mean |cos| at nearest points; IoU by winding number on a "
    f"{geometry.OCCUPANCY_NODES}^3 grid."
)


def evaluate(inputs: EvaluationInputs, settings: EvaluationSettings, out: Path) -> Metrics:
    """Write `renders/`, `meshes/`, `metrics.json`, charts and `report.html` into `out`; return what metrics.json holds.

    A score that is not available is null, with a reason next to it.
    """
    started = time.perf_counter()
    capture = inputs.capture
    truth = truth_of(inputs.capture_folder, capture)
    unavailable = {split: why for split in SPLITS if (why := reason_unavailable(split, inputs.training_folder))}
    available = [split for split in (TRAINING_VIEW, *SPLITS) if split not in unavailable]
    avatars = {split: avatar_for_split(split, inputs.avatar, inputs.fitted) for split in available}
    shown = [sample_views(all_views(capture, split), settings.report_rows) for split in available]
    views = {split: scored_views(split, truth, settings.max_images) for split in available if split in SPLITS}
    illustrative = (POSED, TRACKED) if not capture.test_cameras else ()  # only those that the report shows
    wanted = dict.fromkeys(itertools.chain(*shown, *(views[split] for split in views if split not in illustrative)))
    image_seconds = render(avatars, capture, list(wanted), out)
    rendered = time.perf_counter()
    found: Any = {"protocol": protocol_of(truth), "lpips": lpips_availability(), "seconds_per_image": image_seconds}
    found |= {split: score_split(split, views[split], truth, out) for split in views}
    found |= {split: unscored(why) for split, why in unavailable.items()}
    true_meshes = truth.meshes()
    meshed: dict[str, tuple[Avatar, list[int]]] = {
        split: (avatars[split], mesh_frames(split_frames(capture, split), true_meshes, settings.max_meshes))
        for split in PRIMARY_SPLITS
        if split not in unavailable
    }
    for split, scores in score_meshes(meshed, true_meshes, out).items():
        found[split] |= scores
    for split in unavailable.keys() & set(PRIMARY_SPLITS):
        found[split] |= {"geometry": None, "geometry_reason": unavailable[split]}
    found |= collect_held_out(capture, inputs.held_out_folders)
    found["seconds"] = {"rendering": rendered - started, "scores and meshes": time.perf_counter() - rendered}
    write_report(inputs, settings, truth, true_meshes, found, out)
    found["seconds"]["all"] = time.perf_counter() - started
    write_result(out / "metrics.json", Metrics, found)
    log.info("evaluation took %.0f s, %.0f s of them rendering", found["seconds"]["all"], rendered - started)
    return found


def protocol_of(truth: GroundTruth) -> str:
    """Return the protocol, including what differs for captures without true masks."""
    given = isinstance(truth, GivenMasks)
    return f"{PROTOCOL} Here, images are compared to {UNDER_GIVEN_MASKS}." if given else PROTOCOL


def mesh_frames(frames: tuple[int, ...], true_meshes: dict[int, trimesh.Trimesh], count: int) -> list[int]:
    """Return the frames to mesh: at most `count`, evenly spaced among those with a true surface, or among all if none
    has one."""
    return evenly_spaced([f for f in frames if f in true_meshes] or frames, count)


def score_meshes(
    shown: Mapping[str, tuple[Avatar, list[int]]], true_meshes: dict[int, trimesh.Trimesh], out: Path
) -> dict[str, dict[str, Any]]:
    """Write `meshes/<frame>.ply` of avatars and frames by split, posed as each avatar's body is; return the mean
    geometry scores of each split, or null with a reason. If any of its frames has no surface, the reason says why."""
    (out / "meshes").mkdir(exist_ok=True)

    def measure(split_and_frame: tuple[str, int]) -> tuple[str, dict[str, Any] | str | None]:
        split, frame = split_and_frame
        try:
            mesh = posed_surface(shown[split][0], frame)
        except InputError as error:  # young or failed models may have no surface, which is a result
            return split, str(error)
        log.info("meshed frame %d: %d faces", frame, len(mesh.faces))
        mesh.export(out / "meshes" / f"{frame:06d}.ply")
        if frame not in true_meshes:
            return split, None
        return split, {"frame": frame} | geometry.score_geometry(mesh, true_meshes[frame], np.random.default_rng(0))

    found: dict[str, list[Any]] = {split: [] for split in shown}
    every = [(split, frame) for split, (_, frames) in shown.items() for frame in frames]
    device = next((avatar.body.theta.device for avatar, _ in shown.values()), torch.device("cpu"))
    for split, score in tracked(side_by_side(measure, every, device), "meshes", len(every)):
        found[split].append(score)
    return {split: _mean_scores(scores) for split, scores in found.items()}


def _mean_scores(found: list[dict[str, Any] | str | None]) -> dict[str, Any]:
    """Return the means of scores of surfaces; in place of a score, there may be the reason why a frame has no surface,
    or None if it has no true one."""
    for reason in found:
        if isinstance(reason, str):
            return {"geometry": None, "geometry_reason": reason}
    scores = [score for score in found if isinstance(score, dict)]
    if not scores:
        return {"geometry": None, "geometry_reason": "the capture has no ground-truth surface in these frames"}
    means = {name: float(np.mean([score[name] for score in scores])) for name in scores[0] if name != "frame"}
    return {"geometry": means | {"n": len(scores), "per_surface": scores}}


def reason_without_surface(scores: Mapping[str, Any]) -> str | None:
    """Return why the field that a split's scores belong to has no surface; None if it has one or none was extracted."""
    reason = scores.get("geometry_reason", "")
    return reason if reason.startswith(NO_SURFACE) else None
