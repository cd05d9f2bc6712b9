"""Scores of a training: its snapshots and its final model, scored on held-out images and surfaces, and rendering
times."""

import json
import logging
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from hnerf.avatar.avatar import Avatar
from hnerf.avatar.trained import load_avatar
from hnerf.body.fit_result import BodyFit
from hnerf.capture.capture import Capture, read_rgb, write_image
from hnerf.evaluation.columns import avatar_for_split, reason_unavailable
from hnerf.evaluation.evaluate import mesh_frames, protocol_of, score_meshes
from hnerf.evaluation.ground_truth import GroundTruth
from hnerf.evaluation.images import render, score_split, unscored, views_with_mask
from hnerf.evaluation.lpips import lpips_availability
from hnerf.evaluation.pictures import crop, frame_person
from hnerf.evaluation.views import PRIMARY_SPLITS, SPLITS, View, all_views, split_frames
from hnerf.evenly_spaced import evenly_spaced
from hnerf.geometry.camera import Camera
from hnerf.results.files import write_result
from hnerf.results.scores import CurvePoint, EndScores, ImageScores, Picture, Scores, SplitScores
from hnerf.study.benchmark.plan import ScoringSettings
from hnerf.study.benchmark.training_distance import pose_distances_deg, view_angle_deg
from hnerf.study.machine import machine

log = logging.getLogger("hnerf.study")

PICTURES = 2  # images shown of each training
REPEATS = 3  # of a timed rendering; their median counts
SLOW_S = 10.0  # an image that takes this long is timed once
SCORING_PROTOCOL = (
    "Training seconds: the trainer's own clock from its first step on, without reading the capture and without setup "
    "(scene statistics, gathering of pixels, building of field and shell: setup_seconds in scores.json). Curves: fewer "
    "images and surfaces than in tables, the same ones at every point and for all methods, new poses animated; the "
    "last point is the finished field. "
    f"Time of a frame: median of {REPEATS} renderings of a whole image, of one if it takes over {SLOW_S:.0f} s. "
    "Peak memory: on a CPU that of the training process, including all libraries; on a GPU that of tensors."
)


@dataclass(frozen=True)
class ScoringScene:
    """What trainings are scored against: the capture with calibrated cameras, the body as fitted before training, and
    the ground truth."""

    capture: Capture
    fitted: BodyFit
    truth: GroundTruth


def score(scene: ScoringScene, training: Path, settings: ScoringSettings, out: Path) -> Scores:
    """Write `scores.json`, renderings and meshes into `out`; return the content of scores.json.

    training: the training's folder. A score that is not available is null, with a reason next to it.
    """
    avatar, split = load_avatar(training), settings.split
    unavailable = {name: why for name in SPLITS if (why := reason_unavailable(name, training))}
    protocol = f"{protocol_of(scene.truth)} {SCORING_PROTOCOL}"
    found: Any = {"machine": machine(), "protocol": protocol, "lpips": lpips_availability()}
    found["split"], found["training"] = split, json.loads((training / "report.json").read_text())
    found["curve"] = curve(scene, training, settings, out)
    for name in SPLITS:
        if name in unavailable:
            found[name] = unscored(unavailable[name])
            if name in PRIMARY_SPLITS:
                found[name] |= {"geometry": None, "geometry_reason": unavailable[name]}
            continue
        column = avatar_for_split(name, avatar, scene.fitted)
        found[name] = score_views(scene, column, name, settings.images, settings.meshes, out)
        add_training_distances(scene, name, found[name])
    found["pictures"] = write_pictures(scene, split, found[split]["per_image"], out)
    camera = next(iter(scene.capture.cameras.values()))
    found["frame_seconds"] = {
        str(side): frame_seconds(avatar, camera, scene.capture.train_frames[0], side)
        for side in settings.frame_sizes_px
    }
    write_result(out / "scores.json", Scores, found)
    return found


def score_end(scene: ScoringScene, training: Path, settings: ScoringSettings, out: Path) -> EndScores:
    """Write `scores.json` with the training's report and only the last point of its curve; return its content."""
    rows = curve(scene, training, settings, out)
    found = EndScores(training=json.loads((training / "report.json").read_text()), curve=rows[-1:])
    write_result(out / "scores.json", EndScores, found)
    return found


def curve(scene: ScoringScene, training: Path, settings: ScoringSettings, out: Path) -> list[CurvePoint]:
    """Return training seconds and scores of every snapshot and, last, of the finished field, in order of time; none if
    the capture has no test camera or the field nothing to show for the split."""
    split, rows = settings.split, list[CurvePoint]()
    if not scene.capture.test_cameras or reason_unavailable(split, training):
        return rows
    end_s = json.loads((training / "report.json").read_text())["field_seconds"]
    taken = {json.loads((f / "settings.json").read_text())["seconds"]: f for f in (training / "snapshots").glob("*")}
    models = {s: taken[s] for s in sorted(taken) if s < end_s} | {end_s: training}
    for seconds, model in models.items():
        folder = out / "snapshots" / f"{seconds:g}"
        folder.mkdir(parents=True)
        column = avatar_for_split(split, load_avatar(model), scene.fitted)
        figures: Any = score_views(scene, column, split, settings.snapshot_images, settings.snapshot_meshes, folder)
        del figures["per_image"]
        rows.append({"seconds": seconds} | figures)
        log.info("after %.0f s: %s dB", seconds, figures["psnr"])
    return rows


def score_views(
    scene: ScoringScene, avatar: Avatar, split: str, images: int | None, meshes: int, out: Path
) -> SplitScores:
    """Score a split's avatar on at most this many of the images and surfaces that have ground truth, in the format of
    the evaluation; None scores all images."""
    views = all_views(scene.capture, split)
    views = evenly_spaced(views_with_mask(views, scene.truth) or views, images or len(views))
    if views and scene.capture.test_cameras:
        render({split: avatar}, scene.capture, views, out)
    found: Any = score_split(split, views, scene.truth, out)
    if split not in PRIMARY_SPLITS:
        return found
    if not meshes:
        return found | {"geometry": None, "geometry_reason": "the study requests no surface here"}
    true_meshes = scene.truth.meshes()
    frames = [f for f in mesh_frames(split_frames(scene.capture, split), true_meshes, meshes) if f in true_meshes]
    return found | score_meshes({split: (avatar, frames)}, true_meshes, out)[split]


def write_pictures(scene: ScoringScene, split: str, per_image: list[ImageScores], out: Path) -> list[Picture]:
    """Write a few scored renderings and their ground truth, cropped to the person, as
    `pictures/<k>-{render,truth}.png`; return which ones."""
    chosen = [Picture(camera=row["camera"], frame=row["frame"]) for row in evenly_spaced(per_image, PICTURES)]
    for k, row in enumerate(chosen):
        box = frame_person(scene.truth.mask(**row))
        both = {"render": read_rgb(View(split, **row).path(out)), "truth": scene.truth.on_black(**row)[0]}
        for name, picture in both.items():
            write_image(out / "pictures" / f"{k}-{name}.png", crop(picture, box))
    return chosen


def add_training_distances(scene: ScoringScene, split: str, found: SplitScores) -> None:
    """Add to the scores of each image and surface how far its view and its pose are from the training data. The
    distances are computed from the body as fitted, so that they are the same for all methods, however each tunes the
    poses."""
    capture, body = scene.capture, scene.fitted
    apart_deg = pose_distances_deg(body, split_frames(capture, split), capture.train_frames)
    vertices_m = body.vertices_m().cpu().numpy()
    middles_m = (vertices_m.min(1) + vertices_m.max(1)) / 2
    trained = [capture.cameras[name] for name in capture.train_cameras]
    for row in found["per_image"]:
        middle_m = middles_m[body.index(row["frame"])]
        row["view_angle_deg"] = view_angle_deg(capture.cameras[row["camera"]], trained, middle_m)
    geometry = found.get("geometry")
    for row in [*found["per_image"], *(geometry["per_surface"] if geometry else ())]:
        row["pose_distance_deg"] = apart_deg[row["frame"]]


def frame_seconds(avatar: Avatar, camera: Camera, frame: int, side_px: int) -> float:
    """Return the median time in seconds to render a fitted pose as an image with this longest side."""
    resized = camera.scaled(side_px / max(camera.size_px))
    pose = avatar.body.pose(frame)
    seconds: list[float] = []
    while not seconds or (len(seconds) < REPEATS and seconds[0] < SLOW_S):
        started = time.perf_counter()
        with torch.no_grad():
            avatar.render(resized, *pose).rgb.cpu()
        seconds.append(time.perf_counter() - started)
    return float(np.median(seconds))
