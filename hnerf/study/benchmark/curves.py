"""Curves of accuracy against cost: Pareto front, time to reach a level, and bin means."""

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

Point = tuple[float, float]


def pareto_front(points: Mapping[str, Point]) -> list[str]:
    """Return the names of the points (cost, accuracy) that no other dominates, cheapest first. A point dominates
    another if it costs no more and is no less accurate, and is better in at least one of the two."""
    front = [
        name
        for name, (cost, accuracy) in points.items()
        if not any(c <= cost and a >= accuracy and (c, a) != (cost, accuracy) for c, a in points.values())
    ]
    return sorted(front, key=lambda name: points[name])


def seconds_to_reach(curve: Sequence[Point], level: float) -> float | None:
    """Return when a curve of (seconds, score) first reaches a level, interpolated linearly in log seconds; None if it
    never does. A curve that starts above the level reaches it at its first point, since earlier times are unknown."""
    for (s, v), (t, w) in zip(((0.0, -math.inf), *curve), curve, strict=False):
        if w >= level:
            if not math.isfinite(v):
                return t
            return math.exp(math.log(s) + (math.log(t) - math.log(s)) * (level - v) / (w - v))
    return None


def value_at(curve: Sequence[Point], seconds: float) -> float | None:
    """Return the value of a curve of (seconds, score) at a time, interpolated linearly in log seconds and constant
    after the last point; None before the first."""
    if not curve or seconds < curve[0][0]:
        return None
    times, values = zip(*curve, strict=True)
    return float(np.interp(math.log(seconds), np.log(times), values))


def bin_edges(clouds: Iterable[Sequence[Point]], bins: int) -> list[float]:
    """Return bins + 1 equally spaced edges from the smallest to the largest x of all points; an empty list if there are
    no points."""
    x = [x for points in clouds for x, _ in points]
    return np.linspace(min(x), max(x), bins + 1).tolist() if x else []


def bin_means(points: Sequence[Point], edges: Sequence[float]) -> dict[int, tuple[float, float, int]]:
    """Return mean x, mean y and the number of points between each two successive edges, by the number of the bin, for
    bins that are not empty. The last edge is inclusive."""
    found = np.array(points)
    place = np.digitize(found[:, 0], edges[1:-1])
    parts = {k: found[place == k] for k in sorted(set(place.tolist()))}
    return {k: (float(part[:, 0].mean()), float(part[:, 1].mean()), len(part)) for k, part in parts.items()}
