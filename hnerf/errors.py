"""The one error that bad input raises."""


class InputError(Exception):
    """Bad input. The message is one line that names the file and says what to do; it is never retried."""


class NotApplicableError(InputError):
    """What was asked for cannot be tried on this capture; nothing is wrong with either."""


def one_line(error: Exception) -> str:
    """An error's last line, or its kind where it says nothing."""
    return str(error).splitlines()[-1] if str(error) else type(error).__name__
