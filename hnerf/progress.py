"""Progress of long work, as log records at DEBUG level, which a display draws and which are otherwise hidden; and how
long its steps take."""

import json
import logging
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import NamedTuple, TypeVar

T = TypeVar("T")

log = logging.getLogger("hnerf.progress")

RECORD_SEPARATOR = "\x1e"  # RFC 7464; no line of a log begins with it
RELAY_EVERY_S = 0.5


class Progress(NamedTuple):
    """The attribute `progress` of a log record; the work has ended when `done` reaches `total`."""

    what: str
    done: float
    total: float


_listeners: list[Callable[[Progress], None]] = []


def report(what: str, done: float, total: float) -> None:
    """Log how much of the work called `what` is done, and call the listeners."""
    progress = Progress(what, done, total)
    log.debug("%s: %g of %g", what, done, total, extra={"progress": progress})
    for listener in _listeners:
        listener(progress)


@contextmanager
def listening(listener: Callable[[Progress], None]) -> Iterator[None]:
    """Call the listener at every report that this process makes inside the context."""
    _listeners.append(listener)
    try:
        yield
    finally:
        _listeners.remove(listener)


def tracked(items: Iterable[T], what: str, count: int) -> Iterator[T]:
    """Yield the items and report, before each, how many are done; and that the work has ended, however it ends."""
    try:
        for number, item in enumerate(items):
            report(what, number, count)
            yield item
    finally:
        report(what, count, count)


@contextmanager
def timed(step: str, seconds: dict[str, float], logger: logging.Logger) -> Iterator[None]:
    """Log the seconds that a step takes, and store them under its name."""
    started_s = time.perf_counter()
    yield
    seconds[step] = round(time.perf_counter() - started_s, 3)
    logger.info("%s: %.1f s", step, seconds[step])


def relay() -> None:
    """Write progress as lines on standard output from here on, for the process that started this one."""
    next_s = 0.0

    def write(progress: Progress) -> None:  # unless it was written just before and there is more to come
        nonlocal next_s
        if time.monotonic() >= next_s or progress.done >= progress.total:
            next_s = time.monotonic() + RELAY_EVERY_S
            print(RECORD_SEPARATOR + json.dumps(progress), flush=True)

    _listeners.append(write)


def report_relayed(line: str) -> bool:
    """Report the progress in a line that another process wrote after calling `relay`; return whether it is such a line.
    The rest of the line is dropped: processes and their libraries share one pipe, and do not wait for each other's line
    ends. So is progress that was cut short, as on a full disk."""
    if line.startswith(RECORD_SEPARATOR):
        with suppress(ValueError):
            progress, _ = json.JSONDecoder().raw_decode(line.removeprefix(RECORD_SEPARATOR))
            report(*progress)
        return True
    return False
