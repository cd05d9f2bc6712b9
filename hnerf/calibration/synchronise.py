"""Synchronisation: the time offset of each camera against the others, to a fraction of a frame.

The other cameras triangulate the keypoints; the camera's own keypoints of earlier and later frames are compared with
their projections. The part that a small rotation or translation of the camera would explain is removed first, so that a
stale pose is not mistaken for an offset. The mean square distance over whole-frame shifts is a parabola near its
minimum: its vertex is the offset, its curvature shows how well the motion determines it, and a jackknife over blocks of
frames gives the standard error.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hnerf.calibration.diagnosis import TRIM, trimmed_cost_px, trimmed_mean
from hnerf.capture.capture import Capture
from hnerf.capture.timing import median_step, resample
from hnerf.config import CalibrationSettings
from hnerf.errors import InputError
from hnerf.geometry.camera import Camera
from hnerf.geometry.triangulation import triangulate

MAX_STEPS = 10  # largest shift tried in either direction, in steps between the capture's frames
MIN_FRAMES = 8  # frames that a shifted camera must share with the others, at the best shift and its two neighbours
JACKKNIFE_BLOCKS = 12  # of consecutive frames, each left out once
SUSPECTED_SIGMAS, CERTAIN_SIGMAS = (2.0, 5.0)  # standard errors beyond which an offset is suspected, or certain
MIN_OFFSET_FRAMES = 0.1  # smaller offsets are below the resolution of the parabola fit
MAX_DISTANCE_FRAMES = 1.2  # between an instant and the recorded image that shows it
MAX_ERROR_STEPS = 0.5  # standard error; beyond it an offset is not observable
MIN_CURVATURE_SIGMAS = 2.0  # standard errors by which the curvature must exceed 0
IRLS_ROUNDS = 5  # of iteratively re-weighted least squares
OUTLIER_SCALES = 3.0  # times the scale of the residuals
MIN_SCALE_PX = 0.5  # of the residuals; no detector is more accurate

log = logging.getLogger("hnerf.calibration")


@dataclass(frozen=True)
class Timing:
    """A camera's measured time offset: it recorded the others' frame f in its own frame f + offset_frames.

    error_frames: standard error; both are NaN if not measured. half_offsets: from each half of the frames alone.
    reason: why the offset is not observable, else empty.
    """

    offset_frames: float = np.nan
    error_frames: float = np.nan
    half_offsets: tuple[float, float] = (0.0, 0.0)
    reason: str = ""

    @property
    def suspected(self) -> bool:
        """Return whether the camera may be out of sync."""
        return abs(self.offset_frames) > max(MIN_OFFSET_FRAMES, SUSPECTED_SIGMAS * self.error_frames)

    @property
    def certain(self) -> bool:
        """Return whether the camera is certainly out of sync: the offset is far beyond its error, and each half of the
        frames gains by the other half's offset (a parabola is lower at x than at 0 if x lies between 0 and twice its
        vertex).
        """
        a, b = self.half_offsets
        agree = a * b > 0 and abs(a) < 2 * abs(b) < 4 * abs(a)
        far = abs(self.offset_frames) > max(MIN_OFFSET_FRAMES, CERTAIN_SIGMAS * self.error_frames)
        return not self.reason and agree and far


@dataclass(frozen=True)
class _View:
    """One camera's keypoints (F, 25, 3) and the other cameras' prediction of them: predicted_px (F, 25, 2), NaN where
    they cannot triangulate, and its derivative with respect to the camera's pose, pose_jacobian (F, 25, 2, 6)."""

    frames: Sequence[int]
    keypoints: np.ndarray
    predicted_px: np.ndarray
    pose_jacobian: np.ndarray

    def residuals(self, step: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the camera's keypoints `step` frames later minus the prediction, (F, 25, 2) px, and their weights (F,
        25)."""
        row, later_by = {frame: i for i, frame in enumerate(self.frames)}, step * median_step(self.frames)
        later = [row.get(frame + later_by, -1) for frame in self.frames]
        moved = self.keypoints[later] * (np.array(later) >= 0)[:, None, None]
        known = np.isfinite(self.predicted_px).all(-1)
        return np.nan_to_num(moved[..., :2] - self.predicted_px), moved[..., 2] * known


@dataclass(frozen=True)
class _Parabola:
    """Weighted square distances (3, F) in px^2 at three neighbouring shifts, in steps, and their weights (F,)."""

    middle: int
    squares: np.ndarray
    weights: np.ndarray

    def vertex(self, frames: np.ndarray) -> float:
        """Return the shift of the minimum in steps, from these frames alone, clamped to the outer shifts."""
        before, at, after = self.squares[:, frames].sum(1)
        curvature = before - 2 * at + after
        return self.middle + (float(np.clip((before - after) / (2 * curvature), -1, 1)) if curvature > 0 else 0.0)

    def curvature_px2(self, frames: np.ndarray) -> float:
        """Return by how much a shift of one step raises the mean square distance, from these frames alone."""
        before, at, after = self.squares[:, frames].sum(1)
        return float((before - 2 * at + after) / 2 / self.weights[frames].sum().clip(1e-9))

    @property
    def noise_px(self) -> float:
        """Return the root mean square distance at the middle shift."""
        return float(np.sqrt(self.squares[1].sum() / self.weights.sum().clip(1e-9)))


def synchronise_capture(
    capture: Capture, cameras: Sequence[Camera], keypoints: np.ndarray, settings: CalibrationSettings
) -> tuple[Capture, dict[str, float], list[str]]:
    """Return the capture with the offsets that `synchronise` found (the same object if none), the costs tried, and
    notes.

    Raises InputError, saying what to cut, if more than half of the frames would be lost or would show images more than
    a frame away: the ingested images then lack the instants that the offsets require.
    """
    offsets, held_out_px, notes = synchronise(cameras, keypoints, capture.frames, settings)
    if not offsets:
        return capture, held_out_px, notes
    synchronised = capture.synchronised(offsets)
    lost = [frame for frame in capture.frames if frame not in synchronised.frames]
    off_frames = {name: synchronised.recorded_frame(name, 0) - offset for name, offset in offsets.items()}
    farthest = max(off_frames, key=lambda name: abs(off_frames[name]))
    too_far = abs(off_frames[farthest]) > MAX_DISTANCE_FRAMES * capture.frame_step
    if 2 * len(lost) > len(capture.frames) or not synchronised.train_frames or too_far:
        raise InputError(f"{capture.name}: {_cut_advice(capture.train_cameras, offsets, capture.frame_step)}")
    if synchronised.frame_step != capture.frame_step:
        what = (
            f"frames in between were not ingested: images of camera {farthest} are "
            f"{off_frames[farthest]:+.2f} frames off"
        )
        notes = [*notes, what]
    if lost:
        notes = [*notes, f"{len(lost)} frames dropped that not every camera recorded: {', '.join(map(str, lost))}"]
    return synchronised, held_out_px, notes


def _cut_advice(cameras: Sequence[str], offsets: dict[str, float], frame_step: int) -> str:
    """Return what to cut from recordings whose frame numbers are `frame_step` apart."""
    late = ", ".join(f"camera {name} by {offset:+.2f} frames" for name, offset in offsets.items())
    earliest = min(offsets.get(name, 0.0) for name in cameras)
    cuts = {name: round((offsets.get(name, 0.0) - earliest) / frame_step) for name in cameras}
    orders = ", ".join(f"{cut} from camera {name}" for name, cut in cuts.items() if cut)
    return (
        f"out of step: {late}; run `hnerf synchronise`, after removing clocks.toml if there is one; or cut frames from "
        f"the start of recordings: {orders}, and from those of test cameras that are as late; then cut all to the same "
        "length and ingest again"
    )


def synchronise(
    cameras: Sequence[Camera], keypoints: np.ndarray, frames: Sequence[int], settings: CalibrationSettings
) -> tuple[dict[str, float], dict[str, float], list[str]]:
    """Return the offsets in frames of unsynchronised cameras, the held-out costs of everything tried, and notes.

    Cameras are shifted one by one, first the one whose shift improves agreement most; a shift is accepted only if its
    offset is certain and held-out frames improve. keypoints (C, frames, 25, 3).
    """
    offsets: dict[str, float] = {}
    held_out_px: dict[str, float] = {}
    for _ in cameras:
        shifted = _shift_keypoints(cameras, keypoints, frames, offsets)
        found = measure_timing(cameras, shifted, frames)
        if not any(timing.certain for timing in found.values()):
            break
        as_is_px = _halves_cost_px(cameras, [shifted, shifted])
        held_out_px.setdefault("not synchronised", as_is_px)
        tried = {}
        for name in (name for name, timing in found.items() if timing.suspected):
            so_far = offsets.get(name, 0.0)
            by_other_half = [offsets | {name: so_far + half} for half in reversed(found[name].half_offsets)]
            tried[name] = _halves_cost_px(
                cameras, [_shift_keypoints(cameras, keypoints, frames, o) for o in by_other_half]
            )
            what = f"camera {name} shifted by {so_far + found[name].offset_frames:+.2f} frames"
            held_out_px[what] = tried[name]
            log.info("tried: %s: %.2f px", what, tried[name])
        best = min(tried, key=tried.__getitem__)
        if tried[best] > (1 - settings.min_improvement) * as_is_px:
            break
        if not found[best].certain:
            doubt = f"camera {best} may be out of step, but its offset is not certain: no camera is shifted"
            return {}, held_out_px, [doubt]
        offsets[best] = offsets.get(best, 0.0) + found[best].offset_frames
    for name in offsets:  # each was measured while others were still out of sync
        timing = measure_timing(cameras, _shift_keypoints(cameras, keypoints, frames, offsets), frames)[name]
        offsets[name] += 0.0 if timing.reason else timing.offset_frames
    return _relative_to_least_shifted(offsets, len(cameras)), held_out_px, []


def measure_timing(cameras: Sequence[Camera], keypoints: np.ndarray, frames: Sequence[int]) -> dict[str, Timing]:
    """Measure each camera's time offset against the others. keypoints (C, frames, 25, 3); frames as recorded, in
    order."""
    if len(cameras) < 3:
        return {camera.name: Timing(reason="it takes two other cameras to place keypoints") for camera in cameras}
    return {camera.name: _timing(_view(cameras, keypoints, i, frames)) for i, camera in enumerate(cameras)}


def _relative_to_least_shifted(offsets: dict[str, float], cameras: int) -> dict[str, float]:
    """Return the offsets relative to the least shifted camera if every camera was shifted, because only time
    differences are observable; drop negligible ones."""
    common = min(offsets.values(), key=abs) if len(offsets) == cameras else 0.0
    return {name: offset - common for name, offset in offsets.items() if abs(offset - common) >= MIN_OFFSET_FRAMES}


def _shift_keypoints(
    cameras: Sequence[Camera], keypoints: np.ndarray, frames: Sequence[int], offsets: dict[str, float]
) -> np.ndarray:
    """Return keypoints (C, frames, 25, 3) resampled at these time offsets."""
    instants = [np.asarray(frames) + offsets.get(camera.name, 0.0) for camera in cameras]
    return np.stack([resample(k[:, None], frames, t)[:, 0] for k, t in zip(keypoints, instants, strict=True)])


def _halves_cost_px(cameras: Sequence[Camera], keypoints: Sequence[np.ndarray]) -> float:
    """Return the mean of two trimmed costs: of the first keypoints (C, frames, 25, 3) on the first half of the frames,
    and of the second on the second half."""
    halves = [np.array_split(k, 2, axis=1)[half] for half, k in enumerate(keypoints)]
    return float(np.mean([trimmed_cost_px(cameras, half) for half in halves]))


def _timing(view: _View) -> Timing:
    """Return the time offset of one camera; its error comes from the jackknife over blocks of frames (Efron and
    Tibshirani 1993, chapter 11)."""
    every = np.arange(len(view.frames))
    halves = np.array_split(every, 2)
    enough = max(MIN_FRAMES, len(every) // 2)
    costs = _cost_by_step(view, [every, *halves], enough)
    if len(costs) < 3:
        return Timing(reason=f"fewer than {enough} frames in common")
    lowest, *lowest_of_half = (min(costs, key=lambda step: costs[step][part]) for part in range(3))
    parabola, step = _parabola(view, lowest), median_step(view.frames)
    if np.count_nonzero(parabola.weights) < MIN_FRAMES:
        return Timing(reason=f"fewer than {MIN_FRAMES} frames with neighbours {step} before and after")
    kept = [np.setdiff1d(every, left_out) for left_out in np.array_split(every, JACKKNIFE_BLOCKS)]
    error = _jackknife_error([parabola.vertex(k) for k in kept])
    curvature_px2 = parabola.curvature_px2(every)
    curvature_error_px2 = _jackknife_error([parabola.curvature_px2(k) for k in kept])
    reason = ""
    if curvature_px2 < MIN_CURVATURE_SIGMAS * curvature_error_px2 or error > MAX_ERROR_STEPS:
        reason = (
            f"too little motion: one frame moves keypoints by {np.sqrt(max(curvature_px2, 0)) / step:.2f} px more than "
            f"a turn or move of the camera would, against {parabola.noise_px:.1f} px of noise"
        )
    elif max(abs(half - lowest) for half in lowest_of_half) > 1:
        reason = f"the halves of the frames disagree: {' and '.join(f'{step * half:+d}' for half in lowest_of_half)}"
    elif lowest in (min(costs), max(costs)):
        reason = f"the best shift is at the end of the range searched, {lowest * step:+d} frames"
    first, second = (parabola.vertex(half) * step for half in halves)
    return Timing(parabola.vertex(every) * step, error * step, (first, second), reason)


def _jackknife_error(values: Sequence[float]) -> float:
    return float(np.sqrt((len(values) - 1) * np.var(values)))


def _view(cameras: Sequence[Camera], keypoints: np.ndarray, index: int, frames: Sequence[int]) -> _View:
    others = [i for i in range(len(cameras)) if i != index]
    points_m = triangulate([cameras[i] for i in others], keypoints[others])[0].reshape(-1, 3)
    predicted_px, depth_m = cameras[index].project(points_m)
    predicted_px[~(depth_m > 0)] = np.nan
    pose_jacobian = np.nan_to_num(_pose_jacobian(cameras[index], points_m))
    shape = keypoints.shape[1:3]
    return _View(frames, keypoints[index], predicted_px.reshape(*shape, 2), pose_jacobian.reshape(*shape, 2, 6))


def _pose_jacobian(camera: Camera, points_m: np.ndarray) -> np.ndarray:
    """Return the derivatives (K, 2, 6) of the pixels of points (K, 3) with respect to a small rotation and translation
    in the camera frame: x' = x + w cross x + t, and the pinhole projection (Hartley and Zisserman, appendix 6)."""
    x, y, z = np.moveaxis(points_m @ camera.R.T + camera.t_m, -1, 0)
    zero = np.zeros_like(z)
    by_move = np.stack([np.stack([1 / z, zero, -x / z**2], -1), np.stack([zero, 1 / z, -y / z**2], -1)], -2)
    turns = np.stack([np.stack([zero, z, -y], -1), np.stack([-z, zero, x], -1), np.stack([y, -x, zero], -1)], -2)
    focal_px = np.array([camera.K[0, 0], camera.K[1, 1]])
    return focal_px[:, None] * np.concatenate([by_move @ turns, by_move], -1)


def _cost_by_step(view: _View, parts: Sequence[np.ndarray], enough: int) -> dict[int, list[float]]:
    """Return trimmed distances in px for each part of the frames, at every shift that leaves `enough` frames to
    compare."""
    costs = {}
    for step in range(-MAX_STEPS, MAX_STEPS + 1):
        residuals, weights = view.residuals(step)
        if np.count_nonzero(weights.any(1)) >= enough:
            unexplained = _remove_pose_effect(
                residuals, view.pose_jacobian, _robust_weights(residuals, view.pose_jacobian, weights)
            )
            distances = np.where(weights > 0, np.linalg.norm(unexplained, axis=-1), np.nan)
            costs[step] = [trimmed_mean(distances[part], TRIM) for part in parts]
    return costs


def _parabola(view: _View, middle: int) -> _Parabola:
    """Return the distances of the same observations at three shifts, with outliers determined at the middle one.

    Keypoints that move far within a step get less weight, so that a jump (a cut in the recording) cannot outweigh the
    rest.
    """
    three = [view.residuals(middle + step) for step in (-1, 0, 1)]
    shared = np.all([weights > 0 for _, weights in three], axis=0)
    robust = _robust_weights(three[1][0], view.pose_jacobian, three[1][1] * shared)
    residuals = [_remove_pose_effect(residuals, view.pose_jacobian, robust) for residuals, _ in three]
    distances = np.linalg.norm(residuals[1], axis=-1)
    scale_px = max(MIN_SCALE_PX, OUTLIER_SCALES / 2 * float(np.median(distances[shared])) if shared.any() else 0.0)
    moved_px = np.linalg.norm(residuals[2] - residuals[0], axis=-1) / 2
    used = three[1][1] * shared * (distances < OUTLIER_SCALES * scale_px) / (1 + (moved_px / scale_px) ** 2)
    squares = np.stack([(used[..., None] * r**2).sum((1, 2)) for r in residuals])
    return _Parabola(middle, squares, used.sum(1))


def _robust_weights(residuals: np.ndarray, pose_jacobian: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return Cauchy weights (F, 25) of the residuals that no rotation or translation of the camera explains."""
    robust = weights
    for _ in range(IRLS_ROUNDS):
        distances = np.linalg.norm(_remove_pose_effect(residuals, pose_jacobian, robust), axis=-1)
        scale_px = max(MIN_SCALE_PX, OUTLIER_SCALES / 2 * float(np.median(distances[weights > 0])))
        robust = weights / (1 + (distances / scale_px) ** 2)
    return robust


def _remove_pose_effect(residuals: np.ndarray, pose_jacobian: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return residuals (F, 25, 2) without the part that a change of the camera's pose explains (weighted least
    squares)."""
    root = np.sqrt(weights)[..., None]
    A, b = (root[..., None] * pose_jacobian).reshape(-1, 6), (root * residuals).reshape(-1)
    return residuals - pose_jacobian @ np.linalg.lstsq(A.T @ A, A.T @ b, rcond=None)[0]
