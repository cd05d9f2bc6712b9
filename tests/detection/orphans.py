"""A detection whose networks never return, for tests: python -m tests.detection.orphans FOLDER."""

import os
import resource
import signal
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from hnerf.config import DetectionSettings
from hnerf.detection import detect


def never(capture: Any, camera: str, settings: DetectionSettings, out: Path) -> None:
    """Create a file named after the process id, then sleep."""
    (out / str(os.getpid())).touch()
    time.sleep(100)


def processor_limits_s(capture: Any, camera: str, settings: DetectionSettings, out: Path) -> tuple[int, int]:
    """Return a worker's soft and hard limit of processor time."""
    return resource.getrlimit(resource.RLIMIT_CPU)


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # background processes of a shell ignore SIGINT
    detect.find_in_camera = never
    cameras: Any = SimpleNamespace(train_cameras=("01", "02"), frames=(0,))
    detect._find_people(cameras, DetectionSettings(), Path(sys.argv[1]))
