"""The second opinion: each half of the overlap, searched for by itself.

The best pose is the best of millions, so what speaks for it is partly chance: the few lines that
happened to fit. Cut in two, a lucky overlap falls apart, as each half by itself lies better
elsewhere. The halves of a right one point back to the same pose, each better than to any other.
"""

from __future__ import annotations

import numpy as np

from commonmap.matching.figures import other_poses
from commonmap.matching.search import (
    KEEP,
    Peaks,
    SearchPlan,
    centre_columns,
    evidence_at,
    plan_part,
    plan_search,
    search,
)
from commonmap.matching.slabs import Columns, SlabGrid, coarsen, list_columns
from commonmap.types import Bools, Float64s

LEAST_COLUMNS = 40
"""Standing columns over known cells that two halves need."""

HALF_OVERLAP = 0.5
"""Share of a half's known cells that a pose must place on known cells: at the pose it is all."""


def measure_halves(
    target: SlabGrid, source: SlabGrid, found: Peaks, cell: float, *, workers: int
) -> tuple[float, float] | None:
    """Return, per half of the overlap, its evidence at the best pose over that at any other.

    target, source: on half of `cell`, metres. None where too little stands in the overlap.
    """
    grid = coarsen(target, 2)
    columns = list_columns(source)
    over = _over_known(grid, centre_columns(columns, found.centre), found.pose[0])
    standing = over & (columns.occupied > 0)
    if np.count_nonzero(standing) < LEAST_COLUMNS:
        return None
    along = _along(columns.xy, columns.xy[standing])
    upper = along > np.median(along[standing])
    plan = plan_search(target, source)
    first, second = (
        _ratio(target, grid, _part_of(source, over & side), found, plan, cell, workers)
        for side in (~upper, upper)
    )
    return first, second


def _over_known(grid: SlabGrid, columns: Columns, pose: Float64s) -> Bools:
    """Return (N,) bool, the columns that lie on a known cell of the target at a pose."""
    x, y, yaw = pose
    c, s = np.cos(yaw), np.sin(yaw)
    placed = columns.xy @ np.array([[c, s], [-s, c]]) + (x, y)
    ij = np.floor((placed - grid.origin) / grid.cell).astype(np.int64)
    inside = ((ij >= 0) & (ij < grid.shape)).all(axis=1)
    over = np.zeros(len(ij), dtype=bool)
    over[inside] = grid.known[ij[inside, 0], ij[inside, 1]] > 0
    return over


def _along(xy: Float64s, standing: Float64s) -> Float64s:
    """Return how far the columns lie along the longer axis of what stands, (N,) metres."""
    middle = standing.mean(axis=0)
    axes = np.linalg.eigh(np.cov((standing - middle).T))[1]
    return np.asarray((xy - middle) @ axes[:, 1])


def _part_of(source: SlabGrid, kept: Bools) -> SlabGrid:
    """Return the grid with only the kept of its known cells, in the order of `list_columns`."""
    ij = np.nonzero(source.known)
    mask = np.zeros(source.shape, dtype=bool)
    mask[ij] = kept
    nothing = source.known.dtype.type(0)
    return SlabGrid(
        source.origin,
        source.cell,
        np.where(mask, source.occupied, nothing),
        np.where(mask, source.known, nothing),
        source.n_slabs,
    )


def _ratio(
    target: SlabGrid, grid: SlabGrid, half: SlabGrid, found: Peaks, plan: SearchPlan, cell: float,
    workers: int,
) -> float:  # fmt: skip
    """Return the half's best evidence near the pose of `found` over its best anywhere else."""
    # on finer cells it would cost as much as the whole; on coarser ones it may miss its best pose
    plan = plan_part(plan, half, keep=KEEP // 4)
    peaks = search(target, half, min_overlap=HALF_OVERLAP, plan=plan, workers=workers)
    middle = found.T_target_source() @ np.array([*peaks.centre, 0.0, 1.0])
    pose = np.array([*middle[:2], found.pose[0, 2]])
    here = evidence_at(grid, centre_columns(list_columns(half), peaks.centre), pose).score
    away = other_poses(peaks, pose, cell)
    near = float(peaks.score[~away].max(initial=here))
    return near / max(float(peaks.score[away].max(initial=0.0)), 1e-9)
