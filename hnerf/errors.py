"""Exceptions that bad input raises."""


class InputError(Exception):
    """Bad input. The message is one line that names the file and says what to do; such a failure is never retried."""


class NotApplicableError(InputError):
    """A request that this capture does not allow, such as comparing cameras where there is only one; neither is at
    fault."""


class InvalidAsset(Exception):
    """A package that must not be handed over. The message names the file and every defect."""


def one_line(error: Exception) -> str:
    """Return the last line of an error's message, or the name of its class if the message is empty."""
    return str(error).splitlines()[-1] if str(error) else type(error).__name__
