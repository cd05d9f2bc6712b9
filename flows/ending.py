"""How a command ends on SIGTERM or SIGHUP, and how it handles streams that were closed before it started or cannot be
written."""

import fcntl
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Timer
from types import FrameType

ENDING = (signal.SIGTERM, signal.SIGHUP)
SEND_AGAIN_S = 0.1  # by then, Python has left the code that drops exceptions


class Terminated(KeyboardInterrupt):
    """A signal as an exception, which unwinds a command as Ctrl-C does."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.signal = signal.Signals(number)


@contextmanager
def unwound_by_signals() -> Iterator[None]:
    """Raise Terminated in the code inside on the first SIGTERM or SIGHUP (a closed terminal). Ignore further ones,
    which timeout(1) sends while files are being removed, and signals that were ignored before, as under nohup(1).
    Processes that a command starts have the default handler again. If Python drops this exception or that of Ctrl-C, as
    in a weak reference's callback, the signal is sent once more."""
    heeded = [number for number in ENDING if signal.getsignal(number) is not signal.SIG_IGN]
    before, hook = {number: signal.signal(number, _terminate) for number in heeded}, sys.unraisablehook
    sys.unraisablehook = lambda dropped: _send_again(dropped.exc_value) or hook(dropped)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        sys.unraisablehook = hook


def _terminate(number: int, frame: FrameType | None) -> None:
    for one in ENDING:
        signal.signal(one, signal.SIG_IGN)
    raise Terminated(number)


def _send_again(dropped: BaseException | None) -> bool:
    """If the dropped exception came from a signal, send this process that signal once more in a moment; return whether
    it did."""
    if not isinstance(dropped, KeyboardInterrupt):
        return False
    number = signal.SIGINT
    if isinstance(dropped, Terminated):
        number = dropped.signal
        signal.signal(number, _terminate)
    timer = Timer(SEND_AGAIN_S, os.kill, (os.getpid(), number))
    timer.daemon = True  # a process that has ended by then needs no signal
    timer.start()
    return True


def open_closed_streams() -> None:
    """Redirect standard output and error to /dev/null if they are closed (`>&-`) or open only for reading. For a closed
    one, Python has None in its place. The next file that is opened would get its number, and libraries would write into
    it."""
    for number, name in ((1, "stdout"), (2, "stderr")):
        if getattr(sys, name) is None or fcntl.fcntl(number, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
            os.dup2(os.open(os.devnull, os.O_WRONLY), number)
            os.set_inheritable(number, True)
            setattr(sys, name, os.fdopen(number, "w"))


def drop_what_is_left() -> None:
    """Drop output that standard output and error do not take because the disk is full or nobody reads it. Otherwise,
    Python would print a traceback about it at exit and change the exit code."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
