import threading

import pytest
import torch

from hnerf.side_by_side import MOST_AT_ONCE, side_by_side

CPU, GPU = torch.device("cpu"), torch.device("cuda")


@pytest.mark.parametrize("threads, at_once", [(2, 2), (9, MOST_AT_ONCE)])
def test_cores_are_divided_among_what_runs_at_a_time(
    monkeypatch: pytest.MonkeyPatch, threads: int, at_once: int
) -> None:
    """Nobody passes the barrier before as many as wanted are there."""
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    given, barrier = [], threading.Barrier(at_once)
    monkeypatch.setattr(torch, "set_num_threads", given.append)

    def squared(number: int) -> int:
        barrier.wait(timeout=10)
        return number**2

    assert list(side_by_side(squared, range(2 * at_once), CPU)) == [n**2 for n in range(2 * at_once)]
    assert given == [threads // at_once] * at_once


def test_a_gpu_does_one_after_another(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "get_num_threads", lambda: 4)
    here = threading.get_ident()
    assert list(side_by_side(lambda _: threading.get_ident(), range(3), GPU)) == [here] * 3


def test_as_many_threads_as_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """A limit on torch's threads, as while a body is fitted, does not hold for work side by side."""
    monkeypatch.setattr(torch, "get_num_threads", lambda: 1)
    monkeypatch.setattr(torch, "set_num_threads", lambda _: None)
    barrier = threading.Barrier(2)
    assert sorted(side_by_side(lambda _: barrier.wait(timeout=10), range(2), CPU, threads=2)) == [0, 1]


def test_what_fails_is_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    monkeypatch.setattr(torch, "set_num_threads", lambda _: None)
    with pytest.raises(ZeroDivisionError):
        list(side_by_side(lambda n: 1 // n, [1, 0, 2], CPU))


def test_work_waits_until_results_are_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    monkeypatch.setattr(torch, "set_num_threads", lambda _: None)
    items = iter(range(100))
    results = side_by_side(lambda n: n, items, CPU)
    assert next(results) == 0
    assert next(items) == 3  # three of them were taken for two threads
    results.close()
