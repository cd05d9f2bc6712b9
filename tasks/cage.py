"""A separate process, with limits, that reads untrusted files.

A reader that crashes, or that takes all memory, all processors or the network, ends this process and not the run. The
run sends it its work pickled; it answers in text, one JSON object per line:

    {"log": [logger, level, message]}, {"progress": [what, done, total]}, {"opened": path}, {"printed": text}
    {"error": "InputError" | "PlaceError" | "OSError" | "LostWorkerError" | "other", "arguments": [...]}, at most one
"""

import ctypes
import errno
import io
import json
import logging
import os
import pickle
import resource
import signal
import subprocess
import sys
import traceback
from collections.abc import Callable
from concurrent.futures.process import BrokenProcessPool
from contextlib import redirect_stdout
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TextIO

from hnerf.errors import InputError, PlaceError, is_out_of_memory
from hnerf.processes import end_with_parent
from hnerf.progress import Progress, listening, report
from tasks.launcher import KILLED, LostWorkerError
from tasks.limits import current_limits, limit_s
from tasks.source import Source, require_unchanged

MAX_WRITTEN_BYTES = 1 << 32  # per file: one image, or the keypoints of a camera
MAX_OPEN_FILES = 1024
CLONE_NEWUSER, CLONE_NEWNET = 0x10000000, 0x40000000  # linux/sched.h
BEYOND = {errno.EFBIG: "what is written of it is too large", errno.EMFILE: "it needs too many open files"}
NO_MEMORY = -4  # cv2.Error.StsNoMem
ERRORS: dict[str, type[Exception]] = {
    kind.__name__: kind for kind in (InputError, PlaceError, OSError, LostWorkerError)
}


def run_caged(read: Callable[..., object], *arguments: object, folder: Path) -> None:
    """Call `read(*arguments)`, which reads files in `folder`, in a separate process. Log and print here what it logs
    and prints.

    Memory, processor time without progress, and size and number of files are limited. There is no network if the system
    lets a process give it up. Its temporary files are removed, however it ends. Raises InputError that names the file
    if a limit ends the process or it crashes, LostWorkerError if it was killed from outside, and the errors of `read`:
    InputError and OSError unchanged, others as RuntimeError.
    """
    size = int(current_limits().reader_gib * (1 << 30))
    work = pickle.dumps((read, arguments, str(folder), size, limit_s(1)))
    with (
        TemporaryDirectory(prefix="hnerf-", ignore_cleanup_errors=True) as scratch,  # a killed reader leaves its files
        subprocess.Popen(
            [sys.executable, "-m", "tasks.cage", str(os.getpid())],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, "PYTHONSAFEPATH": "1", "MALLOC_ARENA_MAX": "4", "TMPDIR": scratch},
            start_new_session=True,
        ) as reader,
    ):
        try:
            assert reader.stdin is not None and reader.stdout is not None
            reader.stdin.write(work)
            reader.stdin.close()
            opened, error = folder, None
            for line in reader.stdout:
                message = json.loads(line)
                opened = Path(message.get("opened", opened))
                error = message if "error" in message else error
                _pass_on(message)
        except BaseException:
            reader.kill()
            raise
    if error:
        raise ERRORS.get(error["error"], RuntimeError)(*error["arguments"])
    if reader.returncode > 0:
        raise RuntimeError(f"{opened}: its reader ended with exit code {reader.returncode}")
    if reader.returncode < 0:
        raise _killed(opened, signal.Signals(-reader.returncode))


def read_source(source: Source, read: Callable[..., object], *arguments: object) -> None:
    """Call `read(*arguments)`, which reads the recording, as `run_caged` does. Raises InputError if the recording has
    changed since its digest was taken: one that is moved or replaced meanwhile looks damaged."""
    try:
        run_caged(read, *arguments, folder=source.root)
    except (InputError, FileNotFoundError):
        require_unchanged(source)
        raise
    require_unchanged(source)


def _pass_on(message: dict[str, Any]) -> None:
    if "progress" in message:
        report(*message["progress"])
    if "printed" in message:
        sys.stdout.write(message["printed"])
    if "log" in message:
        name, level, text = message["log"]
        logging.getLogger(name).log(level, "%s", text)


def _killed(opened: Path, by: signal.Signals) -> Exception:
    if by in KILLED:
        return LostWorkerError(f"{opened}: its reader was killed by {by.name}")
    if by == signal.SIGXCPU:
        why = f"no progress in {limit_s(1):.0f} s of a processor's time; export it again, or raise limits.stage_s"
    else:
        why = f"reading it crashed ({by.name}); export it again"
    return InputError(f"{opened}: {why}")


def _main(parent: int) -> None:
    """Do the work that arrives on standard input."""
    end_with_parent(signal.SIGKILL, parent)
    _give_up_network()
    replies = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # for what libraries print
    read, arguments, folder, memory_bytes, patience_s = pickle.load(sys.stdin.buffer)
    opened = Path(folder)

    def note_opened(event: str, given: tuple[object, ...]) -> None:
        nonlocal opened
        if event == "open" and isinstance(given[0], str) and given[0].startswith(folder):
            opened = Path(given[0])
            _send(replies, opened=given[0])

    def progressed(progress: Progress) -> None:
        _limit_processor_time(patience_s)
        _send(replies, progress=progress)

    sys.addaudithook(note_opened)
    logging.getLogger("hnerf").addHandler(_Sender(replies))
    _limit(resource.RLIMIT_DATA, memory_bytes)
    _limit(resource.RLIMIT_FSIZE, MAX_WRITTEN_BYTES)
    _limit(resource.RLIMIT_NOFILE, MAX_OPEN_FILES)
    _limit(resource.RLIMIT_CORE, 0)
    _limit_processor_time(patience_s)
    try:
        with listening(progressed), redirect_stdout(_Printed(replies)):
            read(*arguments)
    except Exception as error:
        _send(replies, **_told(error, opened, memory_bytes))


def _told(error: Exception, opened: Path, memory_bytes: int) -> dict[str, object]:
    """Return the message to the run about an error. If a limit was exceeded, it names the file that was opened last."""
    number = error.errno if isinstance(error, OSError) else None
    if is_out_of_memory(error) or getattr(error, "code", None) == NO_MEMORY:
        why = f"reading it needs more than {memory_bytes / (1 << 30):g} GiB"
        error = InputError(f"{opened}: {why}; export it again, or raise limits.reader_gib")
    elif number in BEYOND:
        error = InputError(f"{opened}: {BEYOND[number]}; export it again")
    if isinstance(error, BrokenProcessPool):
        return {"error": "LostWorkerError", "arguments": [f"{opened}: a process of its reader ended: {error}"]}
    if isinstance(error, InputError):
        return {"error": "PlaceError" if isinstance(error, PlaceError) else "InputError", "arguments": [str(error)]}
    if isinstance(error, OSError) and number is None:  # our own, for libraries that do not say why
        return {"error": "OSError", "arguments": [str(error)]}
    if isinstance(error, OSError):
        named = error.filename2 or error.filename  # of a copy, the file that is written
        name = None if named is None else str(named)
        return {"error": "OSError", "arguments": [number, error.strerror or str(error), name]}
    return {"error": "other", "arguments": [traceback.format_exc()]}


def _send(replies: TextIO, **message: object) -> None:
    replies.write(json.dumps(message) + "\n")


class _Printed(io.TextIOBase):
    def __init__(self, replies: TextIO) -> None:
        self.replies = replies

    def write(self, text: str) -> int:
        """Send what is printed to the run."""
        _send(self.replies, printed=text)
        return len(text)


class _Sender(logging.Handler):
    def __init__(self, replies: TextIO) -> None:
        super().__init__()
        self.replies = replies

    def emit(self, record: logging.LogRecord) -> None:
        """Send a record to the run."""
        _send(self.replies, log=[record.name, record.levelno, record.getMessage()])


def _give_up_network() -> None:
    """Give up network access for good, if the system lets this process do so, with or without root rights."""
    libc = ctypes.CDLL(None)
    if hasattr(libc, "unshare") and libc.unshare(CLONE_NEWNET):
        libc.unshare(CLONE_NEWUSER | CLONE_NEWNET)


def _limit(what: int, most: int) -> None:
    most = _allowed(what, most)
    resource.setrlimit(what, (most, most))


def _allowed(what: int, most: int) -> int:
    """Return the limit, or a lower one that the system already sets."""
    _, allowed = resource.getrlimit(what)
    return most if allowed == resource.RLIM_INFINITY else min(most, allowed)


def _limit_processor_time(seconds: float) -> None:
    """Allow this process that much more processor time, counted from now."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    _, allowed = resource.getrlimit(resource.RLIMIT_CPU)
    most = int(used.ru_utime + used.ru_stime + seconds) + 1
    resource.setrlimit(resource.RLIMIT_CPU, (_allowed(resource.RLIMIT_CPU, most), allowed))


if __name__ == "__main__":
    _main(int(sys.argv[1]))
