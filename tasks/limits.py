"""Time limits: a stage that makes no progress for its limit is ended, with the reason in one line.

An alarm raises StalledError in the main thread, which ends Python code, including code that waits. C code that never
returns to Python is ended, with its whole process, by the watchdog of faulthandler. That needs no interpreter and
prints where the process was stuck; a worker then reports the run as crashed.
"""

import faulthandler
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from types import FrameType

from hnerf.config import LimitSettings
from hnerf.progress import Progress, listening

GRACE_S = 120.0  # to end ranks, which get 40 s, and to remove files
REARM_S = 1.0
_settings: ContextVar[LimitSettings] = ContextVar("limits")


class StalledError(RuntimeError):
    """A stage made no progress for its limit. retryable: a retry would continue from where it was."""

    def __init__(self, message: str, retryable: bool) -> None:
        super().__init__(message)
        self.retryable = retryable


def set_limits(settings: LimitSettings) -> None:
    """Apply these limits to the stages that run from now on in this context."""
    _settings.set(settings)


def current_limits() -> LimitSettings:
    """Return the limits that `set_limits` applied."""
    return _settings.get(LimitSettings())


def limit_s(images: int) -> float:
    """Return the seconds for which a stage that works on this many images may make no progress."""
    settings = current_limits()
    return settings.stage_s + settings.image_s * images


@contextmanager
def limited(stage: str, images: int, resumable: bool) -> Iterator[None]:
    """Raise StalledError in the code inside if it reports no progress for the stage's limit; if that does not end it,
    end this process. Outside the main thread, where nothing can be raised, only end the process."""
    patience_s, last = limit_s(images), Progress("", 0, 0)
    armed_s = time.monotonic()
    main = threading.current_thread() is threading.main_thread()

    def arm() -> None:
        if main:  # whichever thread reports progress
            signal.setitimer(signal.ITIMER_REAL, patience_s)
        faulthandler.dump_traceback_later(patience_s + GRACE_S, exit=True, file=sys.__stderr__ or 2)

    def rearm(progress: Progress) -> None:
        nonlocal armed_s, last
        if progress == last:  # repeated by a process that waits for others
            return
        last = progress
        if time.monotonic() - armed_s > REARM_S:
            armed_s = time.monotonic()
            arm()

    def end(number: int, frame: FrameType | None) -> None:
        at = f" after {last.done:g} of {last.total:g} {last.what}" if last.what else ""
        raise StalledError(
            f"{stage}: ended, no progress for {patience_s:.0f} s{at} (in {_place(frame)}); if the machine is that "
            "slow, raise limits.stage_s or limits.image_s",
            resumable,
        )

    before = signal.signal(signal.SIGALRM, end) if main else None
    try:
        with listening(rearm):
            arm()
            yield
    finally:
        faulthandler.cancel_dump_traceback_later()
        if main:
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGALRM, before)


def _place(frame: FrameType | None) -> str:
    """Return the module and the line of this project's code that the stage was executing."""
    while frame is not None:
        name = frame.f_globals.get("__name__", "")
        if name.split(".")[0] in ("hnerf", "tasks"):
            return f"{name}, line {frame.f_lineno}"
        frame = frame.f_back
    return "a library"
