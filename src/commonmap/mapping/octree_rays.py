"""Rays taken one by one through the blocks of an octree, as Numba kernels.

`insert_rays` counts every ray by itself (OctoMap's `insertRay`), `cast` looks for the first
occupied voxel (OctoMap's `castRay`), `add` updates single voxels (OctoMap's `updateNode`).
"""

from __future__ import annotations

import numba
import numpy as np

from commonmap.io.morton import spread
from commonmap.mapping.octree_kernels import FAR, HIT, KEY_LIMIT, OUT, key_of, probe, ray
from commonmap.types import KEY_ORIGIN

RAY_BLOCKS = 3 * (KEY_LIMIT >> 3) + 8
"""No ray passes more blocks than this."""


@numba.njit(cache=True, inline="always")  # type: ignore[misc]
def _code(kx, ky, kz):  # type: ignore[no-untyped-def]
    return spread(kx) | spread(ky) << 1 | spread(kz) << 2


@numba.njit(cache=True, inline="always")  # type: ignore[misc]
def _add_one(block, i, change, low, high):  # type: ignore[no-untyped-def]
    """Add to the log-odds of one voxel, clamped, as OctoMap's `updateNode` does."""
    old = block[i]
    if old != old:
        old = np.float32(0.0)
    elif (change >= 0 and old >= high) or (change <= 0 and old <= low):
        return
    block[i] = min(max(old + change, low), high)


@numba.njit(cache=True)  # type: ignore[misc]
def add(codes, slots, values, change, low, high):  # type: ignore[no-untyped-def]
    """Add `change` to the voxel of each code, one after the other."""
    for n in range(codes.shape[0]):
        _add_one(values[slots[n]], codes[n] & 511, change, low, high)


@numba.njit(cache=True)  # type: ignore[misc]
def _add_at(  # type: ignore[no-untyped-def]
    code, codes, n_blocks, values, table_codes, table_slots, change, low, high
):
    place = probe(table_codes, code >> 9)
    if table_codes[place] < 0:
        table_codes[place] = code >> 9
        table_slots[place] = n_blocks
        codes[n_blocks] = code >> 9
        values[n_blocks] = np.float32(np.nan)
        n_blocks += 1
    _add_one(values[table_slots[place]], code & 511, change, low, high)
    return n_blocks


@numba.njit(cache=True, inline="always")  # type: ignore[misc]
def _room(kx, ky, kz, lx, ly, lz):  # type: ignore[no-untyped-def]
    """Return how many blocks a ray between two voxels can pass at most."""
    return (abs(kx - lx) + abs(ky - ly) + abs(kz - lz)) // 8 + 8


@numba.njit(cache=True)  # type: ignore[misc]
def insert_rays(  # type: ignore[no-untyped-def]
    first, origins, ends, state, resolution, codes, n_blocks, values, table_codes, table_slots,
    hit, miss, low, high,
):  # fmt: skip
    """Insert rays from the one at `first` on; return (rays done, blocks), early when room ends."""
    factor = 1.0 / resolution
    stride = 0 if origins.shape[0] == 1 else 1
    room = min(codes.shape[0], min(values.shape[0], table_codes.shape[0] // 2))
    key = np.empty(3, np.int64)
    last = np.empty(3, np.int64)
    step = np.empty(3, np.int64)
    t = np.empty(3)
    dt = np.empty(3)
    for n in range(first, ends.shape[0]):
        if state[n] == OUT:
            continue
        origin, end = origins[n * stride], ends[n]
        inside = True
        for a in range(3):
            key[a], last[a] = key_of(origin[a], factor), key_of(end[a], factor)
            inside &= key[a] >= 0
        if not inside:
            continue
        if n_blocks + _room(key[0], key[1], key[2], last[0], last[1], last[2]) > room:
            return n, n_blocks
        if key[0] != last[0] or key[1] != last[1] or key[2] != last[2]:
            dx, dy, dz = end[0] - origin[0], end[1] - origin[1], end[2] - origin[2]
            length = np.float32(np.sqrt(np.float64(dx * dx + dy * dy + dz * dz)))
            if not length > 0:
                length = np.float32(1.0)
            for a in range(3):
                step[a], t[a], dt[a] = ray(origin[a], end[a], key[a], resolution, length)
            while True:
                n_blocks = _add_at(
                    _code(key[0], key[1], key[2]), codes, n_blocks, values, table_codes,
                    table_slots, miss, low, high,
                )  # fmt: skip
                a = (0 if t[0] < t[2] else 2) if t[0] < t[1] else (1 if t[1] < t[2] else 2)
                key[a] += step[a]
                t[a] += dt[a]
                if key[0] == last[0] and key[1] == last[1] and key[2] == last[2]:
                    break
                if min(min(t[0], t[1]), t[2]) > length:
                    break
        if state[n] == HIT:
            n_blocks = _add_at(
                _code(last[0], last[1], last[2]), codes, n_blocks, values, table_codes,
                table_slots, hit, low, high,
            )  # fmt: skip
    return ends.shape[0], n_blocks


@numba.njit(cache=True)  # type: ignore[misc]
def cast(  # type: ignore[no-untyped-def]
    origins, directions, resolution, values, table_codes, table_slots, max_range, ignore_unknown,
    hit, end,
):  # fmt: skip
    """Fill hit and end of each ray. max_range: 0 or less for none."""
    factor = 1.0 / resolution
    stride = 0 if origins.shape[0] == 1 else 1
    key = np.empty(3, np.int64)
    step = np.empty(3, np.int64)
    t = np.empty(3)
    dt = np.empty(3)
    for n in range(directions.shape[0]):
        origin, along = origins[n * stride], directions[n]
        inside = True
        for a in range(3):
            key[a] = key_of(origin[a], factor)
            inside &= key[a] >= 0
        if not inside:
            continue
        x, y, z = along[0], along[1], along[2]
        length = np.float32(np.sqrt(np.float64(x * x + y * y + z * z)))
        if not length > 0:
            continue
        for a in range(3):
            step[a], t[a], dt[a] = ray(np.float32(0), along[a], key[a], resolution, length)
            if step[a] != 0:
                border = (np.float64(key[a] - KEY_ORIGIN) + 0.5) * resolution
                border += np.float64(np.float32(step[a] * resolution * 0.5))
                t[a] = (border - np.float64(origin[a])) / np.float64(along[a] / length)
        first = True
        while True:
            code = _code(key[0], key[1], key[2])
            place = probe(table_codes, code >> 9)
            value = np.float32(np.nan)
            if table_codes[place] >= 0:
                value = values[table_slots[place], code & 511]
            for a in range(3):
                if first and value >= 0:
                    end[n, a] = origin[a]
                else:
                    end[n, a] = (np.float64(key[a] - KEY_ORIGIN) + 0.5) * resolution
            if not first and max_range > 0:
                distance = 0.0
                for a in range(3):
                    distance += np.float64((end[n, a] - origin[a]) * (end[n, a] - origin[a]))
                if distance > max_range * max_range:
                    break
            if value >= 0:
                hit[n] = True
                break
            if value != value and not ignore_unknown:
                break
            first = False
            a = (0 if t[0] < t[2] else 2) if t[0] < t[1] else (1 if t[1] < t[2] else 2)
            if t[a] == FAR or key[a] + step[a] < 0 or key[a] + step[a] >= KEY_LIMIT:
                break
            key[a] += step[a]
            t[a] += dt[a]
