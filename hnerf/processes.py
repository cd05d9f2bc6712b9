"""Processes that end when their parent does."""

import ctypes
import os
import signal

PR_SET_PDEATHSIG = 1  # linux/prctl.h
_libc = ctypes.CDLL(None)


def end_with_parent(last: signal.Signals, parent: int) -> None:
    """Have the kernel (Linux) send this process a signal when its parent, with process id `parent`, dies; send it now
    if the parent has died already."""
    if hasattr(_libc, "prctl"):
        _libc.prctl(PR_SET_PDEATHSIG, last)
        if os.getppid() != parent:
            os.kill(os.getpid(), last)
