"""Launcher that runs a module in several processes under torchrun, none of which outlives the caller."""

import errno
import fcntl
import json
import logging
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir

from hnerf.errors import REASON, InputError
from hnerf.processes import end_with_parent
from hnerf.progress import report_relayed

GRACE_S = 40  # torchrun gives its ranks 30 s to end before it kills them
LAST_LINES = 20  # of a failed rank's output, shown in the error
RANK_LINE = re.compile(r"^\[default\d+\]:")
LOGS, LOCK, YOUNG_S = "hnerf-ranks-", "lock", 60.0
FAILURE = "failure.json"  # tasks/agent.py: the first failing rank and its exit code
# Signals sent from outside; others are raised by the process itself and would recur.
KILLED = (signal.SIGKILL, signal.SIGTERM)


class LostWorkerError(RuntimeError):
    """A rank or torchrun got no memory or was killed from outside; the work can be retried."""


class RankFailedError(RuntimeError):
    """A rank could not continue because of its work; the message, one line, says why. It is not retried."""


def _os_error(message: str) -> OSError:
    """Build an OSError from JSON: errno, its meaning, file. errno is null if a library did not report one."""
    number, why, name = json.loads(message)
    return OSError(why) if number is None else OSError(number, why, name)


# Exceptions by exit code of ranks that print the reason in one line on stderr; libraries may print more at exit.
ERROR_BY_EXIT_CODE: dict[int, Callable[[str], Exception]] = {
    2: InputError,
    3: RankFailedError,
    4: _os_error,
    5: LostWorkerError,
}


def run_ranks(module: str, arguments: Sequence[str], processes: int) -> None:
    """Run `python -m module arguments` in `processes` processes, and log their output line by line.

    Raises the exception of ERROR_BY_EXIT_CODE if a rank ends with that code, LostWorkerError if one was killed, and
    otherwise RuntimeError with the last lines of the first failing rank. All ranks end with the caller, however it
    ends: the kernel signals the caller's death to torchrun, and torchrun's death to the ranks.
    """
    _remove_left_behind()
    with TemporaryDirectory(prefix=LOGS, dir=_temporary_folder()) as logs, Path(logs, LOCK).open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # the kernel releases it, however this process ends
        command = [sys.executable, "-m", "tasks.agent", f"{logs}/{FAILURE}"]
        command += ["--standalone", f"--nproc-per-node={processes}", "--tee=3", f"--log-dir={logs}"]
        command += ["-m", "tasks.rank", module, *arguments]
        agent = subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            env=_environment(processes),
            start_new_session=True,
            preexec_fn=partial(end_with_parent, signal.SIGTERM, os.getpid()),
        )
        try:
            _follow(agent, logging.getLogger(module))
        except BaseException:
            _stop(agent)
            raise
        if agent.returncode:
            raise _error(module, Path(logs), agent.returncode)


def _temporary_folder() -> str:
    """Return the folder of temporary files. Raises OSError for a full disk if none takes a file, which Python reports
    as a missing folder."""
    try:
        return gettempdir()
    except FileNotFoundError:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "/tmp") from None


def _remove_left_behind() -> None:
    """Remove log folders whose process was killed. A folder is in use while its lock is held; a recent one may not be
    locked yet."""
    for folder in Path(_temporary_folder()).glob(f"{LOGS}*"):
        with suppress(OSError), (folder / LOCK).open("r+") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if time.time() - (folder / LOCK).stat().st_mtime > YOUNG_S:
                shutil.rmtree(folder)


def _environment(processes: int) -> dict[str, str]:
    """Return the ranks' environment: the cores are divided evenly among them, and waiting threads sleep, unless the
    user has set otherwise. Spinning threads make a step many times slower when anything else runs on the machine.
    Modules are never imported from the current folder, whatever its files are called. Output is unbuffered: torchrun
    does not flush what it passes on, and a training without visible progress counts as stalled."""
    threads = max(1, len(os.sched_getaffinity(0)) // processes)
    own = {"PYTHONSAFEPATH": "1", "PYTHONUNBUFFERED": "1"}
    return {"OMP_NUM_THREADS": str(threads), "OMP_WAIT_POLICY": "PASSIVE", **os.environ, **own}


def _follow(agent: "subprocess.Popen[str]", log: logging.Logger) -> None:
    """Log the ranks' lines until all have ended, and report their progress."""
    assert agent.stdout is not None
    for line in agent.stdout:
        text = RANK_LINE.sub("", line.rstrip())
        if not report_relayed(text):
            log.log(logging.INFO if RANK_LINE.match(line) else logging.DEBUG, "%s", text)
    agent.wait()


def _stop(agent: "subprocess.Popen[str]") -> None:
    """Ask torchrun to end its ranks; if it does not, kill it, and thereby them."""
    agent.terminate()
    try:
        agent.wait(timeout=GRACE_S)
    except subprocess.TimeoutExpired:
        agent.kill()
        agent.wait()


def _error(module: str, logs: Path, ended: int) -> Exception:
    """Build the exception from torchrun's exit code and its report of the first failed rank."""
    if ended < 0:
        return LostWorkerError(f"{module}: torchrun was killed by {signal.Signals(-ended).name}")
    if not (logs / FAILURE).exists():
        return RuntimeError(f"{module}: torchrun did not start")
    if not (report := (logs / FAILURE).read_text()):
        return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(logs / FAILURE))
    rank, code = json.loads(report)
    written = [path.read_text(errors="replace") for path in logs.glob(f"*/attempt_0/{rank}/stderr.log")]
    lines = "".join(written).strip().splitlines()
    reasons = [line.removeprefix(REASON) for line in lines if line.startswith(REASON)]
    if code in ERROR_BY_EXIT_CODE and reasons:
        return ERROR_BY_EXIT_CODE[code](reasons[-1])
    if -code in KILLED:
        return LostWorkerError(f"{module}: rank {rank} was killed by {signal.Signals(-code).name}")
    how = f"crashed with {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
    return RuntimeError("\n".join([f"{module}: rank {rank} {how}", *lines[-LAST_LINES:]]))
