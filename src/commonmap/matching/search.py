"""The search over x, y and yaw, full circle, without an initial guess.

At a coarse cell every pose is scored exactly by FFT, tile by tile (`tiles.py`); the best separate
peaks then descend through cells half as wide, each climbing to its local maximum (`climb.py`). On
the last cell those that are close to the best climb once more, from everywhere about them. The
mirrored source goes the same way in the same call: its best score is a draw of what chance alone
reaches (the decoy).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numba
import numpy as np

from commonmap.config import ComputeConfig
from commonmap.frames import from_xyz_yaw
from commonmap.matching.climb import HERE, climb_all, starts_around
from commonmap.matching.evidence import count_tables, sum_table, weigh, xlogx_table
from commonmap.matching.lanes import WIDTH
from commonmap.matching.levels import Level, find_level
from commonmap.matching.slabs import Columns, SlabGrid, coarsen, is_shared, list_columns
from commonmap.matching.tiles import (
    Sweep,
    circle,
    find_turned_rim,
    plan_tiles,
    search_tiles,
)
from commonmap.types import Float64s, Progress, no_progress

BUDGET = 1e8
"""Padded cells times yaws times layers, of the exhaustive part of a search."""

KEEP = 256
"""Poses of the exhaustive part that climb."""

GLANCE_BUDGET, GLANCE_KEEP = BUDGET / 32.0, KEEP // 8
"""The same of a glance: cells twice as wide or more, half as many yaws."""

CLOSE = 0.64
"""Peaks with at least this share of the best evidence climb from everywhere about them."""

MOST_CLOSE = 8
"""Peaks that do so at most."""


@dataclass(frozen=True, eq=False)
class Peaks:
    """Planar poses, best first.

    pose: (M, 3) x, y, yaw of the source's centre in the target's frame.
    score: (M,) nats, see `evidence.py`. overlap: (M,) share of the source's known cells that meet
    known cells of the target. centre: (2,) the point of the source's frame that x, y place.
    per_yaw: (n_yaw, 2) yaw and the best score at it, of the coarse search.
    cell: metres, of the grid on which the scores were taken.
    """

    pose: Float64s
    score: Float64s
    overlap: Float64s
    centre: Float64s
    per_yaw: Float64s
    cell: float

    def T_target_source(self, rank: int = 0) -> Float64s:
        """Return the planar motion of the peak of that rank, (4, 4), z = 0."""
        x, y, yaw = self.pose[rank]
        shift = from_xyz_yaw(-self.centre[0], -self.centre[1], 0.0, 0.0)
        return np.asarray(from_xyz_yaw(x, y, 0.0, yaw) @ shift)


@dataclass(frozen=True)
class SearchPlan:
    """What the search will do, derived from the two maps. cells: coarse to fine, metres."""

    cells: tuple[float, ...]
    n_yaw: int
    keep: tuple[int, ...]


def plan_search(
    target: SlabGrid, source: SlabGrid, *, budget: float = BUDGET, keep: int = KEEP
) -> SearchPlan:
    """Return the pyramid of cells and the number of yaws for two grids of half the finest cell.

    The coarsest cell is the finest one that keeps the exhaustive part within `budget` (padded
    cells times yaws times layers), and leaves at least 16 cells along the source. keep: poses that
    climb on it; on every finer one a quarter of these, but at least a tenth of `keep`.
    """
    radius = _radius(list_columns(source))
    cell = 2.0 * target.cell
    cells = [cell]
    while True:
        n_yaw = _yaws_side_by_side(radius, cells[0])
        side = [n * target.cell / cells[0] + 2.0 * radius / cells[0] for n in target.shape]
        cost = side[0] * side[1] * n_yaw * (4 * target.n_slabs)
        if cost <= budget or 2.0 * radius / (2.0 * cells[0]) < 16:
            break
        cells.insert(0, 2.0 * cells[0])
    return SearchPlan(tuple(cells), n_yaw, _climbing(keep, len(cells)))


def _climbing(keep: int, n_cells: int) -> tuple[int, ...]:
    """Return how many poses climb on each cell."""
    return tuple(max(3 * keep // 32, keep >> (2 * level)) for level in range(n_cells))


def _yaws_side_by_side(radius: float, cell: float) -> int:
    """Return how many yaws, rounded up to as many as go side by side."""
    return WIDTH * -(-count_yaws(radius, cell) // WIDTH)


def plan_part(plan: SearchPlan, part: SlabGrid, *, keep: int) -> SearchPlan:
    """Return the plan for a part of a source, on the cells of the plan for the whole."""
    n_yaw = _yaws_side_by_side(_radius(list_columns(part)), plan.cells[0])
    return SearchPlan(plan.cells, n_yaw, _climbing(keep, len(plan.cells)))


def plan_glance(target: SlabGrid, source: SlabGrid) -> SearchPlan:
    """Return the plan of a search that tells most maps which match, and no more."""
    return plan_search(target, source, budget=GLANCE_BUDGET, keep=GLANCE_KEEP)


def search(
    target: SlabGrid,
    source: SlabGrid,
    *,
    min_overlap: float,
    mirrored: bool = False,
    plan: SearchPlan | None = None,
    n_peaks: int = 16,
    workers: int = 2,
    compute: ComputeConfig | None = None,
    progress: Progress = no_progress,
) -> Peaks:
    """Return the best separate poses of `source` on `target`, both on half the finest cell.

    min_overlap: share of the source's known cells that must meet known cells of the target.
    mirrored: reflect the source (x -> -x about its centre) first; no true match exists then.
    The answer is the same for any number of workers, and wherever and in whatever memory the
    search runs. A large target may be mapped from a file: it is read in parts.
    """
    return _search_sides(
        target, source, (mirrored,), min_overlap, plan, n_peaks, workers, compute, progress
    )[0]


def search_both(
    target: SlabGrid,
    source: SlabGrid,
    *,
    min_overlap: float,
    plan: SearchPlan | None = None,
    n_peaks: int = 16,
    workers: int = 2,
    compute: ComputeConfig | None = None,
    progress: Progress = no_progress,
) -> tuple[Peaks, Peaks]:
    """Return what `search` does of the source as it is, and of the mirrored one.

    In less time than one after the other: both are turned and transformed once.
    """
    found, decoy = _search_sides(
        target, source, (False, True), min_overlap, plan, n_peaks, workers, compute, progress
    )
    return found, decoy


def _search_sides(
    target: SlabGrid, source: SlabGrid, sides: tuple[bool, ...], min_overlap: float,
    plan: SearchPlan | None, n_peaks: int, workers: int, compute: ComputeConfig | None,
    progress: Progress,
) -> list[Peaks]:  # fmt: skip
    """Return the peaks of each side, False of the source as it is, True of the mirrored one.

    That one on the target is the source on the mirrored target, and is searched so.
    """
    plan = plan or plan_search(target, source)
    compute = compute or ComputeConfig()
    centre = _centre(list_columns(source))
    rungs = [_find_rung(target, source, cell, centre, min_overlap, compute) for cell in plan.cells]

    ladders = [[rung.mirror() for rung in rungs] if mirrored else rungs for mirrored in sides]

    # Every pose at the coarsest cell; then each candidate climbs down the ladder
    foot = [ladder[0] for ladder in ladders]
    found = _search_all(foot, circle(plan.n_yaw), workers, compute, progress)
    peaks = [
        _descend(ladder, plan, *one, centre, n_peaks=n_peaks, workers=workers)
        for ladder, one in zip(ladders, found, strict=True)
    ]
    back = np.array([-1.0, 1.0, -1.0])
    return [
        replace(one, pose=one.pose * back) if mirrored else one
        for one, mirrored in zip(peaks, sides, strict=True)
    ]


@dataclass(frozen=True, eq=False)
class Rung:
    """Both maps on cells of one width. columns: of the source, about its centre.

    n_known: cells that the source knows, unturned. least_pairs: known pairs that a pose needs.
    """

    level: Level
    columns: Columns
    n_known: int
    least_pairs: float

    def mirror(self) -> Rung:
        """Return the rung of the mirrored target."""
        return replace(self, level=self.level.mirror())


def _find_rung(
    target: SlabGrid, source: SlabGrid, cell: float, centre: Float64s, min_overlap: float,
    compute: ComputeConfig,
) -> Rung:  # fmt: skip
    factor = round(cell / target.cell)
    # the source's columns on half of the cell: no holes when turned
    columns = centre_columns(list_columns(coarsen(source, max(1, factor // 2))), centre)
    n_known = _known_cells(columns, cell)
    return Rung(find_level(target, factor, compute), columns, n_known, min_overlap * n_known)


def _descend(
    rungs: list[Rung], plan: SearchPlan, pose: Float64s, score: Float64s, per_yaw: Float64s,
    centre: Float64s, *, n_peaks: int, workers: int,
) -> Peaks:  # fmt: skip
    """Return the best of the coarsest cell's peaks (M, 3), on the finest cell."""
    finest = plan.cells[-1]
    step = 2.0 * np.pi / plan.n_yaw
    order = separate(pose, score, 2.0 * plan.cells[0], 1.5 * step, plan.keep[0])
    pose = pose[order]

    # Each candidate climbs at this cell, then at half of it, and so on
    for n, (rung, cell) in enumerate(zip(rungs, plan.cells, strict=True)):
        yaw_step = step * cell / plan.cells[0] / 2.0
        climb = partial(
            climb_all, rung.level, rung.columns, yaw_step=yaw_step, least_pairs=rung.least_pairs,
            workers=workers,
        )  # fmt: skip
        pose, score, pairs = climb(pose, starts=starts_around(2, 1) if n > 0 else HERE)
        last = n == len(plan.cells) - 1
        keep = n_peaks if last else plan.keep[n + 1]
        apart = 2.0 * cell if not last else 4.0 * finest
        order = separate(pose, score, apart, (6.0 if last else 2.0) * yaw_step, keep)
        pose, score, pairs = pose[order], score[order], pairs[order]

    # The best and those close to it, each from the starts about it
    close = pose[score >= CLOSE * score.max(initial=0.0)][:MOST_CLOSE]
    again = climb(close, starts=starts_around(1, 1, apart=2), each=True)
    pose, score, pairs = (
        np.concatenate([new, old]) for new, old in zip(again, (pose, score, pairs), strict=True)
    )
    order = separate(pose, score, 4.0 * finest, 6.0 * yaw_step, n_peaks)
    overlap = np.minimum(pairs[order] / max(rungs[-1].n_known, 1), 1.0)
    return Peaks(pose[order], score[order], overlap, centre, per_yaw, finest)


@dataclass(frozen=True)
class Standing:
    """What speaks for one pose. score: of the search. evidence: nats, not weighed.

    n_pairs: known pairs of the best known slab.
    """

    score: float
    evidence: float
    n_pairs: int


def evidence_at(target: SlabGrid, columns: Columns, pose: Float64s) -> Standing:
    """Return what speaks for one pose x, y, yaw.

    columns: of the source, about the point that x, y place, on half the target's cell.
    """
    table = count_tables(
        target.occupied, target.known, target.origin, target.cell, columns.xy, columns.occupied,
        columns.known, columns.n_slabs, np.asarray(pose, np.float64)[None],
    )[0]  # fmt: skip
    xlogx = xlogx_table(int(table[:, 0].max(initial=0)) + 1)
    evidence, doubt = sum_table(table, xlogx)
    return Standing(float(weigh(evidence, doubt)), float(evidence), int(table[:, 0].max()))


def _centre(columns: Columns) -> Float64s:
    return np.asarray(0.5 * (columns.xy.min(axis=0) + columns.xy.max(axis=0)))


def _radius(columns: Columns) -> float:
    """Return the distance from the centre that 98 % of the source's columns do not exceed."""
    distance = np.hypot(*(columns.xy - _centre(columns)).T)
    return float(np.quantile(distance, 0.98))


def count_yaws(radius: float, cell: float) -> int:
    """Return how many yaws: the outermost columns move by one cell between two of them."""
    return max(16, int(np.ceil(2.0 * np.pi * radius / cell)))


def centre_columns(columns: Columns, centre: Float64s) -> Columns:
    """Return the columns about a point of the source."""
    xy = np.ascontiguousarray(columns.xy - centre)
    return Columns(xy, columns.occupied, columns.known, columns.n_slabs)


def _search_all(
    rungs: list[Rung], yaws: Float64s, workers: int, compute: ComputeConfig, progress: Progress
) -> list[tuple[Float64s, Float64s, Float64s]]:  # fmt: skip
    """Return, of each side, the separate peaks of every yaw: poses (M, 3), scores (M,), per_yaw.

    rungs: of each side, of one size. per_yaw: (n_yaw, 2) yaw and the best score at it.
    """
    rung = rungs[0]
    level, columns, cell = rung.level, rung.columns, rung.level.cell
    reach = float(np.hypot(*columns.xy.T).max())
    side = 2 * int(np.ceil(reach / cell)) + 2
    low = np.full(2, -0.5 * side * cell)
    sweep = Sweep(columns, cell, low, side, yaws, rung.least_pairs, compute.arrays)
    at_once = workers if compute.scheduler is None else 1
    # where the maps touch in so few rows that no pose there has pairs enough, nothing is scored
    rim = find_turned_rim(sweep)
    shared = level.whole is not None and is_shared(level.whole.known, columns.n_slabs)
    shared = shared and is_shared(columns.known, columns.n_slabs)
    plan = plan_tiles(
        level.shape, side, columns.n_slabs, shared=shared, compute=compute, workers=at_once,
        rim=rim, n_targets=len(rungs),
    )  # fmt: skip
    levels = tuple(rung.level for rung in rungs)
    found = search_tiles(
        levels, sweep, plan.tiles, compute=compute, workers=workers, progress=progress
    )
    return [_poses(one, of_side, sweep) for one, of_side in zip(levels, found, strict=True)]


def _poses(
    level: Level, found: list[Float64s], sweep: Sweep
) -> tuple[Float64s, Float64s, Float64s]:
    """Return the poses (M, 3) and scores (M,) of translations (n, 3) of every yaw, and per_yaw."""
    rows, yaws = np.concatenate(found), sweep.yaws
    # translation [u, v] lays the source's point (0, 0) here
    at = level.origin + (rows[:, :2] - (sweep.side - 1)) * sweep.cell - sweep.low
    pose = np.column_stack([at, np.repeat(yaws, [len(f) for f in found])])
    best = np.array([f[:, 2].max(initial=-np.inf) for f in found])
    return pose, rows[:, 2], np.column_stack([yaws, best])


def _known_cells(columns: Columns, cell: float) -> int:
    """Return how many cells of that width the source knows, unturned."""
    cells = np.floor(columns.xy / cell).astype(np.int64)
    return len(np.unique(cells[:, 0] * (1 << 32) + cells[:, 1]))


def separate(
    pose: Float64s, score: Float64s, distance: float, yaw: float, n: int
) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Return the indices of the best poses, best first, no two of them nearer than both limits."""
    order = np.argsort(-score, kind="stable")
    order = order[np.isfinite(score[order])]
    return np.asarray(_separate(np.ascontiguousarray(pose), order, distance, yaw, n))


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _separate(pose, order, distance, yaw, most):  # type: ignore[no-untyped-def]
    kept, n = np.empty(min(most, order.shape[0]), np.int64), 0
    for i in order:
        if n == kept.shape[0]:
            break
        alone = True
        for k in kept[:n]:
            turn = abs((pose[k, 2] - pose[i, 2] + np.pi) % (2.0 * np.pi) - np.pi)
            if turn < yaw and np.hypot(pose[k, 0] - pose[i, 0], pose[k, 1] - pose[i, 1]) < distance:
                alone = False
                break
        if alone:
            kept[n] = i
            n += 1
    return kept[:n].copy()
