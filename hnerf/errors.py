"""Exceptions that bad input raises."""

import errno

DISK_FULL = (errno.ENOSPC, errno.EDQUOT)
# Failures to read that say nothing about the file: a stale or unreachable share, one whose program (FUSE) has ended, a
# failing disk, a busy machine.
UNREACHABLE = (
    errno.EIO, errno.ESTALE, errno.EREMOTEIO, errno.ETIMEDOUT, errno.EHOSTDOWN, errno.EHOSTUNREACH, errno.ENOTCONN,
    errno.ECONNABORTED, errno.EMFILE, errno.ENFILE, errno.ENOMEM,
)  # fmt: skip
# In messages of PyTorch on a GPU and on a CPU, of cuBLAS, and of Warp.
OUT_OF_MEMORY = ("out of memory", "can't allocate memory", "ALLOC_FAILED", "Failed to allocate")
REASON = "hnerf: "  # begins the line on standard error that says why a process ends
MAX_MESSAGE = 2000  # characters; text from a stranger's file may be longer


class InputError(Exception):
    """Bad input. The message is one line that names the file and says what to do; such a failure is never retried."""

    def __init__(self, message: str) -> None:
        super().__init__(printable(message))


class NotApplicableError(InputError):
    """A request that this capture does not allow, such as comparing cameras where there is only one; neither is at
    fault."""


class PlaceError(InputError):
    """Storage for results that is missing, not accessible or full, or a machine with too few GPUs or without a file of
    `hnerf models`: not the recording's fault, and not a result of a study; unfinished work is kept."""


class InvalidAsset(Exception):
    """A package that must not be delivered. The message names the file and every defect."""


def raise_if_unreachable(error: Exception) -> None:
    """Raise an error of reading a file that another attempt may not meet, so that it is not taken for bad input."""
    if isinstance(error, OSError) and error.errno in UNREACHABLE:
        raise error


def is_out_of_memory(error: object) -> bool:
    """Return whether this machine or its GPU had no memory left. Errors of PyTorch and Warp are known by the first line
    of their message: they share no class, and naming those they have would import PyTorch."""
    first, _, _ = str(error).partition("\n")
    told = isinstance(error, RuntimeError) and any(phrase in first for phrase in OUT_OF_MEMORY)
    return isinstance(error, MemoryError) or told


def printable(text: str) -> str:
    """Return text as one line of bounded length that cannot control a terminal: line breaks become spaces, other
    control characters are escaped."""
    line = " ".join(text.splitlines())
    if len(line) > MAX_MESSAGE:
        line = f"{line[: MAX_MESSAGE // 2]} ... {line[-MAX_MESSAGE // 2 :]}"
    return line if line.isprintable() else "".join(c if c.isprintable() else ascii(c)[1:-1] for c in line)


def one_line(error: Exception) -> str:
    """Return the line of an error's message that says why: the first, or the first below a traceback; the name of the
    error's class if the message is empty. Libraries' advice follows it."""
    lines = [line for line in str(error).splitlines() if line.strip()]
    below = max((k for k, line in enumerate(lines, 1) if line.startswith(('  File "', "    "))), default=0)
    return (lines[below:] or lines or [type(error).__name__])[0]
