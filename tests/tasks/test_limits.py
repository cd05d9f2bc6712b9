import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import count
from pathlib import Path
from typing import Any

import pytest
from prefect import flow

from hnerf.config import LimitSettings
from hnerf.progress import report
from tasks import limits
from tasks.launcher import run_ranks
from tasks.limits import StalledError, limit_s, limited, set_limits
from tasks.policy import is_retryable
from tasks.source import Source, read_capture
from tasks.stage import Stage
from tasks.store import Store
from tests.tasks.test_launcher import wait_until_running

ROOT = Path(__file__).parents[2]


def within(stage_s: float, work: Callable[[], Any], image_s: float = 0.0) -> Any:
    """Run work under limits; return its result."""
    set_limits(LimitSettings(stage_s=stage_s, image_s=image_s))
    return work()


def sleep_in(resumable: bool, with_progress_every_s: float | None = None, duration_s: float = 5.0) -> None:
    with limited("fit", 1, resumable):
        end_s = time.monotonic() + duration_s
        for done in count():
            time.sleep(with_progress_every_s or duration_s)
            report("outlines", done % 10, 10)
            if time.monotonic() > end_s:
                return


@pytest.mark.parametrize("resumable", [True, False])
def test_a_stage_without_progress_is_ended_with_its_cause(resumable: bool) -> None:
    with pytest.raises(StalledError, match=r"^fit: ended, no progress for 0 s \(in a library\); if the") as caught:
        within(0.1, lambda: sleep_in(resumable))
    assert is_retryable(caught.value) == resumable
    assert signal.getsignal(signal.SIGALRM) == signal.SIG_DFL and signal.getitimer(signal.ITIMER_REAL) == (0, 0)


def test_progress_restarts_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "REARM_S", 0.0)
    within(0.3, lambda: sleep_in(False, with_progress_every_s=0.1, duration_s=0.6))


def test_progress_in_another_thread_restarts_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """A download from a bucket reports from the thread of its event loop."""
    monkeypatch.setattr(limits, "REARM_S", 0.0)

    def download() -> None:
        for done in range(16):
            report("a.mp4", done, 16)
            time.sleep(0.05)

    def wait_for_download() -> None:
        with limited("fetched", 1, resumable=False), ThreadPoolExecutor(1) as pool:
            pool.submit(download).result()

    within(0.5, wait_for_download)


def test_repeated_progress_does_not_restart_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "REARM_S", 0.0)

    def report_the_same() -> None:
        with limited("detection", 1, resumable=True):
            for _ in range(20):
                report("detection", 3, 10)
                time.sleep(0.1)

    with pytest.raises(StalledError, match="after 3 of 10 detection"):
        within(0.3, report_the_same)


def test_limits_grow_with_the_number_of_images() -> None:
    assert within(10.0, lambda: limit_s(6), image_s=0.5) == 13.0


def stuck(out: Path, source: Source) -> dict[str, float]:
    time.sleep(5)
    return {}


def test_a_stage_that_is_ended_leaves_nothing_behind(tmp_path: Path) -> None:
    (tmp_path / "ada").mkdir()
    stage = Stage(stuck, "stuck", "1", resumable=False)
    with pytest.raises(StalledError, match=r"^stuck: ended"):
        within(0.1, lambda: stage(Store(tmp_path / "store"), read_capture(tmp_path / "ada")[0]))
    assert not (tmp_path / "store").exists()


@flow
def flow_with_stuck_stage(store: Path, source: Source) -> None:
    """Run a stage that makes no progress, under limits that the flow sets."""
    set_limits(LimitSettings(stage_s=0.1, image_s=0))
    Stage(stuck, "stuck", "1", resumable=False)(Store(store), source)


def test_limits_apply_in_a_flow_run_and_a_stall_is_not_retried(prefect_api: str, tmp_path: Path) -> None:
    (tmp_path / "ada").mkdir()
    with pytest.raises(StalledError, match=r"^stuck: ended"):
        flow_with_stuck_stage(tmp_path / "store", read_capture(tmp_path / "ada")[0])


def test_waiting_for_another_process_is_not_a_stall(tmp_path: Path) -> None:
    """The other process has a limit of its own."""
    store, found = Store(tmp_path / "store"), []
    write = 'lambda out: (print("at it", flush=True), __import__("time").sleep(1)) and {}'
    code = f"from pathlib import Path; from tasks.store import Store; Store(Path({str(store.root)!r}))"
    code += f".get_or_compute('fit', 'k', {write})"
    other = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE)
    assert other.stdout and other.stdout.readline() == b"at it\n"
    within(0.1, lambda: found.append(store.get_or_compute("fit", "k", lambda out: pytest.fail("done twice"))))
    assert found[0].name == "fit/k" and other.wait() == 0
    other.stdout.close()


def test_stalled_ranks_are_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(ROOT))

    def wait_for_ranks() -> None:
        with limited("training", 1, True):
            run_ranks("tests.tasks.ranks", ["sleep", str(tmp_path)], 1)

    with pytest.raises(StalledError):
        within(1.5, wait_for_ranks)
    wait_until_running(tmp_path, 0)


def test_code_that_never_returns_ends_its_process() -> None:
    """Such code handles no signals."""
    code = """
import signal, time
from hnerf.config import LimitSettings
from tasks import limits
limits.GRACE_S = 0.1
limits.set_limits(LimitSettings(stage_s=0.1, image_s=0))
with limits.limited("capture", 1, False):
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGALRM})
    time.sleep(20)
"""
    started = time.monotonic()
    ended = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert ended.returncode == 1 and "Timeout" in ended.stderr and time.monotonic() - started < 15
