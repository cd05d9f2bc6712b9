"""pycolmap, imported without its handler of SIGTERM: its logging takes the signal for a crash, prints a stack and ends
the process at once. Every module takes it from here."""

import signal
import threading

import pycolmap

__all__ = ["pycolmap"]

_handler = signal.getsignal(signal.SIGTERM)  # of before: Python does not see what a library sets
if _handler is not None and threading.current_thread() is threading.main_thread():  # no other may set it
    signal.signal(signal.SIGTERM, _handler)
