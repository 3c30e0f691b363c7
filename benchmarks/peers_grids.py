"""Height maps compared by brute force at every pose of a coarse grid, as its authors describe it.

Two families, both with a step of one cell in x and y and of `YAW_STEP` in heading, and only at
poses where at least half of the draft's cells meet cells of the base:

- Kaeslin et al. 2016, "Collaborative localization of aerial and ground robots through elevation
  maps": elevation maps (the highest point of a cell), zero-mean SAD, zero-mean SSD, NCC (with the
  means taken off, as the maps have no common height) and mutual information of 16 classes.
- Akay et al.: heights above ground under 1 m, K divergence normalised over the overlap.

The cell is a 48th of the draft's extent. Scores are added up cell by cell in compiled loops;
only the count of shared cells, which says which poses are looked at, comes from an FFT.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray
from scipy import fft

Floats = NDArray[np.float64]

YAW_STEP = math.radians(4.0)
MIN_OVERLAP = 0.5
N_CLASSES = 16
FLOOR = 0.05
"""The height in metres that stands for flat ground where a metric needs positive heights."""
CELLS_ACROSS = 48
LEAST_CELL = 0.2


@dataclass(frozen=True, eq=False)
class Columns:
    """The known cells of a map: middles (N, 2), the compared value (N,), an elevation (N,)."""

    xy: Floats
    value: Floats
    z: Floats


def choose_cell(draft: Floats) -> float:
    """Return the cell in metres: a 48th of the draft's extent, at least 0.2 m."""
    low, high = np.quantile(draft[:, :2], [0.01, 0.99], axis=0)
    return max(LEAST_CELL, float((high - low).max()) / CELLS_ACROSS)


def list_elevations(xyz: Floats, cell: float) -> Columns:
    """Return the highest point of each cell that holds a point."""
    ij = np.floor(xyz[:, :2] / cell).astype(np.int64)
    order = np.lexsort((xyz[:, 2], ij[:, 1], ij[:, 0]))
    ij = ij[order]
    last = np.append((ij[1:] != ij[:-1]).any(axis=1), True)
    z = xyz[order[last], 2]
    return Columns((ij[last] + 0.5) * cell, z, z)


def list_low_heights(xyz: Floats, cell: float) -> Columns:
    """Return the height above ground of the highest point under 1 m, and the ground itself."""
    from commonmap.mapping.ground import find_ground

    ground = find_ground(xyz)
    height = xyz[:, 2] - ground.height_at(xyz[:, :2])
    low = (height < 1.0) & (height > -1.0)
    columns = list_elevations(np.column_stack([xyz[low, :2], height[low]]), cell)
    return Columns(columns.xy, np.maximum(columns.z, FLOOR), ground.height_at(columns.xy))


def classify(value: Floats) -> Floats:
    """Return the class 0 to 15 of each value: even steps over the middle 98 % of the map's own."""
    low, high = np.quantile(value, [0.01, 0.99])
    step = max(float(high - low), 1e-9) / N_CLASSES
    return np.clip(np.floor((value - low) / step), 0, N_CLASSES - 1)


@numba.njit(cache=True)  # type: ignore[misc]
def zero_mean_sad(a: Floats, b: Floats) -> float:
    """Return the mean absolute difference after each side's mean is taken off."""
    offset, total = (a - b).mean(), 0.0
    for k in range(a.size):
        total += abs(a[k] - b[k] - offset)
    return total / a.size


@numba.njit(cache=True)  # type: ignore[misc]
def zero_mean_ssd(a: Floats, b: Floats) -> float:
    """Return the mean squared difference after each side's mean is taken off."""
    total = square = 0.0
    for k in range(a.size):
        d = a[k] - b[k]
        total += d
        square += d * d
    return square / a.size - (total / a.size) ** 2


@numba.njit(cache=True)  # type: ignore[misc]
def negative_ncc(a: Floats, b: Floats) -> float:
    """Return minus the normalised cross-correlation with both means taken off."""
    mean_a, mean_b = a.mean(), b.mean()
    aa = bb = ab = 0.0
    for k in range(a.size):
        p, q = a[k] - mean_a, b[k] - mean_b
        aa += p * p
        bb += q * q
        ab += p * q
    return -ab / math.sqrt(aa * bb) if aa * bb > 0.0 else 1.0


@numba.njit(cache=True)  # type: ignore[misc]
def negative_mi(a: Floats, b: Floats) -> float:
    """Return minus the mutual information in nats of values that are classes 0 to 15."""
    joint = np.zeros((16, 16))
    for k in range(a.size):
        joint[int(a[k]), int(b[k])] += 1.0
    joint /= a.size
    rows, columns = joint.sum(axis=1), joint.sum(axis=0)
    total = 0.0
    for i in range(16):
        for j in range(16):
            if joint[i, j] > 0.0:
                total -= joint[i, j] * math.log(joint[i, j] / (rows[i] * columns[j]))
    return total


@numba.njit(cache=True)  # type: ignore[misc]
def k_divergence(a: Floats, b: Floats) -> float:
    """Return sum P ln(2P / (P + Q)) of heights that are normalised over the overlap."""
    sum_a, sum_b = a.sum(), b.sum()
    total = 0.0
    for k in range(a.size):
        p, q = a[k] / sum_a, b[k] / sum_b
        total += p * math.log(2.0 * p / (p + q))
    return total


MEASURES = ("zsad", "zssd", "ncc", "mi", "k")


@numba.njit(cache=True)  # type: ignore[misc]
def cost_of(measure: int, a: Floats, b: Floats) -> float:
    """Return the cost by `MEASURES[measure]` of two equally long rows of values; less is better."""
    if measure == 0:
        return zero_mean_sad(a, b)
    if measure == 1:
        return zero_mean_ssd(a, b)
    if measure == 2:
        return negative_ncc(a, b)
    if measure == 3:
        return negative_mi(a, b)
    return k_divergence(a, b)


@numba.njit(cache=True)  # type: ignore[misc]
def best_shift(measure, base, draft, count, least):  # type: ignore[no-untyped-def]
    """Return (cost, u, v) of the best shift of `draft` on `base`, both NaN where unknown.

    count[u, v]: shared cells when draft cell [i, j] lies on base cell
    [i + u - n + 1, j + v - m + 1], (n, m) the draft's shape. least: how many a shift needs.
    """
    n, m = draft.shape
    # The base with unknown cells all round, so that no shift leaves it; the draft as a list
    width = base.shape[1] + 2 * (m - 1)
    padded = np.full((base.shape[0] + 2 * (n - 1), width), np.nan)
    padded[n - 1 : n - 1 + base.shape[0], m - 1 : m - 1 + base.shape[1]] = base
    flat = padded.ravel()
    i, j = np.nonzero(~np.isnan(draft))
    where, value = i * width + j, np.empty(i.size)
    for c in range(i.size):
        value[c] = draft[i[c], j[c]]
    a, b = np.empty(i.size + 1), np.empty(i.size + 1)
    best, best_u, best_v = np.inf, -1, -1
    for u in range(count.shape[0]):
        for v in range(count.shape[1]):
            if count[u, v] < least:
                continue
            k, start = 0, u * width + v
            for c in range(where.size):
                q = flat[start + where[c]]
                a[k], b[k] = value[c], q
                k += q == q
            cost = cost_of(measure, a[:k], b[:k])
            if cost < best:
                best, best_u, best_v = cost, u, v
    return best, best_u, best_v


def rasterise(columns: Columns, cell: float, yaw: float) -> tuple[Floats, Floats, Floats]:
    """Return (value, z, low corner) of columns turned by `yaw` about the origin; the highest wins.

    Both grids are (nx, ny), NaN where nothing lies. The corner is a whole number of cells.
    """
    c, s = math.cos(yaw), math.sin(yaw)
    ij = np.floor(columns.xy @ np.array([[c, s], [-s, c]]) / cell).astype(np.int64)
    low = ij.min(axis=0)
    grid = np.full((2, *(ij.max(axis=0) - low + 1)), np.nan)
    order = np.argsort(columns.value, kind="stable")
    i, j = (ij[order] - low).T
    grid[0, i, j], grid[1, i, j] = columns.value[order], columns.z[order]
    return grid[0], grid[1], low * cell


def count_shared(base: Floats, draft: Floats) -> NDArray[np.int64]:
    """Return the shared known cells at every shift, as `best_shift` wants them."""
    full = tuple(a + b - 1 for a, b in zip(base.shape, draft.shape, strict=True))
    size = tuple(fft.next_fast_len(n, real=True) for n in full)
    known = fft.rfft2(np.isfinite(base).astype(np.float64), size)
    known *= fft.rfft2(np.isfinite(draft[::-1, ::-1]).astype(np.float64), size)
    return np.rint(fft.irfft2(known, size)[: full[0], : full[1]]).astype(np.int64)


def search(target: Floats, source: Floats, *, measure: str) -> tuple[Floats, dict[str, Any]]:
    """Return (T_target_source, figures) of the pose of least cost on the coarse grid.

    target, source: (N, 3) metres. measure: one of `MEASURES`. Roll and pitch stay zero; z is the
    median difference of elevation at the best pose.
    """
    cell = choose_cell(source)
    make = list_low_heights if measure == "k" else list_elevations
    middle = 0.5 * (source[:, :2].min(axis=0) + source[:, :2].max(axis=0))
    base, draft = make(target, cell), make(source, 0.5 * cell)
    if measure == "mi":
        base = Columns(base.xy, classify(base.value), base.z)
        draft = Columns(draft.xy, classify(draft.value), draft.z)
    draft = Columns(draft.xy - middle, draft.value, draft.z)
    base_value, base_z, base_low = rasterise(base, cell, 0.0)

    best: tuple[float, ...] = (np.inf,)
    yaws = np.arange(0.0, 2.0 * np.pi - 1e-9, YAW_STEP)
    for yaw in yaws:
        value, z, low = rasterise(draft, cell, yaw)
        count = count_shared(base_value, value)
        least = max(4, int(MIN_OVERLAP * np.count_nonzero(np.isfinite(value))))
        cost, u, v = best_shift(MEASURES.index(measure), base_value, value, count, least)
        if cost < best[0]:
            n, m = value.shape
            shift = base_low - low + (np.array([u, v]) - [n - 1, m - 1]) * cell
            best = (cost, yaw, *shift, _rise(base_z, z, u - n + 1, v - m + 1))
    figures = {"cell_m": cell, "yaws": len(yaws), "score": best[0]}
    if len(best) == 1:
        return np.eye(4), figures | {"found": False}
    _, yaw, x, y, rise = best
    c, s = math.cos(yaw), math.sin(yaw)
    T = np.array([[c, -s, 0, x], [s, c, 0, y], [0, 0, 1, rise], [0, 0, 0, 1]], np.float64)
    T[:2, 3] -= T[:2, :2] @ middle
    return T, figures | {"found": True}


def _rise(base: Floats, draft: Floats, di: int, dj: int) -> float:
    """Return the median of base minus draft where draft cell [i, j] lies on base [i+di, j+dj]."""
    n, m = draft.shape
    i, j = (
        slice(max(0, -di), min(n, base.shape[0] - di)),
        slice(max(0, -dj), min(m, base.shape[1] - dj)),
    )
    on_base = base[i.start + di : i.stop + di, j.start + dj : j.stop + dj]
    return float(np.nanmedian(on_base - draft[i, j]))
