"""The map that odometry registers to: points in hashed voxels, of bounded memory.

A voxel keeps its first points, a least distance apart, so that a surface seen long ago still holds
the pose; sums over its points give planes and lines without a visit to each. Voxels are found
through an open-addressing table (linear probing); their points lie in one dense block. Voxels
farther from the sensor than the map's reach are forgotten.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from commonmap.types import Float32s, Float64s

KEY_BITS = 21
KEY_HALF = 1 << (KEY_BITS - 1)
EMPTY = -1


class LocalMap:
    """Points in voxels around the sensor. Changed in place by `insert` and `crop`.

    voxel: edge of a voxel, metres. per_voxel: most points a voxel keeps. reach: metres from the
    sensor beyond which voxels are forgotten.

    sums: of the points of each voxel, from its middle: x, y, z, xx, yy, zz, xy, xz, yz.
    """

    def __init__(self, voxel: float, *, per_voxel: int, reach: float, capacity: int = 1 << 13):
        self.voxel = float(voxel)
        self.per_voxel = int(per_voxel)
        self.reach = float(reach)
        self.apart = self.voxel / np.sqrt(per_voxel)
        self.n = 0
        self._make(capacity)

    def _make(self, capacity: int) -> None:
        self.keys: NDArray[np.int64] = np.empty(capacity, np.int64)
        self.count: NDArray[np.int32] = np.zeros(capacity, np.int32)
        self.points: Float32s = np.empty((capacity, self.per_voxel, 3), np.float32)
        self.sums: Float64s = np.zeros((capacity, 9))
        self.table: NDArray[np.int32] = np.full(4 * capacity, EMPTY, np.int32)

    @property
    def n_bytes(self) -> int:
        """Bytes the map's arrays hold."""
        return sum(a.nbytes for a in (self.keys, self.count, self.points, self.sums, self.table))

    def insert(self, points: Float64s) -> None:
        """Add (N, 3) points of the map frame, rounded to float32."""
        done = 0
        while True:
            done, self.n = _insert(
                points, done, self.voxel, self.apart**2, self.keys, self.count, self.points,
                self.sums, self.table, self.n,
            )  # fmt: skip
            if done == len(points):
                return
            self._grow()

    def _grow(self) -> None:
        """Double the room for voxels."""
        keys, count, points, n = self.keys, self.count, self.points, self.n
        sums = self.sums
        self._make(2 * len(keys))
        self.keys[:n], self.count[:n], self.points[:n] = keys[:n], count[:n], points[:n]
        self.sums[:n] = sums[:n]
        _index(self.keys, n, self.table)

    def crop(self, centre: Float64s) -> None:
        """Forget voxels farther than the reach from the sensor at `centre` (3,)."""
        self.n = _crop(
            centre, self.reach, self.voxel, self.keys, self.count, self.points, self.sums, self.n
        )
        capacity = len(self.keys)
        self.table.fill(EMPTY)
        if 8 * self.n < capacity and capacity > 1 << 13:  # give room back
            keys, count, points, sums = self.keys, self.count, self.points, self.sums
            self._make(capacity // 2)
            self.keys[: self.n], self.count[: self.n] = keys[: self.n], count[: self.n]
            self.points[: self.n] = points[: self.n]
            self.sums[: self.n] = sums[: self.n]
        _index(self.keys, self.n, self.table)

    def all_points(self) -> Float32s:
        """Return every point of the map, (N, 3), in the order of voxels."""
        kept = np.arange(self.per_voxel) < self.count[: self.n, None]
        return np.asarray(self.points[: self.n][kept])


@numba.njit(cache=True, nogil=True, inline="always")  # type: ignore[untyped-decorator]
def pack(i, j, k):  # type: ignore[no-untyped-def]
    """Return one number for the voxel of three signed indices."""
    mask = (1 << KEY_BITS) - 1
    return (
        ((i + KEY_HALF) & mask) << (2 * KEY_BITS)
        | ((j + KEY_HALF) & mask) << KEY_BITS
        | ((k + KEY_HALF) & mask)
    )


@numba.njit(cache=True, nogil=True, inline="always")  # type: ignore[untyped-decorator]
def find(key, keys, table):  # type: ignore[no-untyped-def]
    """Return (voxel or -1, place in the table where it is or would go)."""
    mask = table.shape[0] - 1
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    at = np.int64((mixed >> np.uint64(32)) & np.uint64(mask))
    while True:
        voxel = table[at]
        if voxel < 0 or keys[voxel] == key:
            return voxel, at
        at = (at + 1) & mask


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _insert(points, first, edge, apart2, keys, count, kept, sums, table, n):  # type: ignore[no-untyped-def]
    """Insert points from `first` on; return (points done, voxels), early where room runs out.

    A point belongs to the voxel in which it lies as it is kept, rounded to float32.
    """
    room = kept.shape[1]
    factor = 1.0 / edge
    for p in range(first, points.shape[0]):
        x = np.float64(np.float32(points[p, 0]))
        y = np.float64(np.float32(points[p, 1]))
        z = np.float64(np.float32(points[p, 2]))
        key = pack(
            np.int64(np.floor(x * factor)),
            np.int64(np.floor(y * factor)),
            np.int64(np.floor(z * factor)),
        )
        voxel, at = find(key, keys, table)
        if voxel < 0:
            if n == keys.shape[0]:
                return p, n
            voxel = n
            table[at] = n
            keys[n] = key
            count[n] = 0
            sums[n] = 0.0
            n += 1
        c = count[voxel]
        if c == room:
            continue
        free = True
        for q in range(c):
            dx, dy, dz = kept[voxel, q, 0] - x, kept[voxel, q, 1] - y, kept[voxel, q, 2] - z
            if dx * dx + dy * dy + dz * dz < apart2:
                free = False
                break
        if free:
            kept[voxel, c, 0], kept[voxel, c, 1], kept[voxel, c, 2] = x, y, z
            count[voxel] = c + 1
            x -= (np.floor(x * factor) + 0.5) * edge
            y -= (np.floor(y * factor) + 0.5) * edge
            z -= (np.floor(z * factor) + 0.5) * edge
            sums[voxel, 0] += x
            sums[voxel, 1] += y
            sums[voxel, 2] += z
            sums[voxel, 3] += x * x
            sums[voxel, 4] += y * y
            sums[voxel, 5] += z * z
            sums[voxel, 6] += x * y
            sums[voxel, 7] += x * z
            sums[voxel, 8] += y * z
    return points.shape[0], n


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _index(keys, n, table):  # type: ignore[no-untyped-def]
    """Write the first `n` voxels into an empty table."""
    for voxel in range(n):
        _, at = find(keys[voxel], keys, table)
        table[at] = voxel


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _crop(centre, reach, edge, keys, count, points, sums, n):  # type: ignore[no-untyped-def]
    """Move the voxels within reach to the front; return their number."""
    kept = 0
    mask = (1 << KEY_BITS) - 1
    for v in range(n):
        key = keys[v]
        x = (((key >> (2 * KEY_BITS)) & mask) - KEY_HALF + 0.5) * edge - centre[0]
        y = (((key >> KEY_BITS) & mask) - KEY_HALF + 0.5) * edge - centre[1]
        z = ((key & mask) - KEY_HALF + 0.5) * edge - centre[2]
        if x * x + y * y + z * z <= reach * reach:
            keys[kept] = key
            count[kept] = count[v]
            points[kept] = points[v]
            sums[kept] = sums[v]
            kept += 1
    return kept


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def thin(points: Float64s | Float32s, cell: float) -> NDArray[np.int64]:
    """Return the index of the first point in each cell of a grid, rising."""
    n = points.shape[0]
    size = 16
    while size < 3 * n:
        size *= 2
    keys = np.empty(n, np.int64)
    table = np.full(size, EMPTY, np.int32)
    out = np.empty(n, np.int64)
    kept = 0
    for p in range(n):
        key = pack(
            np.int64(np.floor(points[p, 0] / cell)),
            np.int64(np.floor(points[p, 1] / cell)),
            np.int64(np.floor(points[p, 2] / cell)),
        )
        voxel, at = find(key, keys, table)
        if voxel < 0:
            table[at] = kept
            keys[kept] = key
            out[kept] = p
            kept += 1
    return out[:kept]
