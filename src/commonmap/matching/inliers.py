"""How many of the source's standing points have a standing point of the target beside them."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from commonmap.frames import apply
from commonmap.mapping.points import bounds, floor_int, sample_where
from commonmap.matching.neighbours import sort_by_column
from commonmap.types import Bools, Float64s

MOST_POINTS = 20_000
"""Standing points of the source that are looked at."""


def share_of_inliers(
    target: Float64s,
    target_standing: Bools,
    source: Float64s,
    source_standing: Bools,
    T_target_source: Float64s,
    *,
    reach: float,
) -> float:
    """Return how many standing source points over known columns lie near a standing target point.

    target, source: (N, 3), (M, 3) metres, own frames. standing: masks of what rises above the
    ground (the ground itself lies on the ground anywhere). reach: metres, how near is near, and
    how near the middle of a column of that width must be in which the target has any point. 0
    where nothing stands over known columns.
    """
    draft = apply(T_target_source, sample_where(source, source_standing, MOST_POINTS))
    if len(draft) == 0 or not target_standing.any():
        return 0.0
    low, high = (
        keep(draft_end, target_end)
        for keep, draft_end, target_end in zip(
            (np.maximum, np.minimum), bounds(draft), bounds(target), strict=True
        )
    )
    if (low > high)[:2].any():
        return 0.0
    n_x, n_y = (int(n) + 3 for n in np.floor((high - low)[:2] / reach))
    known, near = _count(target, target_standing, draft, low[:2] - reach, reach, n_x, n_y)
    return float(near / known) if known else 0.0


def _count(
    target: Float64s, standing: Bools, draft: Float64s, low: Float64s, reach: float, n_x: int,
    n_y: int,
) -> tuple[int, int]:  # fmt: skip
    """Return how many draft points lie over known columns, and how many of them near a point."""
    cell = _columns(np.ascontiguousarray(target), low, reach, n_x, n_y)
    seen = np.zeros(n_x * n_y + 1, np.bool_)
    seen[cell] = True  # the last one gathers what lies outside
    upright = np.flatnonzero(standing & (cell < n_x * n_y))
    order, starts = sort_by_column(cell[upright], n_x * n_y)
    known, near = _look(
        target[upright[order]], starts, seen, np.ascontiguousarray(draft), low, reach, n_x, n_y
    )
    return int(known), int(near)


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _columns(
    xyz: Float64s, low: Float64s, size: float, n_x: int, n_y: int
) -> NDArray[np.int32]:  # pragma: no cover
    """Return each point's cell of an (n_x, n_y) grid, n_x * n_y where it lies outside."""
    cell = np.empty(xyz.shape[0], np.int32)
    for n in range(xyz.shape[0]):
        i = floor_int((xyz[n, 0] - low[0]) / size)
        j = floor_int((xyz[n, 1] - low[1]) / size)
        inside = 0 <= i < n_x and 0 <= j < n_y
        cell[n] = i * n_y + j if inside else n_x * n_y
    return cell


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _look(
    upright: Float64s, starts: NDArray[np.int64], seen: Bools, draft: Float64s, low: Float64s,
    reach: float, n_x: int, n_y: int,
) -> tuple[int, int]:  # fmt: skip  # pragma: no cover
    known, near = 0, 0
    for n in range(draft.shape[0]):
        i = floor_int((draft[n, 0] - low[0]) / reach)
        j = floor_int((draft[n, 1] - low[1]) / reach)
        if i < 1 or j < 1 or i > n_x - 2 or j > n_y - 2:
            continue  # beyond all that the target has
        over, hit = False, False
        for a in range(i - 1, i + 2):
            for b in range(j - 1, j + 2):
                c = a * n_y + b
                if seen[c]:
                    x, y = low[0] + (a + 0.5) * reach, low[1] + (b + 0.5) * reach
                    off = (draft[n, 0] - x) ** 2 + (draft[n, 1] - y) ** 2
                    over = over or off <= reach * reach
                for m in range(starts[c], starts[c + 1]):
                    square = 0.0
                    for k in range(3):
                        square += (upright[m, k] - draft[n, k]) ** 2
                    hit = hit or square <= reach * reach
        known += over
        near += over and hit
    return known, near
