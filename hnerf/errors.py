"""The one error that bad input raises."""


class CaptureError(Exception):
    """Bad input. The message is one line that names the file and says what to do; it is never retried."""
