"""The search of the full circle and all translations with every metric of the table at once.

As `matching.search_metric` does it for one metric: the source's columns, half a cell apart, are
turned and gathered into cells; one yaw moves the outermost of them by a cell.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from commonmap.matching.search import count_yaws, separate
from commonmap.matching.search_metric import scatter_heights
from commonmap.matching.slabs import (
    SlabGrid,
    coarse_origin,
    coarse_shape,
    coarsen,
    pack_slabs,
    scatter,
)
from commonmap.matching.tiles import circle
from commonmap.study.metrics_kernels import best_peaks, vertex
from commonmap.study.metrics_scores import COLUMNS, prepare, score_all
from commonmap.types import Float64s, GridMap

N_PEAKS = 6
"""Peaks kept of each yaw."""

APART = (4.0, 3.0)
"""Cells and yaw steps: poses nearer than both are the same optimum."""

STRICT = 0.5
"""Share of the source's known cells that a pose must lay on known cells by the stricter rule."""

SAMPLE = 23
"""Of the scores of all poses, one in so many tells how they spread."""


@dataclass(frozen=True, eq=False)
class Found:
    """What each metric of `COLUMNS` found, (M, ...) each.

    pose: x, y, yaw of the source's centre in the target's frame, of its best pose, to a part of a
    cell; NaN where it has no optimum. score: the metric there, turned so that more is better.
    sharpness: how far the best pose is above the best one elsewhere, in robust standard deviations
    of all scores (1.4826 times the median deviation from the median). margin: the same for the
    best pose near the truth against the best elsewhere; negative where something else is better.
    strict: the best pose of those with an overlap of `STRICT` or more, on a step of yaw.
    centre: (2,) the point of the source's frame that the poses place. cell, yaw_step: of the
    search, metres and radians. n_poses: how many were scored.
    """

    pose: Float64s
    score: Float64s
    sharpness: Float64s
    margin: Float64s
    strict: Float64s
    centre: Float64s
    cell: float
    yaw_step: float
    n_poses: int


def search_all(
    target: GridMap,
    source: GridMap,
    *,
    factor: int = 2,
    min_overlap: float = 0.3,
    floor: float = 0.05,
    T_target_source: Float64s | None = None,
    near: tuple[float, float] = (2.0, 1.5),
) -> Found:
    """Return the best pose of every metric, of height maps with slabs on 1 / `factor` of the cell.

    min_overlap: share of the source's known cells that a pose must lay on known cells.
    T_target_source: (4, 4), the truth, planar: what `margin` needs; NaN without it.
    near: cells and yaw steps; a pose nearer than both to the truth is right.
    """
    cell = factor * target.cell
    i, j = np.nonzero(source["known"])
    xy = source.origin + (np.column_stack([i, j]) + 0.5) * source.cell
    centre = 0.5 * (xy.min(axis=0) + xy.max(axis=0))
    xy = np.ascontiguousarray(xy - centre)
    height = source["height"][i, j]
    slabs_s = pack_slabs(source.origin, source.cell, source["slab_occupied"], source["slab_known"])
    occupied_s, known_s = slabs_s.occupied[i, j], slabs_s.known[i, j]
    reach = float(np.hypot(*xy.T).max())
    side = 2 * int(np.ceil(reach / cell)) + 2
    low = np.full(2, -0.5 * side * cell)
    _, unturned = scatter_heights(xy, height, 1.0, 0.0, cell, low, side, side)
    n_known = int(np.count_nonzero(unturned))
    n_yaw = count_yaws(float(np.quantile(np.hypot(*xy.T), 0.98)), cell)
    yaws = circle(n_yaw)

    # 1. the target on the cells of the search, and its half of all sums
    slabs_t = pack_slabs(target.origin, target.cell, target["slab_occupied"], target["slab_known"])
    origin, slabs_t, height_t, known_t = _coarse(target, slabs_t, factor)
    top = float(max(height.max(), height_t.max(), floor))
    prepared = prepare(
        height_t, known_t, slabs_t, (side, side), top=top, floor=floor,
        min_cells=max(4, int(np.ceil(min_overlap * n_known))),
    )  # fmt: skip

    # 2. every yaw: the peaks of each metric, a sample of its scores, the best near the truth
    truth = None if T_target_source is None else _planar(T_target_source, centre)
    peaks, strict, samples, n_poses = [], [], [], 0
    at_truth = np.full(len(COLUMNS), -np.inf)
    for yaw in yaws:
        cosine, sine = float(np.cos(yaw)), float(np.sin(yaw))
        turned, known = scatter_heights(xy, height, cosine, sine, cell, low, side, side)
        bits = scatter(xy, occupied_s, known_s, cosine, sine, cell, low, side, side)
        scores = score_all(prepared, turned, known, *bits)
        if not len(scores.u):
            continue
        gain = scores.gain
        rows = best_peaks(gain, scores.u, scores.v, prepared.surface_shape, N_PEAKS)
        at = origin + (rows[..., :2] - (side - 1)) * cell - low
        peaks.append(np.dstack([at, np.full(rows.shape[:2], yaw), rows[..., 2]]))
        enough = scores.n >= STRICT * n_known
        rows = best_peaks(
            np.ascontiguousarray(gain[:, enough]), scores.u[enough], scores.v[enough],
            prepared.surface_shape, 1,
        )  # fmt: skip
        at = origin + (rows[..., :2] - (side - 1)) * cell - low
        strict.append(np.dstack([at, np.full(rows.shape[:2], yaw), rows[..., 2]]))
        samples.append(gain[:, n_poses % SAMPLE :: SAMPLE])
        n_poses += len(scores.u)
        if truth is not None and _turn(yaw - truth[2]) <= near[1] * 2.0 * np.pi / n_yaw:
            here = origin + (np.column_stack([scores.u, scores.v]) - (side - 1)) * cell - low
            close = np.hypot(*(here - truth[:2]).T) <= near[0] * cell
            if close.any():
                best = np.where(np.isfinite(gain[:, close]), gain[:, close], -np.inf).max(axis=1)
                at_truth = np.maximum(at_truth, best)

    # 3. the best of all yaws, and how far it stands out
    M = len(COLUMNS)
    pose, best, second = np.full((M, 3), np.nan), np.full(M, np.nan), np.full((M, 3), np.nan)
    sharpness, margin = np.full(M, np.nan), np.full(M, np.nan)
    if not peaks:
        return Found(pose, best, sharpness, margin, second, centre, cell, 2.0 * np.pi / n_yaw, 0)
    every, firm = np.concatenate(peaks, axis=1), np.concatenate(strict, axis=1)
    spread = _robust_spread(np.concatenate(samples, axis=1))
    apart = APART[0] * cell, APART[1] * 2.0 * np.pi / n_yaw
    for m in range(M):
        rows = firm[m][np.isfinite(firm[m][:, 3])]
        if len(rows):
            second[m] = rows[np.argmax(rows[:, 3]), :3]
        rows = every[m][np.isfinite(every[m][:, 3])]
        if not len(rows):
            continue
        order = separate(rows[:, :3], rows[:, 3], *apart, 2)
        best[m] = rows[order[0], 3]
        pose[m] = _between_yaws(rows, int(order[0]), cell, 2.0 * np.pi / n_yaw)
        if len(order) > 1 and spread[m] > 0.0:
            sharpness[m] = (best[m] - rows[order[1], 3]) / spread[m]
        if truth is not None and spread[m] > 0.0:
            off = np.hypot(*(rows[:, :2] - truth[:2]).T) >= apart[0]
            elsewhere = rows[off | (_turn(rows[:, 2] - truth[2]) >= apart[1]), 3]
            if len(elsewhere):
                margin[m] = (at_truth[m] - elsewhere.max()) / spread[m]
    return Found(pose, best, sharpness, margin, second, centre, cell, 2.0 * np.pi / n_yaw, n_poses)


def _coarse(
    grid: GridMap, slabs: SlabGrid, factor: int
) -> tuple[Float64s, SlabGrid, Float64s, np.ndarray[tuple[int, int], np.dtype[np.bool_]]]:
    """Return the lower corner, slabs, heights and mask of the target on the search's cells."""
    origin, shape = coarse_origin(slabs, factor), coarse_shape(slabs, factor)
    i, j = np.nonzero(grid["known"])
    xy = grid.origin + (np.column_stack([i, j]) + 0.5) * grid.cell
    height, known = scatter_heights(
        xy, grid["height"][i, j], 1.0, 0.0, factor * grid.cell, origin, *shape
    )
    return origin, coarsen(slabs, factor), height, known


def _planar(T: Float64s, centre: Float64s) -> Float64s:
    """Return x, y, yaw of the source's centre, of a planar motion."""
    yaw = float(np.arctan2(T[1, 0], T[0, 0]))
    return np.array([*(T[:2, :2] @ centre + T[:2, 3]), yaw])


def errors(
    found: Found, T_target_source: Float64s, *, strict: bool = False
) -> tuple[Float64s, Float64s]:
    """Return how far each metric's pose is off, metres at the source's centre and radians.

    strict: of the best poses by the stricter rule of the smallest overlap.
    """
    pose, truth = found.strict if strict else found.pose, _planar(T_target_source, found.centre)
    return np.hypot(*(pose[:, :2] - truth[:2]).T), _turn(pose[:, 2] - truth[2])


def _turn(angle: Float64s | float) -> Float64s:
    """Return the size of an angle, 0 to pi."""
    return np.asarray(np.abs((np.asarray(angle) + np.pi) % (2.0 * np.pi) - np.pi))


def _robust_spread(sample: Float64s) -> Float64s:
    """Return 1.4826 times the median deviation from the median of each row, (M,)."""
    with np.errstate(invalid="ignore"):
        finite = np.where(np.isfinite(sample), sample, np.nan)
        full = np.isfinite(finite).any(axis=1)
        out = np.full(len(sample), np.nan)
        middle = np.nanmedian(finite[full], axis=1, keepdims=True)
        out[full] = 1.4826 * np.nanmedian(np.abs(finite[full] - middle), axis=1)
    return out


def _between_yaws(rows: Float64s, best: int, cell: float, yaw_step: float) -> Float64s:
    """Return the best pose with its yaw at the top of a parabola through its two neighbours."""
    x, y, yaw, gain = rows[best]
    close = np.hypot(rows[:, 0] - x, rows[:, 1] - y) <= 2.0 * cell
    turn = (rows[:, 2] - yaw + np.pi) % (2.0 * np.pi) - np.pi
    sides = [
        rows[close & (np.abs(turn - s * yaw_step) < 0.1 * yaw_step), 3].max(initial=-np.inf)
        for s in (-1, 1)
    ]
    return np.array([x, y, yaw + yaw_step * vertex(sides[0], gain, sides[1])])
