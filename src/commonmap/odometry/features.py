"""Edge and planar points of a turn (Zhang and Singh 2014, section V-A), in Numba kernels.

A turn is cut into equal sectors a ring. In each the roughest points are edges, the smoothest are
planar; neighbours of a chosen point are not chosen again; points at the rim of an occlusion and on
surfaces nearly parallel to the beam are excluded.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from commonmap.odometry.turn import Turn
from commonmap.types import Bools, Float32s

SECTORS = 6
"""Sectors a ring. The four numbers below are per sector."""
SHARP, LESS_SHARP, FLAT = 2, 20, 4
WINDOW = np.radians(1.0)
"""Radians to either side in which neighbours on the ring are taken."""
OCCLUSION = 0.1
"""A neighbour farther by this share of the range is behind the nearer one, not beside it."""
GRAZING = 0.02
"""Steps of range to both sides above this share of it mean a surface along the beam."""

PLAIN, LESS, BEST = 0, 1, 2


@dataclass(frozen=True, eq=False)
class Features:
    """Chosen points of a turn, as indices into its arrays, rising.

    sharp, less_sharp: edges; the first are among the second. flat: the smoothest points of each
    sector. smooth: every point that is neither edge nor excluded.
    """

    sharp: NDArray[np.intp]
    less_sharp: NDArray[np.intp]
    flat: NDArray[np.intp]
    smooth: NDArray[np.intp]


def neighbours_each_side(spacing: float) -> int:
    """Return how many neighbours on either side to use, from the angle between points (radians)."""
    return int(np.clip(round(WINDOW / max(spacing, 1e-6)), 3, 10))


def pick_features(turn: Turn) -> Features:
    """Return the edge and planar points of a turn."""
    half = neighbours_each_side(turn.spacing)
    kappa = roughness(turn.xyz, turn.range, turn.ring_start, half)
    excluded = exclude(turn.range, turn.azimuth, turn.ring_start, half, turn.spacing)
    floor = noise_floor(kappa, turn.range)
    edge, plane = choose(kappa, turn.range, excluded, turn.ring_start, half, floor)
    return Features(
        sharp=np.flatnonzero(edge == BEST),
        less_sharp=np.flatnonzero(edge >= LESS),
        flat=np.flatnonzero(plane == BEST),
        smooth=np.flatnonzero(plane >= LESS),
    )


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def roughness(
    xyz: Float32s, range_: Float32s, ring_start: NDArray[np.int64], half: int
) -> Float32s:
    """Return the roughness of each point among its neighbours on the ring (Eq. 1), (N,):

    `kappa_i = |sum_j (X_i - X_j)| / (|G| |X_i|)`, G the `half` neighbours on either side; NaN for
    points too near the end of a ring to have them all.
    """
    kappa = np.full(xyz.shape[0], np.nan, np.float32)
    for ring in range(ring_start.shape[0] - 1):
        first, last = ring_start[ring], ring_start[ring + 1]
        if last - first < 2 * half + 1:
            continue
        sx = sy = sz = 0.0
        for i in range(first, first + 2 * half + 1):
            sx += xyz[i, 0]
            sy += xyz[i, 1]
            sz += xyz[i, 2]
        n = 2 * half + 1
        for i in range(first + half, last - half):
            if i > first + half:
                new, old = i + half, i - half - 1
                sx += np.float64(xyz[new, 0]) - xyz[old, 0]
                sy += np.float64(xyz[new, 1]) - xyz[old, 1]
                sz += np.float64(xyz[new, 2]) - xyz[old, 2]
            dx, dy, dz = n * xyz[i, 0] - sx, n * xyz[i, 1] - sy, n * xyz[i, 2] - sz
            kappa[i] = np.sqrt(dx * dx + dy * dy + dz * dz) / (2 * half * range_[i])
    return kappa


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def exclude(
    range_: Float32s, azimuth: Float32s, ring_start: NDArray[np.int64], half: int, spacing: float
) -> Bools:
    """Return which points are unfit (N,): behind the rim of an occlusion, or on a surface nearly
    parallel to the beam (Zhang and Singh 2014, Fig. 4)."""
    out = np.zeros(range_.shape[0], np.bool_)
    for ring in range(ring_start.shape[0] - 1):
        first, last = ring_start[ring], ring_start[ring + 1]
        for i in range(first, last - 1):
            gap = abs(azimuth[i + 1] - azimuth[i])
            if min(gap, 2.0 * np.pi - gap) > 4.0 * spacing:
                continue
            a, b = range_[i], range_[i + 1]
            if b - a > OCCLUSION * b:  # the next ones are behind: their rim moves with the viewer
                for j in range(i + 1, min(last, i + 1 + half)):
                    out[j] = True
            elif a - b > OCCLUSION * a:
                for j in range(max(first, i + 1 - half), i + 1):
                    out[j] = True
        for i in range(first + 1, last - 1):
            limit = GRAZING * range_[i]
            if abs(range_[i - 1] - range_[i]) > limit and abs(range_[i + 1] - range_[i]) > limit:
                out[i] = True
    return out


def noise_floor(kappa: Float32s, range_: Float32s) -> float:
    """Return the roughness times range, metres, that the range noise alone gives: the median over
    the smoother half of the points."""
    step = max(1, len(kappa) // 4000)
    metres = kappa[::step] * range_[::step]
    metres = metres[np.isfinite(metres)]
    if not len(metres):
        return 0.01
    return max(float(np.partition(metres, len(metres) // 4)[len(metres) // 4]), 1e-4)


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def choose(
    kappa: Float32s, range_: Float32s, excluded: Bools, ring_start: NDArray[np.int64], half: int,
    floor: float,
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:  # fmt: skip
    """Return the grade of each point as an edge and as a plane, (N,): PLAIN, LESS or BEST.

    An edge is rougher than eight times the noise floor (metres of roughness times range), a planar
    point smoother than four times; between them lies nothing that is sure to be either.
    """
    n = kappa.shape[0]
    edge, plane = np.zeros(n, np.uint8), np.zeros(n, np.uint8)
    taken = np.zeros(n, np.bool_)
    for ring in range(ring_start.shape[0] - 1):
        first, last = ring_start[ring] + half, ring_start[ring + 1] - half
        if last <= first:
            continue
        for sector in range(SECTORS):
            a = first + (last - first) * sector // SECTORS
            b = first + (last - first) * (sector + 1) // SECTORS
            for pick in range(LESS_SHARP):
                best, at = np.float32(0.0), -1
                for i in range(a, b):
                    if kappa[i] > best and not taken[i] and not excluded[i]:
                        best, at = kappa[i], i
                if at < 0 or best * range_[at] < 8.0 * floor:
                    break
                edge[at] = BEST if pick < SHARP else LESS
                for j in range(max(a, at - half), min(b, at + half + 1)):
                    taken[j] = True
            for _ in range(FLAT):
                low, at = np.float32(np.inf), -1
                for i in range(a, b):
                    if kappa[i] < low and not taken[i] and not excluded[i]:
                        low, at = kappa[i], i
                if at < 0 or low * range_[at] > 4.0 * floor:
                    break
                plane[at] = BEST
                for j in range(max(a, at - half), min(b, at + half + 1)):
                    taken[j] = True
            for i in range(a, b):
                rough = kappa[i] * range_[i]
                if plane[i] == PLAIN and edge[i] == PLAIN and not excluded[i] and rough < 8 * floor:
                    plane[i] = LESS
    return edge, plane
