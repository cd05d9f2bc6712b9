"""Commands that receive SIGTERM or SIGHUP, and commands whose streams are closed or full."""

import os
import signal
import subprocess
import sys
import time
import weakref
from pathlib import Path

import pytest

from flows.cli import main
from flows.ending import Terminated, unwound_by_signals
from hnerf import synthetic

RUN = "import sys; from flows.cli import main; sys.exit(main(sys.argv[1:]))"
ENDED_MIDWAY = """
import os, signal, sys, time
from types import SimpleNamespace
from flows.cli import main

def write(out, settings):
    import hnerf.pycolmap_import
    (out / "half").touch()
    os.kill(os.getpid(), int(sys.argv.pop()))
    time.sleep(60)

sys.modules["hnerf.synthetic"] = SimpleNamespace(write_synthetic_capture=write)  # without what it imports
sys.exit(main(sys.argv[1:-1]))
"""


@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_signals_print_one_line_and_leave_no_partial_files(tmp_path: Path, number: signal.Signals, status: int) -> None:
    """Also with pycolmap loaded, which would report SIGTERM as a crash."""
    command = [sys.executable, "-c", ENDED_MIDWAY, "synth", str(tmp_path / "ada"), str(int(number))]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr) == (status, f"hnerf: ended by {number.name}\n")
    assert list(tmp_path.iterdir()) == []


def test_a_hangup_that_is_ignored_stays_ignored() -> None:
    """As for a command under nohup(1)."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with unwound_by_signals():
        signal.raise_signal(signal.SIGHUP)
    assert signal.signal(signal.SIGHUP, before) is signal.SIG_IGN


@pytest.mark.parametrize(("number", "raised"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, Terminated)])
def test_a_signal_during_a_weak_reference_callback_is_not_lost(
    number: signal.Signals, raised: type[BaseException]
) -> None:
    class Referred:
        """An object that a weak reference can point to."""

    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # background jobs of a shell ignore SIGINT
    referred = Referred()
    reference = weakref.ref(referred, lambda _: signal.raise_signal(number))
    with pytest.raises(raised) as found, unwound_by_signals():
        del referred
        time.sleep(10)
    signal.signal(signal.SIGINT, before)
    assert reference() is None and found.type is raised


def test_a_second_sigterm_does_not_interrupt_the_clean_up(tmp_path: Path) -> None:
    cleaned = []
    with pytest.raises(Terminated), unwound_by_signals():
        try:
            signal.raise_signal(signal.SIGTERM)
        finally:
            signal.raise_signal(signal.SIGTERM)
            cleaned.append(tmp_path)
    assert cleaned == [tmp_path]


def test_the_former_sigterm_handler_is_restored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    during = []
    monkeypatch.setattr(
        synthetic, "write_synthetic_capture", lambda *_: during.append(signal.getsignal(signal.SIGTERM))
    )
    before = signal.getsignal(signal.SIGTERM)
    assert main(["synth", str(tmp_path / "ada")]) == 0
    assert signal.getsignal(signal.SIGTERM) is before
    assert during != [before]


@pytest.mark.parametrize(
    ("arguments", "lines", "status"),
    [
        ("settings >&-", 0, 0),
        ("settings >&- 2>&-", 0, 0),
        ("settings --preset best >&-", 1, 2),
        ("settings --preset best 2>&-", 0, 2),
        ("store list --store . >&-", 1, 2),
        ("settings 1</dev/null", 0, 0),
        ("settings --preset best 2>/dev/full", 0, 2),
        ("settings --presets best 2>/dev/full", 0, 2),
    ],
)
def test_closed_streams_change_neither_the_work_nor_the_exit_code(
    arguments: str, lines: int, status: int, tmp_path: Path
) -> None:
    ended = from_shell(arguments, tmp_path)
    assert (len(ended.stderr.splitlines()), ended.stdout, ended.returncode) == (lines, "", status)


@pytest.mark.parametrize("arguments", ["--help", "settings", "models"])
def test_the_error_of_a_full_standard_output_is_one_line_with_exit_code_1(arguments: str, tmp_path: Path) -> None:
    ended = from_shell(f"{arguments} >/dev/full", tmp_path)
    assert ended.stderr.startswith("hnerf: [Errno 28] No space left") and ended.stderr.count("\n") == 1
    assert ended.returncode == 1


def test_help_into_a_closed_pipe_has_exit_code_1(tmp_path: Path) -> None:
    ended = from_shell("--help | true; exit ${PIPESTATUS[0]}", tmp_path)
    assert (ended.stderr, ended.returncode) == ("", 1)


def from_shell(arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run `hnerf` with arguments and redirections for bash; its output is buffered, as by default."""
    command = ["bash", "-c", f'"$0" -c "$1" {arguments}', sys.executable, RUN]
    buffered = {**os.environ, "PYTHONUNBUFFERED": ""}
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder, env=buffered)


def test_no_file_gets_the_descriptor_of_a_closed_stream(tmp_path: Path) -> None:
    """Libraries write to standard output and error by file descriptor number (1 and 2)."""
    code = "import sys; from flows import ending; ending.open_closed_streams(); sys.exit(open(sys.executable).fileno())"
    ended = subprocess.run(["sh", "-c", 'exec "$0" -c "$1" >&- 2>&-', sys.executable, code], check=False)
    assert ended.returncode > 2
