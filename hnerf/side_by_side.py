"""Work on several images or surfaces at a time: on a CPU their operations are too small to share cores."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

import torch

T = TypeVar("T")
R = TypeVar("R")

MOST_AT_ONCE = 4  # each takes up to a GiB
CPU = torch.device("cpu")


def side_by_side(
    work: Callable[[T], R], items: Iterable[T], device: torch.device = CPU, threads: int | None = None
) -> Iterator[R]:
    """Yield work(item) for each item in order: one after another on a GPU, in several threads on a CPU. These share
    `threads` torch threads, by default as many as torch has. At most one more result than there are threads waits to be
    taken."""
    threads = threads or torch.get_num_threads()
    workers = min(threads, MOST_AT_ONCE) if device.type == "cpu" else 1
    if workers == 1:
        yield from map(work, items)
        return
    with ThreadPoolExecutor(workers, "beside", torch.set_num_threads, (threads // workers,)) as pool:
        ahead: deque[Future[R]] = deque()
        for item in items:
            ahead.append(pool.submit(work, item))
            if len(ahead) > workers:
                yield ahead.popleft().result()
        while ahead:
            yield ahead.popleft().result()
