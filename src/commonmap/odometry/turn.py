"""One turn of a lidar in the order odometry needs it: ring by ring, along each ring by time."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from commonmap.types import Float32s, Float64s, Scan

MIN_RANGE = 0.3
"""Metres; nearer returns are the robot itself."""


@dataclass(frozen=True, eq=False)
class Turn:
    """Returns of one turn, sorted by ring and, within a ring, by time.

    xyz: (N, 3) float32, sensor frame of each point's moment. range, azimuth: (N,) float32.
    delay: (N,) float64 seconds from `moment` to the point's time. ring: (N,).
    ring_start: (R + 1,) first point of each ring. source: (N,) the point's index in the scan.
    moment: seconds, the mean time of the points: the moment the turn's pose is for.
    spacing: radians between neighbours on a ring, the median.
    """

    xyz: Float32s
    range: Float32s
    azimuth: Float32s
    delay: Float64s
    ring: NDArray[np.int64]
    ring_start: NDArray[np.int64]
    source: NDArray[np.int64]
    moment: float
    spacing: float

    @property
    def n_rings(self) -> int:
        """Number of rings, empty ones included."""
        return len(self.ring_start) - 1


def arrange(scan: Scan) -> Turn:
    """Return the scan as a turn: without points that are not finite or nearer than 0.3 m, and
    without second returns of a firing (the first in the scan's order stays)."""
    time, ring = np.asarray(scan.time, np.float64), np.asarray(scan.ring, np.int64)
    xyz = np.ascontiguousarray(scan.xyz, np.float32)
    n_rings = int(ring.max()) + 1 if len(ring) else 0
    order, is_sorted = _order(ring, time, xyz, MIN_RANGE * MIN_RANGE, n_rings)
    if not is_sorted:
        order = order[np.lexsort((time[order], ring[order]))]
    out = _collect(ring, time, xyz, order, n_rings)
    points, range_, azimuth, delay, ring, ring_start, source, moment = out
    return Turn(
        points, range_, azimuth, delay, ring, ring_start, source,
        moment if len(order) else float(scan.stamp), _spacing(azimuth, ring_start),
    )  # fmt: skip


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _order(
    ring: NDArray[np.int64], time: Float64s, xyz: Float32s, nearest: float, n_rings: int
) -> tuple[NDArray[np.int64], bool]:
    """Return the indices of usable points by ring, else in the order they came (counting sort),
    and whether they are by time on each ring."""
    count = np.zeros(n_rings + 1, np.int64)
    usable = np.zeros(len(ring), np.bool_)
    last = np.full(n_rings + 1, -np.inf)
    is_sorted = True
    for i in range(len(ring)):
        square = xyz[i, 0] * xyz[i, 0] + xyz[i, 1] * xyz[i, 1] + xyz[i, 2] * xyz[i, 2]
        if square >= nearest and square < 1e8:  # NaN and infinity fail
            usable[i] = True
            count[ring[i] + 1] += 1
            is_sorted = is_sorted and time[i] >= last[ring[i]]
            last[ring[i]] = time[i]
    at = np.cumsum(count)
    order = np.empty(at[-1], np.int64)
    for i in range(len(ring)):
        if usable[i]:
            order[at[ring[i]]] = i
            at[ring[i]] += 1
    return order, is_sorted


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _collect(  # type: ignore[no-untyped-def]
    ring, time, xyz, order, n_rings
):
    """Return xyz, range, azimuth, delay, ring, ring_start, source and moment of a turn."""
    n = 0
    kept = np.empty(len(order), np.int64)
    start = np.zeros(n_rings + 1, np.int64)
    moment = 0.0
    for k in range(len(order)):
        i = order[k]
        if k > 0 and ring[i] == ring[order[k - 1]] and time[i] == time[order[k - 1]]:
            continue
        kept[n] = i
        n += 1
        start[ring[i] + 1] += 1
        moment += time[i] - time[order[0]]
    moment = moment / max(n, 1) + (time[order[0]] if n else 0.0)
    points, range_ = np.empty((n, 3), np.float32), np.empty(n, np.float32)
    azimuth, delay, on = np.empty(n, np.float32), np.empty(n), np.empty(n, np.int64)
    for k in range(n):
        i = kept[k]
        x, y, z = xyz[i, 0], xyz[i, 1], xyz[i, 2]
        points[k, 0], points[k, 1], points[k, 2] = x, y, z
        range_[k], azimuth[k] = np.sqrt(x * x + y * y + z * z), np.arctan2(y, x)
        delay[k], on[k] = time[i] - moment, ring[i]
    return points, range_, azimuth, delay, on, np.cumsum(start), kept[:n], moment


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def select(
    xyz: Float32s, delay: Float64s, ring: NDArray[np.int64], chosen: NDArray[np.int64]
) -> tuple[Float64s, Float64s, NDArray[np.int64]]:
    """Return xyz as float64, delay and ring of some points."""
    n = len(chosen)
    points, delays, rings = np.empty((n, 3)), np.empty(n), np.empty(n, np.int64)
    for k in range(n):
        i = chosen[k]
        points[k, 0], points[k, 1], points[k, 2] = xyz[i, 0], xyz[i, 1], xyz[i, 2]
        delays[k], rings[k] = delay[i], ring[i]
    return points, delays, rings


def _spacing(azimuth: Float32s, start: NDArray[np.int64]) -> float:
    """Return the median angle between neighbours of a ring, radians."""
    if len(azimuth) < 2:
        return 2 * np.pi / 1000
    step = np.abs(np.diff(azimuth))
    inner = start[1:-1]
    inner = inner[(inner > 0) & (inner < len(azimuth))]
    step[inner - 1] = np.nan
    step = step[np.isfinite(step) & (step > 1e-6) & (step < 0.1)]
    if not len(step):
        return 2 * np.pi / 1000
    return float(np.median(step[:: max(1, len(step) // 4000)]))
