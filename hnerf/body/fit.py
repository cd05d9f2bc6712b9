"""Fit the body to a capture: keypoints in space, keypoints in the images, then outlines; one shape, a pose a frame."""

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from scipy.ndimage import median_filter
from threadpoolctl import threadpool_limits
from torch import Tensor

from hnerf.body.articulation import Articulation, Pose
from hnerf.body.balance import Balance
from hnerf.body.body_model import BodyModel, body_model
from hnerf.body.clothed_fit import refine_clothed
from hnerf.body.contour_fit import Outline, outline, refine
from hnerf.body.fit_result import BodyFit
from hnerf.body.given_start import given_start, seen_on, told_of
from hnerf.body.initial_root import root_from_image, root_from_space
from hnerf.body.keypoint_fit import FitPriors, Problem, levenberg_marquardt, metres_per_pixel, project
from hnerf.body.observations import Observations, observe, runs
from hnerf.body.pose_prior import PosePrior, Smoothness
from hnerf.body.posture_prior import PosturePrior
from hnerf.capture.capture import Capture
from hnerf.capture.masks import Masks
from hnerf.config import FitSettings
from hnerf.errors import InputError
from hnerf.geometry.silhouette import silhouette

log = logging.getLogger("hnerf.fit")

# How much harder each BODY_25 keypoint accelerates than the trunk.
LIVELINESS = np.array([2, 1, 1, 2, 3, 1, 2, 3, 1, 1, 2, 3, 1, 2, 3, 2, 2, 2, 2, 4, 4, 4, 4, 4, 4])
NEIGHBOURS = 5  # frames that vote on which way a limb bends in depth
KEYPOINT_STEPS = 30  # Levenberg-Marquardt steps at most; it stops by itself
HELD = 0.1  # of its spread: keypoints alone say little of proportions, and at first nothing of a detector's habits
ONE_POSTURE_COSTS = 1.5  # times; noise of keypoints alone 1.1 to 1.3, joints that sway by a degree 1.4, by two 2.0
POOR_IOU, POOR_KEYPOINT_M = 0.75, 0.06  # beyond which a frame is flagged


def fit_body(capture: Capture, masks: Masks | None, settings: FitSettings) -> tuple[BodyFit, dict[str, Any]]:
    """The body in every frame of a capture, from training cameras only; without masks, from keypoints alone.

    Returns the fit and a plain report: seconds by stage, the shape, and for each frame the median keypoint residual in
    px and the silhouette's IoU with the masks (None without), with the frames where these are poor. Raises
    InputError where keypoints are missing or the person is seen by too few cameras in too many frames.
    """
    with threadpool_limits(1):  # so small are the tensors that threads cost more than they give
        seconds: dict[str, float] = {}
        model, given = body_model(settings), capture.given_poses()
        begin = given_start(given, model) if given else None
        seen = observe(capture) if capture.has_keypoints or begin is None else seen_on(begin, capture)
        smoothness = Smoothness(runs(capture), capture.fps, settings.acceleration_mps2 * LIVELINESS)
        up = "xyz".index(capture.up)
        balance = Balance(up) if len(seen.cameras) == 1 else None
        with _timed(seconds, "start"):
            pose = begin or start(capture, seen, model)
        if len(seen.cameras) > 1:
            with _timed(seconds, "keypoints in space"):
                problem = problem_of(model, pose, seen, smoothness, settings, offsets=HELD, proportions=HELD)
                pose = levenberg_marquardt(problem, pose, problem.in_space, KEYPOINT_STEPS)
        with _timed(seconds, "keypoints in images"):
            problem = problem_of(model, pose, seen, smoothness, settings, offsets=1, proportions=HELD)
            problem = replace(problem, balance=balance)
            pose = levenberg_marquardt(problem, pose, problem.in_images, KEYPOINT_STEPS)
            if balance:
                habit = PosturePrior.of_one_view(_by_split(capture), pose, seen.cameras[0])
                pose = resolve_depth_flips(replace(problem, habit=habit), pose, runs(capture))
                pose, habit = hold_single_posture(problem, pose, habit)
            else:
                habit = PosturePrior.of_hands(len(pose.root), Articulation(pose.rig))
        if masks is not None:
            with _timed(seconds, "outlines"):
                problem = problem_of(model, pose, seen, smoothness, settings, offsets=1, proportions=1)
                problem = replace(problem, balance=balance, habit=habit)
                edges = _outlines(capture, masks, problem.scale_m, settings.spacing_m)
                pose = refine(problem, pose, edges, settings, up)
            with _timed(seconds, "clothes"):
                pose = refine_clothed(problem, pose, edges)
        fit = BodyFit(pose.rig.to(dtype=torch.float32), capture.frames, pose.theta.float(), pose.root.float())
        report = _report(capture, masks, seen, pose, fit, seconds)
        return fit, report | ({"given_poses": told_of(model, capture)} if begin else {})


def start(capture: Capture, seen: Observations, model: BodyModel) -> Pose:
    """The likeliest pose of an average body, placed by head and trunk, in space or in the image of a single camera;
    frames where that fails stand as their nearest neighbour does."""
    rig = model.rig(None)
    articulation = Articulation(rig)
    rest_m = (rig.keypoint_weights @ rig.vertices_m).numpy()
    if len(seen.cameras) > 1:
        roots = [root_from_space(rest_m, points_m) for points_m in seen.space_m.numpy()]
    else:
        views = torch.cat([seen.pixels[0], seen.confidence[0, ..., None]], -1).numpy()
        roots = [root_from_image(seen.cameras[0], rest_m, keypoints) for keypoints in views]
    placed = {t: root for t, root in enumerate(roots) if root is not None}
    if len(placed) < len(roots) / 2:
        raise InputError(
            f"{capture.root / 'keypoints.npz'}: head and trunk are found by enough cameras in only {len(placed)} of "
            f"{len(roots)} frames; check the keypoint files and the calibration, or leave those frames out"
        )
    nearest = [placed[min(placed, key=lambda known: abs(known - t))] for t in range(len(roots))]
    theta = torch.zeros(len(roots), len(rig.joints_m), 3, dtype=torch.float64)
    theta[:, articulation.joints[1:]] = PosePrior(articulation).likely()
    return Pose(rig, theta, torch.from_numpy(np.stack(nearest)), torch.zeros(25, 3, dtype=torch.float64))


def resolve_depth_flips(problem: Problem, pose: Pose, follow: list[tuple[int, ...]]) -> Pose:
    """One view shows a bent limb and its mirror image in depth alike; a few frames that fell for the mirror image are
    outvoted by their neighbours. `follow`: frames in order, by run. Without the vote where nothing is gained."""
    pose = levenberg_marquardt(problem, pose, problem.in_images, KEYPOINT_STEPS)
    parts = np.split(pose.theta.numpy(), np.cumsum([len(run) for run in follow])[:-1])
    theta = np.concatenate([median_filter(part, (NEIGHBOURS, 1, 1), mode="nearest") for part in parts])
    again = replace(pose, theta=torch.from_numpy(theta))
    again = levenberg_marquardt(problem, again, problem.in_images, KEYPOINT_STEPS)
    before, after = (problem.assemble(p, problem.in_images)[0] for p in (pose, again))
    return again if after < before else pose


def hold_single_posture(problem: Problem, pose: Pose, habit: PosturePrior) -> tuple[Pose, PosturePrior]:
    """Who turns before the only camera in one posture is held to it, so that all frames tell together how deep a limb
    lies; otherwise each joint keeps the spread it has. One posture it is where the keypoints, and all that is likely
    beside the habit, agree with it nearly as well as with a pose a frame."""
    learned = habit.learned(pose)
    still = learned.of_one_posture()
    if still is None:
        return pose, learned
    held = levenberg_marquardt(replace(problem, habit=still), pose, problem.in_images, KEYPOINT_STEPS)
    free_cost, held_cost = (problem.assemble(p, problem.in_images)[0] for p in (pose, held))
    log.info("one posture in all frames costs %.2f times what a pose a frame does", held_cost / free_cost)
    return (held, still) if held_cost < ONE_POSTURE_COSTS * free_cost else (pose, learned)


def problem_of(
    model: BodyModel, pose: Pose, seen: Observations, smoothness: Smoothness, settings: FitSettings, offsets: float,
    proportions: float,
) -> Problem:  # fmt: skip
    """`offsets` and `proportions` scale the spread of the keypoint offsets and of the shape's details."""
    likely = FitPriors(
        settings.keypoint_m,
        settings.keypoint_outlier_m,
        settings.offset_m * offsets,
        settings.stature_m,
        settings.stature_std_m,
        model.mean,
        torch.where(model.details, proportions * model.spread, model.spread),
        model.low,
        model.high,
    )
    return Problem(seen, metres_per_pixel(seen.cameras, pose), likely, smoothness, model.rig)


def _by_split(capture: Capture) -> list[list[int]]:
    """Rows of the training frames, and of those of novel poses."""
    novel = set(capture.novel_pose_frames)
    rows = [[t for t, frame in enumerate(capture.frames) if (frame in novel) == wanted] for wanted in (False, True)]
    return [group for group in rows if group]


def _outlines(capture: Capture, masks: Masks, scale_m: Tensor, spacing_m: float) -> list[list[Outline | None]]:
    """By frame and training camera; None where a mask was dropped or is empty."""
    edges: list[list[Outline | None]] = []
    for t, frame in enumerate(capture.frames):
        found = [masks.get(name, frame) if (name, frame) in masks else None for name in capture.train_cameras]
        spacings_px = spacing_m / scale_m[:, t].numpy()
        pairs = zip(found, spacings_px, strict=True)
        edges.append([outline(m, px) if m is not None and m.any() else None for m, px in pairs])
    return edges


def _report(
    capture: Capture, masks: Masks | None, seen: Observations, pose: Pose, fit: BodyFit, seconds: dict[str, float]
) -> dict[str, Any]:
    """Plain values that say how good the fit is."""
    residual_px = _keypoint_residuals_px(seen, fit)
    residual_m = residual_px * metres_per_pixel(seen.cameras, pose).mean(0).numpy()
    iou = None if masks is None else _silhouette_iou(capture, masks, fit)
    poor = residual_m > POOR_KEYPOINT_M
    if iou is not None:
        poor |= np.array([value is None or value < POOR_IOU for value in iou])
    flagged = [frame for frame, bad in zip(fit.frames, poor, strict=True) if bad]
    if flagged:
        log.warning("the fit is poor in %d of %d frames: %s", len(flagged), len(poor), flagged)
    vertices_m = pose.rig.vertices_m
    return {
        "seconds": seconds,
        "frames": list(fit.frames),
        "keypoint_residual_px": [None if np.isnan(value) else round(float(value), 2) for value in residual_px],
        "silhouette_iou": iou,
        "poor_frames": flagged,
        "stature_m": round(float(vertices_m[:, 2].max() - vertices_m[:, 2].min()), 3),
        "beta": dict(zip(pose.rig.beta_names, pose.rig.beta.tolist(), strict=True)),
        "keypoint_offsets_m": pose.offsets_m.tolist(),
    }


def _keypoint_residuals_px(seen: Observations, fit: BodyFit) -> np.ndarray:
    """Median over cameras and keypoints, (n,); NaN where nothing was detected."""
    keypoints = torch.einsum("kv,nvd->nkd", fit.rig.keypoint_weights, fit.vertices_m()).double()
    off = torch.stack([project(camera, keypoints)[0] for camera in seen.cameras]) - seen.pixels
    distance = torch.where(seen.confidence > 0, off.norm(dim=-1), torch.nan)
    return distance.transpose(0, 1).flatten(1).nanmedian(1).values.numpy()


def _silhouette_iou(capture: Capture, masks: Masks, fit: BodyFit) -> list[float | None]:
    """Mean over training cameras of the naked body's IoU with the masks, by frame; None where all were dropped."""
    faces = fit.rig.faces.numpy()
    means: list[float | None] = []
    for frame, vertices_m in zip(fit.frames, fit.vertices_m().numpy(), strict=True):
        values = []
        for name in (n for n in capture.train_cameras if (n, frame) in masks):
            covered, mask = silhouette(capture.cameras[name], vertices_m, faces), masks.get(name, frame)
            values.append((covered & mask).sum() / max((covered | mask).sum(), 1))
        means.append(round(float(np.mean(values)), 4) if values else None)
    return means


@contextmanager
def _timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    began = time.monotonic()
    yield
    seconds[stage] = round(time.monotonic() - began, 2)
    log.info("%s: %.1f s", stage, seconds[stage])
