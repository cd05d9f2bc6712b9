"""A rank for the tests of the launcher: python -m tests.tasks.ranks MODE FOLDER."""

import os
import signal
import sys
import time
from pathlib import Path

from hnerf.progress import relay, report


def main(mode: str, folder: Path) -> None:
    """Write a file named after the process id, then behave according to `mode`."""
    rank = int(os.environ["RANK"])
    (folder / str(os.getpid())).touch()
    if rank == 1 and mode == "bad":
        print("a warning\nhnerf: a.jpg: bad; write it again\na warning at exit", file=sys.stderr)
        sys.exit(2)
    if rank == 1 and mode == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if mode == "ok":
        for _ in range(3):
            print(f"rank {rank} of {os.environ['WORLD_SIZE']} at {time.time():.3f}")
            time.sleep(0.5)
        relay()
        report("training", rank, 8)
        return
    time.sleep(100)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
