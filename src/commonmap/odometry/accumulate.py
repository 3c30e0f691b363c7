"""One cloud of a whole log, of bounded size: points in hashed voxels that widen when they are many.

A voxel keeps its first point. A later one takes its place only where it was seen from less than
half the distance: always keeping the nearest would favour returns that noise made short.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from commonmap.errors import EmptyMapError, InputError
from commonmap.types import Cloud, Float32s, Float64s

WIDEN = float(np.sqrt(2.0))
"""By so much voxels widen when there are too many: surfaces then hold half as many."""

KEY_HALF = 1 << 20

SLOT = np.dtype([("key", np.int64), ("kept", np.int32), ("squared", np.float32)])
"""A slot of the hash table: voxel, which of the kept points is its own (-1: none), and the square
of the distance that one was seen from. All that a point needs to know lies in one cache line."""


@dataclass
class _Columns:
    """What is kept of each point, in the order in which voxels were met."""

    xyz: Float64s
    origin: Float32s
    time: Float64s
    intensity: Float32s

    def head(self, n: int) -> tuple[Float64s, Float32s, Float64s, Float32s]:
        return self.xyz[:n], self.origin[:n], self.time[:n], self.intensity[:n]


class Accumulator:
    """Takes clouds in with `add` (turn by turn, with time and ray origins) and gives back `cloud`.

    voxel: metres, at the beginning. max_points: points that are kept at most; where there are more
    the voxels widen by `WIDEN` and what is there is thinned again. Memory follows `max_points`
    alone.
    """

    def __init__(self, *, voxel: float = 0.05, max_points: int = 1_500_000):
        if not voxel > 0.0 or max_points < 1:
            raise InputError(
                f"voxels must be wide and points many; {voxel} m and {max_points} came"
            )
        self.voxel = float(voxel)
        self.max_points = int(max_points)
        self.n = 0
        self._make(min(1 << 16, self.max_points))

    def _make(self, room: int) -> None:
        self._kept = _Columns(
            np.empty((room, 3)), np.empty((room, 3), np.float32), np.empty(room),
            np.empty(room, np.float32),
        )  # fmt: skip
        self._table: NDArray[Any] = np.zeros(1 << int(2 * room - 1).bit_length(), SLOT)
        self._table["kept"] = -1

    def add(self, cloud: Cloud) -> None:
        """Take in the points of a cloud that has time, ray origins and intensity."""
        if cloud.time is None or cloud.origin is None or cloud.intensity is None:
            raise InputError("clouds to be gathered need time, ray origins and intensity")
        self._add(_Columns(cloud.xyz, cloud.origin, cloud.time, cloud.intensity))

    def _add(self, new: _Columns) -> None:
        done = 0
        while True:
            done, self.n = _insert(
                new.xyz, new.origin, new.time, new.intensity, done, 1.0 / self.voxel,
                self._kept.xyz, self._kept.origin, self._kept.time, self._kept.intensity,
                self._table, self.n,
            )  # fmt: skip
            if done == len(new.xyz):
                return
            room = len(self._kept.time)
            if room < self.max_points:
                self._again(min(2 * room, self.max_points))
            else:
                self.voxel *= WIDEN
                self._again(room)

    def _again(self, room: int) -> None:
        """Make room for so many points and put those that are kept in again."""
        old = _Columns(*self._kept.head(self.n))
        self.n = 0
        self._make(room)
        self._add(old)

    def cloud(self) -> Cloud:
        """Return the points that are kept."""
        if self.n == 0:
            raise EmptyMapError("the log holds no point that could be placed")
        xyz, origin, time, intensity = self._kept.head(self.n)
        return Cloud(
            xyz=xyz.copy(), origin=origin.copy(), time=time.copy(), intensity=intensity.copy()
        )


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _insert(
    xyz: Float64s, origin: Float32s, time: Float64s, intensity: Float32s, first: int,
    scale: float, kept_xyz: Float64s, kept_origin: Float32s, kept_time: Float64s,
    kept_intensity: Float32s, table: NDArray[Any], n: int,
) -> tuple[int, int]:  # fmt: skip
    """Put in points from `first` on; return (which point comes next, how many are kept).

    Ends early where there is no more room for a new voxel.
    """
    mask = len(table) - 1
    for p in range(first, len(xyz)):
        key = 0
        squared = 0.0
        for axis in range(3):
            cell = int(np.floor(xyz[p, axis] * scale)) + KEY_HALF
            key = (key << 21) | (cell & 0x1FFFFF)
            squared += (xyz[p, axis] - origin[p, axis]) ** 2
        # Fibonacci hashing: neighbouring voxels land far apart
        at = ((key * 0x9E3779B97F4A7C15) >> 20) & mask
        while table[at].kept >= 0 and table[at].key != key:
            at = (at + 1) & mask
        k = table[at].kept
        if k >= 0:
            if squared >= 0.25 * table[at].squared:
                continue
        else:
            if n == len(kept_time):
                return p, n
            k = n
            n += 1
            table[at].key = key
            table[at].kept = k
        table[at].squared = squared
        for axis in range(3):
            kept_xyz[k, axis] = xyz[p, axis]
            kept_origin[k, axis] = origin[p, axis]
        kept_time[k] = time[p]
        kept_intensity[k] = intensity[p]
    return len(xyz), n
