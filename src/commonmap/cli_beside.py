"""Two logs side by side: the second in a process of its own, which tells its progress, notes and
errors here as if it were this one.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import threading
import traceback
from collections.abc import Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from types import TracebackType
from typing import Any

from commonmap.cli_logs import Input, LogOptions, is_log, take
from commonmap.errors import CommonmapError, InputError
from commonmap.types import Progress

log = logging.getLogger("commonmap")

SMALL = 10_000_000
"""Bytes of a log below which starting a process costs more than it saves (10 s of a VLP-16)."""


def take_both(
    paths: Sequence[Path], options: Sequence[LogOptions], progress: Progress
) -> tuple[Input, Input]:
    """Return two inputs as maps; two raw logs are read at once where there are cores for it.

    The maps are the same as one after the other. An error of either ends both.
    """
    first, second = paths
    if len(os.sched_getaffinity(0)) < 2 or not all(is_log(p) and _size(p) > SMALL for p in paths):
        return take(first, options[0], progress), take(second, options[1], progress)
    with _Beside(second, options[1], progress) as beside:
        mine = take(first, options[0], beside.watching(progress))
        return mine, beside.result()


def _size(path: Path) -> int:
    files = [path] if path.is_file() else path.rglob("*")
    return sum(file.stat().st_size for file in files if file.is_file())


class _Beside:
    """A log that is taken in a process of its own, while the block runs."""

    def __init__(self, path: Path, options: LogOptions, progress: Progress):
        # a fresh process: one that is forked shares locks with the threads of this one
        context = multiprocessing.get_context("spawn")
        self._path = path
        self._progress = progress
        self._ours, theirs = context.Pipe(duplex=False)
        self._process = context.Process(target=_work, args=(theirs, path, options), daemon=True)
        self._process.start()
        theirs.close()
        self._error: Exception | None = None
        self._result: Input | None = None
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()

    def __enter__(self) -> _Beside:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        if self._process.is_alive():
            self._process.terminate()
        self._process.join()
        self._listener.join()

    def watching(self, progress: Progress) -> Progress:
        """Return a progress callback that raises as soon as the other process has failed."""

        def tell(step: str, share: float = 0.0) -> None:
            if self._error is not None:
                raise self._error
            progress(step, share)

        return tell

    def result(self) -> Input:
        """Wait for the map and return it."""
        self._listener.join()
        if self._error is not None:
            raise self._error
        if self._result is None:
            self._process.join()
            raise InputError(
                f"{self._path} was not read to its end: the process that read it was ended "
                f"(code {self._process.exitcode}); is there enough memory?"
            )
        return self._result

    def _listen(self) -> None:
        """Pass on what the process says, until it is done."""
        while True:
            try:
                what, value = self._ours.recv()
            except (EOFError, OSError):
                return
            if what == "progress":
                self._progress(*value)
            elif what == "note":
                log.log(*value)
            elif what == "error":
                self._error = value
            elif what == "fault":
                self._error = RuntimeError(f"in the process that read {self._path}:\n{value}")
            else:
                self._result = value
                self._progress(f"{self._path.name} is ready", 1.0)


class _Sender(logging.Handler):
    def __init__(self, pipe: Connection):
        super().__init__()
        self._pipe = pipe

    def emit(self, record: logging.LogRecord) -> None:
        """Send a note, as text."""
        self._pipe.send(("note", (record.levelno, "%s", record.getMessage())))


def _work(pipe: Connection, path: Path, options: LogOptions) -> None:
    """Take a log and send what it became: the whole life of the process."""
    # an interrupt of the terminal reaches this process too: the one that started it ends it
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    log.addHandler(_Sender(pipe))
    log.setLevel(logging.INFO)

    def progress(step: str, share: float = 0.0) -> None:
        pipe.send(("progress", (step, share)))

    answer: tuple[str, Any]
    try:
        answer = "done", take(path, options, progress)
    except CommonmapError as error:
        answer = "error", error
    except Exception:
        answer = "fault", traceback.format_exc()
    pipe.send(answer)
