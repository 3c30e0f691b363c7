"""Every way to read the paper's formulas, scored literally at every pose.

The paper gives KL, Jeffreys and K (Eqs. 11 to 13) as sums over heights and does not say which
cells the sums run over, what a height of zero does, or what the heights are divided by. A *reading*
is one answer to the three questions:

    cells       all known in both | object in either | object in the draft | object in both
    floor       what a height of zero (a cell without an object) becomes, metres; None: dropped
    normalise   "overlap": divided by the sum over the counted cells, "map": by the sum over the
                whole map, "off": heights in metres as they are

Here the sums are taken cell by cell, without FFT: the slow twin of `matching.correlate`, which it
agrees with where both know the reading (all cells, floor, any normalisation).
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import numba
import numpy as np

from commonmap.matching.search import count_yaws
from commonmap.matching.search_metric import scatter_heights
from commonmap.types import Bools, Float64s, GridMap, Progress, no_progress

METRICS = ("kl", "jeffreys", "k")
"""The paper's metrics, in the order of its equations; the last axis of every array of scores."""

NORMALISE = ("overlap", "map", "off")

CELLS = ("all", "either", "draft", "both")
"""Which cells count: all known in both; with an object in either, in the draft, in both."""

LEAST = 0.2
"""Metres above ground from which a cell holds an object; the lowest slab under 1 m begins here."""

FLOORS = (0.05, 0.001)
"""What a height of zero may become, metres: the product's floor, and the "very small value" of Cha
(2007)."""

LEAST_OVERLAP, LEAST_OBJECTS = 0.5, 0.25
"""A pose counts where this share of the draft's known cells falls on known cells; and for "both",
where this share of the draft's objects falls on objects."""

_STEP, _REACH = 1.0 / 256.0, 40.0
_TABLE = -np.logaddexp(0.0, np.arange(-_REACH, _REACH + 2 * _STEP, _STEP)) + np.log(2.0)
"""ln(2 / (1 + e^s)) on a grid; read off linearly it errs by 5e-7 (its bend is at most 1/4)."""


@dataclass(frozen=True)
class Reading:
    """One way to read the formulas; see the head of this module."""

    cells: str
    floor: float | None
    normalise: str

    @property
    def name(self) -> str:
        """The three answers in a few words."""
        zeros = "zeros dropped" if self.floor is None else f"zeros at {self.floor:g} m"
        return f"{self.cells}, {zeros}, {self.normalise}"


VARIANTS: tuple[tuple[str, float | None], ...] = (
    *((cells, floor) for cells in CELLS[:3] for floor in FLOORS),
    ("both", None),
)
"""Cells and floor; with both heights above zero there is nothing to floor."""

READINGS = tuple(
    Reading(cells, floor, normalise) for cells, floor in VARIANTS for normalise in NORMALISE
)
"""All readings, in the order of the first axis of every array of scores."""

_CODES = np.array([CELLS.index(cells) for cells, _ in VARIANTS])
_FLOORS = np.array([FLOORS[0] if floor is None else floor for _, floor in VARIANTS])


@dataclass(frozen=True, eq=False)
class Lattice:
    """A height map on the cells of a study. height: (nx, ny) metres, 0 where no object stands.

    known: (nx, ny) bool. origin: (2,) metres. cell: metres.
    """

    height: Float64s
    known: Bools
    origin: Float64s
    cell: float


@dataclass(frozen=True, eq=False)
class Columns:
    """A draft (or an area of it) as columns half a cell apart, about its own middle.

    xy: (N, 2) metres about `centre` (2,) of the draft's frame. height: (N,) metres.
    """

    xy: Float64s
    height: Float64s
    centre: Float64s

    @property
    def radius(self) -> float:
        """Metres that 98 % of the columns do not exceed."""
        return float(np.quantile(np.hypot(*self.xy.T), 0.98))


@dataclass(frozen=True, eq=False)
class Best:
    """The best pose of each reading and metric.

    score: (R, 3). pose: (R, 3, 3) x, y, yaw: where the columns' centre comes to lie in the frame
    of the lattice, metres and radians; NaN where no pose counts.
    """

    score: Float64s
    pose: Float64s


def make_lattice(grid: GridMap, cell: float) -> Lattice:
    """Return a height map on half cells as a lattice of `cell`: the highest counts."""
    columns = list_columns(grid)
    xy = columns.xy + columns.centre
    low = np.floor(grid.origin / cell) * cell
    n_x, n_y = np.ceil((xy.max(axis=0) + 0.5 * grid.cell - low) / cell + 1e-6).astype(int)
    height, known = scatter_heights(xy, columns.height, 1.0, 0.0, cell, low, n_x, n_y)
    return Lattice(_objects(height), known, low, cell)


def list_columns(grid: GridMap) -> Columns:
    """Return the known cells of a height map as columns about the middle of their box."""
    i, j = np.nonzero(grid["known"])
    xy = grid.origin + (np.column_stack([i, j]) + 0.5) * grid.cell
    centre = 0.5 * (xy.min(axis=0) + xy.max(axis=0))
    return Columns(xy - centre, np.asarray(grid["height"][i, j], np.float64), centre)


def score_pose(target: Lattice, source: Columns, pose: Float64s) -> tuple[Float64s, int]:
    """Return the scores (R, 3) of a pose x, y, yaw of the columns' centre, and the known cells.

    NaN where the reading counts no cell. The pose is taken as it is, not on the lattice.
    """
    # the target's cells stay; the source's columns are turned, shifted and fall into them
    n_x, n_y = target.height.shape
    c, s = float(np.cos(pose[2])), float(np.sin(pose[2]))
    height, known = scatter_heights(
        source.xy, source.height, c, s, target.cell, target.origin - pose[:2], n_x, n_y
    )
    scores, n = _score_one(
        _objects(height), known, target.height, target.known, 0, 0, _CODES, _FLOORS,
        _totals(_objects(height), known), _totals(target.height, target.known), _TABLE,
    )  # fmt: skip
    return scores.reshape(len(READINGS), 3), int(n)


def search_readings(
    target: Lattice, source: Columns, *, workers: int = 2, progress: Progress = no_progress
) -> Best:
    """Return the best of all poses of the columns on the target, for each reading and metric.

    Every translation by whole cells and every yaw at which the outermost column moves by one cell.
    """
    cell = target.cell
    n_yaw = count_yaws(source.radius, cell)
    yaws = 2.0 * np.pi * np.arange(n_yaw) / n_yaw
    side = 2 * int(np.ceil(float(np.hypot(*source.xy.T).max()) / cell)) + 2
    one = partial(_best_of_yaw, target, source, side)
    score = np.full((len(READINGS), 3), np.inf)
    pose = np.full((len(READINGS), 3, 3), np.nan)
    with ThreadPoolExecutor(workers) as pool:
        for n, (found, where) in enumerate(pool.map(one, yaws)):
            better = found < score
            score[better], pose[better] = found[better], where[better]
            progress("every reading at every pose", (n + 1) / n_yaw)
    return Best(np.where(np.isfinite(score), score, np.nan), pose)


def _best_of_yaw(
    target: Lattice, source: Columns, side: int, yaw: float
) -> tuple[Float64s, Float64s]:
    """Return the best score of each reading and metric at one yaw (R, 3), and its pose."""
    cell, low = target.cell, np.full(2, -0.5 * side * target.cell)
    height, known = scatter_heights(
        source.xy, source.height, float(np.cos(yaw)), float(np.sin(yaw)), cell, low, side, side
    )
    height = _objects(height)
    n_known = int(np.count_nonzero(known))
    n_objects = int(np.count_nonzero(height[known] > 0.0))
    score, shift = _search_shifts(
        height, known, target.height, target.known, _CODES, _FLOORS,
        _totals(height, known), _totals(target.height, target.known), _TABLE,
        max(4, int(LEAST_OVERLAP * n_known)), max(2, int(np.ceil(LEAST_OBJECTS * n_objects))),
    )  # fmt: skip
    pose = np.empty((*score.shape, 3))
    pose[..., :2] = target.origin + shift * cell - low
    pose[..., 2] = yaw
    return score.reshape(-1, 3), pose.reshape(-1, 3, 3)


def _objects(height: Float64s) -> Float64s:
    """Return the heights with what is lower than an object at zero."""
    return np.where(height >= LEAST, height, 0.0)


def _totals(height: Float64s, known: Bools) -> Float64s:
    """Return (V,) the sums of a map's own heights under each variant, metres."""
    mine = height[known]
    mass, n_free = float(mine.sum()), int(np.count_nonzero(mine == 0.0))
    floored = np.isin(_CODES, (CELLS.index("all"), CELLS.index("either")))
    return np.asarray(mass + np.where(floored, n_free * _FLOORS, 0.0))


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _phi(table, s):  # type: ignore[no-untyped-def]
    """Return ln(2 / (1 + e^s)) from its table."""
    at = (min(max(s, -40.0), 40.0) + 40.0) * 256.0
    k = int(at)
    return table[k] + (at - k) * (table[k + 1] - table[k])


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _gather(  # type: ignore[no-untyped-def]
    hs, ks, ls, ht, kt, lt, u, v, both, alone_s, alone_t, sums
):
    """Fill the cells with objects at one shift and their sums; return (n11, n10, n01, n00).

    ls, lt: logarithms of the heights. both: (3, n) a, ln a, ln b. alone_s: (2, n) a, ln a, and
    alone_t: (2, n) b, ln b, of cells where the other side is known and empty.
    """
    n11 = n10 = n01 = n00 = 0
    sums[:] = 0.0
    for i in range(max(0, -u), min(hs.shape[0], ht.shape[0] - u)):
        for j in range(max(0, -v), min(hs.shape[1], ht.shape[1] - v)):
            if not (ks[i, j] and kt[i + u, j + v]):
                continue
            a, b = hs[i, j], ht[i + u, j + v]
            if a > 0.0 and b > 0.0:
                x, y = ls[i, j], lt[i + u, j + v]
                both[0, n11], both[1, n11], both[2, n11] = a, x, y
                n11 += 1
                sums[0] += a
                sums[1] += b
                sums[2] += a * (x - y)
                sums[3] += b * (y - x)
            elif a > 0.0:
                x = ls[i, j]
                alone_s[0, n10], alone_s[1, n10] = a, x
                n10 += 1
                sums[4] += a
                sums[5] += a * x
                sums[6] += x
            elif b > 0.0:
                y = lt[i + u, j + v]
                alone_t[0, n01], alone_t[1, n01] = b, y
                n01 += 1
                sums[7] += b
                sums[8] += b * y
                sums[9] += y
            else:
                n00 += 1
    return n11, n10, n01, n00


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _combine(  # type: ignore[no-untyped-def]
    n11, n10, n01, n00, both, alone_s, alone_t, sums, codes, floors, total_s, total_t, table, out
):
    """Fill out (V, 3, 3) with KL, Jeffreys and K of each variant and normalisation."""
    for m in range(len(codes)):
        code, e = codes[m], floors[m]
        has10, has01, has00 = code <= 2, code <= 1, code == 0
        le = np.log(e)
        # masses over the counted cells, sum a ln(a/b) and sum b ln(b/a)
        A, B, forth, back = sums[0], sums[1], sums[2], sums[3]
        if has10:
            A += sums[4]
            B += e * n10
            forth += sums[5] - sums[4] * le
            back += e * (n10 * le - sums[6])
        if has01:
            A += e * n01
            B += sums[7]
            forth += e * (n01 * le - sums[9])
            back += sums[8] - sums[7] * le
        if has00:
            A += e * n00
            B += e * n00
        for r in range(3):
            if A <= 0.0 or B <= 0.0:
                out[m, r, :] = np.nan
                continue
            by_a = A if r == 0 else (total_s[m] if r == 1 else 1.0)
            by_b = B if r == 0 else (total_t[m] if r == 1 else 1.0)
            g = np.log(by_a / by_b)
            kl = (forth - g * A) / by_a
            out[m, r, 0] = kl
            out[m, r, 1] = kl + (back + g * B) / by_b
            k = 0.0
            for n in range(n11):
                k += both[0, n] * _phi(table, both[2, n] - both[1, n] + g)
            if has10:
                for n in range(n10):
                    k += alone_s[0, n] * _phi(table, le - alone_s[1, n] + g)
            if has01:
                for n in range(n01):
                    k += e * _phi(table, alone_t[1, n] - le + g)
            if has00:
                k += n00 * e * _phi(table, g)
            out[m, r, 2] = k / by_a


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _score_one(  # type: ignore[no-untyped-def]
    hs, ks, ht, kt, u, v, codes, floors, total_s, total_t, table
):
    """Return (V, 3, 3) scores at one shift and the number of cells known in both."""
    most = hs.size
    both, alone_s = np.empty((3, most)), np.empty((2, most))
    alone_t, sums = np.empty((2, most)), np.empty(10)
    out = np.empty((len(codes), 3, 3))
    ls, lt = np.log(np.maximum(hs, 1e-300)), np.log(np.maximum(ht, 1e-300))
    n11, n10, n01, n00 = _gather(hs, ks, ls, ht, kt, lt, u, v, both, alone_s, alone_t, sums)
    _combine(
        n11, n10, n01, n00, both, alone_s, alone_t, sums, codes, floors, total_s, total_t, table,
        out,
    )  # fmt: skip
    return out, n11 + n10 + n01 + n00


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _search_shifts(  # type: ignore[no-untyped-def]
    hs, ks, ht, kt, codes, floors, total_s, total_t, table, need, need_both
):
    """Return the lowest scores (V, 3, 3) over all shifts of one yaw, and the shifts."""
    most = hs.size
    both, alone_s = np.empty((3, most)), np.empty((2, most))
    alone_t, sums = np.empty((2, most)), np.empty(10)
    out = np.empty((len(codes), 3, 3))
    best = np.full((len(codes), 3, 3), np.inf)
    shift = np.zeros((len(codes), 3, 3, 2))
    ls, lt = np.log(np.maximum(hs, 1e-300)), np.log(np.maximum(ht, 1e-300))
    for u in range(1 - hs.shape[0], ht.shape[0]):
        rows = min(hs.shape[0], ht.shape[0] - u) - max(0, -u)
        for v in range(1 - hs.shape[1], ht.shape[1]):
            columns = min(hs.shape[1], ht.shape[1] - v) - max(0, -v)
            if rows * columns < need:
                continue
            n11, n10, n01, n00 = _gather(hs, ks, ls, ht, kt, lt, u, v, both, alone_s, alone_t, sums)
            if n11 + n10 + n01 + n00 < need:
                continue
            _combine(
                n11,
                n10,
                n01,
                n00,
                both,
                alone_s,
                alone_t,
                sums,
                codes,
                floors,
                total_s,
                total_t,
                table,
                out,
            )
            for m in range(len(codes)):
                if codes[m] == 3 and n11 < need_both:
                    continue
                for r in range(3):
                    for k in range(3):
                        if out[m, r, k] < best[m, r, k]:
                            best[m, r, k] = out[m, r, k]
                            shift[m, r, k, 0], shift[m, r, k, 1] = u, v
    return best, shift
