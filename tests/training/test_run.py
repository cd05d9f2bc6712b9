"""How a rank ends."""

import sys

import pytest

from hnerf.errors import CaptureError
from hnerf.training import run
from hnerf.training.step import TrainingError


@pytest.mark.parametrize(("error", "code"), [(CaptureError("a.npz: is cut short"), 2), (TrainingError("empty"), 3)])
def test_what_is_told_is_the_last_line_and_an_exit_code(
    error: Exception, code: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fails(*_: object) -> None:
        raise error

    monkeypatch.setattr(sys, "argv", ["run", "capture", "cameras", "masks", "fit", "{}", "out"])
    monkeypatch.setattr(run.Processes, "join", lambda: None)
    monkeypatch.setattr(run.Capture, "load", fails)
    assert run.main() == code
    assert capsys.readouterr().err == f"{error}\n"
