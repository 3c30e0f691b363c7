"""The exhaustive part of the search, tile by tile: in bounded memory, here or on a Dask cluster.

Every translation of the source belongs to one tile. A tile reads the part of the target that its
translations and one more on each side can reach, so that a peak at its rim is told from a slope.
The counts below a score are whole numbers, whatever the size of the transforms, so the best peaks
of the tiles together are to the bit those of the whole in one piece.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice, pairwise
from typing import Any

import numba
import numpy as np

from commonmap.config import ComputeConfig
from commonmap.errors import InputError, MissingExtraError
from commonmap.matching.arrays import find_arrays
from commonmap.matching.evidence_fft import (
    Spectra,
    bytes_held,
    peaks_on_each,
    transform_target,
)
from commonmap.matching.lane_fft import find_length
from commonmap.matching.levels import Level
from commonmap.matching.slabs import (
    Bits,
    Columns,
    Range,
    SlabGrid,
    scatter_turns,
    turned_cell,
)
from commonmap.matching.threads import in_order
from commonmap.types import Float64s, Progress

N_PEAKS = 6
"""Peaks kept of each yaw, over the whole target."""

CONNECT_SECONDS = 10
"""How long a Dask scheduler may take to answer."""


@dataclass(frozen=True)
class Tile:
    """Translations [u, v] of the whole surface; rows and columns from the first to behind the last.

    Element [u, v] lays source cell [i, j] on cell [i + u - (side - 1), j + v - (side - 1)].
    """

    rows: Range
    columns: Range


@dataclass(frozen=True)
class TilePlan:
    """tiles: in row order, each translation in one. n_bytes: what the search of them holds."""

    tiles: tuple[Tile, ...]
    n_bytes: float


@dataclass(frozen=True, eq=False)
class Sweep:
    """The source and the yaws at which it is laid on every translation.

    columns: about the point that is turned round. low: (2,) lower corner, from that point, of the
    square of `side` cells that holds the source at any yaw. min_pairs: known pairs that a pose
    needs. arrays: name of the array module.
    """

    columns: Columns
    cell: float
    low: Float64s
    side: int
    yaws: Float64s
    min_pairs: float
    arrays: str


def plan_tiles(
    shape: tuple[int, int],
    side: int,
    n_slabs: int,
    *,
    shared: bool,
    compute: ComputeConfig,
    workers: int,
    rim: tuple[int, int] = (0, 0),
    n_targets: int = 1,
) -> TilePlan:
    """Return the cheapest tiles that keep the search within `compute.memory_gb`.

    shape: of the target. side: of the source's square. shared: both know all slabs alike. rim:
    translations at each end along x and y that are left out. n_targets: searched at a time. Raises
    InputError where no tile does.
    """
    full = (shape[0] + side - 1, shape[1] + side - 1)
    rim = (min(rim[0], (full[0] - 1) // 2), min(rim[1], (full[1] - 1) // 2))
    whole = (full[0] - 2 * rim[0], full[1] - 2 * rim[1])
    best: tuple[float, float, int] | None = None
    least = np.inf
    for n_tiles in range(1, max(whole) // 16 + 2):
        extent = -(-max(whole) // n_tiles)
        size = [find_length(min(n, extent + side + 1)) for n in whole]
        held = bytes_held(
            (size[0], size[1]), side, n_slabs, shared=shared, workers=workers, n_targets=n_targets
        )
        number = np.prod([-(-n // extent) for n in whole])
        work = number * size[0] * size[1] * np.log2(size[0] * size[1])
        least = min(least, held)
        if held <= 1e9 * compute.memory_gb and (best is None or work < best[0]):
            best = float(work), held, extent
    if best is None:
        raise InputError(
            f"the search needs compute.memory_gb of at least {1e-9 * least + 0.005:.2f} for a "
            f"source of {side} x {side} cells and {n_slabs} slabs; {compute.memory_gb:g} came"
        )
    _, held, extent = best
    tiles = tuple(
        Tile((u, min(u + extent, full[0] - rim[0])), (v, min(v + extent, full[1] - rim[1])))
        for u in range(rim[0], full[0] - rim[0], extent)
        for v in range(rim[1], full[1] - rim[1], extent)
    )
    return TilePlan(tiles, held)


@dataclass(frozen=True, eq=False)
class Task:
    """One tile at some yaws, with all that its search needs.

    windows: the part of each target. tile, seen: the translations to tell, and with them their
    neighbours, counted from the window's first cell. first: yaw, u, v of the task's own first ones.
    """

    windows: tuple[SlabGrid, ...]
    tile: Tile
    seen: Tile
    sweep: Sweep
    first: tuple[int, int, int]


def search_tiles(
    levels: tuple[Level, ...],
    sweep: Sweep,
    tiles: tuple[Tile, ...],
    *,
    compute: ComputeConfig,
    workers: int,
    progress: Progress,
) -> list[list[Float64s]]:
    """Return, of every level and yaw, the best translations (n, 3): u, v, score, best first.

    levels: of one size, that the source is laid on side by side.
    """
    found = []
    if compute.scheduler is None:
        for n, tile in enumerate(tiles):
            task = _cut(levels, sweep, tile, (0, len(sweep.yaws)))
            tell = partial(_tell, progress, n, len(tiles))
            found.append(search_tile(task, workers=workers, tell=tell))
    else:
        shares = _share_yaws(len(sweep.yaws), len(tiles))
        tasks = (_cut(levels, sweep, tile, yaws) for tile in tiles for yaws in shares)
        for n, peaks in enumerate(_on_cluster(compute.scheduler, tasks)):
            found.append(peaks)
            progress("search", (n + 1) / (len(tiles) * len(shares)))
    together = (np.concatenate(of_level) for of_level in zip(*found, strict=True))
    return [_best_of_each_yaw(peaks, len(sweep.yaws)) for peaks in together]


def _tell(progress: Progress, n: int, n_tiles: int, share: float) -> None:
    progress("search", (n + share) / n_tiles)


def _share_yaws(n_yaws: int, n_tiles: int) -> list[Range]:
    """Return ranges of yaws; few tiles are cut further, so that a cluster has 64 tasks or more."""
    n_shares = min(n_yaws, -(-64 // n_tiles))
    ends = [n_yaws * k // n_shares for k in range(n_shares + 1)]
    return list(pairwise(ends))


def _cut(levels: tuple[Level, ...], sweep: Sweep, tile: Tile, yaws: Range) -> Task:
    """Return the task of a tile: the part of the targets that its translations can reach."""
    seen, reached = [], []
    for (low, high), n in zip((tile.rows, tile.columns), levels[0].shape, strict=True):
        seen.append((max(low - 1, 0), min(high + 1, n + sweep.side - 1)))
        reached.append((min(max(seen[-1][0] - sweep.side + 1, 0), n - 1), min(seen[-1][1], n)))
    u, v = reached[0][0], reached[1][0]
    return Task(
        tuple(level.window(reached[0], reached[1]) for level in levels),
        Tile(_moved(tile.rows, u), _moved(tile.columns, v)),
        Tile(_moved(seen[0], u), _moved(seen[1], v)),
        replace(sweep, yaws=sweep.yaws[slice(*yaws)]),
        (yaws[0], u, v),
    )


def _moved(range_: Range, by: int) -> Range:
    return range_[0] - by, range_[1] - by


def search_tile(
    task: Task, *, workers: int = 1, tell: Callable[[float], None] = lambda share: None
) -> list[Float64s]:
    """Return the best separate translations of a tile, (n, 4) of each target: yaw, u, v, score.

    Yaws by number, at most `N_PEAKS` translations of each.
    """
    sweep = task.sweep
    found = [[np.zeros((0, 4))] for _ in task.windows]
    standing = [n for n, window in enumerate(task.windows) if window.occupied.any()]
    if standing:
        spectra = [
            transform_target(
                task.windows[n], (sweep.side, sweep.side), rows=task.seen.rows,
                columns=task.seen.columns, n_source=min(sweep.side**2, len(sweep.columns.xy)),
                arrays=find_arrays(sweep.arrays),
            )
            for n in standing
        ]  # fmt: skip
        some = partial(_search_yaws, task=task, spectra=spectra)
        at_once = spectra[0].at_once
        starts = range(0, len(sweep.yaws), at_once)
        for start, on_each in zip(starts, in_order(some, starts, workers), strict=True):
            for n, peaks in zip(standing, on_each, strict=True):
                yaws = np.arange(start, start + len(peaks))
                number = np.repeat(yaws, [len(one) for one in peaks])
                rows = np.column_stack([number, np.concatenate(peaks)])
                found[n].append(rows + np.array([*task.first, 0]))
            tell(min(start + at_once, len(sweep.yaws)) / len(sweep.yaws))
    return [np.concatenate(peaks) for peaks in found]


def circle(n: int) -> Float64s:
    """Return n yaws that share out the full circle, radians."""
    return np.asarray(2.0 * np.pi * np.arange(n) / n)


def turn_columns(sweep: Sweep, yaws: Float64s) -> tuple[Bits, Bits]:
    """Return (occupied, known) bits of the source turned by each yaw, (side, side, n_yaws)."""
    columns = sweep.columns
    occupied, known = scatter_turns(
        columns.xy, columns.occupied, columns.known, np.cos(yaws), np.sin(yaws), sweep.cell,
        sweep.low, sweep.side, sweep.side,
    )  # fmt: skip
    return occupied, known


def find_turned_rim(sweep: Sweep) -> tuple[int, int]:
    """Return how many rows and columns at each end hold too few known cells for a pose, at any yaw.

    What `arrays.find_rim` says of the sources that `turn_columns` returns. Where the yaws share out
    the circle in fours, a quarter of them tells of all: the others' rows are its columns, and its
    rows from the other end. Only at right angles a cell's border may belong to either side.
    """
    n, yaws = len(sweep.yaws), sweep.yaws
    if n % 4 == 0 and np.array_equal(yaws, circle(n)):
        yaws = yaws[[*range(n // 4 + 1), n // 2, 3 * n // 4]]
    rows, columns = _find_turned_rim(
        sweep.columns.xy, np.cos(yaws), np.sin(yaws), sweep.cell, sweep.low, sweep.side,
        max(1, math.ceil(sweep.min_pairs)),
    )  # fmt: skip
    least = min(rows, columns)
    return (least, least) if len(yaws) < n else (rows, columns)


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _find_turned_rim(xy, cosines, sines, cell, low, side, least):  # type: ignore[no-untyped-def]
    last = np.full((side, side), -1, np.int32)  # the yaw at which a cell was met last
    count = np.empty((2, side), np.int64)
    rim = np.full(2, side, np.int64)
    for w in range(cosines.shape[0]):
        count[:] = 0
        for n in range(xy.shape[0]):
            i, j = turned_cell(xy[n, 0], xy[n, 1], cosines[w], sines[w], cell, low)
            if 0 <= i < side and 0 <= j < side and last[i, j] != w:
                last[i, j] = w
                count[0, i] += 1
                count[1, j] += 1
        for axis in range(2):
            for step in (1, -1):
                outermost, cells = 0, 0
                while outermost < side:
                    cells += count[axis, outermost if step > 0 else side - 1 - outermost]
                    if cells >= least:
                        break
                    outermost += 1
                rim[axis] = min(rim[axis], outermost)
    return rim[0], rim[1]


def _search_yaws(start: int, *, task: Task, spectra: list[Spectra]) -> list[list[Float64s]]:
    """Return the best separate translations on each target, (n, 3): u, v, score, of some yaws."""
    sweep, own, seen = task.sweep, task.tile, task.seen
    occupied, known = turn_columns(sweep, sweep.yaws[start : start + spectra[0].at_once])
    rim = (
        own.rows[0] - seen.rows[0], seen.rows[1] - own.rows[1],
        own.columns[0] - seen.columns[0], seen.columns[1] - own.columns[1],
    )  # fmt: skip
    first = np.array([seen.rows[0], seen.columns[0], 0])
    found = peaks_on_each(spectra, occupied, known, rim, N_PEAKS, min_overlap=sweep.min_pairs)
    return [[peaks + first for peaks in on_one] for on_one in found]


def _best_of_each_yaw(peaks: Float64s, n_yaws: int) -> list[Float64s]:
    """Return the peaks (n, 4) of all tiles, by yaw, as one piece would have kept them.

    Of equal scores the one of the smaller u, then v, comes first.
    """
    order = np.lexsort((peaks[:, 2], peaks[:, 1], -peaks[:, 3], peaks[:, 0]))
    peaks = peaks[order]
    ends = np.searchsorted(peaks[:, 0], np.arange(n_yaws + 1))
    return [peaks[low : min(low + N_PEAKS, high), 1:] for low, high in pairwise(ends)]


def _on_cluster(address: str, tasks: Iterator[Task]) -> Iterator[list[Float64s]]:
    """Yield the answers of the tasks, as they come, from the workers of a Dask scheduler.

    Twice as many tasks as the workers have threads are under way at a time.
    """
    try:
        distributed: Any = importlib.import_module("distributed")
    except ImportError as problem:
        raise MissingExtraError(
            "a search on a Dask cluster needs distributed: pip install 'commonmap[dask]'"
        ) from problem
    try:
        client = distributed.Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
    except (OSError, ValueError) as problem:
        raise InputError(f"no Dask scheduler answers at {address}: {problem}") from problem
    with client:
        n_threads = sum(client.nthreads().values())
        if n_threads == 0:
            raise InputError(f"the Dask scheduler at {address} has no workers")
        first = [
            client.submit(search_tile, task, pure=False) for task in islice(tasks, 2 * n_threads)
        ]
        waiting = distributed.as_completed(first, loop=client.loop)
        for done in waiting:
            peaks = done.result()
            for task in islice(tasks, 1):
                waiting.add(client.submit(search_tile, task, pure=False))
            yield peaks
