"""How a command ends that is told to, and what it does with streams that were closed before it began."""

import fcntl
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Timer
from types import FrameType

SEND_AGAIN_S = 0.1  # by when Python has left what drops exceptions


class Terminated(KeyboardInterrupt):
    """SIGTERM, which unwinds a command as Ctrl-C does."""


@contextmanager
def unwound_by_sigterm() -> Iterator[None]:
    """Raise Terminated in the code inside on the first SIGTERM; ignore others, which timeout(1) sends while files are
    removed. The processes that a command starts have the default again. Neither this nor Ctrl-C is lost where Python
    drops exceptions, as in a callback of a weak reference: it comes once more."""
    before, hook = signal.signal(signal.SIGTERM, _terminate), sys.unraisablehook
    sys.unraisablehook = lambda dropped: _send_again(dropped.exc_value) or hook(dropped)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
        sys.unraisablehook = hook


def _terminate(number: int, frame: FrameType | None) -> None:
    signal.signal(number, signal.SIG_IGN)
    raise Terminated


def _send_again(dropped: BaseException | None) -> bool:
    """Send this process the signal once more, in a moment, whose exception was dropped; return whether it was one."""
    if not isinstance(dropped, KeyboardInterrupt):
        return False
    number = signal.SIGINT
    if isinstance(dropped, Terminated):
        number = signal.SIGTERM
        signal.signal(number, _terminate)
    timer = Timer(SEND_AGAIN_S, os.kill, (os.getpid(), number))
    timer.daemon = True  # who has ended by then needs none
    timer.start()
    return True


def open_closed_streams() -> None:
    """Let standard output and error that are closed (`>&-`), or open for reading alone, go nowhere: of closed ones,
    Python has None in their place, and the next file that is opened would have their number, into which libraries
    write."""
    for number, name in ((1, "stdout"), (2, "stderr")):
        if getattr(sys, name) is None or fcntl.fcntl(number, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
            os.dup2(os.open(os.devnull, os.O_WRONLY), number)
            os.set_inheritable(number, True)
            setattr(sys, name, os.fdopen(number, "w"))


def drop_what_is_left() -> None:
    """Drop what standard output and error do not take, as their disk is full or nobody reads them: Python would print a
    trace about it at its end, and change the exit code."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
