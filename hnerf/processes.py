"""Processes that end when their parent does, and workers of pools."""

import ctypes
import os
import resource
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


def begin_worker(parent: int) -> None:
    """Prepare a worker of a pool: it is killed when its parent dies, and gets as much processor time as the system
    allows. Otherwise it would keep the limit that a reader of files (tasks/cage.py) had when the worker began, which
    the reader's progress raises for the reader alone."""
    end_with_parent(signal.SIGKILL, parent)
    _, allowed_s = resource.getrlimit(resource.RLIMIT_CPU)
    resource.setrlimit(resource.RLIMIT_CPU, (allowed_s, allowed_s))
