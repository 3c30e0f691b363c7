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


def match_scan_lines(
    points: Float64s, ring: NDArray[np.int64], T: Float64s, before: RingedPoints, reach: float
) -> Rows:
    """Return two rows (Eq. 2) for each edge point that finds a line j, l in the turn before.

    T: (4, 4) takes the points (N, 3) into the frame of `before`. reach: metres.
    """
    out = _scan_lines(
        points, ring, T[:3, :3].copy(), T[:3, 3].copy(), before.xyz, before.azimuth, before.start,
        reach,
    )  # fmt: skip
    return Rows(*out)


def match_scan_planes(
    points: Float64s, ring: NDArray[np.int64], T: Float64s, before: RingedPoints, reach: float
) -> Rows:
    """Return one row (Eq. 3) for each planar point that finds a plane j, l, m."""
    out = _scan_planes(
        points, ring, T[:3, :3].copy(), T[:3, 3].copy(), before.xyz, before.azimuth, before.start,
        reach,
    )  # fmt: skip
    return Rows(*out)


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _nearest(x, azimuth_x, first, last, xyz, azimuth, reach, j, least):  # type: ignore[no-untyped-def]
    """Return (index, squared distance) of the point of one ring nearest to x, within reach.

    j: a point from which it must be at least `sqrt(least)` metres away, or -1.
    """
    n = last - first
    best, at = reach * reach, -1
    if n == 0:
        return at, best
    flat = np.sqrt(x[0] * x[0] + x[1] * x[1])
    window = np.pi if flat <= reach else np.arcsin(reach / flat)
    begin = np.searchsorted(azimuth[first:last], azimuth_x)
    for direction in (1, -1):
        for k in range(n):
            i = begin + k if direction == 1 else begin - 1 - k
            i = first + i % n
            turn = abs(azimuth[i] - azimuth_x)
            turn = min(turn, 2.0 * np.pi - turn)
            # what lies farther round than the best so far cannot be nearer
            if turn > window or (turn < 1.5 and (flat * np.sin(turn)) ** 2 > best):
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
def _scan_lines(points, ring, R, t, xyz, azimuth, start, reach):  # type: ignore[no-untyped-def]
    n, n_rings = points.shape[0], start.shape[0] - 1
    p, c, u = np.empty((2 * n, 3)), np.empty((2 * n, 3)), np.empty((2 * n, 3))
    feature = np.empty(2 * n, np.int64)
    x, e = np.empty(3), np.empty(3)
    rows = 0
    for i in range(n):
        for r in range(3):
            x[r] = R[r, 0] * points[i, 0] + R[r, 1] * points[i, 1] + R[r, 2] * points[i, 2] + t[r]
        a = np.arctan2(x[1], x[0])
        j, best, on = -1, reach * reach, -1
        for k in range(max(0, ring[i] - NEAR_RINGS), min(n_rings, ring[i] + NEAR_RINGS + 1)):
            at, d = _nearest(x, a, start[k], start[k + 1], xyz, azimuth, reach, -1, 0.0)
            if at >= 0 and d < best:
                j, best, on = at, d, k
        if j < 0:
            continue
        l, best = -1, 4.0 * reach * reach
        for k in range(max(0, on - NEAR_RINGS), min(n_rings, on + NEAR_RINGS + 1)):
            if k == on:
                continue
            at, d = _nearest(x, a, start[k], start[k + 1], xyz, azimuth, 2.0 * reach, -1, 0.0)
            if at >= 0 and d < best:
                l, best = at, d
        if l < 0 or point_to_line(x, xyz[j], xyz[l]) > reach:
            continue
        for r in range(3):
            e[r] = xyz[l, r] - xyz[j, r]
        e /= max(np.sqrt((e * e).sum()), 1e-9)
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
            feature[rows] = i
            rows += 1
    return p[:rows], c[:rows], u[:rows], np.full(rows, 0.1), np.zeros(rows), feature[:rows]


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _scan_planes(points, ring, R, t, xyz, azimuth, start, reach):  # type: ignore[no-untyped-def]
    n, n_rings = points.shape[0], start.shape[0] - 1
    p, c, u = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 3))
    sigma, tilt, feature = np.empty(n), np.empty(n), np.empty(n, np.int64)
    x, normal = np.empty(3), np.empty(3)
    rows = 0
    for i in range(n):
        for r in range(3):
            x[r] = R[r, 0] * points[i, 0] + R[r, 1] * points[i, 1] + R[r, 2] * points[i, 2] + t[r]
        a = np.arctan2(x[1], x[0])
        j, best, on = -1, reach * reach, -1
        for k in range(max(0, ring[i] - NEAR_RINGS), min(n_rings, ring[i] + NEAR_RINGS + 1)):
            at, d = _nearest(x, a, start[k], start[k + 1], xyz, azimuth, reach, -1, 0.0)
            if at >= 0 and d < best:
                j, best, on = at, d, k
        if j < 0:
            continue
        m, best = -1, 4.0 * reach * reach
        for k in range(max(0, on - NEAR_RINGS), min(n_rings, on + NEAR_RINGS + 1)):
            if k == on:
                continue
            at, d = _nearest(x, a, start[k], start[k + 1], xyz, azimuth, 2.0 * reach, -1, 0.0)
            if at >= 0 and d < best:
                m, best = at, d
        if m < 0:
            continue
        gap2 = ((xyz[j] - xyz[m]) ** 2).sum()
        # as far from j as m is, or nearly: a triangle that noise cannot turn
        l, _ = _nearest(x, a, start[on], start[on + 1], xyz, azimuth, 2.0 * reach, j, 0.25 * gap2)
        if l < 0:
            continue
        d = point_to_plane(x, xyz[j], xyz[l], xyz[m], normal)
        if abs(d) > reach:
            continue
        for r in range(3):
            p[rows, r] = points[i, r]
            c[rows, r] = xyz[j, r]
            u[rows, r] = normal[r]
        sigma[rows] = 0.05
        tilt[rows] = 2.0 * 0.02**2 / max(gap2, 1e-4)
        feature[rows] = i
        rows += 1
    return p[:rows], c[:rows], u[:rows], sigma[:rows], tilt[:rows], feature[:rows]
