"""Seconds of work across interruptions, with a clock that is set by hand."""

from pathlib import Path

import pytest
import stopwatch
from stopwatch import Stopwatch


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Return a list whose only item is the time."""
    now = [100.0]
    monkeypatch.setattr(stopwatch.time, "monotonic", lambda: now[0])
    return now


def test_time_of_an_interrupted_run_of_the_same_code_is_added(tmp_path: Path, clock: list[float]) -> None:
    first = Stopwatch(tmp_path / "state.json", "a")
    clock[0] = 130.0
    first.save(done=False)
    clock[0] = 500.0
    second = Stopwatch(tmp_path / "state.json", "a")
    clock[0] = 512.0
    assert (second.seconds, second.is_complete, second.began) == (42.0, True, first.began)


def test_a_killed_run_loses_at_most_ten_seconds(tmp_path: Path, clock: list[float]) -> None:
    killed = Stopwatch(tmp_path / "state.json", "a")
    for clock[0] in (109.0, 111.0, 115.0):
        killed.tick()
    assert Stopwatch(tmp_path / "state.json", "a").seconds == 11.0


@pytest.mark.parametrize(("digest", "done"), [("b", False), ("a", True)])
def test_time_of_other_code_or_of_a_finished_run_is_not_added(
    tmp_path: Path, clock: list[float], digest: str, done: bool
) -> None:
    first = Stopwatch(tmp_path / "state.json", "a")
    clock[0] = 130.0
    first.save(done)
    second = Stopwatch(tmp_path / "state.json", digest)
    clock[0] = 135.0
    assert (second.seconds, second.is_complete) == (5.0, False)
    second.save(done=False)
    third = Stopwatch(tmp_path / "state.json", digest)
    assert (third.seconds, third.is_complete) == (5.0, False)
