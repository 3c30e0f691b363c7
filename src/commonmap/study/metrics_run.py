"""Running the metric study on Dask: a task a place, a file a task, written once.

The client alone writes, whole files by renaming; what is there is never written again. So a worker
that dies loses a task, which Dask gives to another, and a client that dies loses what is
under way, which the next start of the same command does again.
"""

from __future__ import annotations

import importlib
import json
import os
from collections.abc import Callable
from contextlib import ExitStack
from itertools import islice
from pathlib import Path
from typing import Any

from commonmap.errors import InputError, MissingExtraError, OutputError
from commonmap.study.metrics_design import PlacePlan, plan_study, run_place
from commonmap.study.metrics_scores import LABELS
from commonmap.study.metrics_times import measure_times
from commonmap.types import Progress, no_progress
from commonmap.version import __version__

CONNECT_SECONDS = 10
"""How long a Dask scheduler may take to answer."""

DEATHS = 20
"""Workers that may die over one task before it is held to be at fault."""

Task = Callable[[int, int], list[dict[str, Any]]]


def run_study(
    out: Path,
    *,
    seed: int,
    quick: bool = False,
    scheduler: str | None = None,
    workers: int | None = None,
    task: Task = run_place,
    progress: Progress = no_progress,
) -> list[Path]:
    """Run what is missing of a study in the folder `out`; return the files of records, in order.

    scheduler: address of a Dask scheduler; by default a cluster of processes on this machine,
    `workers` of them or one a core. task: (seed, index) -> the records of a place.
    """
    plans = plan_study(seed, quick=quick)
    folder = _open_folder(out, seed)
    files = [folder / f"place-{plan.index:04d}.json" for plan in plans]
    missing = [(p, f) for p, f in zip(plans, files, strict=True) if not f.exists()]
    progress("pairs", 1.0 - len(missing) / len(plans))
    if missing:
        _run_missing(missing, len(plans), seed, scheduler, workers, task, progress)
    if not (out / "times.json").exists():
        _write_once(out / "times.json", measure_times())
    return files


def _open_folder(out: Path, seed: int) -> Path:
    """Return the folder of records; refuse one that holds those of another study."""
    folder = out / "records"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as problem:
        raise OutputError(f"cannot make the folder {folder}: {problem.strerror}") from problem
    head = out / "study.json"
    own = {"study": "metrics", "seed": seed, "columns": list(LABELS)}
    if head.exists():
        there = json.loads(head.read_text(encoding="utf-8"))
        if {key: there.get(key) for key in own} != own:
            raise InputError(
                f"{out} holds records of another study (seed {there.get('seed')}); give the same "
                "seed or another folder"
            )
    else:
        _write_once(head, {**own, "version": __version__})
    return folder


def _write_once(path: Path, content: Any) -> None:
    """Write a file whole, by renaming, unless it is there."""
    part = path.with_name(f".{path.name}.{os.getpid()}")
    part.write_text(json.dumps(content, separators=(",", ":")) + "\n", encoding="utf-8")
    try:
        os.link(part, path)
    except FileExistsError:
        pass
    finally:
        part.unlink()


def _run_missing(
    missing: list[tuple[PlacePlan, Path]], n_all: int, seed: int, scheduler: str | None,
    workers: int | None, task: Task, progress: Progress,
) -> None:  # fmt: skip
    """Run the tasks; a file is written as soon as its task is done."""
    with ExitStack() as stack:
        distributed = _import_distributed()
        dask = importlib.import_module("dask")
        stack.enter_context(dask.config.set({"distributed.scheduler.allowed-failures": DEATHS}))
        client = stack.enter_context(_connect(distributed, scheduler, workers, stack))
        n_threads = max(1, sum(client.nthreads().values()))
        # another client may be at work on the same folder: look again before each task
        todo = (item for item in missing if not item[1].exists())
        places: dict[str, Path] = {}

        def submit(item: tuple[PlacePlan, Path]) -> Any:
            future = client.submit(task, seed, item[0].index, pure=False)
            places[future.key] = item[1]
            return future

        waiting = distributed.as_completed(
            [submit(item) for item in islice(todo, 2 * n_threads)], loop=client.loop
        )
        n_done = n_all - len(missing)
        for done in waiting:
            _write_once(places.pop(done.key), done.result())
            n_done += 1
            progress("pairs", n_done / n_all)
            for item in islice(todo, 1):
                waiting.add(submit(item))


def _import_distributed() -> Any:
    try:
        return importlib.import_module("distributed")
    except ImportError as problem:
        raise MissingExtraError(
            "the study runs on Dask: pip install 'commonmap[dask]'"
        ) from problem


def _connect(distributed: Any, scheduler: str | None, workers: int | None, stack: ExitStack) -> Any:
    """Return a client of the scheduler, or of a cluster of processes on this machine."""
    if scheduler is None:
        cluster = stack.enter_context(
            distributed.LocalCluster(
                n_workers=workers or os.cpu_count() or 1, threads_per_worker=1, processes=True,
                dashboard_address=None, memory_limit=0,
            )
        )  # fmt: skip
        return distributed.Client(cluster, set_as_default=False)
    try:
        return distributed.Client(scheduler, timeout=CONNECT_SECONDS, set_as_default=False)
    except (OSError, ValueError) as problem:
        raise InputError(f"no Dask scheduler answers at {scheduler}: {problem}") from problem
