"""When a method has had enough: trainings of twice the time each, until one gains nothing."""

from collections.abc import Sequence

from hnerf.study.benchmark.curves import Point

FIRST_S = 10.0
LEAST_S = 600.0  # before it nothing is flat: young fields stand still before they find the person
FLAT_DB = 0.1
LAST = 1 / 3  # share of the time in which a flat curve gains less
HOW = (
    f"fields trained for {FIRST_S:g} s, {2 * FIRST_S:g} s, {4 * FIRST_S:g} s and so on, each from the start with its "
    f"learning rates falling over its own time, until the best of the last third of a method's time, {LEAST_S:g} s at "
    f"least, is less than {FLAT_DB:g} dB above the best before, or its steps are done"
)


def limits_s(longest_s: float) -> list[float]:
    """Times of a method's trainings, in ascending order."""
    limits = [FIRST_S]
    while 2 * limits[-1] <= longest_s:
        limits.append(2 * limits[-1])
    return limits


def flat(curve: Sequence[Point]) -> bool:
    """Whether a curve of (seconds, PSNR) gained less than FLAT_DB in the last third of its time."""
    end_s = curve[-1][0] if curve else 0.0
    early = [psnr for seconds, psnr in curve if seconds <= (1 - LAST) * end_s]
    late = [psnr for seconds, psnr in curve if seconds > (1 - LAST) * end_s]
    return end_s >= LEAST_S and bool(early) and max(late) < max(early) + FLAT_DB
