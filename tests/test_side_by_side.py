import threading

import pytest
import torch

from hnerf.side_by_side import MOST_AT_ONCE, side_by_side

CPU, GPU = torch.device("cpu"), torch.device("cuda")


@pytest.mark.parametrize("threads, at_once", [(2, 2), (9, MOST_AT_ONCE)])
def test_cores_are_divided_among_parallel_calls(monkeypatch: pytest.MonkeyPatch, threads: int, at_once: int) -> None:
    """The barrier holds each call until `at_once` calls run at the same time."""
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    given, barrier = [], threading.Barrier(at_once)
    monkeypatch.setattr(torch, "set_num_threads", given.append)

    def squared(number: int) -> int:
        barrier.wait(timeout=10)
        return number**2

    assert list(side_by_side(squared, range(2 * at_once), CPU)) == [n**2 for n in range(2 * at_once)]
    assert given == [threads // at_once] * at_once


def test_on_a_gpu_calls_run_one_after_another(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "get_num_threads", lambda: 4)
    here = threading.get_ident()
    assert list(side_by_side(lambda _: threading.get_ident(), range(3), GPU)) == [here] * 3


def test_as_many_threads_run_as_requested(monkeypatch: pytest.MonkeyPatch) -> None:
    """A limit on torch's threads, such as the body fit sets, does not limit parallel work."""
    monkeypatch.setattr(torch, "get_num_threads", lambda: 1)
    monkeypatch.setattr(torch, "set_num_threads", lambda _: None)
    barrier = threading.Barrier(2)
    assert sorted(side_by_side(lambda _: barrier.wait(timeout=10), range(2), CPU, threads=2)) == [0, 1]


def test_errors_are_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    monkeypatch.setattr(torch, "set_num_threads", lambda _: None)
    with pytest.raises(ZeroDivisionError):
        list(side_by_side(lambda n: 1 // n, [1, 0, 2], CPU))


def test_items_are_taken_only_as_results_are_consumed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    monkeypatch.setattr(torch, "set_num_threads", lambda _: None)
    items = iter(range(100))
    results = side_by_side(lambda n: n, items, CPU)
    assert next(results) == 0
    assert next(items) == 3  # for two threads, three items were taken
    results.close()
