"""Processes of the soak test, and simulated machines: each is a worker whose store is on its own disk."""

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from uuid import uuid4

ROOT = Path(__file__).parents[1]
MARK = "HNERF_SOAK"  # an environment variable of every process that is started here
# Run a command in a mount namespace of its own, in which the first folder is mounted on the second.
MOUNTED = 'mount --bind "$1" "$2" && shift 2 && exec "$@"'
WITH_DISK = ("unshare", "--map-root-user", "--mount", "sh", "-c", MOUNTED, "sh")
WORKER = ("prefect", "worker", "start", "--pool", "local", "--type", "process", "--limit", "2")
FLOW_RUN = ("prefect.flow_engine", "prefect.engine")
DELAY_S = 20.0  # the longest wait before a run is killed
STOP_S = 90.0  # TimeoutStopSec of flows/systemd_units.py


@dataclass
class Machine:
    """A worker and its disk."""

    scratch: Path
    number: int
    worker: "subprocess.Popen[bytes]"

    @staticmethod
    def started(scratch: Path, number: int) -> "Machine":
        """Start a machine with an empty disk, which shares the folder `ingested` with the others."""
        disk = scratch / f"disk{number}"
        disk.mkdir()
        (scratch / "ingested").mkdir(exist_ok=True)
        (disk / "ingested").symlink_to(scratch / "ingested")
        return Machine._with_disk(scratch, number)

    @staticmethod
    def _with_disk(scratch: Path, number: int) -> "Machine":
        store = scratch / "store"
        store.mkdir(exist_ok=True)
        command = (*WITH_DISK, str(scratch / f"disk{number}"), str(store), sys.executable, "-m", *WORKER)
        return Machine(scratch, number, start(scratch, f"worker{number}", *command, home=f"prefect{number}"))

    @property
    def disk(self) -> Path:
        """Return the folder that holds this machine's store."""
        return self.scratch / f"disk{self.number}"

    def run(self) -> int | None:
        """Wait for a random time; return the process of some run of this worker that is still alive, or None."""
        runs = [pid for pid in descendants(self.worker.pid) if any(name in command(pid) for name in FLOW_RUN)]
        if not runs:
            return None
        time.sleep(random.uniform(0, DELAY_S))
        alive = [pid for pid in runs if Path(f"/proc/{pid}").exists()]
        return random.choice(alive) if alive else None

    def restarted(self) -> "Machine":
        """Restart the worker if it has ended. As systemd does, first end the processes that it had started."""
        if self.worker.poll() is None:
            return self
        self._end()
        return Machine._with_disk(self.scratch, self.number)

    def lose(self) -> "Machine":
        """Kill all processes of this machine and lose its disk; return an empty machine that replaces it."""
        self._end()
        os.replace(self.disk, self.scratch / f"lost-{uuid4().hex}")
        return Machine.started(self.scratch, self.number)

    def stop(self) -> None:
        """Stop the worker as systemd does: wait for it to end, then kill whatever it had started."""
        self.worker.terminate()
        with suppress(subprocess.TimeoutExpired):
            self.worker.wait(timeout=STOP_S)
        self._end()

    def _end(self) -> None:
        for pid in marked(f"PREFECT_HOME={self.scratch}/prefect{self.number}"):
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self.worker.wait()


def start(scratch: Path, name: str, *command: str, home: str = "prefect") -> "subprocess.Popen[bytes]":
    """Start a command with its own Prefect home; its output goes into a log file."""
    environment = os.environ | {"PREFECT_HOME": str(scratch / home)}
    with (scratch / f"{name}.log").open("ab") as log:
        return subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=log, env=environment)


@contextmanager
def process(scratch: Path, name: str, *arguments: str) -> Iterator["subprocess.Popen[bytes]"]:
    """Run a Python module until the block ends."""
    started = start(scratch, name, sys.executable, "-m", *arguments)
    try:
        yield started
    finally:
        started.terminate()
        started.wait(timeout=60)


def marked(variable: str) -> list[int]:
    """Return the other processes that have this `NAME=value` in their environment."""
    found = []
    for path in Path("/proc").glob("[0-9]*/environ"):
        try:
            if variable.encode() in path.read_bytes().split(b"\0") and int(path.parent.name) != os.getpid():
                found.append(int(path.parent.name))
        except OSError:
            continue
    return found


def descendants(pid: int) -> list[int]:
    """Return a process's children, their children, and so on."""
    return [one for child in _children(pid) for one in (child, *descendants(child))]


def _children(pid: int) -> list[int]:
    try:
        text = " ".join(path.read_text() for path in Path(f"/proc/{pid}/task").glob("*/children"))
    except OSError:
        return []
    return [int(child) for child in text.split()]


def command(pid: int) -> str:
    """Return a process's command line."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
    except OSError:
        return ""


def resident_kib(pid: int) -> int:
    """Return the resident memory of a process."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS"))
