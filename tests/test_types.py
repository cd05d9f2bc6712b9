"""mypy as a test, so that its single process runs in parallel with the other tests."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent
# Without garbage collection, which would take a fifth of the time and is useless in so short a process.
MYPY = "import gc; gc.disable(); gc.enable = int; from mypy.main import main; main()"


def test_types_agree() -> None:
    found = subprocess.run([sys.executable, "-c", MYPY], cwd=ROOT, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stdout + found.stderr
