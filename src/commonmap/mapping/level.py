"""Which way is up, for maps that do not know gravity.

Walls, posts and stems stand upright on any slope. Seen along the true vertical they shrink to lines
and dots, so the up direction is the one along which the plan of everything above ground is most
concentrated: most pairs of points share a cell of the plan. The ground only says roughly where up
is, never exactly: a map of a hillside stays a hillside. How far the verdicts of the map's parts
scatter says how far the whole is to be trusted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np

from commonmap.frames import apply, from_rotation, rotation_between
from commonmap.mapping.ground import find_ground
from commonmap.mapping.points import bounds, first_of_voxels, floor_int, move, rows_of, sample
from commonmap.types import Float64s

MAX_SIGMA = math.radians(2.0)
"""Where the parts of a map disagree by more than this (standard error), nothing upright told."""

FINEST_STEP = math.radians(0.5)
"""The last grid of directions is this fine or finer; a paraboloid through it gives the answer."""

MOST_POINTS = 600_000
"""Points that are looked at, at even steps through the cloud."""

MOST_COARSE = 15_000
"""Points above ground that are looked at while the plan's cells are still wide."""

MOST_OF_PART = 2_000
"""Points above ground that are looked at of each part of the map."""

PRIOR_TILT = math.radians(1.5)
"""How far from level a map is expected to be that says it is (standard deviation)."""


@dataclass(frozen=True, eq=False)
class Levelling:
    """T_level_map: (4, 4) rotation about the origin that makes the map level.

    tilt: radians, of the correction. sigma: radians, standard error of the up direction that the
    upright things give, infinite where there are none. reason: one sentence for the report.
    """

    T_level_map: Float64s
    tilt: float
    sigma: float
    reason: str


def no_levelling(reason: str) -> Levelling:
    """Return the levelling that changes nothing, with its reason."""
    return Levelling(np.eye(4), 0.0, math.inf, reason)


def find_level(xyz: Float64s) -> Levelling:
    """Return the rotation that makes an (N, 3) cloud level, identity where nothing upright tells.

    A tilt that is not three times as large as its own standard error is only partly believed
    (weighed against `PRIOR_TILT`). Deterministic.
    """
    if len(xyz) < 200:
        return no_levelling("too few points to tell which way is up")
    centred = sample(xyz, MOST_POINTS)
    centred = move(from_rotation(np.eye(3), -np.median(sample(centred, 20_000), axis=0)), centred)

    # Roughly up: the map's own z, unless another direction has ground under everything
    up, own = _rough_up(centred)
    R_rough = rotation_between(up, (0.0, 0.0, 1.0))

    # Exactly up: the direction along which what stands above ground makes the sharpest plan
    standing = _standing(centred if own else move(from_rotation(R_rough), centred))
    a, b, sigma = 0.0, 0.0, math.inf
    if len(standing) >= 500:
        a, b = _sharpest(standing, 0.0, 0.0, math.radians(12.0 if own else 30.0), peak_only=True)
        sigma = math.inf if math.isnan(a) else _scatter_of_parts(standing, a, b)
    tilt = math.hypot(a, b)
    trust = 1.0 if tilt > 3.0 * sigma else 1.0 / (1.0 + (sigma / PRIOR_TILT) ** 2)
    if sigma > (MAX_SIGMA if own else 2.0 * MAX_SIGMA):
        a, b, sigma, trust = 0.0, 0.0, math.inf, 0.0
    direction = np.array([math.tan(trust * a), math.tan(trust * b), 1.0]) @ R_rough
    R = rotation_between(direction, (0.0, 0.0, 1.0))
    tilt = math.acos(min(1.0, direction[2] / float(np.linalg.norm(direction))))
    if own and trust == 0.0:
        return no_levelling("nothing upright was found; the map's own z is taken as up")
    how = (
        f"upright things agree within {math.degrees(sigma):.2f} deg"
        if trust > 0.0
        else "the ground lies below; nothing upright was found"
    )
    return Levelling(
        from_rotation(R), tilt, sigma, f"turned by {math.degrees(tilt):.2f} deg: {how}"
    )


def _standing(xyz: Float64s) -> Float64s:
    """Return one point per voxel of what stands over half a metre above ground, at most 60,000."""
    ground = find_ground(xyz)
    above = rows_of(xyz, ground.height_above(xyz) > 0.5)
    if len(above) == 0:
        return above
    # voxels that lay on the plan's own cells would favour the map's own z
    thin = above[first_of_voxels(above - bounds(above)[0], 0.1)]
    return np.ascontiguousarray(thin[:: len(thin) // 60_000 + 1])


def _sharpest(
    xyz: Float64s, a: float, b: float, width: float, *, peak_only: bool = False
) -> tuple[float, float]:
    """Return the tilts (a, b) in radians of the line of sight of the sharpest plan.

    peak_only: return NaN where the sharpest lies on the border of what was looked at. On wide cells
    `MOST_COARSE` of the points tell where it is; all of them do on the finest.
    """
    some = sample(xyz, MOST_COARSE)
    height = max(float(np.ptp(np.quantile(sample(xyz, 10_000)[:, 2], [0.05, 0.95]))), 1.0)
    cell = max(0.6, width * height / 16.0)
    finest = max(0.1, math.radians(0.2) * height)
    while True:
        n_side = 2 * min(8, max(2, math.ceil(width * height / cell))) + 1
        steps = np.linspace(-width, width, n_side)
        step = float(steps[1] - steps[0])
        score = _shared_pairs(xyz if cell <= finest else some, a + steps, b + steps, cell)
        i, j = np.unravel_index(int(np.argmax(score)), score.shape)
        if peak_only and (min(i, j) == 0 or max(i, j) == n_side - 1):
            return math.nan, math.nan  # no peak within reach, only a trend
        peak_only = False
        if cell <= finest and step <= FINEST_STEP:
            off_a, off_b = _top_of(steps, score)
            return a + off_a, b + off_b
        a, b = a + float(steps[i]), b + float(steps[j])
        # Low things come to the finest cell early: then only the angles go on narrowing
        width = step if cell <= finest else 1.5 * step
        cell = max(0.5 * cell, finest)


def _top_of(steps: Float64s, score: Float64s) -> tuple[float, float]:
    """Return where a paraboloid fitted to a square grid of scores peaks, kept within the grid."""
    x, y = (g.ravel() for g in np.meshgrid(steps, steps, indexing="ij"))
    s = steps[-1]
    A = np.column_stack([np.ones(x.size), x / s, y / s, (x / s) ** 2, x * y / s**2, (y / s) ** 2])
    _, p, q, u, v, w = np.linalg.lstsq(A, score.ravel() / score.max(), rcond=None)[0]
    determinant = 4.0 * u * w - v * v
    if u >= 0.0 or determinant <= 0.0:
        i, j = np.unravel_index(int(np.argmax(score)), score.shape)
        return float(steps[i]), float(steps[j])
    top_a, top_b = (v * q - 2.0 * w * p) / determinant, (v * p - 2.0 * u * q) / determinant
    return float(s * np.clip(top_a, -1.0, 1.0)), float(s * np.clip(top_b, -1.0, 1.0))


def _scatter_of_parts(xyz: Float64s, a: float, b: float) -> float:
    """Return the standard error in radians of (a, b), from what each part of the map says alone."""
    low, high = np.quantile(sample(xyz, 10_000)[:, :2], [0.02, 0.98], axis=0)
    size = float((high - low).max()) / 4.0
    ij = np.floor((xyz[:, :2] - low) / max(size, 1e-6)).astype(np.int64)
    part = ij[:, 0] * 64 + ij[:, 1]
    found = []
    for p in np.unique(part):
        inside = xyz[part == p]
        if len(inside) >= 300:
            found.append(_sharpest(sample(inside, MOST_OF_PART), a, b, math.radians(4.0)))
    if len(found) < 3:
        return math.inf
    off = np.array(found) - np.array([a, b])
    spread = 1.4826 * np.median(np.abs(off), axis=0)
    # Few parts estimate their own spread badly: half as much again (Student's t, three parts up)
    return 1.5 * float(np.linalg.norm(np.maximum(spread, 1e-3)) / math.sqrt(len(found)))


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _shared_pairs(xyz, lines_a, lines_b, cell):  # type: ignore[no-untyped-def]
    """Return how many pairs of points share a plan cell, seen along each direction (a, b, 1).

    xyz: (N, 3) metres, N < 2^16. lines_a, lines_b: radians, a and b of a grid of directions.
    Counted on two grids half a cell apart: a wall on a border of one is within a cell of the other.
    """
    n = xyz.shape[0]
    i, n_i = _plan_cells(xyz, 0, lines_a, cell)
    j, n_j = _plan_cells(xyz, 1, lines_b, cell)
    count = np.empty(n_i * n_j, np.uint16)
    pairs = np.zeros((lines_a.shape[0], lines_b.shape[0]))
    for p in range(lines_a.shape[0]):
        for q in range(lines_b.shape[0]):
            total = 0
            for shift in range(2):
                count[:] = 0
                for k in range(n):
                    place = i[p, shift, k] * n_j + j[q, shift, k]
                    total += count[place]
                    count[place] += np.uint16(1)
            pairs[p, q] = total
    return pairs


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _plan_cells(xyz, axis, lines, cell):  # type: ignore[no-untyped-def]
    """Return the cells (n_lines, 2, N) along an axis of the plan, on both grids, and their number.

    At most 1024 cells along a side: what lies further apart is folded onto them.
    """
    out = np.empty((lines.shape[0], 2, xyz.shape[0]), np.int32)
    span, scale = 0.0, 1.0 / cell
    for p in range(lines.shape[0]):
        slope, low, high = np.tan(lines[p]), np.inf, -np.inf
        for k in range(xyz.shape[0]):
            x = xyz[k, axis] - slope * xyz[k, 2]
            low, high = min(low, x), max(high, x)
            at = x * scale
            out[p, 0, k] = np.int32(floor_int(at))
            out[p, 1, k] = np.int32(floor_int(at + 0.5))
        span = max(span, high - low)
    n = 64
    while n < 1024 and n * cell < span + 2.0 * cell:
        n *= 2
    out &= np.int32(n - 1)
    return out, n


def _rough_up(xyz: Float64s) -> tuple[Float64s, bool]:
    """Return (up, whether it is the map's own z): the direction with smooth ground below it all.

    The map's own z stays unless another direction has twice as much of it.
    """
    points = sample(xyz, 100_000)
    low, high = np.quantile(sample(points, 10_000), [0.01, 0.99], axis=0)
    size = max(float((high - low).max()) / 40.0, 0.25)
    own = np.array([0.0, 0.0, 1.0])
    own_share = _smooth_share(points, np.eye(3), size)
    best, best_share = own, max(2.0 * own_share, 0.15)
    if own_share > 0.4:
        return own, True
    for up in _directions(200):
        if up[2] > math.cos(math.radians(20.0)):
            continue
        share = _smooth_share(points, rotation_between(up, (0.0, 0.0, 1.0)), size)
        if share > best_share:
            best, best_share = up, share
    return best, best is own


def _directions(n: int) -> Float64s:
    """Return n unit vectors evenly over the sphere (the golden spiral)."""
    k = np.arange(n) + 0.5
    z = 1.0 - 2.0 * k / n
    turn = np.pi * (1.0 + math.sqrt(5.0)) * k
    r = np.sqrt(1.0 - z**2)
    return np.column_stack([r * np.cos(turn), r * np.sin(turn), z])


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _smooth_share(xyz, R, size):  # type: ignore[no-untyped-def]
    """Return the share of columns whose lowest point goes on straight from neighbour to neighbour.

    Straight: the second difference along x or y is under a fifth of the column's width, and the
    slope under 40 degrees.
    """
    n = 256
    z = np.full((n, n), np.inf)
    for k in range(xyz.shape[0]):
        x = R[0, 0] * xyz[k, 0] + R[0, 1] * xyz[k, 1] + R[0, 2] * xyz[k, 2]
        y = R[1, 0] * xyz[k, 0] + R[1, 1] * xyz[k, 1] + R[1, 2] * xyz[k, 2]
        h = R[2, 0] * xyz[k, 0] + R[2, 1] * xyz[k, 1] + R[2, 2] * xyz[k, 2]
        i, j = floor_int(x / size) + n // 2, floor_int(y / size) + n // 2
        if 0 <= i < n and 0 <= j < n and h < z[i, j]:
            z[i, j] = h
    columns, smooth = 0, 0
    for i in range(1, n - 1):
        for j in range(1, n - 1):
            if not np.isfinite(z[i, j]):
                continue
            columns += 1
            a = np.isfinite(z[i - 1, j]) and np.isfinite(z[i + 1, j])
            b = np.isfinite(z[i, j - 1]) and np.isfinite(z[i, j + 1])
            if (
                a
                and b
                and abs(z[i - 1, j] - 2.0 * z[i, j] + z[i + 1, j]) < 0.2 * size
                and abs(z[i, j - 1] - 2.0 * z[i, j] + z[i, j + 1]) < 0.2 * size
                and abs(z[i + 1, j] - z[i - 1, j]) < 1.7 * size
                and abs(z[i, j + 1] - z[i, j - 1]) < 1.7 * size
            ):
                smooth += 1
    return smooth / max(columns, 1)


def apply_level(levelling: Levelling, xyz: Float64s) -> Float64s:
    """Return the (N, 3) points in the level frame."""
    return apply(levelling.T_level_map, xyz)
