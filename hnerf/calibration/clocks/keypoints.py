"""Start offset and drift of one camera's clock against another's, from one person's keypoints alone.

At the right offset one fundamental matrix explains all frames of two cameras (Albl et al. 2017, On the Two-view
Geometry of Unsynchronized Cameras). The sums that it needs are cross-correlations of the monomials of the keypoints, so
that every offset is tried at the cost of a few Fourier transforms; offset, drift and matrix are then refined together.
"""

from typing import NamedTuple

import numpy as np

from hnerf.errors import InputError
from hnerf.evenly_spaced import evenly_spaced

MIN_OVERLAP_S, MIN_OVERLAP = 1.0, 0.25  # that two recordings must share: in seconds, and as a share of the shorter one
CANDIDATES = 8  # offsets of lowest cost that are refined, each the best within SEPARATION_S
SEPARATION_S = 0.2
ROUNDS = 25  # of refinement
MAX_STEP_S = 0.1  # maximum change of the offset in a round
CLEAR = 0.8  # maximum residual of the best offset, as a share of the next best one's
OTHER_S = 0.5  # difference beyond which two offsets are different solutions
DRIFT_SIGMAS, MAX_DRIFT_ERROR = 4.0, 1e-4  # standard errors that a drift must exceed, and its maximum standard error
REACH_S, MIN_REACH = 0.1, 2  # seconds, and frames, on each side, to which a parabola is fitted
# Quantile of residuals by which offsets are compared. With a high one, a wave of one hand is enough to tell the steps
# of an even walk apart.
JUDGED = 0.95
MIN_KEYPOINTS = 100  # that both cameras must see
MAX_REFINED = 2000  # evenly spaced frames, of those that the other recording may share, to which a clock is refined
CONVERGED = 1e-7  # seconds, and drift: a smaller step ends the refinement


class Track(NamedTuple):
    """One camera's keypoints of the subject on its own clock: times_s (n,) ascending, keypoints (n, 25, 3)."""

    times_s: np.ndarray
    keypoints: np.ndarray


class PairClock(NamedTuple):
    """The clock of camera b as a function of camera a's: t_b = rate t_a + offset_s. middle_s: the middle of what both
    recorded, on a's clock; error_s: standard error of t_b there; rate_error: of the rate, at most MAX_DRIFT_ERROR."""

    offset_s: float
    rate: float
    middle_s: float
    error_s: float
    rate_error: float

    def offset_at(self, rate: float) -> float:
        """Return the offset that synchronises both clocks in the middle of what both recorded if b's rate is `rate`,
        which other pairs may determine better."""
        return self.offset_s + (self.rate - rate) * self.middle_s


class _Path(NamedTuple):
    """A smoothed track: times_s (n,); moments (3, n, 25, 2), the positions, velocities and accelerations, in seconds;
    known (n, 25); to_unit (3, 3), which maps homogeneous pixels to positions of mean 0 and standard deviation 1."""

    times_s: np.ndarray
    moments: np.ndarray
    known: np.ndarray
    to_unit: np.ndarray

    @property
    def step_s(self) -> float:
        """Return the median time between frames."""
        return float(np.median(np.diff(self.times_s)))

    @property
    def window_s(self) -> float:
        """Return the duration of the frames that are smoothed together, whose errors are therefore correlated."""
        return (2 * _reach(self.step_s) + 1) * self.step_s

    def at(self, instants_s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return positions (m, 25, 2) and velocities (m, 25, 2) at instants on this clock, by Taylor expansion from the
        nearest frame, and which are known (m, 25)."""
        after = np.searchsorted(self.times_s, instants_s).clip(1, len(self.times_s) - 1)
        row = after - (instants_s - self.times_s[after - 1] < self.times_s[after] - instants_s)
        ahead_s = instants_s - self.times_s[row]
        known = self.known[row] & (np.abs(ahead_s) <= 0.75 * self.step_s)[:, None]
        place, velocity, acceleration = self.moments[:, row]
        t = ahead_s[:, None, None]
        return place + t * velocity + t**2 / 2 * acceleration, velocity + t * acceleration, known


class _Fit(NamedTuple):
    """A refined clock. middle_s: the middle of what both recorded, on the first clock; covariance (2, 2): of the offset
    there, and of the rate."""

    offset_s: float
    rate: float
    middle_s: float
    residual: float
    covariance: np.ndarray


def smoothed(track: Track) -> _Path:
    """Fit a parabola to the frames around each frame of a track (local regression, Cleveland 1979), in units of the
    spread of its positions (Hartley 1997).

    Without smoothing, a detector's noise would average out between frames, so that offsets of half a frame would seem
    to fit best; and differences of noisy positions would not be usable velocities. Raises InputError if nobody is seen.
    """
    xy, seen = track.keypoints[..., :2], track.keypoints[..., 2] > 0
    if len(track.times_s) < 3 or not seen.any():
        raise InputError("the person is seen in fewer than three frames; film longer, or leave the camera out")
    mean, spread = xy[seen].mean(0), float(xy[seen].std(0).mean())
    step_s = float(np.median(np.diff(track.times_s)))
    reach = _reach(step_s)
    rows = np.arange(len(xy))[:, None] + np.arange(-reach, reach + 1)
    inside = (rows >= 0) & (rows < len(xy))
    rows = rows.clip(0, len(xy) - 1)
    t = track.times_s[rows] - track.times_s[:, None]  # (n, K)
    near = inside & (np.abs(t) <= 1.5 * reach * step_s)
    weights = seen[rows] * near[..., None]  # (n, K, 25)
    powers = np.stack([np.ones_like(t), t, t**2 / 2], -1)
    normal = np.einsum("nkj,nka,nkb->njab", weights, powers, powers)
    sums = np.einsum("nkj,nka,nkjx->njax", weights, powers, (xy[rows] - mean) / spread)
    known = seen & (weights.sum(1) >= 4)
    solved = np.zeros((*known.shape, 3, 2))
    solved[known] = np.linalg.solve(normal[known], sums[known])
    to_unit = np.array([[1 / spread, 0, -mean[0] / spread], [0, 1 / spread, -mean[1] / spread], [0, 0, 1]])
    return _Path(track.times_s, np.moveaxis(solved, 2, 0), known, to_unit)


def _reach(step_s: float) -> int:
    """Return the number of frames on each side to which a parabola is fitted."""
    return max(MIN_REACH, round(REACH_S / step_s))


def pair_clock(a: _Path, b: _Path, fundamental: np.ndarray | None = None, near_s: float | None = None) -> PairClock:
    """Return b's clock as a function of a's; both paths are from `smoothed`.

    fundamental: F (3, 3) with x_b^T F x_a = 0 in pixels, if the cameras are calibrated; otherwise it is estimated with
    the offset. near_s: an offset known to half a second, from sound. Raises InputError if the recordings do not share
    enough keypoints, or no offset is clearly better than all others.
    """
    f = None if fundamental is None else _unit_fundamental(fundamental, a, b)
    offsets_s = _best_offsets(a, b, f) if near_s is None else np.array([near_s])
    fits = [_refined(a, b, offset, f, drifts=False) for offset in offsets_s]
    best = min(fits, key=lambda fit: fit.residual)
    if not np.isfinite(best.residual):
        where = "" if near_s is None else f" {near_s:+.1f} s apart, as their sound has them,"
        raise InputError(
            f"the recordings{where} share fewer than {MIN_KEYPOINTS} keypoints of the person; film longer, with the "
            "person in view of both, or leave one out"
        )
    others = [fit.residual for fit in fits if abs(fit.offset_s - best.offset_s) > OTHER_S]
    if others and best.residual > CLEAR * min(others):
        raise InputError(
            "no start offset is clearly better than all others, because the person moves too little, or walks evenly "
            "on; let the person wave, stop and turn in view of all cameras"
        )
    drifting = _refined(a, b, best.offset_s, f, drifts=True)
    error = np.sqrt(drifting.covariance.diagonal())
    if error[1] < MAX_DRIFT_ERROR and abs(drifting.rate - 1) > DRIFT_SIGMAS * error[1]:
        return PairClock(*drifting[:3], float(error[0]), float(error[1]))
    rate_error = min(float(error[1]), MAX_DRIFT_ERROR)  # an unknown drift is not zero: other pairs may determine it
    return PairClock(*best[:3], float(np.sqrt(best.covariance[0, 0])), rate_error)


def _unit_fundamental(fundamental: np.ndarray, a: _Path, b: _Path) -> np.ndarray:
    """Return F of pixels converted to normalised positions (`to_unit`) of two paths, as a vector (9,) of norm 1."""
    F = np.linalg.inv(b.to_unit).T @ fundamental @ np.linalg.inv(a.to_unit)
    return np.asarray(F.ravel() / np.linalg.norm(F))


def _best_offsets(a: _Path, b: _Path, f: np.ndarray | None) -> np.ndarray:
    """Return the offsets in seconds at which a fundamental matrix fits best, one within each SEPARATION_S, the best
    first."""
    step_s = max(a.step_s, b.step_s)
    grids = [np.arange(path.times_s[0], path.times_s[-1] + 1e-9, step_s) for path in (a, b)]
    costs, lags = _cost_by_lag(_monomials(a, grids[0]), _monomials(b, grids[1]), f, step_s)
    chosen: list[int] = []
    for i in np.argsort(costs):
        if not np.isfinite(costs[i]) or len(chosen) == CANDIDATES:
            break
        if all(abs(lags[i] - lags[j]) * step_s >= SEPARATION_S for j in chosen):
            chosen.append(int(i))
    if not chosen:
        raise InputError(
            f"the person is not seen in both recordings for {MIN_OVERLAP_S:g} s at once; film longer, or leave one out"
        )
    return np.asarray(lags[chosen] * step_s + grids[1][0] - grids[0][0])


def _monomials(path: _Path, instants_s: np.ndarray) -> np.ndarray:
    """Return x x^T of the homogeneous positions x on a grid of instants, (3, 3, 25, m), 0 where not known."""
    places, _, known = path.at(instants_s)
    x = np.concatenate([places, np.ones_like(places[..., :1])], -1) * known[..., None]
    return np.einsum("mji,mjk->ikjm", x, x)


def _cost_by_lag(a: np.ndarray, b: np.ndarray, f: np.ndarray | None, step_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean square of x_b^T F x_a for each lag in steps by which b's frames are later, and the lags: of F if
    `f` is given, else the least one over all F of norm 1. It is infinite where the two overlap too little. a (3, 3, 25,
    m) and b (3, 3, 25, n) of `_monomials`."""
    m, n = a.shape[-1], b.shape[-1]
    size = 1 << (m + n - 1).bit_length()
    in_a, in_b = np.conj(np.fft.rfft(a, size)), np.fft.rfft(b, size)
    lags = np.arange(-(m - 1), n)
    sums = np.empty((len(lags), 9, 9))
    for i in range(3):
        for j in range(3):
            block = np.fft.irfft((in_b[i, j] * in_a).sum(2), size)[..., lags]  # (3, 3, lags)
            sums[:, 3 * i : 3 * i + 3, 3 * j : 3 * j + 3] = np.moveaxis(block, -1, 0)
    shared = sums[:, 8, 8]
    least = max(MIN_OVERLAP_S / step_s, MIN_OVERLAP * min(m, n))
    frames = np.minimum(np.minimum(m, n - lags), np.minimum(n, m + lags))
    enough = (frames >= least) & (shared >= 5 * least)
    costs = np.full(len(lags), np.inf)
    squares = np.linalg.eigvalsh(sums[enough])[:, 0] if f is None else sums[enough] @ f @ f
    costs[enough] = squares.clip(1e-12) / shared[enough]
    return costs, lags


def _refined(a: _Path, b: _Path, offset_s: float, fixed: np.ndarray | None, drifts: bool) -> _Fit:
    """Return the clock and a high quantile of the residuals, from a first offset.

    Gauss-Newton on x_b(t)^T F x_a over the clock and, unless it is `fixed`, F together; each residual is divided by its
    gradient (Sampson's distance, Hartley and Zisserman 2004, section 11.4.3) and has a Cauchy weight. The unknown
    offset is that in the middle of what both recorded, where it does not depend on the drift.
    """
    on_b_s, reach_s = a.times_s + offset_s, ROUNDS * MAX_STEP_S  # the offset changes by no more
    near = np.flatnonzero((on_b_s >= b.times_s[0] - reach_s) & (on_b_s <= b.times_s[-1] + reach_s)).tolist()
    times_s = a.times_s[evenly_spaced(near, MAX_REFINED)]
    places, _, known_a = a.at(times_s)
    both = (times_s + offset_s >= b.times_s[0]) & (times_s + offset_s <= b.times_s[-1])
    middle_s = float(np.median(times_s[both])) if both.any() else 0.0
    clock, f = np.array([offset_s, 0.0]), fixed
    for _ in range(ROUNDS):
        x_b, v_b, known = b.at(times_s + clock[0] + clock[1] * (times_s - middle_s))
        known = known & known_a
        if known.sum() < MIN_KEYPOINTS:
            return _Fit(offset_s, 1.0, middle_s, np.inf, np.full((2, 2), np.inf))
        in_a, in_b = (np.column_stack([x[known], np.ones(known.sum())]) for x in (places, x_b))
        t = np.broadcast_to(times_s[:, None] - middle_s, known.shape)[known]
        A = (in_b[:, :, None] * in_a[:, None, :]).reshape(-1, 9)
        f = np.linalg.eigh(A.T @ A)[1][:, 0] if f is None else f
        line_b, line_a = in_a @ f.reshape(3, 3).T, in_b @ f.reshape(3, 3)
        gradient = np.sqrt((line_a[:, :2] ** 2).sum(1) + (line_b[:, :2] ** 2).sum(1)).clip(1e-9)
        residuals = A @ f / gradient
        weights = 1 / (1 + (residuals / (1.5 * np.median(np.abs(residuals)) + 1e-9)) ** 2)
        by_time = (v_b[known] * line_b[:, :2]).sum(1)
        clock_columns = np.column_stack([by_time, by_time * t])[:, : 1 + drifts]
        J = np.hstack([clock_columns, A] if fixed is None else [clock_columns]) / gradient[:, None]
        normal, ahead = (J * weights[:, None]).T @ J, (J * weights[:, None]).T @ residuals
        if fixed is None:  # the norm of F is free: it is kept
            normal[1 + drifts :, 1 + drifts :] += np.outer(f, f) * normal.trace()
        step = -np.linalg.lstsq(normal, ahead, rcond=None)[0]
        if np.abs(step[: 1 + drifts]).max() < CONVERGED:
            break
        clock[: 1 + drifts] += step[: 1 + drifts].clip(-MAX_STEP_S, MAX_STEP_S)
        if fixed is None:
            f = (f + step[1 + drifts :]) / np.linalg.norm(f + step[1 + drifts :])
    together = _off_together(a, b, len(times_s) / len(near))
    variance = float((weights * residuals**2).sum() / weights.sum()) * together
    covariance = np.zeros((2, 2))
    covariance[: 1 + drifts, : 1 + drifts] = variance * np.linalg.pinv(normal)[: 1 + drifts, : 1 + drifts]
    residual = float(np.quantile(np.abs(residuals), JUDGED))
    return _Fit(float(clock[0] - clock[1] * middle_s), float(1 + clock[1]), middle_s, residual, covariance)


def _off_together(a: _Path, b: _Path, used: float) -> float:
    """Return how many of a's used frames, evenly spaced, fall within one smoothing window. used: their share."""
    return max(1.0, max(a.window_s, b.window_s) / (a.step_s / used))
