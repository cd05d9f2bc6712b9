"""The fault program, on code of one line; and that its own faults can still be inserted."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.faults import FAULTS, ROOT, Fault, judge, with_fault


@pytest.mark.parametrize("fault", FAULTS, ids=[fault.name for fault in FAULTS])
def test_every_fault_can_be_inserted(fault: Fault) -> None:
    """Its text is found exactly once, the changed file still compiles, and its tests exist."""
    faulty = with_fault(fault, ROOT)
    assert faulty != (ROOT / fault.file).read_text()
    compile(faulty, fault.file, "exec")
    assert (ROOT / fault.tests).is_file()


def test_names_are_unique() -> None:
    assert len({fault.name for fault in FAULTS}) == len(FAULTS)


@pytest.fixture
def code(tmp_path: Path) -> Path:
    (tmp_path / "hnerf").mkdir()
    (tmp_path / "tests").mkdir()
    (tmp_path / "hnerf" / "sums.py").write_text("def total(a, b):\n    return a + b\n")
    (tmp_path / "tests" / "test_sums.py").write_text(
        "from hnerf.sums import total\n\n\ndef test_total():\n    assert total(2, 2) == 4\n"
    )
    return tmp_path


def test_faults_are_caught_or_missed(code: Path) -> None:
    """The test of 2 + 2 misses a change to 2 * 2, and catches 2 - 2. The code itself is not changed."""
    before = (code / "hnerf" / "sums.py").read_text()
    minus, times = (Fault("sum", "sums", "a + b", f"a {sign} b") for sign in "-*")
    assert judge(minus, code).red == "tests/test_sums.py::test_total"
    assert judge(times, code).red is None
    assert (code / "hnerf" / "sums.py").read_text() == before


def test_tests_that_hang_because_of_a_fault_are_ended(code: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The fault adds zeros forever."""
    monkeypatch.setattr("tests.faults.LIMIT_S", 2.0)
    assert judge(Fault("sum", "sums", "a + b", "sum(iter(int, 1))"), code).red == "its time limit of 2 s"


def test_code_that_cannot_run_is_an_error_and_not_a_catch(code: Path) -> None:
    broken = Fault("sum", "sums", "a + b", "a +")
    with pytest.raises(RuntimeError, match="SyntaxError"):
        judge(broken, code)


@pytest.mark.parametrize(("text", "times"), [("a * b", 0), ("a", 3)])
def test_a_text_that_is_not_found_exactly_once_is_refused(code: Path, text: str, times: int) -> None:
    with pytest.raises(ValueError, match=rf"^sum: found {times} times in hnerf/sums.py, not once"):
        judge(Fault("sum", "sums", text, "b"), code)


def test_unknown_names_are_refused() -> None:
    done = subprocess.run([sys.executable, "tests/faults.py", "gravity"], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 2 and "no such fault: gravity" in done.stderr
