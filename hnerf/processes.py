"""Processes that end when their parent does."""

import ctypes
import signal

PR_SET_PDEATHSIG = 1  # linux/prctl.h
_libc = ctypes.CDLL(None)


def end_with_parent(last: signal.Signals) -> None:
    """Have the kernel (Linux) send this process a signal when its parent dies."""
    if hasattr(_libc, "prctl"):
        _libc.prctl(PR_SET_PDEATHSIG, last)
