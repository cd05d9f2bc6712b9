"""The clocks of all cameras, from those of pairs."""

import logging
from collections.abc import Mapping
from itertools import combinations
from typing import NamedTuple

import numpy as np

from hnerf.calibration.clocks.keypoints import PairClock, Track, pair_clock, smoothed
from hnerf.calibration.matches import fundamental
from hnerf.capture.clocks import Clock
from hnerf.errors import InputError
from hnerf.geometry.camera import Camera

ROUNDS = 10  # of iteratively re-weighted least squares over pairs
LEAST_ERROR_S = 5e-4  # of a pair: smaller errors do not raise its weight
CONTRADICTION = 4.0  # standard errors beyond which a pair counts less

log = logging.getLogger("hnerf.calibration")


class Clocks(NamedTuple):
    """Clocks by camera, the first camera's being the common one. error_s: standard error of each, in the middle of what
    it recorded together with others; refused: why a pair could not be measured."""

    clocks: dict[str, Clock]
    error_s: dict[str, float]
    refused: dict[tuple[str, str], str]


def estimate_clocks(
    tracks: Mapping[str, Track],
    cameras: Mapping[str, Camera] | None = None,
    near_s: Mapping[tuple[str, str], float] | None = None,
) -> Clocks:
    """Return the clocks of the cameras from the subject's keypoints.

    cameras: if they are calibrated, in the pixels of the keypoints. near_s: offsets of pairs known to half a second,
    from sound. Raises InputError naming a camera that never shows the person, or that no pair links to the first.
    """
    names = list(tracks)
    if len(names) < 2:
        raise InputError("one recording has nothing to be synchronised with; film with two cameras or more")
    paths = {}
    for name, track in tracks.items():
        try:
            paths[name] = smoothed(track)
        except InputError as error:
            raise InputError(f"camera {name}: {error}") from None
    pairs, refused = dict[tuple[str, str], PairClock](), dict[tuple[str, str], str]()
    for a, b in combinations(names, 2):
        F = fundamental(cameras[a], cameras[b]) if cameras else None
        try:
            pairs[a, b] = pair_clock(paths[a], paths[b], F, (near_s or {}).get((a, b)))
            log.info("cameras %s and %s: %+.3f s, %+.0f ppm", a, b, pairs[a, b].offset_s, 1e6 * (pairs[a, b].rate - 1))
        except InputError as error:
            refused[a, b] = str(error)
    _check_linked(names, pairs, refused)
    rates, _ = _solve(names, {pair: np.log(found.rate) for pair, found in pairs.items()},
                      {pair: max(found.rate_error, 1e-7) for pair, found in pairs.items()}, {})  # fmt: skip
    rate_of = dict(zip(names, np.exp(rates), strict=True))
    ratios = {(a, b): float(rate_of[b] / rate_of[a]) for a, b in pairs}
    offsets_s, errors_s = _solve(
        names,
        {pair: found.offset_at(ratios[pair]) for pair, found in pairs.items()},
        {pair: max(found.error_s, LEAST_ERROR_S) for pair, found in pairs.items()},
        ratios,
    )
    clocks = {name: Clock(float(o), float(rate_of[name])) for name, o in zip(names, offsets_s, strict=True)}
    return Clocks(clocks, dict(zip(names, map(float, errors_s), strict=True)), refused)


def _check_linked(
    names: list[str], pairs: Mapping[tuple[str, str], PairClock], refused: Mapping[tuple[str, str], str]
) -> None:
    """Raise InputError naming the first camera that no chain of pairs links to the first one."""
    linked = {names[0]}
    for _ in names:
        linked |= {name for pair in pairs if linked.intersection(pair) for name in pair}
    for name in names:
        if name not in linked:
            why = next(reason for pair, reason in refused.items() if name in pair)
            raise InputError(f"camera {name}: {why}")


def _solve(
    names: list[str],
    differences: Mapping[tuple[str, str], float],
    errors: Mapping[tuple[str, str], float],
    factors: Mapping[tuple[str, str], float],
) -> tuple[np.ndarray, np.ndarray]:
    """Return values x (C,) with x_b = factor x_a + difference for pairs (a, b), the first being 0, and their standard
    errors: least squares with Cauchy weights, since a pair may be wrong."""
    A = np.zeros((len(differences), len(names)))
    for row, (a, b) in zip(A, differences, strict=True):
        row[names.index(a)], row[names.index(b)] = -factors.get((a, b), 1.0), 1.0
    A, y = A[:, 1:], np.array(list(differences.values()))
    sigma = np.array([errors[pair] for pair in differences])
    weights = np.ones(len(y))
    for _ in range(ROUNDS):
        normal = (A * (weights / sigma**2)[:, None]).T @ A
        x = np.linalg.solve(normal, (A * (weights / sigma**2)[:, None]).T @ y)
        weights = 1 / (1 + ((y - A @ x) / (CONTRADICTION * sigma)) ** 2)
    return np.array([0.0, *x]), np.array([0.0, *np.sqrt(np.linalg.inv(normal).diagonal())])
