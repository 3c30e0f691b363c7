"""Nearest points and normals, on columns of the plan: what a registration asks again and again.

Points of a map lie on few surfaces, one a voxel, so a square of columns about a point holds what
is near it, and little else. Squares grow until nothing further out can be nearer.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from threading import Lock

import numba
import numpy as np
from numpy.typing import NDArray

from commonmap.mapping.points import bounds, floor_int
from commonmap.types import Float64s

MOST_NEIGHBOURS = 32
"""Neighbours that a normal is taken from at most."""


@dataclass(frozen=True, eq=False)
class PlanIndex:
    """Points by columns of the plan. points: (N, 3) metres, in the order of their columns.

    number: (N,) index of each in the array that came in. starts: (nx * ny + 1,) where each column
    begins. low: (2,) corner of the first. size: metres, of a column. gap: (nx * ny,) how many
    squares of columns about each, itself the first, hold nothing, 255 at most.
    """

    points: Float64s
    number: NDArray[np.int64]
    starts: NDArray[np.int64]
    low: Float64s
    size: float
    shape: tuple[int, int]
    gap: NDArray[np.uint8]

    def query(
        self, xyz: Float64s, *, distance_upper_bound: float = math.inf, workers: int = 1
    ) -> tuple[Float64s, NDArray[np.int64]]:
        """Return (distance, index) of the nearest point of each of (M, 3), as SciPy's trees do.

        Where none is nearer than the bound: infinity, and the number of points. One thread.
        """
        distance, index = _query(
            self.points, self.number, self.starts, self.gap, self.low, self.size, *self.shape,
            np.ascontiguousarray(xyz, dtype=np.float64), distance_upper_bound,
        )  # fmt: skip
        return distance, index


def index_points(xyz: Float64s, spacing: float) -> PlanIndex:
    """Return an index of (N, 3) points that lie about `spacing` metres apart, N > 0."""
    low, high = bounds(xyz)
    extent = (high - low)[:2]
    size = 1.5 * spacing
    while np.prod(np.floor(extent / size) + 1.0) > 8.0 * len(xyz) + 1024.0:
        size *= 1.5
    n_x, n_y = (int(n) + 1 for n in np.floor(extent / size))
    column = _columns(np.ascontiguousarray(xyz), low, size, n_x, n_y)
    order, starts = sort_by_column(column, n_x * n_y)
    gap = _gaps(starts, n_x, n_y)
    return PlanIndex(xyz[order], order, starts, low[:2], size, (n_x, n_y), gap)


def sort_by_column(
    column: NDArray[np.int32], n_columns: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the order of points by their columns, and where each column begins (n_columns + 1,).

    Those of one column stay in the order that they came in.
    """
    starts = np.zeros(n_columns + 1, np.int64)
    np.cumsum(np.bincount(column, minlength=n_columns), out=starts[1:])
    return np.asarray(_order_by(column, starts)), starts


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _gaps(starts, n_x, n_y):  # type: ignore[no-untyped-def]
    """Return the distance, in columns along the longer way, to the nearest that holds a point."""
    gap = np.empty((n_x, n_y), np.uint8)
    most = np.uint8(255)
    for i in range(n_x):  # from what lies before, then from what lies behind
        for j in range(n_y):
            c = i * n_y + j
            if starts[c + 1] > starts[c]:
                gap[i, j] = 0
                continue
            near = gap[i, j - 1] if j > 0 else most
            if i > 0:
                for k in range(max(j - 1, 0), min(j + 2, n_y)):
                    near = min(near, gap[i - 1, k])
            gap[i, j] = near + np.uint8(near < most)
    for i in range(n_x - 1, -1, -1):
        for j in range(n_y - 1, -1, -1):
            near = gap[i, j + 1] if j + 1 < n_y else most
            if i + 1 < n_x:
                for k in range(max(j - 1, 0), min(j + 2, n_y)):
                    near = min(near, gap[i + 1, k])
            gap[i, j] = min(gap[i, j], near + np.uint8(near < most))
    return gap.ravel()


class Normals:
    """The unit normals of the points of an index, worked out as they are asked for.

    Of each point's `n_neighbours` nearest, itself among them: across their thinnest direction.
    `normals[which]` are the (M, 3) of (M,) points, numbered as they came in. Threads may share it.
    """

    def __init__(self, index: PlanIndex, n_neighbours: int) -> None:
        if not 3 <= n_neighbours <= MOST_NEIGHBOURS:
            raise ValueError(
                f"3 to {MOST_NEIGHBOURS} neighbours make a normal; {n_neighbours} came"
            )
        self.index, self.n_neighbours = index, n_neighbours
        self._normal = np.empty_like(index.points)
        self._found = np.zeros(len(index.points), dtype=bool)
        self._place = np.empty_like(index.number)
        self._place[index.number] = np.arange(len(index.number))
        self._one = Lock()

    def __getitem__(self, which: NDArray[np.int64]) -> Float64s:
        return np.asarray(self.at_least(which)[which])

    def at_least(self, which: NDArray[np.int64]) -> Float64s:
        """Return the normals (N, 3) of all points; only those of (M,) points must be right."""
        index = self.index
        with self._one:
            _find_normals(
                index.points, self._place, index.starts, index.low, index.size, *index.shape,
                self.n_neighbours, which, self._found, self._normal,
            )  # fmt: skip
        return self._normal


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _columns(xyz, low, size, n_x, n_y):  # type: ignore[no-untyped-def]
    column = np.empty(xyz.shape[0], np.int32)
    for n in range(xyz.shape[0]):
        i = min(int((xyz[n, 0] - low[0]) / size), n_x - 1)
        j = min(int((xyz[n, 1] - low[1]) / size), n_y - 1)
        column[n] = i * n_y + j
    return column


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _order_by(column, starts):  # type: ignore[no-untyped-def]
    """Return the points by column, those of one in the order that they came in."""
    order, place = np.empty(column.shape[0], np.int64), starts[:-1].copy()
    for n in range(column.shape[0]):
        order[place[column[n]]] = n
        place[column[n]] += 1
    return order


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _query(  # type: ignore[no-untyped-def]
    points, number, starts, gap, low, size, n_x, n_y, xyz, reach
):
    distance = np.full(xyz.shape[0], np.inf)
    index = np.full(xyz.shape[0], points.shape[0], np.int64)
    most = reach * reach
    for n in range(xyz.shape[0]):
        x, y, z = xyz[n, 0], xyz[n, 1], xyz[n, 2]
        u, v = (x - low[0]) / size, (y - low[1]) / size
        i0, j0 = floor_int(u), floor_int(v)
        # how far the border of the point's own column is, at the nearest
        inner = min(min(u - i0, i0 + 1.0 - u), min(v - j0, j0 + 1.0 - v)) * size
        nearest, best = most, -1
        # squares that lie wholly beside the grid, or hold nothing, are passed over
        ring = max(0, max(max(-i0, i0 - n_x + 1), max(-j0, j0 - n_y + 1)))
        if ring == 0:
            ring = int(gap[i0 * n_y + j0])
        last = max(max(i0, n_x - 1 - i0), max(j0, n_y - 1 - j0))
        while ring <= last:
            bound = inner + (ring - 1) * size if ring > 0 else 0.0
            if bound * bound >= nearest:
                break
            for i in range(max(i0 - ring, 0), min(i0 + ring, n_x - 1) + 1):
                whole = i == i0 - ring or i == i0 + ring
                step = 1 if whole or ring == 0 else 2 * ring
                for j in range(j0 - ring, j0 + ring + 1, step):
                    if j < 0 or j >= n_y:
                        continue
                    c = i * n_y + j
                    for m in range(starts[c], starts[c + 1]):
                        square = (
                            (points[m, 0] - x) ** 2
                            + (points[m, 1] - y) ** 2
                            + (points[m, 2] - z) ** 2
                        )
                        if square < nearest:
                            nearest, best = square, m
            ring += 1
        if best >= 0:
            distance[n], index[n] = np.sqrt(nearest), number[best]
    return distance, index


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _find_normals(  # type: ignore[no-untyped-def]
    points, place, starts, low, size, n_x, n_y, n_neighbours, which, done, out
):
    """Set the normals (N, 3) of (M,) points, as they are numbered, that are not `done` yet.

    place: (N,) where each of them is in `points`.
    """
    square = np.empty(MOST_NEIGHBOURS)
    near = np.empty(MOST_NEIGHBOURS, np.int64)
    for one in which:
        if done[one]:
            continue
        done[one] = True
        n = place[one]
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        i0 = min(int((x - low[0]) / size), n_x - 1)
        j0 = min(int((y - low[1]) / size), n_y - 1)
        last = max(max(i0, n_x - 1 - i0), max(j0, n_y - 1 - j0))
        found = 0
        for ring in range(last + 1):
            # what lies beyond the squares so far is at least this far away
            bound = max((ring - 1) * size, 0.0)
            if found == n_neighbours and bound * bound >= square[found - 1]:
                break
            for i in range(max(i0 - ring, 0), min(i0 + ring, n_x - 1) + 1):
                whole = i == i0 - ring or i == i0 + ring
                step = 1 if whole or ring == 0 else 2 * ring
                for j in range(j0 - ring, j0 + ring + 1, step):
                    if j < 0 or j >= n_y:
                        continue
                    c = i * n_y + j
                    for m in range(starts[c], starts[c + 1]):
                        s = (
                            (points[m, 0] - x) ** 2
                            + (points[m, 1] - y) ** 2
                            + (points[m, 2] - z) ** 2
                        )
                        if found == n_neighbours:
                            if s >= square[found - 1]:
                                continue
                            at = found - 1
                        else:
                            at = found
                            found += 1
                        while at > 0 and square[at - 1] > s:
                            square[at], near[at] = square[at - 1], near[at - 1]
                            at -= 1
                        square[at], near[at] = s, m
        _thinnest(points, near, found, out[one])


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _thinnest(points, near, found, normal):  # type: ignore[no-untyped-def]
    """Set normal (3,) to the direction in which the points vary least."""
    mx, my, mz = 0.0, 0.0, 0.0
    for k in range(found):
        mx += points[near[k], 0]
        my += points[near[k], 1]
        mz += points[near[k], 2]
    mx, my, mz = mx / found, my / found, mz / found
    a, b, c, d, e, f = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(found):
        x, y, z = points[near[k], 0] - mx, points[near[k], 1] - my, points[near[k], 2] - mz
        a += x * x
        b += x * y
        c += x * z
        d += y * y
        e += y * z
        f += z * z
    # smallest eigenvalue of [[a b c], [b d e], [c e f]] in closed form (Smith 1961)
    q = (a + d + f) / 3.0
    spread = (a - q) ** 2 + (d - q) ** 2 + (f - q) ** 2 + 2.0 * (b * b + c * c + e * e)
    normal[0], normal[1], normal[2] = 0.0, 0.0, 1.0
    if spread <= 1e-28:
        return
    p = np.sqrt(spread / 6.0)
    ra, rd, rf, rb, rc, re = (a - q) / p, (d - q) / p, (f - q) / p, b / p, c / p, e / p
    half = 0.5 * (ra * (rd * rf - re * re) - rb * (rb * rf - re * rc) + rc * (rb * re - rd * rc))
    angle = np.arccos(min(1.0, max(-1.0, half))) / 3.0
    least = q + 2.0 * p * np.cos(angle + 2.0 * np.pi / 3.0)
    # its eigenvector is across two rows of the matrix less the eigenvalue: the two most apart
    a, d, f = a - least, d - least, f - least
    x1, y1, z1 = b * e - c * d, c * b - a * e, a * d - b * b
    x2, y2, z2 = b * f - c * e, c * c - a * f, a * e - b * c
    x3, y3, z3 = d * f - e * e, e * c - b * f, b * e - c * d
    n1 = x1 * x1 + y1 * y1 + z1 * z1
    n2 = x2 * x2 + y2 * y2 + z2 * z2
    n3 = x3 * x3 + y3 * y3 + z3 * z3
    if n2 > n1 and n2 >= n3:
        x1, y1, z1, n1 = x2, y2, z2, n2
    elif n3 > n1:
        x1, y1, z1, n1 = x3, y3, z3, n3
    if n1 > 0.0:
        length = np.sqrt(n1)
        normal[0], normal[1], normal[2] = x1 / length, y1 / length, z1 / length
