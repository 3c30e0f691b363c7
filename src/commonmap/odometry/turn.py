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
    delay: (N,) float64 seconds from `moment` to the point's time.
    ring_start: (R + 1,) first point of each ring. source: (N,) the point's index in the scan.
    moment: seconds, the mean time of the points: the moment the turn's pose is for.
    spacing: radians between neighbours on a ring, the median.
    """

    xyz: Float32s
    range: Float32s
    azimuth: Float32s
    delay: Float64s
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
    order = _order(ring, xyz, MIN_RANGE * MIN_RANGE, n_rings)
    if not _is_sorted(ring, time, order):
        order = order[np.lexsort((time[order], ring[order]))]
    order = order[_first_returns(ring, time, order)]
    start = np.zeros(n_rings + 1, np.int64)
    np.cumsum(np.bincount(ring[order], minlength=n_rings), out=start[1:])
    moment = float(time[order].mean()) if len(order) else float(scan.stamp)
    xyz = xyz[order]
    range_, azimuth = _polar(xyz)
    return Turn(
        xyz=xyz, range=range_, azimuth=azimuth, delay=time[order] - moment, ring_start=start,
        source=order, moment=moment, spacing=_spacing(azimuth, start),
    )  # fmt: skip


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _order(
    ring: NDArray[np.int64], xyz: Float32s, nearest: float, n_rings: int
) -> NDArray[np.int64]:
    """Return the indices of usable points by ring, else in the order they came (counting sort)."""
    count = np.zeros(n_rings + 1, np.int64)
    usable = np.zeros(len(ring), np.bool_)
    for i in range(len(ring)):
        square = xyz[i, 0] * xyz[i, 0] + xyz[i, 1] * xyz[i, 1] + xyz[i, 2] * xyz[i, 2]
        if square >= nearest and square < 1e8:  # NaN and infinity fail
            usable[i] = True
            count[ring[i] + 1] += 1
    at = np.cumsum(count)
    order = np.empty(at[-1], np.int64)
    for i in range(len(ring)):
        if usable[i]:
            order[at[ring[i]]] = i
            at[ring[i]] += 1
    return order


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _is_sorted(ring: NDArray[np.int64], time: Float64s, order: NDArray[np.int64]) -> bool:
    for k in range(1, len(order)):
        a, b = order[k - 1], order[k]
        if ring[a] == ring[b] and time[b] < time[a]:
            return False
    return True


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _first_returns(
    ring: NDArray[np.int64], time: Float64s, order: NDArray[np.int64]
) -> NDArray[np.bool_]:
    kept = np.ones(len(order), np.bool_)
    for k in range(1, len(order)):
        a, b = order[k - 1], order[k]
        kept[k] = ring[a] != ring[b] or time[a] != time[b]
    return kept


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _polar(xyz: Float32s) -> tuple[Float32s, Float32s]:
    n = xyz.shape[0]
    range_, azimuth = np.empty(n, np.float32), np.empty(n, np.float32)
    for i in range(n):
        x, y, z = xyz[i, 0], xyz[i, 1], xyz[i, 2]
        range_[i] = np.sqrt(x * x + y * y + z * z)
        azimuth[i] = np.arctan2(y, x)
    return range_, azimuth


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
