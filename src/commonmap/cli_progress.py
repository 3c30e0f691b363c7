"""How a command says where it is and what it noted: a moving line on a terminal, or plain lines."""

from __future__ import annotations

import logging
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from commonmap.types import Progress, no_progress


@contextmanager
def telling(*, quiet: bool) -> Iterator[Progress]:
    """Yield the progress callback for this terminal; it writes to stderr only."""
    if quiet:
        yield no_progress
    elif sys.stderr.isatty():
        with _moving() as progress:
            yield progress
    else:
        yield _Lines()


class _Lines:
    """A line for each new step, with the seconds since the start."""

    def __init__(self) -> None:
        self.start = time.perf_counter()
        self.told: set[str] = set()

    def __call__(self, step: str, share: float = 0.0) -> None:
        if step not in self.told:
            self.told.add(step)
            seconds = time.perf_counter() - self.start
            print(f"{seconds:7.1f} s  {step}", file=sys.stderr, flush=True)


@contextmanager
def _moving() -> Iterator[Progress]:
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bars

    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=30),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
    )
    with Bars(*columns, console=Console(stderr=True), transient=True) as bars:
        tasks = {threading.get_ident(): bars.add_task("start", total=1.0)}

        def tell(step: str, share: float = 0.0) -> None:
            # jobs that run at once tell from threads of their own: a bar each
            me = threading.get_ident()
            if me not in tasks:
                tasks[me] = bars.add_task(step, total=1.0)
            bars.update(tasks[me], description=step, completed=share)

        yield tell


@contextmanager
def noting(quiet: bool) -> Iterator[None]:
    """Print what readers note about a file (points left out, units) as lines on stderr."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("note: %(message)s"))
    told: set[str] = set()

    def is_new(record: logging.LogRecord) -> bool:
        # A log is read twice: once for the way, once for the map
        text = record.getMessage()
        fresh = text not in told
        told.add(text)
        return fresh

    handler.addFilter(is_new)
    logger = logging.getLogger("commonmap")
    handler.setLevel(logging.ERROR if quiet else logging.INFO)
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)
