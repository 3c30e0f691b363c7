"""Edge and planar features of a turn against the turn before (Zhang and Singh 2014, section V-B).

The features of the turn before are kept ring by ring in the order of azimuth; a partner is looked
for on the rings around the feature's own, near its azimuth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from commonmap.odometry.distances import point_to_line, point_to_plane
from commonmap.odometry.solve import Rows
from commonmap.types import Float64s

NEAR_RINGS = 2
"""Rings to either side on which partners are looked for (Zhang and Singh: consecutive scans)."""


@dataclass(frozen=True, eq=False)
class RingedPoints:
    """Points of a turn by ring and azimuth: xyz (N, 3), azimuth (N,) rising in each ring,
    start (R + 1,)."""

    xyz: Float64s
    azimuth: Float64s
    start: NDArray[np.int64]


def by_ring(xyz: Float64s, ring: NDArray[np.int64], n_rings: int) -> RingedPoints:
    """Return points (N, 3) sorted by ring and azimuth."""
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0])
    order = np.argsort(ring * 8.0 + azimuth, kind="stable")
    start = np.zeros(n_rings + 1, np.int64)
    np.cumsum(np.bincount(ring, minlength=n_rings), out=start[1:])
    return RingedPoints(np.ascontiguousarray(xyz[order]), azimuth[order], start)


def match_scan(
    points: Float64s, ring: NDArray[np.int64], n_sharp: int, T: Float64s, edges: RingedPoints,
    planes: RingedPoints, reach: float,
) -> Rows:  # fmt: skip
    """Return the rows of edge points and, behind them, of planar points that find partners.

    T: (4, 4) takes the points (N, 3), the first `n_sharp` of them edges, into the frame of the turn
    before. Two rows (Eq. 2) for each edge point that finds a line j, l there; one (Eq. 3) for each
    planar point that finds a plane j, l, m. reach: metres.
    """
    rows = Rows.room(len(points) + n_sharp)
    R, t = np.ascontiguousarray(T[:3, :3]), T[:3, 3].copy()
    end = _scan_lines(
        points[:n_sharp], ring, R, t, edges.xyz, edges.azimuth, edges.start, reach, *rows.arrays
    )
    end = _scan_planes(
        points, n_sharp, end, ring, R, t, planes.xyz, planes.azimuth, planes.start, reach,
        *rows.arrays,
    )  # fmt: skip
    return rows.head(end)


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _nearest(x, azimuth_x, first, last, xyz, azimuth, best, j, least):  # type: ignore[no-untyped-def]
    """Return (index, squared distance) of the point of one ring nearest to x, nearer than
    `sqrt(best)`; (-1, best) where there is none.

    j: a point from which it must be at least `sqrt(least)` metres away, or -1.
    """
    n, at = last - first, -1
    if n == 0:
        return at, best
    flat2 = x[0] * x[0] + x[1] * x[1]
    begin, high = first, last
    while begin < high:
        middle = (begin + high) // 2
        if azimuth[middle] < azimuth_x:
            begin = middle + 1
        else:
            high = middle
    begin -= first
    for direction in (1, -1):
        for k in range(n):
            i = begin + k if direction == 1 else begin - 1 - k
            if i >= n:
                i -= n
            elif i < 0:
                i += n
            i += first
            turn = abs(azimuth[i] - azimuth_x)
            turn = min(turn, 2.0 * np.pi - turn)
            # what lies farther round than the best so far cannot be nearer: its distance is at
            # least that of x to its bearing, flat * sin(turn)
            sine = turn * (1.0 - turn * turn / 6.0) if turn < 1.5 else 0.9
            if flat2 * sine * sine > best:
                break
            d = (xyz[i, 0] - x[0]) ** 2 + (xyz[i, 1] - x[1]) ** 2 + (xyz[i, 2] - x[2]) ** 2
            if d < best:
                if j >= 0:
                    apart = (xyz[i, 0] - xyz[j, 0]) ** 2 + (xyz[i, 1] - xyz[j, 1]) ** 2
                    apart += (xyz[i, 2] - xyz[j, 2]) ** 2
                    if apart < least:
                        continue
                best, at = d, i
    return at, best


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _nearest_around(x, azimuth_x, ring, skip, start, xyz, azimuth, best):  # type: ignore[no-untyped-def]
    """Return (index, its ring) of the point nearest to x on the rings around one, that ring first;
    (-1, -1) where none is nearer than `sqrt(best)`. skip: leave out the ring itself."""
    at = on = -1
    for step in range(1 if skip else 0, 2 * NEAR_RINGS + 1):
        k = ring + (step + 1) // 2 * (1 if step % 2 else -1)
        if 0 <= k < start.shape[0] - 1:
            i, d = _nearest(x, azimuth_x, start[k], start[k + 1], xyz, azimuth, best, -1, 0.0)
            if i >= 0:
                at, best, on = i, d, k
    return at, on


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _scan_lines(  # type: ignore[no-untyped-def]
    points, ring, R, t, xyz, azimuth, start, reach, p, c, u, sigma, tilt, feature
):
    """Fill the rows of edge points from the first on, two a line; return their number."""
    n = points.shape[0]
    x, e = np.empty(3), np.empty(3)
    rows = 0
    for i in range(n):
        for r in range(3):
            x[r] = R[r, 0] * points[i, 0] + R[r, 1] * points[i, 1] + R[r, 2] * points[i, 2] + t[r]
        a = np.arctan2(x[1], x[0])
        j, on = _nearest_around(x, a, ring[i], False, start, xyz, azimuth, reach * reach)
        if j < 0:
            continue
        l, _ = _nearest_around(x, a, on, True, start, xyz, azimuth, 4.0 * reach * reach)
        if l < 0 or point_to_line(x, xyz[j], xyz[l]) > reach:
            continue
        for r in range(3):
            e[r] = xyz[l, r] - xyz[j, r]
        length = max(np.sqrt(e[0] * e[0] + e[1] * e[1] + e[2] * e[2]), 1e-9)
        e[0], e[1], e[2] = e[0] / length, e[1] / length, e[2] / length
        k = 0
        for r in range(1, 3):
            if abs(e[r]) < abs(e[k]):
                k = r
        a1, a2, a3 = -e[k] * e[0], -e[k] * e[1], -e[k] * e[2]
        if k == 0:
            a1 += 1.0
        elif k == 1:
            a2 += 1.0
        else:
            a3 += 1.0
        length = np.sqrt(a1 * a1 + a2 * a2 + a3 * a3)
        a1, a2, a3 = a1 / length, a2 / length, a3 / length
        for side in range(2):
            for r in range(3):
                p[rows, r] = points[i, r]
                c[rows, r] = xyz[j, r]
            if side == 0:
                u[rows, 0], u[rows, 1], u[rows, 2] = a1, a2, a3
            else:
                u[rows, 0] = e[1] * a3 - e[2] * a2
                u[rows, 1] = e[2] * a1 - e[0] * a3
                u[rows, 2] = e[0] * a2 - e[1] * a1
            sigma[rows], tilt[rows], feature[rows] = 0.1, 0.0, i
            rows += 1
    return rows


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _scan_planes(  # type: ignore[no-untyped-def]
    points, first, rows, ring, R, t, xyz, azimuth, start, reach, p, c, u, sigma, tilt, feature
):
    """Fill the rows of planar points from `first` on behind `rows`; return the end."""
    x, normal = np.empty(3), np.empty(3)
    for i in range(first, points.shape[0]):
        for r in range(3):
            x[r] = R[r, 0] * points[i, 0] + R[r, 1] * points[i, 1] + R[r, 2] * points[i, 2] + t[r]
        a = np.arctan2(x[1], x[0])
        j, on = _nearest_around(x, a, ring[i], False, start, xyz, azimuth, reach * reach)
        if j < 0:
            continue
        m, _ = _nearest_around(x, a, on, True, start, xyz, azimuth, 4.0 * reach * reach)
        if m < 0:
            continue
        gap2 = 0.0
        for r in range(3):
            gap2 += (xyz[j, r] - xyz[m, r]) ** 2
        far = 4.0 * reach * reach
        # as far from j as m is, or nearly: a triangle that noise cannot turn
        l, _ = _nearest(x, a, start[on], start[on + 1], xyz, azimuth, far, j, 0.25 * gap2)
        if l < 0:
            continue
        d = point_to_plane(x, xyz[j], xyz[l], xyz[m], normal)
        if abs(d) > reach:
            continue
        for r in range(3):
            p[rows, r] = points[i, r]
            c[rows, r] = xyz[j, r]
            u[rows, r] = normal[r]
        sigma[rows], tilt[rows] = 0.05, 2.0 * 0.02**2 / max(gap2, 1e-4)
        feature[rows] = i
        rows += 1
    return rows
