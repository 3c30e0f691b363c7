"""Distances of feature points to lines and planes, and lines and planes through map points.

"Eq." are those of the source paper, which follow Zhang and Singh 2014.
"""

from __future__ import annotations

import numba
import numpy as np

from commonmap.types import Float64s


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def point_to_line(x: Float64s, j: Float64s, l: Float64s) -> float:
    """Return the distance of x to the line through j and l (Eq. 2), metres:

    `d = |(x - j) x (x - l)| / |j - l|`.
    """
    ax, ay, az = x[0] - j[0], x[1] - j[1], x[2] - j[2]
    bx, by, bz = x[0] - l[0], x[1] - l[1], x[2] - l[2]
    cx, cy, cz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    ux, uy, uz = j[0] - l[0], j[1] - l[1], j[2] - l[2]
    return float(
        np.sqrt(cx * cx + cy * cy + cz * cz)
        / max(np.sqrt(ux * ux + uy * uy + uz * uz), 1e-12)
    )  # fmt: skip


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def point_to_plane(x: Float64s, j: Float64s, l: Float64s, m: Float64s, normal: Float64s) -> float:
    """Return the signed distance of x to the plane through j, l, m (Eq. 3) and fill its normal:

    `d = (x - j) . n`, `n = (j - l) x (j - m) / |(j - l) x (j - m)|`; the paper takes |d|.
    """
    ax, ay, az = j[0] - l[0], j[1] - l[1], j[2] - l[2]
    bx, by, bz = j[0] - m[0], j[1] - m[1], j[2] - m[2]
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    length = max(np.sqrt(nx * nx + ny * ny + nz * nz), 1e-12)
    normal[0], normal[1], normal[2] = nx / length, ny / length, nz / length
    return float((x[0] - j[0]) * normal[0] + (x[1] - j[1]) * normal[1] + (x[2] - j[2]) * normal[2])


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def eigen3(S: Float64s, values: Float64s, vectors: Float64s) -> None:
    """Fill the eigenvalues (3,), rising, and eigenvectors (columns of (3, 3)) of a symmetric S.

    Closed form (Smith 1961) for the values, cross products of the rows for the first and the last
    vector, which is exact enough for covariances of points and some five times faster than LAPACK.
    """
    scale = max(abs(S[0, 0]), abs(S[1, 1]), abs(S[2, 2]), 1e-300)
    a, b, c = S[0, 0] / scale, S[1, 1] / scale, S[2, 2] / scale
    d, e, f = S[0, 1] / scale, S[0, 2] / scale, S[1, 2] / scale
    mean = (a + b + c) / 3.0
    off = d * d + e * e + f * f
    p2 = (a - mean) ** 2 + (b - mean) ** 2 + (c - mean) ** 2 + 2.0 * off
    p = np.sqrt(p2 / 6.0)
    if p < 1e-12:
        for r in range(3):
            values[r] = mean * scale
            for k in range(3):
                vectors[r, k] = 1.0 if r == k else 0.0
        return
    x, y, z = (a - mean) / p, (b - mean) / p, (c - mean) / p
    u, v, w = d / p, e / p, f / p
    half = 0.5 * (x * (y * z - w * w) - u * (u * z - w * v) + v * (u * w - y * v))
    phi = np.arccos(min(1.0, max(-1.0, half))) / 3.0
    high = mean + 2.0 * p * np.cos(phi)
    low = mean + 2.0 * p * np.cos(phi + 2.0943951023931953)
    values[0], values[1], values[2] = low * scale, (3.0 * mean - high - low) * scale, high * scale
    _null(a - low, b - low, c - low, d, e, f, vectors, 0)
    _null(a - high, b - high, c - high, d, e, f, vectors, 2)
    along = vectors[0, 0] * vectors[0, 2] + vectors[1, 0] * vectors[1, 2]
    along += vectors[2, 0] * vectors[2, 2]
    length = 0.0
    for r in range(3):
        vectors[r, 2] -= along * vectors[r, 0]
        length += vectors[r, 2] ** 2
    if length < 1e-12:  # low and high vector fell together: any direction across the first
        k = 0
        for r in range(1, 3):
            if abs(vectors[r, 0]) < abs(vectors[k, 0]):
                k = r
        length = 0.0
        for r in range(3):
            vectors[r, 2] = (1.0 if r == k else 0.0) - vectors[k, 0] * vectors[r, 0]
            length += vectors[r, 2] ** 2
    length = np.sqrt(length)
    for r in range(3):
        vectors[r, 2] /= length
    vectors[0, 1] = vectors[1, 2] * vectors[2, 0] - vectors[2, 2] * vectors[1, 0]
    vectors[1, 1] = vectors[2, 2] * vectors[0, 0] - vectors[0, 2] * vectors[2, 0]
    vectors[2, 1] = vectors[0, 2] * vectors[1, 0] - vectors[1, 2] * vectors[0, 0]


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _null(
    a: float, b: float, c: float, d: float, e: float, f: float, vectors: Float64s, column: int
) -> None:
    """Fill a column with the direction that the symmetric matrix (a b c | d e f) takes to zero."""
    # cross products of the rows (a d e), (d b f), (e f c); the longest is the safest
    x0, y0, z0 = d * f - e * b, e * d - a * f, a * b - d * d
    x1, y1, z1 = d * c - e * f, e * e - a * c, a * f - d * e
    x2, y2, z2 = b * c - f * f, f * e - d * c, d * f - b * e
    s0 = x0 * x0 + y0 * y0 + z0 * z0
    s1 = x1 * x1 + y1 * y1 + z1 * z1
    s2 = x2 * x2 + y2 * y2 + z2 * z2
    if s1 > s0 and s1 >= s2:
        x0, y0, z0, s0 = x1, y1, z1, s1
    elif s2 > s0:
        x0, y0, z0, s0 = x2, y2, z2, s2
    if s0 < 1e-24:  # two equal eigenvalues: any direction across the remaining row
        x0, y0, z0 = a, d, e
        if d * d + b * b + f * f > x0 * x0 + y0 * y0 + z0 * z0:
            x0, y0, z0 = d, b, f
        if e * e + f * f + c * c > x0 * x0 + y0 * y0 + z0 * z0:
            x0, y0, z0 = e, f, c
        if abs(x0) <= abs(y0) and abs(x0) <= abs(z0):
            x0, y0, z0 = 0.0, -z0, y0
        elif abs(y0) <= abs(z0):
            x0, y0, z0 = z0, 0.0, -x0
        else:
            x0, y0, z0 = -y0, x0, 0.0
        s0 = x0 * x0 + y0 * y0 + z0 * z0
    length = np.sqrt(s0)
    vectors[0, column], vectors[1, column], vectors[2, column] = (
        x0 / length, y0 / length, z0 / length,
    )  # fmt: skip
