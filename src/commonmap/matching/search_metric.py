"""The search with any metric of the table: every translation exactly, yaw by yaw.

The counterpart of `search` for metrics on height maps. The source's heights are turned as columns
half a cell apart, so that no holes appear; the highest that falls into a cell is its height.
"""

from __future__ import annotations

from functools import partial

import numba
import numpy as np

from commonmap.matching import correlate
from commonmap.matching.arrays import find_rim
from commonmap.matching.peaks import local_maxima
from commonmap.matching.search import Peaks, count_yaws, separate
from commonmap.matching.slabs import turned_cell
from commonmap.matching.threads import in_order
from commonmap.matching.tiles import N_PEAKS, circle
from commonmap.metrics.plans import DifferenceSum, JointHistogram, MinSum, Smooth
from commonmap.metrics.table import find_metric
from commonmap.types import Float64s, GridMap, Progress, no_progress

_WEIGHT = {Smooth: 2.0, JointHistogram: 6.0, MinSum: 16.0, DifferenceSum: 16.0}
"""Time of one pose by kind of plan, in units of the plain sums."""


def search_metric(
    target: GridMap,
    source: GridMap,
    *,
    metric: str,
    normalise: str,
    floor: float,
    min_overlap: float,
    mirrored: bool = False,
    n_peaks: int = 16,
    arrays: str = "numpy",
    workers: int = 2,
    budget: float = 4e7,
    progress: Progress = no_progress,
) -> Peaks:
    """Return the best separate poses of `source` on `target` (height maps on half the finest cell).

    The scores in the answer are turned so that more is better. Cells are as fine as `budget`
    (padded cells times yaws, of a plain sum) allows. Other arguments as in `search` and
    `correlate`.
    """
    xy, height = _columns(source)
    centre = 0.5 * (xy.min(axis=0) + xy.max(axis=0))
    xy = (xy - centre) * np.array([-1.0 if mirrored else 1.0, 1.0])
    reach = float(np.hypot(*xy.T).max())
    radius = float(np.quantile(np.hypot(*xy.T), 0.98))
    row = find_metric(metric)
    budget /= _WEIGHT.get(type(row.fft), 1.0)
    factor = 2
    while True:
        cell = factor * target.cell
        n_yaw = count_yaws(radius, cell)
        sides = [n * target.cell / cell + 2.0 * reach / cell for n in target.shape]
        if sides[0] * sides[1] * n_yaw <= budget or 2.0 * radius / (2.0 * cell) < 16:
            break
        factor *= 2

    # The target on these cells, its spectra once
    t_xy, t_height = _columns(target)
    low_t = np.floor(target.origin / cell) * cell
    size_t = np.ceil((t_xy.max(axis=0) + target.cell - low_t) / cell).astype(int)
    height_t, known_t = scatter_heights(t_xy, t_height, 1.0, 0.0, cell, low_t, *size_t)
    side = 2 * int(np.ceil(reach / cell)) + 2
    low = np.full(2, -0.5 * side * cell)
    _, known_0 = scatter_heights(xy, height, 1.0, 0.0, cell, low, side, side)
    n_known = int(np.count_nonzero(known_0))
    yaws = circle(n_yaw)
    min_cells = max(4, int(min_overlap * n_known))
    turned = (
        scatter_heights(xy, height, float(np.cos(t)), float(np.sin(t)), cell, low, side, side)[1]
        for t in yaws
    )
    prepared = correlate.prepare_target(
        row,
        height_t,
        known_t,
        (side, side),
        normalise=normalise if normalise in row.normalisations else row.normalisations[0],
        floor=floor,
        height_range=(0.0, float(max(height.max(), t_height.max(), floor))),
        min_cells=min_cells,
        rim=find_rim(turned, (side, side), min_cells),
        xp=arrays,
        workers=1,
    )
    one = partial(
        _search_yaw, prepared=prepared, xy=xy, height=height, cell=cell, low=low, side=side,
        origin=low_t,
    )  # fmt: skip
    found = []
    for n, peaks in enumerate(in_order(one, yaws, workers)):
        found.append(peaks)
        progress("search", (n + 1) / n_yaw)
    rows = np.concatenate(found)
    best = np.array([f[:, 3].max(initial=-np.inf) for f in found])
    order = separate(rows[:, :3], rows[:, 3], 4.0 * cell, 6.0 * np.pi / n_yaw, n_peaks)
    rows = rows[order]
    return Peaks(
        rows[:, :3],
        rows[:, 3],
        np.minimum(rows[:, 4] / max(n_known, 1), 1.0),
        centre,
        np.column_stack([yaws, best]),
        cell,
    )


def _columns(grid: GridMap) -> tuple[Float64s, Float64s]:
    """Return centres (N, 2) and heights (N,) of the known cells."""
    i, j = np.nonzero(grid["known"])
    return grid.origin + (np.column_stack([i, j]) + 0.5) * grid.cell, grid["height"][i, j]


def _search_yaw(
    yaw: float,
    *,
    prepared: correlate.PreparedTarget,
    xy: Float64s,
    height: Float64s,
    cell: float,
    low: Float64s,
    side: int,
    origin: Float64s,
) -> Float64s:
    """Return the best separate translations at one yaw, (n, 5) x, y, yaw, score, cells."""
    turned, known = scatter_heights(
        xy, height, float(np.cos(yaw)), float(np.sin(yaw)), cell, low, side, side
    )
    surface = correlate.score_surface(prepared, turned, known, workers=1)
    gain = -prepared.metric.cost(surface.score)
    score = np.where(np.isfinite(gain), gain, -np.inf).astype(np.float64)
    index, _ = local_maxima(score, N_PEAKS, -np.inf)
    index = index[index[:, 0] >= 0]
    where = origin + (index - (side - 1)) * cell - low
    values = score[index[:, 0], index[:, 1]]
    cells = surface.n_overlap[index[:, 0], index[:, 1]].astype(np.float64)
    return np.column_stack([where, np.full(len(where), yaw), values, cells])


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def scatter_heights(xy, height, cosine, sine, cell, low, n_x, n_y):  # type: ignore[no-untyped-def]
    """Return (height, known) of turned columns on a grid: the highest that falls into a cell."""
    out = np.zeros((n_x, n_y))
    known = np.zeros((n_x, n_y), np.bool_)
    for n in range(xy.shape[0]):
        i, j = turned_cell(xy[n, 0], xy[n, 1], cosine, sine, cell, low)
        if 0 <= i < n_x and 0 <= j < n_y:
            if not known[i, j] or height[n] > out[i, j]:
                out[i, j] = height[n]
            known[i, j] = True
    return out, known
