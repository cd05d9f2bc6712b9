"""Fit the body to a capture, one shape and one pose per frame: keypoints in space, keypoints in the images, then
outlines."""

import logging
import math
from dataclasses import replace

import numpy as np
import torch
from scipy.ndimage import median_filter
from threadpoolctl import threadpool_limits
from torch import Tensor

from hnerf.body.articulation import Articulation, Pose
from hnerf.body.balance import Balance
from hnerf.body.body_model import BodyModel, body_model
from hnerf.body.clothed_fit import refine_with_clothing
from hnerf.body.contour_fit import Outline, outline, refine_with_outlines
from hnerf.body.fingers import fit_fingers
from hnerf.body.fit_result import BodyFit
from hnerf.body.given_start import given_poses_note, initial_pose_from_given, observations_of_pose
from hnerf.body.ground import Ground, is_ground
from hnerf.body.hand_points import PalmTerm, has_fingers, observe_hands
from hnerf.body.initial_root import root_from_image, root_from_space
from hnerf.body.keypoint_fit import Problem, levenberg_marquardt, metres_per_pixel
from hnerf.body.limb_depths import observe_limb_depths
from hnerf.body.observations import Observations, observe, runs
from hnerf.body.pose_prior import PosePrior, Smoothness
from hnerf.body.posture_prior import PosturePrior
from hnerf.body.reprojection import project
from hnerf.body.standing_feet import StandingFeet
from hnerf.capture.capture import Capture
from hnerf.capture.masks import Masks
from hnerf.capture.timing import median_step, nearest_rows
from hnerf.config import FitSettings
from hnerf.errors import InputError
from hnerf.geometry.silhouette import silhouette
from hnerf.progress import timed
from hnerf.results.preparation import FitReport

log = logging.getLogger("hnerf.fit")

# Standard deviation of each BODY_25 keypoint's acceleration, relative to the trunk's.
ACCELERATION_SCALE = np.array([2, 1, 1, 2, 3, 1, 2, 3, 1, 1, 2, 3, 1, 2, 3, 2, 2, 2, 2, 4, 4, 4, 4, 4, 4])
MEDIAN_FRAMES = 5  # frames that vote on which way a limb bends in depth
KEYPOINT_STEPS = 30  # Levenberg-Marquardt steps at most; it usually converges before
# Factor on standard deviations: keypoints alone say little about proportions, and at first nothing about where the
# detector places keypoints on the body.
TIGHT_STD = 0.1
# Ratio to the cost of one pose per frame: 1.1 to 1.3 by keypoint noise alone, 1.4 if joints sway by a degree, 2.0 by
# two.
MAX_SINGLE_POSTURE_COST = 1.5
KNOWN_STATURE_STD_M = 0.02  # of a stature from `capture.toml`: shoes, and how it was measured
MAX_STATURE_SIGMAS = 1.5  # from the usual or stated one, beyond which a stature from one camera is in doubt
DISTANCE_BYTES = 2**31
POOR_IOU, POOR_KEYPOINT_M = 0.75, 0.06  # a frame that is worse than either is flagged


def fit_body(capture: Capture, masks: Masks | None, settings: FitSettings) -> tuple[BodyFit, FitReport]:
    """Fit the body in every frame of a capture, from training cameras only; without masks, from keypoints alone.

    Raises InputError if keypoints are missing or too few cameras see the person in too many frames.
    """
    threads = torch.get_num_threads()  # for frames in parallel, one thread each
    with threadpool_limits(1):  # tensors are so small that threads cost more time than they save
        seconds: dict[str, float] = {}
        if capture.stature_m:
            known = {"stature_m": capture.stature_m, "stature_std_m": KNOWN_STATURE_STD_M}
            settings = settings.model_copy(update=known)
        model, given = body_model(settings), capture.given_poses()
        given_pose = initial_pose_from_given(given, model, capture.frames) if given else None
        observations = (
            observations_of_pose(given_pose, given.known, capture)
            if given and given_pose and not capture.has_keypoints
            else observe(capture)
        )
        smoothness = Smoothness(runs(capture), capture.fps, settings.acceleration_mps2 * ACCELERATION_SCALE)
        up, single = "xyz".index(capture.up), len(observations.cameras) == 1
        hands, step_s = observe_hands(capture), median_step(capture.frames) / capture.fps
        limb_depths, balance = observe_limb_depths(capture, observations), Balance(up) if single else None
        ground = None
        if single and is_ground(observations.cameras[0], observations.keypoints(0), capture.up, capture.stature_m):
            ground = Ground(up)
        with timed("start", seconds, log):
            pose = given_pose or initial_pose(capture, observations, model)
        palm = PalmTerm(hands) if hands and has_fingers(pose.rig) else None
        if not single:
            with timed("keypoints in space", seconds, log):
                problem = make_problem(
                    model, pose, observations, smoothness, settings, offsets=TIGHT_STD, proportions=TIGHT_STD
                )
                pose = levenberg_marquardt(replace(problem, in_space=True), pose, KEYPOINT_STEPS)
        with timed("keypoints in images", seconds, log):
            problem = make_problem(model, pose, observations, smoothness, settings, offsets=1, proportions=TIGHT_STD)
            problem = replace(problem, limb_depths=limb_depths, balance=balance, ground=ground)
            pose, posture_prior = _fit_in_images(capture, problem, pose, palm)
        if palm:
            with timed("fingers", seconds, log):
                pose = fit_fingers(pose, palm.views, problem.scale_m, runs(capture), step_s)
        if masks is not None:
            with timed("outlines", seconds, log):
                problem = make_problem(model, pose, observations, smoothness, settings, offsets=1, proportions=1)
                problem = replace(problem, limb_depths=limb_depths, balance=balance, palm=palm)
                problem = replace(problem, standing_feet=StandingFeet.of_pose(pose, runs(capture), capture.fps))
                problem = replace(problem, ground=ground and Ground(up, each_foot=True), posture_prior=posture_prior)
                edges = _outlines(capture, masks, problem.scale_m, settings.spacing_m)
                pose = refine_with_outlines(problem, pose, edges, up if ground else None, threads)
            with timed("clothes", seconds, log):
                pose = refine_with_clothing(problem, pose, edges, threads)
        if palm and masks is not None:
            with timed("fingers again", seconds, log):
                pose = fit_fingers(pose, palm.views, problem.scale_m, runs(capture), step_s)
        fit = BodyFit(pose.rig.to(dtype=torch.float32), capture.frames, pose.theta.float(), pose.root.float())
        report = _report(capture, masks, observations, pose, fit, seconds)
        if single:
            report["on_ground"] = ground is not None
            report["doubts"] = _doubts_about_depth(capture.name, posture_prior.single_posture)
            _warn_of_stature(report["stature_m"], settings, capture.stature_m is not None)
        if given_pose:
            report["given_poses"] = given_poses_note(model, capture)
        return fit, report


def _fit_in_images(capture: Capture, problem: Problem, pose: Pose, palm: PalmTerm | None) -> tuple[Pose, PosturePrior]:
    """Return the pose fitted to keypoints in the images, then to the palms as well, if hand points are known; and the
    posture prior for the next stages. With one camera, also resolve what a single view leaves ambiguous."""
    pose = levenberg_marquardt(problem, pose, KEYPOINT_STEPS)
    if palm:
        problem = replace(problem, palm=palm)
        pose = levenberg_marquardt(problem, pose, KEYPOINT_STEPS)
    cameras = problem.observations.cameras
    if len(cameras) > 1:
        return pose, PosturePrior.of_twists(len(pose.root), Articulation(pose.rig))
    posture_prior = PosturePrior.of_single_view(_by_split(capture), pose, cameras[0])
    problem = replace(problem, ground=problem.ground and replace(problem.ground, each_foot=True))
    pose = resolve_depth_flips(replace(problem, posture_prior=posture_prior), pose, runs(capture))
    return hold_single_posture(problem, pose, posture_prior)


def initial_pose(capture: Capture, observations: Observations, model: BodyModel) -> Pose:
    """Return the most likely pose of an average body, placed by head and trunk: in space, or in the image of a single
    camera.

    A frame where that fails takes the placement of the nearest frame where it does not. Raises InputError if it fails
    in most of the frames that show any part of a person.
    """
    rig = model.rig(None)
    articulation = Articulation(rig)
    rest_m = (rig.keypoint_weights @ rig.vertices_m).numpy()
    if len(observations.cameras) > 1:
        roots = [root_from_space(rest_m, points_m) for points_m in observations.space_m.numpy()]
    else:
        roots = [root_from_image(observations.cameras[0], rest_m, seen) for seen in observations.keypoints(0)]
    placed = {row: root for row, root in enumerate(roots) if root is not None}
    shown = int((observations.confidence > 0).any(-1).any(0).sum())  # the person may enter late
    if not placed or len(placed) < shown / 2:
        raise InputError(
            f"{capture.root / 'keypoints.npz'}: head and trunk are found by enough cameras in only {len(placed)} of "
            f"{shown} frames with a person; check the keypoint files and the calibration, or leave those frames out"
        )
    nearest = [placed[row] for row in nearest_rows(list(placed), capture.frames)]
    theta = torch.zeros(len(roots), len(rig.joints_m), 3, dtype=torch.float64)
    theta[:, articulation.joints[1:]] = PosePrior(articulation).mean_pose()
    return Pose(rig, theta, torch.from_numpy(np.stack(nearest)), torch.zeros(25, 3, dtype=torch.float64))


def resolve_depth_flips(problem: Problem, pose: Pose, runs_of_frames: list[tuple[int, ...]]) -> Pose:
    """Resolve limbs that are mirrored in depth: in one view, a bent limb and its mirror image look the same.

    A few frames in which the fit took the mirror image are outvoted by their neighbours (median filter), and the fit is
    repeated; the first result is kept if the cost does not fall. `runs_of_frames`: frames in order, by run.
    """
    pose = levenberg_marquardt(problem, pose, KEYPOINT_STEPS)
    parts = np.split(pose.theta.numpy(), np.cumsum([len(run) for run in runs_of_frames])[:-1])
    theta = np.concatenate([median_filter(part, (MEDIAN_FRAMES, 1, 1), mode="nearest") for part in parts])
    again = replace(pose, theta=torch.from_numpy(theta))
    again = levenberg_marquardt(problem, again, KEYPOINT_STEPS)
    before, after = (problem.assemble(p)[0] for p in (pose, again))
    return again if after < before else pose


def hold_single_posture(problem: Problem, pose: Pose, posture_prior: PosturePrior) -> tuple[Pose, PosturePrior]:
    """Hold a person who turns in front of the only camera to a single posture, if there is one; return the pose and the
    prior for the next stages.

    With a single posture all frames together determine the depth of each limb. It is accepted if keypoints and the
    other priors agree with it nearly as well as with one pose per frame; otherwise each joint keeps its own standard
    deviation.
    """
    learned = posture_prior.with_learned_std(pose)
    single = learned.as_single_posture()
    if single is None:
        return pose, learned
    held = levenberg_marquardt(replace(problem, posture_prior=single), pose, KEYPOINT_STEPS)
    free_cost, held_cost = (problem.assemble(p)[0] for p in (pose, held))
    log.info("one posture in all frames costs %.2f times what one pose per frame does", held_cost / free_cost)
    return (held, single) if held_cost < MAX_SINGLE_POSTURE_COST * free_cost else (pose, learned)


def make_problem(
    model: BodyModel, pose: Pose, observations: Observations, smoothness: Smoothness, settings: FitSettings,
    offsets: float, proportions: float,
) -> Problem:  # fmt: skip
    """Return the least-squares problem at a pose; `offsets` and `proportions` scale the standard deviations of the
    keypoint offsets and of the shape's details."""
    model = replace(model, std=torch.where(model.details, proportions * model.std, model.std))
    settings = settings.model_copy(update={"offset_m": offsets * settings.offset_m})
    return Problem(observations, metres_per_pixel(observations.cameras, pose), model, settings, smoothness)


def _by_split(capture: Capture) -> list[list[int]]:
    """Return the rows of the training frames, and those of the novel-pose frames, without empty groups."""
    novel = set(capture.novel_pose_frames)
    rows = [[t for t, frame in enumerate(capture.frames) if (frame in novel) == wanted] for wanted in (False, True)]
    return [group for group in rows if group]


def _outlines(capture: Capture, masks: Masks, scale_m: Tensor, spacing_m: float) -> list[list[Outline | None]]:
    """Return the masks' outlines by frame and training camera; None where a mask was dropped or is empty. Their
    distances are stored at every pixel, or at as many as fit into DISTANCE_BYTES."""
    pixels = len(capture.frames) * sum(math.prod(capture.cameras[name].size_px) for name in capture.train_cameras)
    stride = max(1, math.ceil(math.sqrt(pixels * np.float32().itemsize / DISTANCE_BYTES)))
    edges: list[list[Outline | None]] = []
    for t, frame in enumerate(capture.frames):
        found = [masks.get(name, frame) if (name, frame) in masks else None for name in capture.train_cameras]
        spacings_px = spacing_m / scale_m[:, t].numpy()
        pairs = zip(found, spacings_px, strict=True)
        edges.append([outline(m, px, stride) if m is not None and m.any() else None for m, px in pairs])
    return edges


def _report(
    capture: Capture,
    masks: Masks | None,
    observations: Observations,
    pose: Pose,
    fit: BodyFit,
    seconds: dict[str, float],
) -> FitReport:
    """Return how good the fit is."""
    residual_px = _keypoint_residuals_px(observations, fit)
    residual_m = residual_px * metres_per_pixel(observations.cameras, pose).mean(0).numpy()
    iou = None if masks is None else _silhouette_iou(capture, masks, fit)
    poor = residual_m > POOR_KEYPOINT_M
    poor |= np.isnan(residual_m) if iou is None else [value is None or value < POOR_IOU for value in iou]
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


def _doubts_about_depth(name: str, single_posture: Tensor) -> list[str]:
    """Return and log in which frames a single camera leaves the depth of limbs open. single_posture (n,) bool: the
    frames in which all others of their posture determine it."""
    undetermined, frames = int((~single_posture).sum()), len(single_posture)
    if not undetermined:
        return []
    line = (
        f"one camera does not determine the depth of limbs in {undetermined} of {frames} frames: that needs a second "
        "camera, or a person who turns around in one posture"
    )
    log.warning("%s: %s", name, line)
    return [line]


def _warn_of_stature(stature_m: float, settings: FitSettings, stated: bool) -> None:
    """Warn if a single camera makes the person much taller or shorter than expected, or than `capture.toml` states:
    they may not be standing at height 0."""
    off_m = stature_m - settings.stature_m
    if abs(off_m) > MAX_STATURE_SIGMAS * settings.stature_std_m:
        log.warning(
            "the person comes out %.2f m tall, %.2f m %s: do they stand on world height 0, and is the camera's height "
            "right? %s",
            stature_m,
            settings.stature_m,
            "stated" if stated else "expected",
            "Check stature_m in capture.toml, too" if stated else "State their height as stature_m in capture.toml",
        )


def _keypoint_residuals_px(observations: Observations, fit: BodyFit) -> np.ndarray:
    """Return each frame's median residual over cameras and keypoints, (n,); NaN where nothing was detected."""
    keypoints = torch.einsum("kv,nvd->nkd", fit.rig.keypoint_weights, fit.vertices_m()).double()
    off = torch.stack([project(camera, keypoints)[0] for camera in observations.cameras]) - observations.pixels
    distance = torch.where(observations.confidence > 0, off.norm(dim=-1), torch.nan)
    return distance.transpose(0, 1).flatten(1).nanmedian(1).values.numpy()


def _silhouette_iou(capture: Capture, masks: Masks, fit: BodyFit) -> list[float | None]:
    """Return the mean over training cameras of the naked body's IoU with the masks, by frame; None where all were
    dropped."""
    faces = fit.rig.faces.numpy()
    means: list[float | None] = []
    for frame, vertices_m in zip(fit.frames, fit.vertices_m().numpy(), strict=True):
        values = []
        for name in (n for n in capture.train_cameras if (n, frame) in masks):
            covered, mask = silhouette(capture.cameras[name], vertices_m, faces), masks.get(name, frame)
            values.append((covered & mask).sum() / max((covered | mask).sum(), 1))
        means.append(round(float(np.mean(values)), 4) if values else None)
    return means
