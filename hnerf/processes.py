"""Processes that end when their parent does, and when they are told to."""

import ctypes
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

PR_SET_PDEATHSIG = 1  # linux/prctl.h
_libc = ctypes.CDLL(None)


def end_with_parent(last: signal.Signals) -> None:
    """Have the kernel (Linux) send this process a signal when its parent dies."""
    if hasattr(_libc, "prctl"):
        _libc.prctl(PR_SET_PDEATHSIG, last)


@contextmanager
def sigterm_kept() -> Iterator[None]:
    """Keep what this process does on SIGTERM from a library that replaces it when it is imported inside: pycolmap's
    logging takes the signal for a crash, prints a stack and ends the process at once."""
    yield
    handler = signal.getsignal(signal.SIGTERM)
    if handler is not None and threading.current_thread() is threading.main_thread():  # no other may set it
        signal.signal(signal.SIGTERM, handler)
