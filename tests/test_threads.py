"""How work is shared out, and on how many threads."""

from __future__ import annotations

import os
import threading

import pytest

from commonmap.matching.threads import both, count_cores, in_order


def test_as_many_threads_as_the_process_has_cores_and_no_more(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {3}, raising=False)
    assert count_cores(2) == 1
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(16)), raising=False)
    assert count_cores(2) == 2
    monkeypatch.delattr(os, "sched_getaffinity")  # not every system tells
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert count_cores(2) == 1


@pytest.mark.parametrize("workers", [1, 2, 5])
def test_answers_come_in_the_order_of_the_items(workers: int) -> None:
    assert list(in_order(lambda n: n * n, range(20), workers)) == [n * n for n in range(20)]
    assert both(lambda: "one", lambda: 2, workers) == ("one", 2)


def test_one_worker_is_the_thread_that_calls_and_two_are_others() -> None:
    here = threading.get_ident()
    assert set(in_order(lambda n: threading.get_ident(), range(4), 1)) == {here}
    assert both(threading.get_ident, threading.get_ident, 1) == (here, here)
    assert here not in set(in_order(lambda n: threading.get_ident(), range(4), 2))
    assert here not in both(threading.get_ident, threading.get_ident, 2)


@pytest.mark.parametrize("workers", [1, 2])
def test_a_problem_reaches_the_caller(workers: int) -> None:
    def fail(n: int) -> int:
        raise ValueError(f"item {n}")

    with pytest.raises(ValueError, match="item 0"):
        list(in_order(fail, range(3), workers))
    with pytest.raises(ValueError, match="item 7"):
        both(lambda: 1, lambda: fail(7), workers)
