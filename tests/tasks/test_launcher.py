import fcntl
import json
import logging
import os
import re
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from threading import Event, Thread
from unittest.mock import Mock

import pytest

from hnerf.errors import InputError
from tasks import agent, launcher
from tasks.launcher import LostWorkerError, RankFailedError, run_ranks
from tasks.policy import is_retryable

RANKS = "tests.tasks.ranks"
PATIENCE_S = 60.0


@pytest.fixture(autouse=True)
def tests_on_python_path(monkeypatch: pytest.MonkeyPatch) -> None:
    """Put the tests, which are not installed, on the Python path of the ranks."""
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))


def still_running(folder: Path) -> list[int]:
    """Return the process ids of the ranks that are running."""
    return [i for i in (int(path.name) for path in folder.iterdir()) if runs(i)]


def runs(process: int) -> bool:
    try:
        return b") Z" not in Path(f"/proc/{process}/stat").read_bytes()
    except (FileNotFoundError, ProcessLookupError):  # the latter if it ends between open and read
        return False


def wait_until_running(folder: Path, count: int) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while len(still_running(folder)) != count:
        assert time.monotonic() < deadline, f"{still_running(folder)} are running, not {count}"
        time.sleep(0.05)


def test_ranks_log_at_once_report_progress_and_ignore_modules_in_the_working_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Progress lines are reported, but not logged as well."""
    for name in ("tasks.py", "torch.py"):
        (tmp_path / name).write_text("raise SystemExit(1)")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PYTHONUNBUFFERED", raising=False)
    with caplog.at_level(logging.INFO, logger=RANKS), caplog.at_level(logging.DEBUG, logger="hnerf.progress"):
        run_ranks(RANKS, ["ok", str(tmp_path)], processes=2)
    lines = [record for record in caplog.records if record.name == RANKS]
    for rank in (0, 1):
        mine = [record for record in lines if record.message.startswith(f"rank {rank} of 2 at ")]
        delays_s = [record.created - float(record.message.split()[-1]) for record in mine]
        assert len(delays_s) == 3 and max(delays_s) - min(delays_s) < 0.4  # the ranks write 0.5 s apart
    assert len(lines) == 6
    progress = [record.progress for record in caplog.records if record.name == "hnerf.progress"]
    assert sorted(progress) == [("training", 0, 8), ("training", 1, 8)]


def test_waiting_threads_of_ranks_sleep_unless_the_user_set_a_policy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
    assert launcher._environment(2)["OMP_WAIT_POLICY"] == "PASSIVE"
    monkeypatch.setenv("OMP_WAIT_POLICY", "ACTIVE")
    assert launcher._environment(2)["OMP_WAIT_POLICY"] == "ACTIVE"


@pytest.mark.parametrize(
    ("mode", "error", "message"),
    [
        ("bad", InputError, r"^a\.jpg: bad; write it again$"),
        ("killed", LostWorkerError, "rank 1 was killed by SIGKILL"),
    ],
)
def test_a_failing_rank_ends_all_ranks_with_its_message(
    tmp_path: Path, mode: str, error: type[Exception], message: str
) -> None:
    with pytest.raises(error) as caught:
        run_ranks(RANKS, [mode, str(tmp_path)], processes=2)
    assert type(caught.value) is error and re.search(message, str(caught.value))
    assert still_running(tmp_path) == []


@pytest.mark.parametrize(
    ("code", "line", "error", "message"),
    [
        (1, "ValueError: boom", RuntimeError, "^ranks: rank 1 ended with exit code 1\na warning\nValueError: boom$"),
        (2, "hnerf: a.jpg: bad; write it again\nat exit", InputError, r"^a\.jpg: bad; write it again$"),
        (3, "hnerf: no surface: check the masks", RankFailedError, "^no surface: check the masks$"),
        (
            4,
            'hnerf: [28, "No space left on device", "b.pt"]',
            OSError,
            r"^\[Errno 28\] No space left on device: 'b\.pt'$",
        ),
        (5, "hnerf: CUDA out of memory; end what", LostWorkerError, "^CUDA out of memory; end what$"),
        (-signal.SIGTERM, "stopped", LostWorkerError, "^ranks: rank 1 was killed by SIGTERM$"),
        (-signal.SIGSEGV, "oh", RuntimeError, "^ranks: rank 1 crashed with SIGSEGV\na warning\noh$"),
    ],
)
def test_the_exit_code_of_the_first_failure_determines_the_error(
    tmp_path: Path, code: int, line: str, error: type[Exception], message: str
) -> None:
    (tmp_path / launcher.FAILURE).write_text(json.dumps([1, code]))
    written = tmp_path / "run" / "attempt_0" / "1" / "stderr.log"
    written.parent.mkdir(parents=True)
    written.write_text(f"a warning\n{line}\n")
    found = launcher._error("ranks", tmp_path, 1)
    assert type(found) is error and re.search(message, str(found))


def test_an_empty_failure_report_is_a_full_disk(tmp_path: Path) -> None:
    (tmp_path / launcher.FAILURE).touch()
    found = launcher._error("ranks", tmp_path, 1)
    assert is_retryable(found) and str(found) == f"[Errno 28] No space left on device: '{tmp_path}/{launcher.FAILURE}'"


@pytest.mark.parametrize("fatal", [signal.SIGKILL, signal.SIGINT])
def test_ranks_end_with_the_caller(tmp_path: Path, fatal: signal.Signals) -> None:
    code = f"from tasks.launcher import run_ranks; run_ranks({RANKS!r}, ['sleep', {str(tmp_path)!r}], 2)"
    heard = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)  # a background job of a shell would ignore SIGINT
    caller = subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.DEVNULL, preexec_fn=heard)
    wait_until_running(tmp_path, 2)
    os.kill(caller.pid, fatal)
    caller.wait()
    wait_until_running(tmp_path, 0)


def test_torchrun_ends_even_if_one_of_its_threads_continues(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def interrupted(arguments: object) -> None:
        Thread(target=Event().wait).start()
        raise KeyboardInterrupt("while it ended its ranks")

    monkeypatch.setattr(agent, "run", interrupted)
    if not (child := os.fork()):
        try:
            agent.main(tmp_path / "failure", ["-m", "nothing"])
        finally:
            os._exit(9)
    _, status = os.waitpid(child, 0)
    assert os.waitstatus_to_exitcode(status) == 1 and "while it ended its ranks" in capfd.readouterr().err


def test_ranks_end_with_torchrun_and_its_loss_is_a_lost_worker(tmp_path: Path) -> None:
    with ThreadPoolExecutor() as pool:
        launched = pool.submit(run_ranks, RANKS, ["sleep", str(tmp_path)], 2)
        wait_until_running(tmp_path, 2)
        rank = Path(f"/proc/{still_running(tmp_path)[0]}/status").read_text()
        os.kill(int(re.search(r"PPid:\t(\d+)", rank)[1]), signal.SIGKILL)
        with pytest.raises(LostWorkerError, match="torchrun was killed by SIGKILL"):
            launched.result(PATIENCE_S)
    wait_until_running(tmp_path, 0)


def test_folders_of_killed_launchers_are_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of three folders, one is locked, one is new, and one was left behind."""
    monkeypatch.setattr(launcher, "gettempdir", lambda: str(tmp_path))
    for name in ("used", "young", "left"):
        (tmp_path / f"hnerf-ranks-{name}").mkdir()
        (tmp_path / f"hnerf-ranks-{name}" / "lock").touch()
    for name in ("used", "left"):
        os.utime(tmp_path / f"hnerf-ranks-{name}" / "lock", (0, 0))
    with (tmp_path / "hnerf-ranks-used" / "lock").open() as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        launcher._remove_left_behind()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["hnerf-ranks-used", "hnerf-ranks-young"]


def test_a_full_folder_of_temporary_files_is_a_full_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """Python reports it as a missing folder."""
    monkeypatch.setattr(launcher, "gettempdir", Mock(side_effect=FileNotFoundError(2, "No usable temporary directory")))
    with pytest.raises(OSError, match="No space left on device: '/tmp'"):
        run_ranks(RANKS, [], 1)
