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
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice, pairwise
from typing import Any

import numba
import numpy as np
from scipy import fft

from commonmap.config import ComputeConfig
from commonmap.errors import InputError, MissingExtraError
from commonmap.matching.arrays import find_arrays
from commonmap.matching.evidence import Spectra, evidence_surface, rounding, transform_target
from commonmap.matching.slabs import (
    Bits,
    Columns,
    Range,
    SlabGrid,
    coarse_origin,
    coarse_shape,
    coarse_window,
    coarsen,
    scatter,
)
from commonmap.types import Float64s, Progress

N_PEAKS = 6
"""Peaks kept of each yaw, over the whole target."""

CONNECT_SECONDS = 10
"""How long a Dask scheduler may take to answer."""


@dataclass(frozen=True, eq=False)
class Level:
    """The target on cells `factor` times as wide: whole where it is small, else by windows.

    origin: (2,) metres, lower corner of the level's cell [0, 0]. cell: metres.
    """

    target: SlabGrid
    factor: int
    origin: Float64s
    cell: float
    shape: tuple[int, int]
    whole: SlabGrid | None

    def window(self, rows: Range, columns: Range) -> SlabGrid:
        """Return these cells of the level, which must lie in it."""
        if self.whole is None:
            return coarse_window(self.target, self.factor, rows, columns)
        region = slice(*rows), slice(*columns)
        origin = self.origin + np.array([rows[0], columns[0]]) * self.cell
        occupied, known = (
            np.ascontiguousarray(bits[region]) for bits in (self.whole.occupied, self.whole.known)
        )
        return SlabGrid(origin, self.cell, occupied, known, self.target.n_slabs)

    def around(self, pose: Float64s, reach: float) -> tuple[SlabGrid, int, int]:
        """Return a window that holds all cells nearer than `reach` to poses (P, 3).

        Also the cell of the level on which the window's first cell lies.
        """
        if self.whole is not None:
            return self.whole, 0, 0
        low = np.floor((pose[:, :2].min(axis=0) - reach - self.origin) / self.cell) - 1
        high = np.floor((pose[:, :2].max(axis=0) + reach - self.origin) / self.cell) + 2
        (i0, j0), (i1, j1) = (np.clip(x, 0, self.shape).astype(int).tolist() for x in (low, high))
        return self.window((i0, i1), (j0, j1)), i0, j0


def find_level(target: SlabGrid, factor: int, compute: ComputeConfig) -> Level:
    """Return the level; it is kept whole if its bits take less than a quarter of the memory."""
    shape = coarse_shape(target, factor)
    small = 8.0 * shape[0] * shape[1] <= 0.25e9 * compute.memory_gb
    return Level(
        target, factor, coarse_origin(target, factor), target.cell * factor, shape,
        coarsen(target, factor) if small else None,
    )  # fmt: skip


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
    compute: ComputeConfig,
    workers: int,
    rim: tuple[int, int] = (0, 0),
) -> TilePlan:
    """Return the cheapest tiles that keep the search within `compute.memory_gb`.

    shape: of the target. side: of the source's square. rim: translations at each end along x and
    y that are left out. Raises InputError where no tile does.
    """
    full = (shape[0] + side - 1, shape[1] + side - 1)
    rim = (min(rim[0], (full[0] - 1) // 2), min(rim[1], (full[1] - 1) // 2))
    whole = (full[0] - 2 * rim[0], full[1] - 2 * rim[1])
    best: tuple[float, float, int] | None = None
    least = np.inf
    for n_tiles in range(1, max(whole) // 16 + 2):
        extent = -(-max(whole) // n_tiles)
        size = [fft.next_fast_len(min(n, extent + side + 1), real=True) for n in whole]
        held = _bytes_held((size[0], size[1]), side, n_slabs, workers)
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


def _bytes_held(size: tuple[int, int], side: int, n_slabs: int, workers: int) -> float:
    """Return what the transforms of one tile hold at most: the target's once, per worker its own.

    In words of a cell: two spectra a slab of the target; of each worker spectra of the source, a
    product, four counts, the score and what the transforms need between (measured: 60 bytes).
    """
    n = size[0] * size[1]
    single = rounding(size, n, side * side) < 0.5
    return n * (8.0 * n_slabs + 8.0 + 64.0 * workers) * (1.0 if single else 1.8)


@dataclass(frozen=True, eq=False)
class Task:
    """One tile at some yaws, with all that its search needs.

    window: the part of the target. tile, seen: the translations to tell, and with them their
    neighbours, counted from the window's first cell. first: yaw, u, v of the task's own first ones.
    """

    window: SlabGrid
    tile: Tile
    seen: Tile
    sweep: Sweep
    first: tuple[int, int, int]


def search_tiles(
    level: Level,
    sweep: Sweep,
    tiles: tuple[Tile, ...],
    *,
    compute: ComputeConfig,
    workers: int,
    progress: Progress,
) -> list[Float64s]:
    """Return, of every yaw, the best separate translations (n, 3): u, v, score, best first."""
    found = []
    if compute.scheduler is None:
        for n, tile in enumerate(tiles):
            task = _cut(level, sweep, tile, (0, len(sweep.yaws)))
            tell = partial(_tell, progress, n, len(tiles))
            found.append(search_tile(task, workers=workers, tell=tell))
    else:
        shares = _share_yaws(len(sweep.yaws), len(tiles))
        tasks = (_cut(level, sweep, tile, yaws) for tile in tiles for yaws in shares)
        for n, peaks in enumerate(_on_cluster(compute.scheduler, tasks)):
            found.append(peaks)
            progress("search", (n + 1) / (len(tiles) * len(shares)))
    return _best_of_each_yaw(np.concatenate(found), len(sweep.yaws))


def _tell(progress: Progress, n: int, n_tiles: int, share: float) -> None:
    progress("search", (n + share) / n_tiles)


def _share_yaws(n_yaws: int, n_tiles: int) -> list[Range]:
    """Return ranges of yaws; few tiles are cut further, so that a cluster has 64 tasks or more."""
    n_shares = min(n_yaws, -(-64 // n_tiles))
    ends = [n_yaws * k // n_shares for k in range(n_shares + 1)]
    return list(pairwise(ends))


def _cut(level: Level, sweep: Sweep, tile: Tile, yaws: Range) -> Task:
    """Return the task of a tile: the part of the target that its translations can reach."""
    seen, reached = [], []
    for (low, high), n in zip((tile.rows, tile.columns), level.shape, strict=True):
        seen.append((max(low - 1, 0), min(high + 1, n + sweep.side - 1)))
        reached.append((min(max(seen[-1][0] - sweep.side + 1, 0), n - 1), min(seen[-1][1], n)))
    u, v = reached[0][0], reached[1][0]
    return Task(
        level.window(*reached),
        Tile(_moved(tile.rows, u), _moved(tile.columns, v)),
        Tile(_moved(seen[0], u), _moved(seen[1], v)),
        replace(sweep, yaws=sweep.yaws[slice(*yaws)]),
        (yaws[0], u, v),
    )


def _moved(range_: Range, by: int) -> Range:
    return range_[0] - by, range_[1] - by


def search_tile(
    task: Task, *, workers: int = 1, tell: Callable[[float], None] = lambda share: None
) -> Float64s:
    """Return the best separate translations of a tile, (n, 4): number of the yaw, u, v, score.

    At most `N_PEAKS` a yaw. tell: is told the share of yaws that are done.
    """
    sweep, found = task.sweep, [np.zeros((0, 4))]
    if not task.window.occupied.any():
        return found[0]
    spectra = transform_target(
        task.window, (sweep.side, sweep.side), rows=task.seen.rows, columns=task.seen.columns,
        n_source=min(sweep.side**2, len(sweep.columns.xy)), arrays=find_arrays(sweep.arrays),
        workers=workers,
    )  # fmt: skip
    one = partial(_search_yaw, task=task, spectra=spectra)
    with ThreadPoolExecutor(max_workers=workers) as pool:
        for n, peaks in enumerate(pool.map(one, sweep.yaws)):
            number = np.full((len(peaks), 1), n)
            found.append(np.column_stack([number, peaks]) + np.array([*task.first, 0]))
            tell((n + 1) / len(sweep.yaws))
    return np.concatenate(found)


def turn_columns(sweep: Sweep, yaw: float) -> tuple[Bits, Bits]:
    """Return (occupied, known) bits of the source turned by `yaw`, (side, side)."""
    columns = sweep.columns
    occupied, known = scatter(
        columns.xy, columns.occupied, columns.known, math.cos(yaw), math.sin(yaw), sweep.cell,
        sweep.low, sweep.side, sweep.side,
    )  # fmt: skip
    return occupied, known


def _search_yaw(yaw: float, *, task: Task, spectra: Spectra) -> Float64s:
    """Return the best separate translations of a tile at one yaw, (n, 3): u, v, score."""
    sweep = task.sweep
    occupied, known = turn_columns(sweep, float(yaw))
    score, _ = evidence_surface(spectra, occupied, known, min_overlap=sweep.min_pairs, workers=1)
    own, seen = task.tile, task.seen
    rim = (
        own.rows[0] - seen.rows[0], seen.rows[1] - own.rows[1],
        own.columns[0] - seen.columns[0], seen.columns[1] - own.columns[1],
    )  # fmt: skip
    index = local_maxima(score, N_PEAKS, 0.0, *rim)
    index = index[index[:, 0] >= 0]
    values = score[index[:, 0], index[:, 1]].astype(np.float64)
    return np.column_stack([index + np.array([seen.rows[0], seen.columns[0]]), values])


def _best_of_each_yaw(peaks: Float64s, n_yaws: int) -> list[Float64s]:
    """Return the peaks (n, 4) of all tiles, by yaw, as one piece would have kept them.

    Of equal scores the one of the smaller u, then v, comes first.
    """
    order = np.lexsort((peaks[:, 2], peaks[:, 1], -peaks[:, 3], peaks[:, 0]))
    peaks = peaks[order]
    ends = np.searchsorted(peaks[:, 0], np.arange(n_yaws + 1))
    return [peaks[low : min(low + N_PEAKS, high), 1:] for low, high in pairwise(ends)]


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def local_maxima(score, n_peaks, above, low_u=0, high_u=0, low_v=0, high_v=0):  # type: ignore[no-untyped-def]
    """Return the indices (n_peaks, 2) of the highest 3x3 local maxima over `above`, else -1.

    So many rows and columns at the rims are only neighbours of the others, and no peaks.
    """
    index = np.full((n_peaks, 2), -1, np.int64)
    value = np.full(n_peaks, -np.inf)
    n_u, n_v = score.shape
    for u in range(low_u, n_u - high_u):
        for v in range(low_v, n_v - high_v):
            s = score[u, v]
            if not s > value[-1] or s <= above:
                continue
            peak = True
            for a in range(max(u - 1, 0), min(u + 2, n_u)):
                for b in range(max(v - 1, 0), min(v + 2, n_v)):
                    earlier = a < u or (a == u and b < v)
                    if score[a, b] > s or (earlier and score[a, b] == s):
                        peak = False
            if not peak:
                continue
            place = n_peaks - 1
            while place > 0 and s > value[place - 1]:
                value[place] = value[place - 1]
                index[place] = index[place - 1]
                place -= 1
            value[place] = s
            index[place, 0], index[place, 1] = u, v
    return index


def _on_cluster(address: str, tasks: Iterator[Task]) -> Iterator[Float64s]:
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
