"""The ground under a cloud: robust to canopies, roofs, slopes to 30 degrees and low blunders.

The ground is the lowest surface that no reachable lower point contradicts. On a grid of lowest
points its largest `s`-Lipschitz minorant (the lower envelope of cones of slope `s`, Vosselman 2000)
removes whatever rises more steeply than any ground does: trees, cars, walls, the rim of roofs. What
is left in the middle of large flat roofs is a component that stands above everything round it, and
goes as a whole. The rest is filled in by push and pull over a pyramid of means.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from scipy import ndimage

from commonmap.errors import EmptyMapError
from commonmap.mapping.points import bounds, floor_int, sample
from commonmap.types import Bools, Float64s

MAX_SLOPE = math.tan(math.radians(38.0))
"""Steepest ground that is believed: 30 degrees, and what roughness adds over one cell."""


PLANE_CELLS = 5_000
"""Cells that the plane under a map is fitted to."""


@dataclass(frozen=True, eq=False)
class Ground:
    """A ground surface on a grid (cell [i, j] as in `GridMap`), defined everywhere on it.

    origin: (2,) metres. cell: metres. z: (nx, ny) float64 height at the cells' centres.
    seen: (nx, ny) bool, the ground itself was measured in this cell; else z is interpolated.
    """

    origin: Float64s
    cell: float
    z: Float64s
    seen: Bools

    def height_at(self, xy: Float64s) -> Float64s:
        """Return the ground's z at (N, 2 or 3) positions, bilinear, constant past outer centres."""
        position = np.asarray(xy, dtype=np.float64)
        return np.asarray(_bilinear(self.z, self.origin, self.cell, position))

    def height_above(self, xyz: Float64s) -> Float64s:
        """Return the height of (N, 3) points above the ground, (N,) metres."""
        z = self.height_at(xyz)
        return np.asarray(np.subtract(xyz[:, 2], z, out=z))


def find_ground(xyz: Float64s, *, cell: float | None = None) -> Ground:
    """Return the ground under an (N, 3) cloud that is level (z up), in metres.

    cell: edge of the grid; by default half a metre, or more where the points are sparse.
    Raises EmptyMapError for a cloud with fewer than three points.
    """
    if len(xyz) < 3:
        raise EmptyMapError(f"a map needs at least three points to have a ground; {len(xyz)} came")
    if cell is None:
        cell = choose_ground_cell(typical_spacing(xyz))
    low, high = bounds(xyz)
    origin = np.floor(low[:2] / cell) * cell
    shape = tuple(np.floor((high[:2] - origin) / cell).astype(int) + 1)
    lowest = _lowest(np.ascontiguousarray(xyz, dtype=np.float64), origin, cell, *shape)
    lowest = _drop_low_blunders(lowest, cell)
    tolerance = 0.15 + 0.1 * cell

    # What no cone of the steepest believable slope undercuts may be ground
    envelope = _cone_envelope(lowest, MAX_SLOPE * cell)
    candidate = np.isfinite(lowest) & (lowest - envelope <= tolerance)

    # A smooth piece that stands above all that surrounds it is a roof or a deck
    candidate = _drop_standing_pieces(lowest, candidate, cell, MAX_SLOPE * cell + tolerance)

    # What still rises from the smoothed surface is low growth, a kerb stone, the foot of a stem
    z = fill(np.where(candidate, lowest, np.nan))
    for _ in range(2):
        smooth = ndimage.gaussian_filter(z, max(1.0, 1.0 / cell), mode="nearest")
        candidate &= lowest - smooth <= 2.0 * tolerance
        z = fill(np.where(candidate, lowest, np.nan))
    return Ground(origin=origin, cell=cell, z=z, seen=candidate)


def choose_ground_cell(spacing: float) -> float:
    """Return the cell of a ground under points so far apart, metres."""
    return max(0.5, 1.5 * spacing)


def typical_spacing(xyz: Float64s) -> float:
    """Return the distance between neighbouring columns of points seen from above, in metres.

    The share of occupied cells of a 1 m grid is known; within them n points on an area A lie
    about sqrt(A / n) apart. Robust against unequal density: the median over cells.
    """
    low, high = bounds(xyz)
    extent = (high - low)[:2]
    coarse = max(1.0, float(extent.max()) / 4096.0)
    for _ in range(4):
        n_x, n_y = (int(n) for n in np.floor(extent / coarse) + 1)
        counts = _count(np.ascontiguousarray(xyz, dtype=np.float64), low, coarse, n_x, n_y)
        counts = counts[counts > 0]
        median = float(np.median(counts))
        if median >= 4 or len(counts) < 16:
            break
        coarse *= 2.0
    return float(coarse / math.sqrt(max(median, 1.0)))


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _count(xyz, low, cell, n_x, n_y):  # type: ignore[no-untyped-def]
    count = np.zeros(n_x * n_y, np.int32)
    for n in range(xyz.shape[0]):
        i = min(int((xyz[n, 0] - low[0]) / cell), n_x - 1)
        j = min(int((xyz[n, 1] - low[1]) / cell), n_y - 1)
        count[i * n_y + j] += 1
    return count


def fill(z: Float64s) -> Float64s:
    """Return z with NaN cells filled: a plane through what is known, plus push-pull of the rest.

    The plane makes gaps and rims follow a slope; push-pull (means over a pyramid, Gortler et al.
    1996) makes them follow the relief. Where nothing is known at all the answer is zero.
    """
    known = np.isfinite(z)
    if not known.any():
        return np.zeros_like(z)
    return np.asarray(_push_and_pull(np.ascontiguousarray(z), *_fit_plane(z, known)))


def _fit_plane(z: Float64s, known: Bools) -> tuple[float, float, float]:
    """Return a, b, c of the plane a i + b j + c through the known cells.

    Least squares over `PLANE_CELLS` of them, three times reweighted (Cauchy).
    """
    at = sample(np.flatnonzero(known), PLANE_CELLS)
    ij = np.column_stack(np.unravel_index(at, z.shape)).astype(np.float64)
    middle = ij.mean(axis=0)
    A, b = np.column_stack([ij - middle, np.ones(len(at))]), z.ravel()[at]
    w = np.ones(len(at))
    x: Float64s = np.zeros(3)
    for _ in range(4):
        weighted = (A * w[:, None]).T
        N = weighted @ A + 1e-9 * len(at) * np.eye(3)
        x = np.asarray(np.linalg.solve(N, weighted @ b), dtype=np.float64)
        residual = b - A @ x
        scale = 1.4826 * float(np.median(np.abs(residual))) + 1e-3
        w = 1.0 / (1.0 + (residual / (2.0 * scale)) ** 2)
    return float(x[0]), float(x[1]), float(x[2] - middle @ x[:2])


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _push_and_pull(z, a, b, c):  # type: ignore[no-untyped-def]
    """Return z, its NaN cells from a pyramid of means of what it is off the plane a i + b j + c."""
    off, weight = np.zeros(z.shape), np.zeros(z.shape)
    for i in range(z.shape[0]):
        for j in range(z.shape[1]):
            if not np.isnan(z[i, j]):
                off[i, j], weight[i, j] = z[i, j] - (a * i + b * j + c), 1.0
    values, weights = [off], [weight]
    while max(off.shape) > 1:
        off, weight = _halve(off, weight)
        values.append(off)
        weights.append(weight)
    for level in range(len(values) - 2, -1, -1):
        off = _pull(off, values[level], weights[level])
    filled = z.copy()
    for i in range(z.shape[0]):
        for j in range(z.shape[1]):
            if np.isnan(z[i, j]):
                filled[i, j] = off[i, j] + (a * i + b * j + c)
    return filled


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _halve(value, weight):  # type: ignore[no-untyped-def]
    """Return the weighted mean of every two by two cells, and their weight, at most one."""
    n_x, n_y = value.shape
    shape = (n_x + 1) // 2, (n_y + 1) // 2
    mean, sum_ = np.zeros(shape), np.zeros(shape)
    for i in range(n_x):
        for j in range(n_y):
            mean[i >> 1, j >> 1] += value[i, j] * weight[i, j]
            sum_[i >> 1, j >> 1] += weight[i, j]
    for i in range(shape[0]):
        for j in range(shape[1]):
            if sum_[i, j] > 0.0:
                mean[i, j] /= sum_[i, j]
            sum_[i, j] = min(sum_[i, j], 1.0)
    return mean, sum_


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _pull(coarse, value, weight):  # type: ignore[no-untyped-def]
    """Return the values, where they have little weight those of the coarser level, bilinear."""
    n_x, n_y = coarse.shape
    out = np.empty(value.shape)
    for i in range(value.shape[0]):
        near = i >> 1
        far = min(near + 1, n_x - 1) if i & 1 else max(near - 1, 0)
        for j in range(value.shape[1]):
            k = j >> 1
            m = min(k + 1, n_y - 1) if j & 1 else max(k - 1, 0)
            one = 0.75 * coarse[near, k] + 0.25 * coarse[far, k]
            other = 0.75 * coarse[near, m] + 0.25 * coarse[far, m]
            w = weight[i, j]
            out[i, j] = w * value[i, j] + (1.0 - w) * (0.75 * one + 0.25 * other)
    return out


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _lowest(xyz, origin, cell, nx, ny):  # type: ignore[no-untyped-def]
    z = np.full((nx, ny), np.nan)
    for n in range(xyz.shape[0]):
        i = floor_int((xyz[n, 0] - origin[0]) / cell)
        j = floor_int((xyz[n, 1] - origin[1]) / cell)
        if not z[i, j] <= xyz[n, 2]:
            z[i, j] = xyz[n, 2]
    return z


def _drop_low_blunders(lowest: Float64s, cell: float) -> Float64s:
    """Return `lowest` without cells far below all but three of their 7x7 neighbours."""
    reach = 3.0 * math.sqrt(2.0) * cell * MAX_SLOPE + 0.5
    return np.asarray(_without_blunders(lowest, reach))


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _without_blunders(lowest, reach):  # type: ignore[no-untyped-def]
    nx, ny = lowest.shape
    kept = lowest.copy()
    for i in range(nx):
        for j in range(ny):
            z = lowest[i, j]
            if np.isnan(z):
                continue
            low, seen = 0, 0  # of the neighbours and the cell itself
            for a in range(max(i - 3, 0), min(i + 4, nx)):
                for b in range(max(j - 3, 0), min(j + 4, ny)):
                    seen += not np.isnan(lowest[a, b])
                    low += lowest[a, b] <= z + reach
                if low > 4:
                    break
            if low <= 4 and seen > 4:
                kept[i, j] = np.nan
    return kept


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _cone_envelope(lowest, rise):  # type: ignore[no-untyped-def]
    """Return min over cells q of lowest[q] + rise * distance(p, q), by a two-pass chamfer."""
    nx, ny = lowest.shape
    E = np.empty((nx, ny))
    for i in range(nx):
        for j in range(ny):
            E[i, j] = lowest[i, j] if np.isfinite(lowest[i, j]) else np.inf
    near, far = rise, rise * np.sqrt(2.0)
    for _ in range(2):
        for i in range(nx):
            for j in range(ny):
                e = E[i, j]
                if i > 0:
                    e = min(e, E[i - 1, j] + near)
                    if j > 0:
                        e = min(e, E[i - 1, j - 1] + far)
                    if j < ny - 1:
                        e = min(e, E[i - 1, j + 1] + far)
                if j > 0:
                    e = min(e, E[i, j - 1] + near)
                E[i, j] = e
        for i in range(nx - 1, -1, -1):
            for j in range(ny - 1, -1, -1):
                e = E[i, j]
                if i < nx - 1:
                    e = min(e, E[i + 1, j] + near)
                    if j > 0:
                        e = min(e, E[i + 1, j - 1] + far)
                    if j < ny - 1:
                        e = min(e, E[i + 1, j + 1] + far)
                if j < ny - 1:
                    e = min(e, E[i, j + 1] + near)
                E[i, j] = e
    return E


def _drop_standing_pieces(z: Float64s, candidate: Bools, cell: float, step: float) -> Bools:
    """Return `candidate` without the smooth pieces that stand above what surrounds them.

    Pieces are cells joined by steps of at most `step`. For each piece the nearest cells of other
    pieces are its surroundings, as far away as the cones have eaten into it, which on a roof of
    8 m is 10 m (14 m askew); it stands when most of them are lower by more than a metre, and by
    more than half the steepest slope over the way there. The largest piece stays.
    """
    label = _label_smooth(np.where(candidate, z, np.nan), step)
    n_pieces = int(label.max())
    if n_pieces < 2:
        return candidate
    area = np.bincount(label.ravel(), minlength=n_pieces + 1)
    area[0] = 0
    drop = float(np.ptp(z[candidate]))
    reach = max(6, math.ceil(1.5 * drop / (MAX_SLOPE * cell)))
    lower, higher = _compare_borders(
        np.where(candidate, z, np.nan), label, n_pieces, reach, 1.0, 0.5 * MAX_SLOPE * cell
    )
    stands = (lower > 2.0 * higher) & (lower > 0)
    stands[int(np.argmax(area))] = False
    stands[0] = False
    kept = candidate & ~stands[label]
    return kept if kept.any() else candidate


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _label_smooth(z, step):  # type: ignore[no-untyped-def]
    nx, ny = z.shape
    label = np.zeros((nx, ny), np.int32)
    stack = np.empty((nx * ny, 2), np.int32)
    n = 0
    for i0 in range(nx):
        for j0 in range(ny):
            if label[i0, j0] != 0 or not np.isfinite(z[i0, j0]):
                continue
            n += 1
            label[i0, j0] = n
            stack[0, 0], stack[0, 1] = i0, j0
            top = 1
            while top > 0:
                top -= 1
                i, j = stack[top, 0], stack[top, 1]
                for di in range(-1, 2):
                    for dj in range(-1, 2):
                        a, b = i + di, j + dj
                        if a < 0 or b < 0 or a >= nx or b >= ny or label[a, b] != 0:
                            continue
                        if abs(z[a, b] - z[i, j]) <= step:
                            label[a, b] = n
                            stack[top, 0], stack[top, 1] = a, b
                            top += 1
    return label


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _compare_borders(z, label, n_pieces, reach, margin, rise):  # type: ignore[no-untyped-def]
    """Count, per piece, looks along x and y that meet another piece clearly lower, or not lower."""
    lower = np.zeros(n_pieces + 1, np.int64)
    higher = np.zeros(n_pieces + 1, np.int64)
    nx, ny = z.shape
    for i in range(nx):
        for j in range(ny):
            me = label[i, j]
            if me == 0:
                continue
            for d in range(4):
                di = 1 if d == 0 else (-1 if d == 1 else 0)
                dj = 1 if d == 2 else (-1 if d == 3 else 0)
                for k in range(1, reach + 1):
                    a, b = i + k * di, j + k * dj
                    if a < 0 or b < 0 or a >= nx or b >= ny:
                        break
                    other = label[a, b]
                    if other == me:
                        break
                    if other != 0:
                        if z[a, b] < z[i, j] - max(margin, k * rise):
                            lower[me] += 1
                        else:
                            higher[me] += 1
                        break
    return lower, higher


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _bilinear(z, origin, cell, xy):  # type: ignore[no-untyped-def]
    nx, ny = z.shape
    out = np.empty(xy.shape[0])
    for n in range(xy.shape[0]):
        u = min(max((xy[n, 0] - origin[0]) / cell - 0.5, 0.0), nx - 1.0)
        v = min(max((xy[n, 1] - origin[1]) / cell - 0.5, 0.0), ny - 1.0)
        i, j = min(int(u), max(nx - 2, 0)), min(int(v), max(ny - 2, 0))
        a, b = min(i + 1, nx - 1), min(j + 1, ny - 1)
        s, t = u - i, v - j
        out[n] = (1 - s) * ((1 - t) * z[i, j] + t * z[i, b]) + s * ((1 - t) * z[a, j] + t * z[a, b])
    return out
