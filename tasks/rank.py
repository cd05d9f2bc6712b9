"""One of several processes, as started by the launcher under torchrun: python -m tasks.rank MODULE ARGUMENTS."""

import runpy
import signal
import sys

from hnerf.processes import end_with_parent

if __name__ == "__main__":
    end_with_parent(signal.SIGKILL)  # before the module's imports, which take seconds
    del sys.argv[0]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
