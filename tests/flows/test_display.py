import io
import logging
import re
import sys

import pytest

from flows.display import display
from hnerf.progress import log, report


class Screen(io.StringIO):
    def isatty(self) -> bool:
        return True


def work() -> object:
    """Report half of some work, log a line, and report the end; return `sys.stdout` as it is then."""
    with display():
        report("rendering", 5, 10)
        logging.getLogger("hnerf.stage").info("training: [1/2]")
        report("rendering", 10, 10)
        return sys.stdout


def test_a_terminal_shows_a_bar_until_the_work_has_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(sys, "stdout", screen := Screen())
    handlers = list(logging.getLogger("hnerf").handlers)
    assert work() is screen  # not replaced by rich, which would wrap lines to the terminal's width
    assert "rendering" in screen.getvalue() and "50%" in screen.getvalue()
    assert "hnerf.stage: training: [1/2]\n" in screen.getvalue()
    assert screen.getvalue().rstrip().endswith("\x1b[2K\x1b[?25h")  # the bar's line is erased
    assert not log.isEnabledFor(logging.DEBUG) and logging.getLogger("hnerf").handlers == handlers


def test_other_outputs_show_only_log_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdout", file := io.StringIO())
    work()
    (line,) = file.getvalue().splitlines()
    assert re.fullmatch(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d [+-]\d{4} hnerf\.stage: training: \[1/2\]", line)


def test_a_closed_pipe_prints_no_traceback_per_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Closed(io.StringIO):
        def write(self, text: str) -> int:
            raise BrokenPipeError

    monkeypatch.setattr(sys, "stdout", Closed())
    work()
    assert capsys.readouterr().err == ""
