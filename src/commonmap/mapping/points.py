"""Points of a map, whatever it came as: a cloud, an octree, or a plain array."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numpy.typing import NDArray

from commonmap.errors import EmptyMapError
from commonmap.frames import apply, check_points
from commonmap.types import TREE_DEPTH, Bools, Cloud, Float64s, Leaves

Rows = TypeVar("Rows", bound=NDArray[Any])

GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)

MAX_VOXELS = 20_000_000
"""Pruned leaves are opened up to about this many voxels; beyond, each stands for itself."""


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def floor_int(value):  # type: ignore[no-untyped-def]
    """Return the whole number at or below a value, which must lie within 2^62.

    What `np.floor` says, in instructions that the compiler can do side by side.
    """
    whole = np.int64(value)
    return whole - np.int64(value < whole)


def points_of(item: Cloud | Leaves | Float64s, name: str = "map") -> Float64s:
    """Return the finite points (N, 3) float64 of a map: of an octree, its occupied voxels' centres.

    Raises InputError for an array of another shape and EmptyMapError where no point is left.
    """
    if isinstance(item, Leaves):
        xyz = voxel_centres(item)
    else:
        xyz = check_points(item.xyz if isinstance(item, Cloud) else item, name)
    if not _all_finite(xyz.reshape(-1)):
        xyz = xyz[np.isfinite(xyz).all(axis=1)]
    if len(xyz) == 0:
        kind = "occupied voxel" if isinstance(item, Leaves) else "finite point"
        raise EmptyMapError(f"the {name} holds no {kind}; a map needs at least a few hundred")
    return np.ascontiguousarray(xyz)


def voxel_centres(leaves: Leaves) -> Float64s:
    """Return the centres (N, 3) of the smallest voxels of all occupied leaves."""
    occupied = leaves.occupied
    keys = leaves.keys[occupied].astype(np.int64)
    width = np.left_shift(1, TREE_DEPTH - leaves.depth[occupied].astype(np.int64))
    if float((width.astype(np.float64) ** 3).sum()) > MAX_VOXELS:
        return leaves.centres()[occupied]
    found = []
    for w in np.unique(width):
        corner = keys[width == w]
        steps = np.arange(w)
        offset = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
        found.append((corner[:, None, :] + offset[None, :, :]).reshape(-1, 3))
    if not found:
        return np.zeros((0, 3))
    return (np.concatenate(found) - (1 << (TREE_DEPTH - 1)) + 0.5) * leaves.resolution


def bounds(xyz: Float64s) -> tuple[Float64s, Float64s]:
    """Return the lowest and highest coordinates, each (3,), of (N, 3) points, N > 0.

    One pass over the rows; numpy's reductions along the long axis take ten times as long.
    """
    low, high = _bounds(np.ascontiguousarray(xyz, dtype=np.float64))
    return low, high


def inside_box(points: Float64s, low: Float64s, high: Float64s) -> Bools:
    """Return (N,) bool, which of (N, D) points lie in a box, low and high of D or fewer numbers."""
    inside = np.ones(len(points), dtype=bool)
    for a in range(len(low)):  # coordinate by coordinate: a third of the time
        inside &= (points[:, a] >= low[a]) & (points[:, a] <= high[a])
    return inside


def rows_of(xyz: Float64s, wanted: Bools) -> Float64s:
    """Return the wanted ones, (N,) bool, of (N, 3) points, in half of numpy's time."""
    return np.asarray(_rows_of(np.ascontiguousarray(xyz, dtype=np.float64), wanted))


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _rows_of(xyz, wanted):  # type: ignore[no-untyped-def]
    n = 0
    for k in range(wanted.shape[0]):
        n += wanted[k]
    out, n = np.empty((n, 3)), 0
    for k in range(wanted.shape[0]):
        if wanted[k]:
            for a in range(3):
                out[n, a] = xyz[k, a]
            n += 1
    return out


def sample(xyz: Rows, n_most: int) -> Rows:
    """Return at most `n_most` of the points (or other rows), one from each of as many equal runs.

    Where in its run a point is taken from follows the golden ratio: an even step would meet the
    same rings of a spinning lidar over and over.
    """
    return xyz if len(xyz) <= n_most else cast(Rows, xyz[sampled(len(xyz), n_most)])


def sample_where(xyz: Float64s, wanted: Bools, n_most: int) -> Float64s:
    """Return what `sample` takes of the wanted points, (N,) bool."""
    return xyz[sample(np.flatnonzero(wanted), n_most)]


def sampled(n: int, n_most: int) -> NDArray[np.int64]:
    """Return which of n points `sample` takes where there are more than `n_most`, rising."""
    return np.asarray(_sampled(n, n_most))


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _sampled(n, n_most):  # type: ignore[no-untyped-def]
    place, width = np.empty(n_most, np.int64), n / n_most
    for run in range(n_most):
        turn = run * GOLDEN
        place[run] = int((run + (turn - np.floor(turn))) * width)
    return place


def move(T_a_b: Float64s, xyz: Float64s) -> Float64s:
    """Return (N, 3) points of frame b in frame a, as `frames.apply` does, for millions of them.

    One pass on one thread: what runs beside it keeps its core.
    """
    return np.asarray(_move(T_a_b, np.ascontiguousarray(xyz, dtype=np.float64)))


def move_cloud(T_a_b: Float64s, cloud: Cloud) -> Cloud:
    """Return a cloud of frame b, with its ray origins, in frame a."""
    origin = cloud.origin
    if origin is not None:
        origin = apply(T_a_b, origin).astype(np.float32)
    return replace(cloud, xyz=apply(T_a_b, cloud.xyz), origin=origin)


def thin(xyz: Float64s, voxel: float, n_most: int | None = None) -> Float64s:
    """Return the mean point of every voxel of a width in metres, in the order of the voxels.

    n_most: widen the voxels until about so many are left; the means of smaller voxels then count
    one each, however many points they hold.
    """
    for _ in range(8):
        if len(xyz) == 0:
            return xyz
        order, starts = _group(xyz, voxel)
        xyz = np.asarray(_means(np.ascontiguousarray(xyz), order, starts))
        if n_most is None or len(xyz) <= n_most:
            break
        voxel *= max(1.15, np.sqrt(len(xyz) / n_most) * 0.95)
    return xyz


def first_of_voxels(xyz: Float64s, voxel: float) -> NDArray[np.int64]:
    """Return the index of the first point of every voxel of a width in metres, rising."""
    return np.asarray(_first_of_keys(_keys(xyz, voxel)))


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _first_of_keys(key):  # type: ignore[no-untyped-def]
    """Return where each of the values, 0 and up, comes first, rising: by a table of them."""
    size = 64
    while size < 2 * key.shape[0]:
        size *= 2
    met = np.full(size, -1, np.int64)
    found, n = np.empty(key.shape[0], np.int64), 0
    for k in range(key.shape[0]):
        mixed = np.uint64(key[k]) * np.uint64(0x9E3779B97F4A7C15)
        place = np.int64(mixed >> np.uint64(32)) & (size - 1)
        while met[place] != -1 and met[place] != key[k]:
            place = (place + 1) & (size - 1)
        if met[place] == -1:
            met[place] = key[k]
            found[n] = k
            n += 1
    return found[:n].copy()


def _group(xyz: Float64s, voxel: float) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Return the points' order by voxel, and where each voxel starts in it."""
    order, key = _sort(_keys(xyz, voxel))
    return order, np.asarray(_starts(key))


def _keys(xyz: Float64s, voxel: float) -> NDArray[np.int32] | NDArray[np.int64]:
    """Return the number of each point's voxel, see `_voxel_keys`."""
    xyz, scale = np.ascontiguousarray(xyz), 1.0 / voxel
    low, high = (np.floor(end * scale) for end in bounds(xyz))
    shape = high - low + 1.0
    key: NDArray[np.int64] = _voxel_keys(xyz, scale, low, shape.astype(np.int64))
    return key.astype(np.int32) if np.prod(shape) < 2.0**31 else key  # half the bytes to sort


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _starts(key):  # type: ignore[no-untyped-def]
    """Return where each value of sorted keys begins, and behind the last of them their number."""
    n = 1 if key.shape[0] > 0 else 0
    for i in range(1, key.shape[0]):
        n += key[i] != key[i - 1]
    starts = np.empty(n + 1, np.int64)
    m = 0
    for i in range(key.shape[0]):
        if i == 0 or key[i] != key[i - 1]:
            starts[m] = i
            m += 1
    starts[n] = key.shape[0]
    return starts


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _voxel_keys(xyz, scale, low, shape):  # type: ignore[no-untyped-def]
    """Return one number per point, the same in a voxel, rising in x, then y, then z.

    Numbers beyond 2^62 are folded: only of voxels very far apart may some then share one.
    """
    key = np.empty(xyz.shape[0], np.int64)
    for n in range(xyz.shape[0]):
        number = np.int64(0)
        for a in range(3):
            number = number * shape[a] + floor_int(xyz[n, a] * scale) - np.int64(low[a])
        key[n] = number & np.int64((1 << 62) - 1)
    return key


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _sort(key):  # type: ignore[no-untyped-def]
    """Return the order of keys of 0 and up, equal ones as they came, and the sorted keys.

    By digits of 11 bits, the last one first: as many passes as the largest key has. n < 2^31.
    """
    n, digit = key.shape[0], 11
    order, sorted_key = np.arange(n, dtype=np.int32), key.copy()
    next_order, next_key = np.empty_like(order), np.empty_like(key)
    place = np.empty((1 << digit) + 1, np.int64)
    most, shift = key.max() if n > 0 else 0, 0
    while most >> shift > 0:
        place[:] = 0
        for i in range(n):
            place[((sorted_key[i] >> shift) & ((1 << digit) - 1)) + 1] += 1
        for d in range(1 << digit):
            place[d + 1] += place[d]
        for i in range(n):
            d = (sorted_key[i] >> shift) & ((1 << digit) - 1)
            next_key[place[d]], next_order[place[d]] = sorted_key[i], order[i]
            place[d] += 1
        sorted_key, next_key = next_key, sorted_key
        order, next_order = next_order, order
        shift += digit
    return order, sorted_key


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _means(xyz, order, starts):  # type: ignore[no-untyped-def]
    out = np.empty((starts.shape[0] - 1, 3))
    for v in range(starts.shape[0] - 1):
        x, y, z = 0.0, 0.0, 0.0
        for n in range(starts[v], starts[v + 1]):
            m = order[n]
            x += xyz[m, 0]
            y += xyz[m, 1]
            z += xyz[m, 2]
        number = starts[v + 1] - starts[v]
        out[v, 0], out[v, 1], out[v, 2] = x / number, y / number, z / number
    return out


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _move(T, xyz):  # type: ignore[no-untyped-def]
    out = np.empty_like(xyz)
    for n in range(xyz.shape[0]):
        x, y, z = xyz[n, 0], xyz[n, 1], xyz[n, 2]
        for a in range(3):
            out[n, a] = T[a, 0] * x + T[a, 1] * y + T[a, 2] * z + T[a, 3]
    return out


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _bounds(xyz: NDArray[np.float64]):  # type: ignore[no-untyped-def]
    x0, y0, z0 = xyz[0]
    x1, y1, z1 = xyz[0]
    for n in range(xyz.shape[0]):
        x, y, z = xyz[n, 0], xyz[n, 1], xyz[n, 2]
        x0, y0, z0 = min(x0, x), min(y0, y), min(z0, z)
        x1, y1, z1 = max(x1, x), max(y1, y), max(z1, z)
    return np.array([x0, y0, z0]), np.array([x1, y1, z1])


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _all_finite(values):  # type: ignore[no-untyped-def]
    """Return whether no value is infinite or not a number: such a one times zero is no number."""
    total = 0.0
    for value in values:
        total += value * 0.0
    return total == 0.0
