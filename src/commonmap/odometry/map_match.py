"""Edge and planar features against the local map: lines and planes through the points around."""

from __future__ import annotations

import numba
import numpy as np

from commonmap.odometry.distances import eigen3
from commonmap.odometry.local_map import LocalMap, find, pack
from commonmap.odometry.solve import Rows
from commonmap.types import Float64s

LEAST_SIGMA = 0.01
"""Metres; no surface is trusted more than this."""

WIDTH = 0.28
"""A plane's points spread at least so much of a voxel across their longest direction, standard
deviation (a disc of one voxel's radius: 0.5)."""


def match_planes(points: Float64s, T: Float64s, fine: LocalMap, coarse: LocalMap) -> Rows:
    """Return one row (Eq. 3) for each planar point (N, 3) that finds a plane in the map.

    The plane is that of the map's points within one voxel's edge (principal axes); where these lie
    on a line, as the rings of one turn do far away, the coarse map is asked.
    """
    out = _planes(
        points, T[:3, :3].copy(), T[:3, 3].copy(), fine.voxel, fine.keys, fine.count, fine.points,
        fine.table, coarse.voxel, coarse.keys, coarse.count, coarse.points, coarse.table,
    )  # fmt: skip
    return Rows(*out)


def match_lines(points: Float64s, T: Float64s, edges: LocalMap) -> Rows:
    """Return two rows (Eq. 2) for each edge point (N, 3) that finds a line in the map."""
    out = _lines(
        points, T[:3, :3].copy(), T[:3, 3].copy(), edges.voxel, edges.keys, edges.count,
        edges.points, edges.table,
    )  # fmt: skip
    return Rows(*out)


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _gather(x, y, z, edge, keys, count, kept, table, mean, S):  # type: ignore[no-untyped-def]
    """Fill mean (3,) and covariance S (3, 3) of the map's points within one edge of a point;
    return their number."""
    n = 0
    sx = sy = sz = 0.0
    xx = yy = zz = xy = xz = yz = 0.0
    r2 = edge * edge
    i0, j0, k0 = np.int64(np.floor(x / edge)), np.int64(np.floor(y / edge)), np.int64(
        np.floor(z / edge)
    )  # fmt: skip
    for i in range(i0 - 1, i0 + 2):
        bx = max(0.0, max(i * edge - x, x - (i + 1) * edge))
        for j in range(j0 - 1, j0 + 2):
            by = max(0.0, max(j * edge - y, y - (j + 1) * edge))
            for k in range(k0 - 1, k0 + 2):
                bz = max(0.0, max(k * edge - z, z - (k + 1) * edge))
                if bx * bx + by * by + bz * bz >= r2:
                    continue
                voxel, _ = find(pack(i, j, k), keys, table)
                if voxel < 0:
                    continue
                for q in range(count[voxel]):
                    dx = kept[voxel, q, 0] - x
                    dy = kept[voxel, q, 1] - y
                    dz = kept[voxel, q, 2] - z
                    if dx * dx + dy * dy + dz * dz < r2:
                        n += 1
                        sx += dx
                        sy += dy
                        sz += dz
                        xx += dx * dx
                        yy += dy * dy
                        zz += dz * dz
                        xy += dx * dy
                        xz += dx * dz
                        yz += dy * dz
    if n > 0:
        sx, sy, sz = sx / n, sy / n, sz / n
        S[0, 0], S[1, 1], S[2, 2] = xx / n - sx * sx, yy / n - sy * sy, zz / n - sz * sz
        S[0, 1] = S[1, 0] = xy / n - sx * sy
        S[0, 2] = S[2, 0] = xz / n - sx * sz
        S[1, 2] = S[2, 1] = yz / n - sy * sz
        mean[0], mean[1], mean[2] = x + sx, y + sy, z + sz
    return n


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _planes(  # type: ignore[no-untyped-def]
    points, R, t, edge, keys, count, kept, table, edge2, keys2, count2, kept2, table2
):
    """Return p, c, u, sigma, tilt, feature of the rows of planar points."""
    n = points.shape[0]
    p, c, u = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 3))
    sigma, tilt, feature = np.empty(n), np.empty(n), np.empty(n, np.int64)
    S, V, lam, mean = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3)
    rows = 0
    for i in range(n):
        x = R[0, 0] * points[i, 0] + R[0, 1] * points[i, 1] + R[0, 2] * points[i, 2] + t[0]
        y = R[1, 0] * points[i, 0] + R[1, 1] * points[i, 1] + R[1, 2] * points[i, 2] + t[1]
        z = R[2, 0] * points[i, 0] + R[2, 1] * points[i, 1] + R[2, 2] * points[i, 2] + t[2]
        found = False
        for level in range(2):
            if level == 0:
                m = _gather(x, y, z, edge, keys, count, kept, table, mean, S)
            else:
                m = _gather(x, y, z, edge2, keys2, count2, kept2, table2, mean, S)
            if m < 6:
                continue
            eigen3(S, lam, V)
            low = max(lam[0], 0.0) * m / (m - 3.0)
            # a plane: wide both ways, and thin; one ring with the noise of its ranges is a
            # false plane, spanned by the ring and the beam, that would hold the sensor back
            wide = WIDTH * (edge if level == 0 else edge2)
            if lam[1] > wide * wide and lam[1] > 0.05 * lam[2] and lam[1] > 5.0 * low:
                found = True
                break
        if not found:
            continue
        a = b = 0.0
        for r in range(3):
            q = (x if r == 0 else (y if r == 1 else z)) - mean[r]
            a += q * V[r, 1]
            b += q * V[r, 2]
            p[rows, r] = points[i, r]
            c[rows, r] = mean[r]
            u[rows, r] = V[r, 0]
        own = low + LEAST_SIGMA * LEAST_SIGMA
        leverage = 1.0 + a * a / lam[1] + b * b / lam[2]
        sigma[rows] = np.sqrt(own * (1.0 + leverage / m))
        tilt[rows] = own / m * (0.5 / lam[1] + 0.5 / lam[2])
        feature[rows] = i
        rows += 1
    return p[:rows], c[:rows], u[:rows], sigma[:rows], tilt[:rows], feature[:rows]


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _lines(points, R, t, edge, keys, count, kept, table):  # type: ignore[no-untyped-def]
    """Return p, c, u, sigma, tilt, feature of the rows of edge points, two rows a line."""
    n = points.shape[0]
    p, c, u = np.empty((2 * n, 3)), np.empty((2 * n, 3)), np.empty((2 * n, 3))
    sigma, tilt, feature = np.empty(2 * n), np.empty(2 * n), np.empty(2 * n, np.int64)
    S, V, lam, mean = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3)
    rows = 0
    for i in range(n):
        x = R[0, 0] * points[i, 0] + R[0, 1] * points[i, 1] + R[0, 2] * points[i, 2] + t[0]
        y = R[1, 0] * points[i, 0] + R[1, 1] * points[i, 1] + R[1, 2] * points[i, 2] + t[1]
        z = R[2, 0] * points[i, 0] + R[2, 1] * points[i, 1] + R[2, 2] * points[i, 2] + t[2]
        m = _gather(x, y, z, edge, keys, count, kept, table, mean, S)
        if m < 5:
            continue
        eigen3(S, lam, V)
        if lam[2] < 5.0 * lam[1]:
            continue
        along = 0.0
        for r in range(3):
            along += ((x if r == 0 else (y if r == 1 else z)) - mean[r]) * V[r, 2]
        for k in range(2):
            own = max(lam[k], 0.0) * m / (m - 2.0) + LEAST_SIGMA * LEAST_SIGMA
            for r in range(3):
                p[rows, r] = points[i, r]
                c[rows, r] = mean[r]
                u[rows, r] = V[r, k]
            sigma[rows] = np.sqrt(own * (1.0 + (1.0 + along * along / lam[2]) / m))
            tilt[rows] = own / m / lam[2]
            feature[rows] = i
        rows += 1
    return p[:rows], c[:rows], u[:rows], sigma[:rows], tilt[:rows], feature[:rows]
