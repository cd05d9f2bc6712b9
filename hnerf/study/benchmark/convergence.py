"""Convergence of a method: successive trainings, each twice as long as the one before, until the score no longer
improves."""

from collections.abc import Sequence

from hnerf.study.benchmark.curves import Point

FIRST_S = 10.0
MIN_S = 600.0  # earlier, no curve counts as flat: young fields stagnate before they find the person
FLAT_DB = 0.1
LAST_SHARE = 1 / 3  # share of the time in which a flat curve gains less than FLAT_DB
CURVE_PROTOCOL = (
    f"fields trained for {FIRST_S:g} s, {2 * FIRST_S:g} s, {4 * FIRST_S:g} s and so on, each from the start with its "
    f"learning rates decaying over its own time, until the best of the last third of a method's time, of {MIN_S:g} s "
    f"or more, is less than {FLAT_DB:g} dB above the best before, or its steps are done"
)


def training_limits_s(longest_s: float) -> list[float]:
    """Return the time limits of a method's trainings, in ascending order."""
    limits = [FIRST_S]
    while 2 * limits[-1] <= longest_s:
        limits.append(2 * limits[-1])
    return limits


def is_flat(curve: Sequence[Point]) -> bool:
    """Return whether a curve of (seconds, PSNR) gained less than FLAT_DB in the last third of its time."""
    end_s = curve[-1][0] if curve else 0.0
    early = [psnr for seconds, psnr in curve if seconds <= (1 - LAST_SHARE) * end_s]
    late = [psnr for seconds, psnr in curve if seconds > (1 - LAST_SHARE) * end_s]
    return end_s >= MIN_S and bool(early) and max(late) < max(early) + FLAT_DB
