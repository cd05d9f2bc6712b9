import os
import signal
import subprocess
import sys

import pytest


@pytest.mark.parametrize(("parent", "ended"), [("os.getppid()", 0), ("os.getppid() + 1", -signal.SIGKILL)])
def test_a_process_whose_parent_has_already_died_is_killed(parent: str, ended: int) -> None:
    code = f"import os, signal; from hnerf.processes import end_with_parent; end_with_parent(signal.SIGKILL, {parent})"
    done = subprocess.run([sys.executable, "-c", code], cwd=os.getcwd(), check=False)
    assert done.returncode == ended
