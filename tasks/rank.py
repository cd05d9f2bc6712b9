"""One of several processes that the launcher starts under torchrun: python -m tasks.rank MODULE ARGUMENTS."""

import os
import runpy
import signal
import sys

from hnerf.processes import end_with_parent

AGENT = "HNERF_AGENT"  # the process id of torchrun

if __name__ == "__main__":
    # Before the module is imported, which takes seconds.
    end_with_parent(signal.SIGKILL, int(os.environ.get(AGENT, os.getppid())))
    del sys.argv[0]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
