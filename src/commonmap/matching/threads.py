"""Work side by side, on as many threads as there are cores for; no answer depends on how many."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

First = TypeVar("First")
Second = TypeVar("Second")


def count_cores(most: int) -> int:
    """Return how many cores this process may use, 1 to `most`.

    On one core a second thread only takes the caches away from the first: 8 % of a match.
    """
    if hasattr(os, "sched_getaffinity"):
        return min(len(os.sched_getaffinity(0)), most)
    return min(os.cpu_count() or 1, most)


def in_order(
    function: Callable[[First], Second], items: Iterable[First], workers: int
) -> Iterator[Second]:
    """Yield what the function returns of every item, in their order."""
    if workers == 1:
        yield from map(function, items)
        return
    with ThreadPoolExecutor(max_workers=workers) as pool:
        yield from pool.map(function, items)


def both(
    first: Callable[[], First], second: Callable[[], Second], workers: int
) -> tuple[First, Second]:
    """Return what both functions return, side by side if there is more than one worker."""
    if workers == 1:
        return first(), second()
    with ThreadPoolExecutor(max_workers=2) as pool:
        one, other = pool.submit(first), pool.submit(second)
        return one.result(), other.result()
