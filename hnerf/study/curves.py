"""Accuracy against cost: what dominates what, and when a level is reached."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

Point = tuple[float, float]


def pareto_front(points: Mapping[str, Point]) -> list[str]:
    """Names of the points (cost, accuracy) that no other beats: none is at most as dear and at least as accurate, and
    better in one of the two. Cheapest first."""
    front = [
        name
        for name, (cost, accuracy) in points.items()
        if not any(c <= cost and a >= accuracy and (c, a) != (cost, accuracy) for c, a in points.values())
    ]
    return sorted(front, key=lambda name: points[name])


def seconds_to(curve: Sequence[Point], level: float) -> float | None:
    """When a curve of (seconds, figure) first reaches a level, linear in log seconds between its points; None if it
    never does. A curve that starts above the level reaches it at its first point: nothing is known of before."""
    for (s, v), (t, w) in zip(((0.0, -math.inf), *curve), curve, strict=False):
        if w >= level:
            if not math.isfinite(v):
                return t
            return math.exp(math.log(s) + (math.log(t) - math.log(s)) * (level - v) / (w - v))
    return None


def binned(points: Sequence[Point], bins: int) -> list[Point]:
    """Means of x and y over bins of equally many points, in the order of x; never more bins than points."""
    ordered = np.array(sorted(points))
    return [(float(x), float(y)) for x, y in (part.mean(0) for part in np.array_split(ordered, bins) if len(part))]
