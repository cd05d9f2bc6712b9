"""What a training was worth: its snapshots and its end scored on what was held out, images timed."""

import json
import logging
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from hnerf.capture.camera import Camera
from hnerf.capture.capture import Capture, read_rgb, write_image
from hnerf.errors import CaptureError
from hnerf.evaluation.evaluate import (
    LPIPS,
    MEANS,
    PROTOCOL,
    known_views,
    mesh_frames,
    render,
    score_meshes,
    score_split,
)
from hnerf.evaluation.ground_truth import GroundTruth
from hnerf.evaluation.pictures import crop, frame_person
from hnerf.evaluation.views import SPLITS, View, all_views, split_frames
from hnerf.render.avatar import Avatar
from hnerf.spread import spread
from hnerf.study.machine import machine
from hnerf.study.nearness import pose_distances_deg, view_angle_deg
from hnerf.study.plan import ScoringSettings
from hnerf.training.model import load_avatar

log = logging.getLogger("hnerf.study")

PICTURES = 2
REPEATS = 3
LONG_S = 10.0  # an image that takes as long is timed once
ONE_MOMENT = "models one moment"
NO_NOVEL_POSES = {
    "nerf": f"NeRF {ONE_MOMENT}",
    "idr": f"IDR {ONE_MOMENT}",
    "nerfies": "Nerfies has no pose to set: it replays the moments it was trained on",
}
HOW = (
    "Training seconds: the trainer's own clock, without reading the capture. Curves: fewer images and surfaces than "
    "tables, the same ones at every point and for all methods; the last point is the finished subject; fitting "
    "novel poses to it counts only where new poses are what is scored. "
    f"Time of a frame: median of {REPEATS} renderings of a whole image, of one where it takes over {LONG_S:.0f} s. "
    "Peak memory: on a CPU that of the training process, all libraries included; on a GPU what tensors took."
)


@dataclass(frozen=True)
class Scene:
    """What scoring needs besides a training: the capture with calibrated cameras, and the truth where there is one."""

    capture: Capture
    truth: GroundTruth | None
    device: str


def score(scene: Scene, training: Path, settings: ScoringSettings, out: Path) -> dict[str, Any]:
    """Write `scores.json`, renderings and meshes into `out`; what scores.json holds.

    training: the folder that training left. A figure that cannot be had is null, and a reason stands beside it.
    """
    avatar = load_avatar(training, scene.device)
    reason = why_no_novel_poses(training)
    found: dict[str, Any] = {"machine": machine(), "protocol": f"{PROTOCOL} {HOW}", "lpips": LPIPS}
    split = curve_split(scene, settings)
    found["split"], found["training"] = split, json.loads((training / "report.json").read_text())
    found["curve"] = [] if split == "novel_pose" and reason else curve(scene, split, training, avatar, settings, out)
    for name in SPLITS:
        if name == "novel_pose" and reason:
            found[name] = {"n": 0, "per_image": [], "reason": reason} | dict.fromkeys(MEANS)
            found[name] |= {"geometry": None, "geometry_reason": reason}
        else:
            found[name] = score_at(scene, avatar, name, settings.images, settings.meshes, out)
            add_nearness(scene.capture, avatar, name, found[name])
    found["pictures"] = write_pictures(scene, split, found[split]["per_image"], out)
    camera = next(iter(scene.capture.cameras.values()))
    found["frame_seconds"] = {
        str(side): frame_seconds(avatar, camera, scene.capture.train_frames[0], side)
        for side in settings.frame_sizes_px
    }
    (out / "scores.json").write_text(json.dumps(found, indent=1))
    return found


def score_end(scene: Scene, training: Path, settings: ScoringSettings, out: Path) -> dict[str, Any]:
    """Write `scores.json` with what training reported and the last point of its curve alone; what it holds."""
    reason, split = why_no_novel_poses(training), curve_split(scene, settings)
    avatar = load_avatar(training, scene.device)
    rows = [] if split == "novel_pose" and reason else curve(scene, split, training, avatar, settings, out)
    found = {"training": json.loads((training / "report.json").read_text()), "curve": rows[-1:]}
    (out / "scores.json").write_text(json.dumps(found, indent=1))
    return found


def curve_split(scene: Scene, settings: ScoringSettings) -> str:
    """The split that curves are of."""
    return settings.split if scene.capture.test_cameras else "novel_pose"


def why_no_novel_poses(training: Path) -> str | None:
    """Why what training left in a folder cannot show poses that it was not trained on; None if it can."""
    stored = json.loads((training / "settings.json").read_text())
    machinery: str = stored["training"]["machinery"]
    if machinery == "paper" and stored["static"]:
        return f"H-NeRF's static network {ONE_MOMENT}"
    return NO_NOVEL_POSES.get(machinery)


def curve(
    scene: Scene, split: str, training: Path, finished: Avatar, settings: ScoringSettings, out: Path
) -> list[dict[str, Any]]:
    """Seconds of training and figures of every snapshot, and last of the finished model, in the order of time."""
    report = json.loads((training / "report.json").read_text())
    end_s = report["field_seconds" if split == "novel_view" else "seconds"]
    taken = {json.loads((f / "settings.json").read_text())["seconds"]: f for f in (training / "snapshots").glob("*")}
    models = [(s, load_avatar(taken[s], scene.device)) for s in sorted(taken) if s < end_s]
    rows = []
    for seconds, avatar in [*models, (end_s, finished)]:
        folder = out / "snapshots" / f"{seconds:g}"
        folder.mkdir(parents=True)
        figures = score_at(scene, avatar, split, settings.snapshot_images, settings.snapshot_meshes, folder)
        del figures["per_image"]
        rows.append({"seconds": seconds} | figures)
        log.info("after %.0f s: %s dB", seconds, figures["psnr"])
    return rows


def score_at(scene: Scene, avatar: Avatar, split: str, images: int | None, meshes: int, out: Path) -> dict[str, Any]:
    """A split's figures in the form of evaluation, of at most as many images and surfaces of which the truth is known;
    None is all."""
    views = all_views(scene.capture, split)
    views = spread(known_views(views, scene.truth) or views, images or len(views))
    if views:
        render(avatar, scene.capture, views, out)
    found = score_split(split, views, scene.truth, out)
    if not meshes:
        return found | {"geometry": None, "geometry_reason": "the study asks for no surface here"}
    true_meshes = scene.truth.meshes() if scene.truth else {}
    frames = [f for f in mesh_frames(split_frames(scene.capture, split), true_meshes, meshes) if f in true_meshes]
    try:
        return found | score_meshes(avatar, frames, true_meshes, out)
    except CaptureError as error:  # a result of young or failed models, not a fault of the study
        return found | {"geometry": None, "geometry_reason": str(error)}


def write_pictures(scene: Scene, split: str, per_image: list[dict[str, Any]], out: Path) -> list[dict[str, Any]]:
    """Write a few scored renderings and the truth, cut to the person, as `pictures/<k>-{render,truth}.png`; which."""
    chosen = [{key: row[key] for key in ("camera", "frame")} for row in spread(per_image, PICTURES)]
    for k, row in enumerate(chosen):
        assert scene.truth is not None  # something was scored
        box = frame_person(scene.truth.mask(**row))
        both = {"render": read_rgb(View(split, **row).path(out)), "truth": scene.truth.on_black(**row)[0]}
        for name, picture in both.items():
            write_image(out / "pictures" / f"{k}-{name}.png", crop(picture, box))
    return chosen


def add_nearness(capture: Capture, avatar: Avatar, split: str, found: dict[str, Any]) -> None:
    """Put beside each image's and surface's figures how far its view and its pose are from those of training."""
    apart_deg = pose_distances_deg(avatar.body, split_frames(capture, split), capture.train_frames)
    vertices_m = avatar.body.vertices_m().cpu().numpy()
    middles_m = (vertices_m.min(1) + vertices_m.max(1)) / 2
    trained = [capture.cameras[name] for name in capture.train_cameras]
    for row in found["per_image"]:
        middle_m = middles_m[avatar.body.index(row["frame"])]
        row["view_angle_deg"] = view_angle_deg(capture.cameras[row["camera"]], trained, middle_m)
    for row in [*found["per_image"], *((found["geometry"] or {}).get("per_surface", ()))]:
        row["pose_distance_deg"] = apart_deg[row["frame"]]


def frame_seconds(avatar: Avatar, camera: Camera, frame: int, side_px: int) -> float:
    """Median seconds of rendering a fitted pose to an image of this longest side."""
    scale = side_px / max(camera.width_px, camera.height_px)
    resized = camera.resized(round(camera.width_px * scale), round(camera.height_px * scale))
    k = avatar.body.index(frame)
    seconds: list[float] = []
    while not seconds or (len(seconds) < REPEATS and seconds[0] < LONG_S):
        started = time.perf_counter()
        with torch.no_grad():
            avatar.render(resized, avatar.body.theta[k], avatar.body.root[k]).rgb.cpu()
        seconds.append(time.perf_counter() - started)
    return float(np.median(seconds))
