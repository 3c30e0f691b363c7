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

ROUGH = 1.3
"""A plane's points spread at least so many times more within it than across it, in variance."""


def match_map(
    points: Float64s, n_planar: int, T: Float64s, fine: LocalMap, coarse: LocalMap, edges: LocalMap
) -> Rows:
    """Return the rows of planar points and, behind them, of edge points that find their like.

    points: (N, 3), the first `n_planar` of them planar.

    - One row (Eq. 3) for each planar point that finds a plane: that of the map's points in the
      voxels around whose middle lies within one edge (principal axes); where these lie on a line,
      as the rings of one turn do far away, the coarse map is asked.
    - Two rows (Eq. 2) for each edge point that finds a line.
    """
    rows = Rows.room(2 * len(points) - n_planar)
    R, t = np.ascontiguousarray(T[:3, :3]), T[:3, 3].copy()
    end = _planes(
        points[:n_planar], R, t, fine.voxel, fine.keys, fine.count, fine.sums, fine.table,
        coarse.voxel, coarse.keys, coarse.count, coarse.sums, coarse.table, *rows.arrays,
    )  # fmt: skip
    end = _lines(
        points, n_planar, end, R, t, edges.voxel, edges.keys, edges.count, edges.sums, edges.table,
        *rows.arrays,
    )  # fmt: skip
    return rows.head(end)


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _gather(x, y, z, edge, keys, count, sums, table, mean, S):  # type: ignore[no-untyped-def]
    """Fill mean (3,) and covariance S (3, 3) of the points of the voxels around (x, y, z) whose
    middle lies within one edge of it; return their number."""
    n = 0
    sx = sy = sz = 0.0
    xx = yy = zz = xy = xz = yz = 0.0
    r2 = edge * edge
    i0, j0, k0 = np.int64(np.floor(x / edge)), np.int64(np.floor(y / edge)), np.int64(
        np.floor(z / edge)
    )  # fmt: skip
    half = 0.5 * edge
    for i in range(i0 - 1, i0 + 2):
        bx = (i + 0.5) * edge - x
        gx = max(0.0, abs(bx) - half)
        for j in range(j0 - 1, j0 + 2):
            by = (j + 0.5) * edge - y
            gy = max(0.0, abs(by) - half)
            for k in range(k0 - 1, k0 + 2):
                bz = (k + 0.5) * edge - z
                gz = max(0.0, abs(bz) - half)
                if gx * gx + gy * gy + gz * gz > r2:  # all of the voxel lies farther
                    continue
                voxel, _ = find(pack(i, j, k), keys, table)
                if voxel < 0:
                    continue
                m = count[voxel]
                ax, ay, az = sums[voxel, 0], sums[voxel, 1], sums[voxel, 2]
                if (ax / m + bx) ** 2 + (ay / m + by) ** 2 + (az / m + bz) ** 2 > r2:
                    continue
                n += m
                sx += ax + m * bx
                sy += ay + m * by
                sz += az + m * bz
                xx += sums[voxel, 3] + bx * (2.0 * ax + m * bx)
                yy += sums[voxel, 4] + by * (2.0 * ay + m * by)
                zz += sums[voxel, 5] + bz * (2.0 * az + m * bz)
                xy += sums[voxel, 6] + bx * ay + by * ax + m * bx * by
                xz += sums[voxel, 7] + bx * az + bz * ax + m * bx * bz
                yz += sums[voxel, 8] + by * az + bz * ay + m * by * bz
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
    points, R, t, edge, keys, count, sums, table, edge2, keys2, count2, sums2, table2, p, c, u,
    sigma, tilt, feature,
):  # fmt: skip
    """Fill the rows of planar points from the first on; return their number."""
    n = points.shape[0]
    S, V, lam, mean = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3)
    rows = 0
    for i in range(n):
        x = R[0, 0] * points[i, 0] + R[0, 1] * points[i, 1] + R[0, 2] * points[i, 2] + t[0]
        y = R[1, 0] * points[i, 0] + R[1, 1] * points[i, 1] + R[1, 2] * points[i, 2] + t[1]
        z = R[2, 0] * points[i, 0] + R[2, 1] * points[i, 1] + R[2, 2] * points[i, 2] + t[2]
        found = False
        for level in range(2):
            if level == 0:
                m = _gather(x, y, z, edge, keys, count, sums, table, mean, S)
            else:
                m = _gather(x, y, z, edge2, keys2, count2, sums2, table2, mean, S)
            if m < 6:
                continue
            eigen3(S, lam, V)
            low = max(lam[0], 0.0) * m / (m - 3.0)
            # a plane: wide both ways; one ring with the noise of its ranges is a false plane,
            # spanned by the ring and the beam, that would hold the sensor back. A rough one, as of
            # a canopy, counts for what its roughness leaves
            wide = WIDTH * (edge if level == 0 else edge2)
            if lam[1] > wide * wide and lam[1] > 0.05 * lam[2] and lam[1] > ROUGH * low:
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
    return rows


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _lines(  # type: ignore[no-untyped-def]
    points, first, rows, R, t, edge, keys, count, sums, table, p, c, u, sigma, tilt, feature
):
    """Fill the rows of edge points from `first` on, two a line, behind `rows`; return the end."""
    S, V, lam, mean = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3)
    for i in range(first, points.shape[0]):
        x = R[0, 0] * points[i, 0] + R[0, 1] * points[i, 1] + R[0, 2] * points[i, 2] + t[0]
        y = R[1, 0] * points[i, 0] + R[1, 1] * points[i, 1] + R[1, 2] * points[i, 2] + t[1]
        z = R[2, 0] * points[i, 0] + R[2, 1] * points[i, 1] + R[2, 2] * points[i, 2] + t[2]
        m = _gather(x, y, z, edge, keys, count, sums, table, mean, S)
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
    return rows
