"""Exit statuses and error lines of a rank."""

import sys
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch

from hnerf.errors import InputError
from hnerf.training import run
from hnerf.training.step import TrainingError

FULL = "CUDA out of memory. Tried to allocate 2 GiB."
ADVICE = "; end what else takes memory, or set training.memory_gib"


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (InputError("a.npz: is cut short"), 2, "a.npz: is cut short"),
        (TrainingError("empty"), 3, "empty"),
        (OSError(28, "No space left", Path("b.pt")), 4, '[28, "No space left", "b.pt"]'),
        (OSError("c.png: cannot be written"), 4, '[null, "c.png: cannot be written", null]'),
        (torch.OutOfMemoryError(FULL), 5, f"{FULL}{ADVICE}"),
        (MemoryError(), 5, f"MemoryError{ADVICE}"),
    ],
)
def test_an_error_is_one_marked_line_and_an_exit_code(
    error: Exception, code: int, line: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["run", "capture", "cameras", "masks", "fit", "{}", "out"])
    monkeypatch.setattr(run.Distributed, "join", lambda: None)
    monkeypatch.setattr(run.Capture, "load", Mock(side_effect=error))
    assert run.main() == code
    assert capsys.readouterr().err == f"hnerf: {line}\n"


def test_a_gpu_without_memory_for_the_process_itself_has_the_same_exit_code(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["run", "capture", "cameras", "masks", "fit", "{}", "out"])
    monkeypatch.setattr(run.Distributed, "join", Mock(side_effect=RuntimeError("CUDA error: out of memory")))
    assert run.main() == 5
