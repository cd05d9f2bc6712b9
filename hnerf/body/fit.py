"""Fit the body to a capture: keypoints in space, keypoints in the images, then outlines; one shape, a pose a frame."""

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from threadpoolctl import threadpool_limits
from torch import Tensor

from hnerf.body.anny import ADULT, BETA_HIGH, BETA_LOW, LOCAL_CHANGES, PHENOTYPES, anny_rig
from hnerf.body.articulation import Articulation, Pose
from hnerf.body.contour_fit import ContourWeights, Outline, outline, refine
from hnerf.body.fit_result import BodyFit
from hnerf.body.initial_root import root_from_image, root_from_space
from hnerf.body.keypoint_fit import Likely, Problem, levenberg_marquardt, metres_per_pixel, project
from hnerf.body.observations import Observations, observe, runs
from hnerf.body.pose_prior import PosePrior, Smoothness
from hnerf.body.rig import Rig
from hnerf.capture.capture import Capture
from hnerf.config import FitSettings
from hnerf.errors import CaptureError
from hnerf.render.silhouette import silhouette

if TYPE_CHECKING:
    from hnerf.segmentation.masks import Masks

log = logging.getLogger("hnerf.fit")

# How much harder each BODY_25 keypoint accelerates than the trunk.
LIVELINESS = np.array([2, 1, 1, 2, 3, 1, 2, 3, 1, 1, 2, 3, 1, 2, 3, 2, 2, 2, 2, 4, 4, 4, 4, 4, 4])
KEYPOINT_STEPS = 30  # Levenberg-Marquardt steps at most; it stops by itself
HELD = 0.1  # of its spread: keypoints alone say little of proportions, and at first nothing of a detector's habits
POOR_IOU, POOR_KEYPOINT_M = 0.75, 0.06  # beyond which a frame is flagged


def fit_body(capture: Capture, masks: "Masks | None", settings: FitSettings) -> tuple[BodyFit, dict[str, Any]]:
    """The body in every frame of a capture, from training cameras only; without masks, from keypoints alone.

    Returns the fit and a plain report: seconds by stage, the shape, and for each frame the median keypoint residual in
    px and the silhouette's IoU with the masks (None without), with the frames where these are poor. Raises
    CaptureError where keypoints are missing or the person is seen by too few cameras in too many frames.
    """
    with threadpool_limits(1):  # so small are the tensors that threads cost more than they give
        seconds: dict[str, float] = {}
        seen = observe(capture)
        smoothness = Smoothness(runs(capture), capture.fps, settings.acceleration_mps2 * LIVELINESS)
        with _timed(seconds, "start"):
            pose = start(capture, seen)
        if len(seen.cameras) > 1:
            with _timed(seconds, "keypoints in space"):
                problem = _problem(pose, seen, smoothness, settings, offsets=HELD, proportions=HELD)
                pose = levenberg_marquardt(problem, pose, problem.in_space, KEYPOINT_STEPS)
        with _timed(seconds, "keypoints in images"):
            problem = _problem(pose, seen, smoothness, settings, offsets=1, proportions=HELD)
            pose = levenberg_marquardt(problem, pose, problem.in_images, KEYPOINT_STEPS)
        if masks is not None:
            with _timed(seconds, "outlines"):
                problem = _problem(pose, seen, smoothness, settings, offsets=1, proportions=1)
                edges = _outlines(capture, masks, problem.scale_m, settings.spacing_m)
                weights = ContourWeights(settings.inside_m, settings.outside_m, settings.clothing_m, settings.spacing_m)
                pose = refine(problem, pose, edges, weights, "xyz".index(capture.up), settings.contour_steps)
        fit = BodyFit(pose.rig.to(dtype=torch.float32), capture.frames, pose.theta.float(), pose.root.float())
        return fit, _report(capture, masks, seen, pose, fit, seconds)


def start(capture: Capture, seen: Observations) -> Pose:
    """The likeliest pose of an average body, placed by shoulders and hips in space, or by head and trunk in the image
    of a single camera; frames where that fails stand as their nearest neighbour does."""
    rig = _rig()
    articulation = Articulation(rig)
    rest_m = (rig.keypoint_weights @ rig.vertices_m).numpy()
    if len(seen.cameras) > 1:
        roots = [root_from_space(rest_m, points_m) for points_m in seen.space_m.numpy()]
    else:
        views = torch.cat([seen.pixels[0], seen.confidence[0, ..., None]], -1).numpy()
        roots = [root_from_image(seen.cameras[0], rest_m, keypoints) for keypoints in views]
    placed = {t: root for t, root in enumerate(roots) if root is not None}
    if len(placed) < len(roots) / 2:
        raise CaptureError(
            f"{capture.root / 'keypoints.npz'}: shoulders and hips are found by enough cameras in only {len(placed)} "
            f"of {len(roots)} frames; check the keypoint files and the calibration, or leave those frames out"
        )
    nearest = [placed[min(placed, key=lambda known: abs(known - t))] for t in range(len(roots))]
    theta = torch.zeros(len(roots), len(rig.joints_m), 3, dtype=torch.float64)
    theta[:, articulation.joints[1:]] = PosePrior(articulation).likely()
    return Pose(rig, theta, torch.from_numpy(np.stack(nearest)), torch.zeros(25, 3, dtype=torch.float64))


def _problem(
    pose: Pose, seen: Observations, smoothness: Smoothness, settings: FitSettings, offsets: float, proportions: float
) -> Problem:
    """`offsets` and `proportions` scale the spread of the keypoint offsets and of the local changes."""
    local = settings.local_change_spread * proportions
    spread = [settings.phenotype_spread] * len(PHENOTYPES) + [local] * len(LOCAL_CHANGES)
    likely = Likely(
        settings.keypoint_m,
        settings.keypoint_outlier_m,
        settings.offset_m * offsets,
        settings.stature_m,
        settings.stature_spread_m,
        *(torch.tensor(values, dtype=torch.float64) for values in (ADULT, spread, BETA_LOW, BETA_HIGH)),
    )
    return Problem(seen, metres_per_pixel(seen.cameras, pose), likely, smoothness, _rig)


def _rig(beta: Tensor | None = None) -> Rig:
    return anny_rig(beta).to(dtype=torch.float64)


def _outlines(capture: Capture, masks: "Masks", scale_m: Tensor, spacing_m: float) -> list[list[Outline | None]]:
    """By frame and training camera; None where a mask is empty."""
    edges: list[list[Outline | None]] = []
    for t, frame in enumerate(capture.frames):
        found = [masks.get(name, frame) for name in capture.train_cameras]
        spacings_px = spacing_m / scale_m[:, t].numpy()
        edges.append([outline(m, px) if m.any() else None for m, px in zip(found, spacings_px, strict=True)])
    return edges


def _report(
    capture: Capture, masks: "Masks | None", seen: Observations, pose: Pose, fit: BodyFit, seconds: dict[str, float]
) -> dict[str, Any]:
    """Plain values that say how good the fit is."""
    residual_px = _keypoint_residuals_px(seen, fit)
    residual_m = residual_px * metres_per_pixel(seen.cameras, pose).mean(0).numpy()
    iou = None if masks is None else _silhouette_iou(capture, masks, fit)
    poor = residual_m > POOR_KEYPOINT_M
    if iou is not None:
        poor |= np.array(iou) < POOR_IOU
    flagged = [frame for frame, bad in zip(fit.frames, poor, strict=True) if bad]
    if flagged:
        log.warning("the fit is poor in %d of %d frames: %s", len(flagged), len(poor), flagged)
    vertices_m = pose.rig.vertices_m
    return {
        "seconds": seconds,
        "frames": list(fit.frames),
        "keypoint_residual_px": [round(float(value), 2) for value in residual_px],
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


def _silhouette_iou(capture: Capture, masks: "Masks", fit: BodyFit) -> list[float]:
    """Mean over training cameras of the naked body's IoU with the masks, by frame."""
    faces = fit.rig.faces.numpy()
    means = []
    for frame, vertices_m in zip(fit.frames, fit.vertices_m().numpy(), strict=True):
        values = []
        for name in capture.train_cameras:
            covered, mask = silhouette(capture.cameras[name], vertices_m, faces), masks.get(name, frame)
            values.append((covered & mask).sum() / max((covered | mask).sum(), 1))
        means.append(round(float(np.mean(values)), 4))
    return means


@contextmanager
def _timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    began = time.monotonic()
    yield
    seconds[stage] = round(time.monotonic() - began, 2)
    log.info("%s: %.1f s", stage, seconds[stage])
