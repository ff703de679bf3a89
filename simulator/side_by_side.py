"""Images computed side by side in threads, and handed out in order."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Image = TypeVar("Image")


def in_order(make: Callable[[int], Image], indices: range, workers: int) -> Iterator[tuple[int, Image]]:
    """Compute images side by side and yield them in order, a few ahead at most: memory stays bounded."""
    waiting: deque[tuple[int, Future[Image]]] = deque()
    pool = ThreadPoolExecutor(workers)
    try:
        for index in indices:
            waiting.append((index, pool.submit(make, index)))
            if len(waiting) > workers + 1:
                first, future = waiting.popleft()
                yield first, future.result()
        while waiting:
            first, future = waiting.popleft()
            yield first, future.result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
