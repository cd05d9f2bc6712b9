"""pycolmap, imported without its SIGTERM handler: its logging takes the signal for a crash, prints a stack trace and
ends the process at once. Every module imports it from here."""

import signal
import threading

import pycolmap

__all__ = ["pycolmap"]

_handler = signal.getsignal(signal.SIGTERM)  # from before the import: Python does not see what a library sets
if _handler is not None and threading.current_thread() is threading.main_thread():  # only this one may set it
    signal.signal(signal.SIGTERM, _handler)
