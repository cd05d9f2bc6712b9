"""Unsynchronised cameras: keypoints between frames, and the frame nearest to an instant.

Instants are counted in recorded frames: camera c with offset o recorded the instant of frame f in its own frame f + o.
"""

from collections.abc import Sequence

import numpy as np
from scipy.optimize import linear_sum_assignment

MAX_STEP_OF_PERSON = 0.3  # of a person's height: maximum mean movement of keypoints from one frame to the next


def nearest_frame(frame: int, offset_frames: float, step: int = 1) -> int:
    """Return the recorded frame nearest to an instant, where frame numbers are `step` apart."""
    return frame + step * int(np.floor(offset_frames / step + 0.5))


def nearest_rows(known: Sequence[int], frames: Sequence[int]) -> list[int]:
    """Return for each frame the known row whose frame is nearest in time, the earlier one of two."""
    numbers, rows = np.asarray(frames), np.asarray(known)
    return rows[[np.abs(numbers[rows] - frame).argmin() for frame in frames]].tolist()


def median_step(frames: Sequence[int]) -> int:
    """Return the median difference between neighbouring frame numbers (at least one, in order)."""
    return int(np.median(np.diff(frames))) if len(frames) > 1 else 1


def resample(keypoints: np.ndarray, frames: Sequence[int], instants: np.ndarray, in_order: bool = False) -> np.ndarray:
    """Resample keypoints (n, people, K, 3) of recorded frames (n,) at other instants (m,): (m, people, K, 3). People
    are matched between frames by position, in whatever order frames list them; in_order: by the order that all frames
    share, as for left and right hands.

    Interpolates linearly between neighbours one median step apart; elsewhere (where a recording ends or jumps) takes
    the frame within half such a step, or nobody if there is none. A keypoint that only the nearer neighbour shows is
    taken from there.
    """
    recorded = np.asarray(frames)
    after = np.searchsorted(recorded, instants).clip(1, max(1, len(recorded) - 1)) % len(recorded)
    before = (after - 1).clip(0)
    gap = (recorded[after] - recorded[before]).clip(1)
    share = ((instants - recorded[before]) / gap).clip(0, 1)
    nearer, farther = np.where(share < 0.5, (before, after), (after, before))
    step = median_step(frames)
    between = (share > 0) & (share < 1) & (gap <= step)
    resampled = keypoints[nearer].copy()
    mix = _mixed if in_order else _between
    for i in np.flatnonzero(between):
        resampled[i] = mix(keypoints[nearer[i]], keypoints[farther[i]], max(share[i], 1 - share[i]))
    resampled[(np.abs(instants - recorded[nearer]) > step / 2) & ~between] = 0
    return resampled


def _between(near: np.ndarray, far: np.ndarray, weight: float) -> np.ndarray:
    """Return people (P, K, 3) between two frames, with `weight` for the near one; a person without a match stays as in
    the near frame."""
    mixed = near.copy()
    distances = np.stack([[_distance(a, b) for b in far] for a in near])
    for a, b in zip(*linear_sum_assignment(distances), strict=True):
        if distances[a, b] < MAX_STEP_OF_PERSON:
            mixed[a] = _mixed(near[a], far[b], weight)
    return mixed


def _mixed(near: np.ndarray, far: np.ndarray, weight: float) -> np.ndarray:
    """Return keypoints (..., K, 3) between two frames, with `weight` for the near one, which alone counts for those
    that the far one does not show."""
    both = (near[..., 2:] > 0) & (far[..., 2:] > 0)
    return np.where(both, weight * near + (1 - weight) * far, near)


def _distance(a: np.ndarray, b: np.ndarray) -> float:
    """Return the mean distance of two people's common keypoints (K, 3), in heights of the taller, at most 1; 1 without
    any."""
    both = (a[:, 2] > 0) & (b[:, 2] > 0)
    if not both.any():
        return 1.0
    height_px = max(float(np.ptp(person[person[:, 2] > 0, :2], axis=0).max()) for person in (a, b))
    return min(1.0, float(np.linalg.norm(a[both, :2] - b[both, :2], axis=-1).mean()) / max(height_px, 1.0))
