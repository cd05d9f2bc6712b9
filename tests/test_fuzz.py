"""A few cases of the fuzz program; and that it detects failures."""

import json
from pathlib import Path

import pytest

from hnerf.errors import InputError
from tests import fuzz as module
from tests.fuzz import READERS, Reader, Workshop, fuzz

CASES = 15 * len(READERS)


def test_damaged_files_are_read_or_refused() -> None:
    """If this fails, `python tests/fuzz.py --case N` repeats the case; make it a test of that reader."""
    found = fuzz(CASES)
    assert found.failures == []
    assert found.cases == CASES


def _read(folder: Path, out: Path) -> object:
    try:
        found = json.loads((folder / "a.json").read_text())
    except (OSError, RecursionError, ValueError):
        raise InputError("a.json: is not JSON") from None
    if found != [1, 2, 3]:
        raise KeyError("another list")
    return found


def _write(folder: Path) -> None:
    (folder / "a.json").write_text("[1, 2, 3]")


def test_another_exception_is_a_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A changed number in the list raises KeyError, a failure; damaged brackets are refused, which is correct."""
    monkeypatch.setattr(module, "READERS", (Reader("list", _write, _read),))
    monkeypatch.setattr(module.resource, "setrlimit", lambda *_: None)
    monkeypatch.setattr(module.logging, "disable", lambda *_: None)
    workshop = Workshop(tmp_path)
    failures = [failure for case in range(100) if (failure := workshop.try_case(0, case)[1])]
    assert 0 < len(failures) < 100 and all(failure.startswith("KeyError") for failure in failures)
    assert (tmp_path / "list" / "a.json").read_text() == "[1, 2, 3]"
