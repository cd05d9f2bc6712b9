import signal
import subprocess
import sys

import pytest

IN_A_THREAD = """
import os, sys, threading

def load():
    import hnerf.pycolmap_import

thread = threading.Thread(target=load)
thread.start()
thread.join()
os.kill(os.getpid(), int(sys.argv[1]))
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGABRT, signal.SIGSEGV])
def test_pycolmap_handles_no_signals(number: signal.Signals) -> None:
    """Also if it is imported outside the main thread, as Prefect does for the hooks of a flow. Its handler would print
    a stack trace, for which it may wait for ever if the process crashed while memory was allocated or freed."""
    ended = subprocess.run([sys.executable, "-c", IN_A_THREAD, str(int(number))], capture_output=True, check=False)
    assert (ended.returncode, ended.stderr) == (-number, b"")
