"""pycolmap, imported without its signal handlers: its logging takes SIGTERM for a crash, prints a stack trace and ends
the process at once; after a crash inside malloc or free, it waits for ever for memory. Every module imports it from
here."""

import ctypes
import signal
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["pycolmap"]

TAKEN = (signal.SIGABRT, signal.SIGBUS, signal.SIGFPE, signal.SIGILL, signal.SIGSEGV, signal.SIGTERM)
ACTION_BYTES = 1024  # more than a struct sigaction has


@contextmanager
def _handlers_kept() -> Iterator[None]:
    """Give the signals TAKEN the handlers that they had before. Python's own functions can do that only in the main
    thread, and do not see handlers that libraries set."""
    libc, before = ctypes.CDLL(None), {number: ctypes.create_string_buffer(ACTION_BYTES) for number in TAKEN}
    for number, action in before.items():
        libc.sigaction(int(number), None, action)
    yield
    for number, action in before.items():
        libc.sigaction(int(number), action, None)


with _handlers_kept():
    import pycolmap
