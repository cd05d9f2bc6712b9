"""Were the cameras in step? The offset in time of each camera against the others, to a fraction of a frame.

The other cameras place the keypoints in space; the camera's own keypoints of earlier and later frames are held against
them. What a small turn or move of the camera would explain is taken out first, so that a stale pose does not pass for
an offset. The mean square distance over whole-frame shifts is a parabola near its lowest point: its vertex is the
offset, its bend says how well motion shows it, and leaving out stretches of frames says how certain it is.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hnerf.calibration.diagnosis import TRIM, trimmed_cost_px, trimmed_mean
from hnerf.capture.capture import Capture
from hnerf.capture.timing import resample, usual_step
from hnerf.config import CalibrationSettings
from hnerf.errors import InputError
from hnerf.geometry.camera import Camera
from hnerf.geometry.triangulation import triangulate

MAX_STEPS = 10  # shifts that are looked at, either way, in steps between the capture's frames
MIN_FRAMES = 8  # that a shifted camera must share with the others, at the best shift and on either side of it
JACKKNIFE_BLOCKS = 12  # of frames, each left out once
SUSPECTED_SIGMAS, CERTAIN_SIGMAS = (
    2.0,
    5.0,
)  # standard errors that an offset must exceed to be suspected, and to be believed
MIN_OFFSET_FRAMES = 0.1  # frames: less is within what the parabola can tell
MAX_DISTANCE_FRAMES = 1.2  # recorded frames between an instant and the picture that shows it
MAX_ERROR_STEPS = 0.5  # standard error up to which an offset says something
MIN_CURVATURE_SIGMAS = 2.0  # standard errors by which one step must raise the distances
IRLS_ROUNDS = 5  # rounds of iteratively re-weighted least squares
OUTLIER_SCALES = 3.0  # times the scale of the residuals
MIN_SCALE_PX = 0.5

log = logging.getLogger("hnerf.calibration")


@dataclass(frozen=True)
class Timing:
    """A camera's offset as measured: it recorded the others' frame f in its own frame f + offset_frames.

    error_frames: standard error; both NaN where it was not measured; by_half: from either half of the frames alone;
    reason: why the offset is not observable, else empty.
    """

    offset_frames: float
    error_frames: float
    half_offsets: tuple[float, float]
    reason: str

    @staticmethod
    def unknown(reason: str) -> "Timing":
        """Not measured at all."""
        return Timing(np.nan, np.nan, (0.0, 0.0), reason)

    @property
    def suspected(self) -> bool:
        """Whether the camera may be out of step."""
        return abs(self.offset_frames) > max(MIN_OFFSET_FRAMES, SUSPECTED_SIGMAS * self.error_frames)

    @property
    def certain(self) -> bool:
        """Whether the camera is out of step: far beyond the error, and each half of the frames gains by the other's
        offset (a parabola is lower at x than at 0 if x lies between 0 and twice its vertex)."""
        a, b = self.half_offsets
        agree = a * b > 0 and abs(a) < 2 * abs(b) < 4 * abs(a)
        far = abs(self.offset_frames) > max(MIN_OFFSET_FRAMES, CERTAIN_SIGMAS * self.error_frames)
        return not self.reason and agree and far


@dataclass(frozen=True)
class _View:
    """One camera's keypoints (F, 25, 3) and, where the other cameras place them: predicted_px (F, 25, 2), NaN where
    they do not, and their derivatives by the camera's pose (F, 25, 2, 6)."""

    frames: Sequence[int]
    keypoints: np.ndarray
    predicted_px: np.ndarray
    pose_jacobian: np.ndarray

    def residuals(self, step: int) -> tuple[np.ndarray, np.ndarray]:
        """Own keypoints of frames so many steps later against the prediction: (F, 25, 2) px, weights (F, 25)."""
        row, later_by = {frame: i for i, frame in enumerate(self.frames)}, step * usual_step(self.frames)
        later = [row.get(frame + later_by, -1) for frame in self.frames]
        moved = self.keypoints[later] * (np.array(later) >= 0)[:, None, None]
        known = np.isfinite(self.predicted_px).all(-1)
        return np.nan_to_num(moved[..., :2] - self.predicted_px), moved[..., 2] * known


@dataclass(frozen=True)
class _Parabola:
    """Weighted squares of distances (3, F) in px^2 at three neighbouring shifts, in steps, and their weights (F,)."""

    middle: int
    squares: np.ndarray
    weights: np.ndarray

    def vertex(self, frames: np.ndarray) -> float:
        """Where it is lowest, in steps, from these frames alone; no further than the outer shifts."""
        before, at, after = self.squares[:, frames].sum(1)
        curvature = before - 2 * at + after
        return self.middle + (float(np.clip((before - after) / (2 * curvature), -1, 1)) if curvature > 0 else 0.0)

    def curvature_px2(self, frames: np.ndarray) -> float:
        """By how much one step raises the mean square distance, from these frames alone."""
        before, at, after = self.squares[:, frames].sum(1)
        return float((before - 2 * at + after) / 2 / self.weights[frames].sum().clip(1e-9))

    @property
    def noise_px(self) -> float:
        """Root mean square distance at the middle shift."""
        return float(np.sqrt(self.squares[1].sum() / self.weights.sum().clip(1e-9)))


def synchronise_capture(
    capture: Capture, cameras: Sequence[Camera], keypoints: np.ndarray, settings: CalibrationSettings
) -> tuple[Capture, dict[str, float], list[str]]:
    """The capture with the offsets that `synchronise` found (the very same without any), costs tried, and notes.

    Raises InputError where more than half of the frames would be lost or shown by pictures more than a frame away,
    since what was ingested lacks the moments that the offsets ask for; it says what to cut.
    """
    offsets, held_out_px, notes = synchronise(cameras, keypoints, capture.frames, settings)
    if not offsets:
        return capture, held_out_px, notes
    synchronised = capture.synchronised(offsets)
    lost = [frame for frame in capture.frames if frame not in synchronised.frames]
    off_frames = {name: synchronised.recorded(name, 0) - offset for name, offset in offsets.items()}
    farthest = max(off_frames, key=lambda name: abs(off_frames[name]))
    too_far = abs(off_frames[farthest]) > MAX_DISTANCE_FRAMES * capture.frame_step
    if 2 * len(lost) > len(capture.frames) or not synchronised.train_frames or too_far:
        raise InputError(f"{capture.name}: {_cut_advice(capture.train_cameras, offsets)}")
    if synchronised.frame_step != capture.frame_step:
        what = (
            f"frames between were not taken: pictures of camera {farthest} are {off_frames[farthest]:+.2f} frames off"
        )
        notes = [*notes, what]
    if lost:
        notes = [*notes, f"{len(lost)} frames dropped that not every camera recorded: {', '.join(map(str, lost))}"]
    return synchronised, held_out_px, notes


def _cut_advice(cameras: Sequence[str], offsets: dict[str, float]) -> str:
    late = ", ".join(f"camera {name} by {offset:+.2f} frames" for name, offset in offsets.items())
    earliest = min(offsets.get(name, 0.0) for name in cameras)
    cuts = {name: round(offsets.get(name, 0.0) - earliest) for name in cameras}
    orders = ", ".join(f"{cut} from camera {name}" for name, cut in cuts.items() if cut)
    return (
        f"out of step: {late}; cut frames from the start of recordings: {orders}, and from those of test cameras that "
        "are as late; then cut all to the same length and ingest again"
    )


def synchronise(
    cameras: Sequence[Camera], keypoints: np.ndarray, frames: Sequence[int], settings: CalibrationSettings
) -> tuple[dict[str, float], dict[str, float], list[str]]:
    """Offsets in frames of the cameras out of step, held-out costs of everything tried, and notes.

    One camera after the other: the one whose shift lets all agree best; taken only if its offset is certain and
    held-out frames gain. keypoints (C, frames, 25, 3).
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
    for name in offsets:  # measured while others were still out of step
        timing = measure_timing(cameras, _shift_keypoints(cameras, keypoints, frames, offsets), frames)[name]
        offsets[name] += 0.0 if timing.reason else timing.offset_frames
    return _relative_to_least_shifted(offsets, len(cameras)), held_out_px, []


def measure_timing(cameras: Sequence[Camera], keypoints: np.ndarray, frames: Sequence[int]) -> dict[str, Timing]:
    """Each camera's offset against the others. keypoints (C, frames, 25, 3); frames as recorded, in order."""
    if len(cameras) < 3:
        return {camera.name: Timing.unknown("it takes two other cameras to place keypoints") for camera in cameras}
    return {camera.name: _timing(_view(cameras, keypoints, i, frames)) for i, camera in enumerate(cameras)}


def _relative_to_least_shifted(offsets: dict[str, float], cameras: int) -> dict[str, float]:
    """Only differences in time can be known: where every camera was shifted, the least shifted one keeps its time."""
    common = min(offsets.values(), key=abs) if len(offsets) == cameras else 0.0
    return {name: offset - common for name, offset in offsets.items() if abs(offset - common) >= MIN_OFFSET_FRAMES}


def _shift_keypoints(
    cameras: Sequence[Camera], keypoints: np.ndarray, frames: Sequence[int], offsets: dict[str, float]
) -> np.ndarray:
    """Keypoints (C, frames, 25, 3) as these offsets would have them."""
    instants = [np.asarray(frames) + offsets.get(camera.name, 0.0) for camera in cameras]
    return np.stack([resample(k[:, None], frames, t)[:, 0] for k, t in zip(keypoints, instants, strict=True)])


def _halves_cost_px(cameras: Sequence[Camera], keypoints: Sequence[np.ndarray]) -> float:
    """Mean of the trimmed costs of the first half of the frames of the first keypoints (C, frames, 25, 3), and of the
    second half of the second."""
    halves = [np.array_split(k, 2, axis=1)[half] for half, k in enumerate(keypoints)]
    return float(np.mean([trimmed_cost_px(cameras, half.reshape(len(cameras), -1, 3)) for half in halves]))


def _timing(view: _View) -> Timing:
    """The offset of one camera; its error by the jackknife over stretches of frames (Efron and Tibshirani 1993,
    chapter 11)."""
    every = np.arange(len(view.frames))
    halves = np.array_split(every, 2)
    costs = _cost_by_step(view, [every, *halves])
    if len(costs) < 3:
        return Timing.unknown(f"fewer than {MIN_FRAMES} frames in common")
    lowest, *lowest_of_half = (min(costs, key=lambda step: costs[step][part]) for part in range(3))
    parabola, step = _parabola(view, lowest), usual_step(view.frames)
    if np.count_nonzero(parabola.weights) < MIN_FRAMES:
        return Timing.unknown(f"fewer than {MIN_FRAMES} frames with neighbours {step} before and after")
    kept = [np.setdiff1d(every, left_out) for left_out in np.array_split(every, JACKKNIFE_BLOCKS)]
    error = _jackknife_error([parabola.vertex(k) for k in kept])
    curvature_px2, curvature_error_px2 = (
        parabola.curvature_px2(every),
        _jackknife_error([parabola.curvature_px2(k) for k in kept]),
    )
    reason = ""
    if curvature_px2 < MIN_CURVATURE_SIGMAS * curvature_error_px2 or error > MAX_ERROR_STEPS:
        reason = (
            f"too little motion: one frame moves keypoints by {np.sqrt(max(curvature_px2, 0)) / step:.2f} px more than a "
            f"turn or move of the camera would, against {parabola.noise_px:.1f} px of noise"
        )
    elif max(abs(half - lowest) for half in lowest_of_half) > 1:
        reason = f"the halves of the frames disagree: {' and '.join(f'{step * half:+d}' for half in lowest_of_half)}"
    elif lowest in (min(costs), max(costs)):
        reason = f"no shift of up to {max(costs) * step} frames fits best"
    first, second = (parabola.vertex(half) * step for half in halves)
    return Timing(parabola.vertex(every) * step, error * step, (first, second), reason)


def _jackknife_error(values: Sequence[float]) -> float:
    n = len(values)
    return float(np.sqrt((n - 1) * np.var(values)))


def _view(cameras: Sequence[Camera], keypoints: np.ndarray, index: int, frames: Sequence[int]) -> _View:
    others = [i for i in range(len(cameras)) if i != index]
    projections = np.stack([cameras[i].projection for i in others])
    points_m = triangulate(projections, keypoints[others].reshape(len(others), -1, 3))[0]
    predicted_px, depth_m = cameras[index].project(points_m)
    predicted_px[~(depth_m > 0)] = np.nan
    pose_jacobian = np.nan_to_num(_pose_jacobian(cameras[index], points_m))
    shape = keypoints.shape[1:3]
    return _View(frames, keypoints[index], predicted_px.reshape(*shape, 2), pose_jacobian.reshape(*shape, 2, 6))


def _pose_jacobian(camera: Camera, points_m: np.ndarray) -> np.ndarray:
    """Derivatives of pixels by a small turn and a small move in the camera's axes, (K, 2, 6), for points (K, 3):
    x' = x + w cross x + t, and the pinhole's (Hartley and Zisserman, appendix 6)."""
    x, y, z = np.moveaxis(points_m @ camera.R.T + camera.t_m, -1, 0)
    zero = np.zeros_like(z)
    by_move = np.stack([np.stack([1 / z, zero, -x / z**2], -1), np.stack([zero, 1 / z, -y / z**2], -1)], -2)
    turns = np.stack([np.stack([zero, z, -y], -1), np.stack([-z, zero, x], -1), np.stack([y, -x, zero], -1)], -2)
    focal_px = np.array([camera.K[0, 0], camera.K[1, 1]])
    return focal_px[:, None] * np.concatenate([by_move @ turns, by_move], -1)


def _cost_by_step(view: _View, parts: Sequence[np.ndarray]) -> dict[int, list[float]]:
    """Trimmed distances in px, in each part of the frames, at every shift that leaves enough to compare."""
    enough, costs = max(MIN_FRAMES, len(view.frames) // 2), {}
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
    """The same observations at three shifts, outliers judged at the middle one.

    What moves far in a step weighs less, so that a jump (a cut in the recording) cannot outweigh the rest.
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
    """Weights (F, 25) that fade (Cauchy) with the distance that no turn or move of the camera explains."""
    robust = weights
    for _ in range(IRLS_ROUNDS):
        distances = np.linalg.norm(_remove_pose_effect(residuals, pose_jacobian, robust), axis=-1)
        scale_px = max(MIN_SCALE_PX, OUTLIER_SCALES / 2 * float(np.median(distances[weights > 0])))
        robust = weights / (1 + (distances / scale_px) ** 2)
    return robust


def _remove_pose_effect(residuals: np.ndarray, pose_jacobian: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Residuals (F, 25, 2) less what the camera's pose explains of them (weighted least squares)."""
    root = np.sqrt(weights)[..., None]
    A, b = (root[..., None] * pose_jacobian).reshape(-1, 6), (root * residuals).reshape(-1)
    return residuals - pose_jacobian @ np.linalg.lstsq(A.T @ A, A.T @ b, rcond=None)[0]
