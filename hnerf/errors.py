"""Exceptions that bad input raises."""

import errno

DISK_FULL = (errno.ENOSPC, errno.EDQUOT)
REASON = "hnerf: "  # begins the line on standard error that says why a process ends
MAX_MESSAGE = 2000  # characters; what a stranger's file says may be longer


class InputError(Exception):
    """Bad input. The message is one line that names the file and says what to do; such a failure is never retried."""

    def __init__(self, message: str) -> None:
        super().__init__(printable(message))


class NotApplicableError(InputError):
    """A request that this capture does not allow, such as comparing cameras where there is only one; neither is at
    fault."""


class PlaceError(InputError):
    """A place of results that is away, closed or full, or a machine with too few GPUs: no fault of the recording, and
    no result of a study; unfinished work stays."""


class InvalidAsset(Exception):
    """A package that must not be handed over. The message names the file and every defect."""


def printable(text: str) -> str:
    """Return text as one line of bounded length that no terminal takes for a command: line breaks become spaces, other
    control characters their escapes."""
    line = " ".join(text.splitlines())
    if len(line) > MAX_MESSAGE:
        line = f"{line[: MAX_MESSAGE // 2]} ... {line[-MAX_MESSAGE // 2 :]}"
    return line if line.isprintable() else "".join(c if c.isprintable() else ascii(c)[1:-1] for c in line)


def one_line(error: Exception) -> str:
    """Return the last line of an error's message, or the name of its class if the message is empty."""
    return str(error).splitlines()[-1] if str(error) else type(error).__name__
