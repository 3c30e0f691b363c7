"""The inner loops of moving and fusing octrees, as Numba kernels. Voxels are in Morton order."""

from __future__ import annotations

import numba
import numpy as np

from commonmap.io.morton import gather, spread
from commonmap.mapping.octree_kernels import KEY_LIMIT, probe

ADD, KEEP, LARGEST = 0, 1, 2
OCCUPIED, FREE = np.int64(1) << 32, np.int64(1) << 33
ROBOTS = (np.int64(1) << 32) - 1


@numba.njit(cache=True)  # type: ignore[misc]
def reach(codes, A, b):  # type: ignore[no-untyped-def]
    """Return the first and the last target block (B, 3) that a moved block can touch."""
    n_blocks = codes.shape[0]
    low, high = np.empty((n_blocks, 3), np.int64), np.empty((n_blocks, 3), np.int64)
    for n in range(n_blocks):
        corner = (8.0 * gather(codes[n]), 8.0 * gather(codes[n] >> 1), 8.0 * gather(codes[n] >> 2))
        for a in range(3):
            least = b[a]
            most = b[a]
            for c in range(3):
                here = A[a, c] * corner[c]
                there = A[a, c] * (corner[c] + 8.0)
                least += min(here, there)
                most += max(here, there)
            low[n, a] = np.int64(np.floor((least + 1e-6) / 8.0))
            high[n, a] = np.int64(np.floor((most - 1e-6) / 8.0))
    return low, high


@numba.njit(cache=True)  # type: ignore[misc]
def list_blocks(low, high):  # type: ignore[no-untyped-def]
    """Return the codes of all blocks in the boxes low..high, repeats included."""
    count = 0
    for n in range(low.shape[0]):
        count += (
            (high[n, 0] - low[n, 0] + 1)
            * (high[n, 1] - low[n, 1] + 1)
            * (high[n, 2] - low[n, 2] + 1)
        )
    codes = np.empty(count, np.int64)
    at = 0
    for n in range(low.shape[0]):
        for z in range(low[n, 2], high[n, 2] + 1):
            for y in range(low[n, 1], high[n, 1] + 1):
                for x in range(low[n, 0], high[n, 0] + 1):
                    codes[at] = spread(x) | spread(y) << 1 | spread(z) << 2
                    at += 1
    return codes


@numba.njit(cache=True, inline="always")  # type: ignore[misc]
def _inside(k):  # type: ignore[no-untyped-def]
    """Return the lowest three bits of a key at every third bit: its part of a place in a block."""
    return (k & 1) | (k & 2) << 2 | (k & 4) << 4


@numba.njit(cache=True)  # type: ignore[misc]
def fill_by_volume(  # type: ignore[no-untyped-def]
    codes, values, source, table_codes, table_slots, A, b, samples, occupied_share, known_share
):
    """Fill target blocks from the source by volume. A, b: target to source voxel coordinates."""
    volume = samples**3
    limit = np.float64(KEY_LIMIT)
    last_x = last_y = last_z = np.int64(-8)
    slot = np.int64(-1)
    for n in range(codes.shape[0]):
        x0, y0, z0 = 8 * gather(codes[n]), 8 * gather(codes[n] >> 1), 8 * gather(codes[n] >> 2)
        for v in range(512):
            x = x0 + gather(v)
            y = y0 + gather(v >> 1)
            z = z0 + gather(v >> 2)
            n_occupied = 0
            n_free = 0
            sum_occupied = 0.0
            sum_free = 0.0
            for i in range(samples):
                px = x + (i + 0.5) / samples
                for j in range(samples):
                    py = y + (j + 0.5) / samples
                    for k in range(samples):
                        pz = z + (k + 0.5) / samples
                        qx = A[0, 0] * px + A[0, 1] * py + A[0, 2] * pz + b[0]
                        qy = A[1, 0] * px + A[1, 1] * py + A[1, 2] * pz + b[1]
                        qz = A[2, 0] * px + A[2, 1] * py + A[2, 2] * pz + b[2]
                        if min(min(qx, qy), qz) < 0.0 or max(max(qx, qy), qz) >= limit:
                            continue
                        kx, ky, kz = np.int64(qx), np.int64(qy), np.int64(qz)
                        away = (kx ^ last_x) | (ky ^ last_y) | (kz ^ last_z)
                        last_x, last_y, last_z = kx, ky, kz
                        if away >> 3:
                            code = spread(kx >> 3) | spread(ky >> 3) << 1 | spread(kz >> 3) << 2
                            place = probe(table_codes, code)
                            slot = np.int64(-1)
                            if table_codes[place] >= 0:
                                slot = np.int64(table_slots[place])
                        if slot < 0:
                            continue
                        value = source[slot, _inside(kx) | _inside(ky) << 1 | _inside(kz) << 2]
                        if value >= 0:
                            n_occupied += 1
                            sum_occupied += value
                        elif value < 0:
                            n_free += 1
                            sum_free += value
            known = n_occupied + n_free
            if known == 0:
                continue
            mean = (sum_occupied + sum_free) / known
            if n_occupied >= occupied_share * volume:
                values[n, v] = max(mean, sum_occupied / volume)
            elif known >= known_share * volume:
                values[n, v] = min(mean, sum_free / volume)


@numba.njit(cache=True)  # type: ignore[misc]
def keep_centres(  # type: ignore[no-untyped-def]
    codes, source, A, b, part, values, table_codes, table_slots
):
    """Make occupied every target voxel that holds the centre of an occupied source voxel.

    A, b: source to target voxel coordinates. part: volume of a source voxel in target voxels, at
    most 1, which its log-odds are weighted with.
    """
    for n in range(codes.shape[0]):
        x0, y0, z0 = 8 * gather(codes[n]), 8 * gather(codes[n] >> 1), 8 * gather(codes[n] >> 2)
        for v in range(512):
            if not source[n, v] >= 0:
                continue
            x, y, z = x0 + gather(v) + 0.5, y0 + gather(v >> 1) + 0.5, z0 + gather(v >> 2) + 0.5
            kx = np.int64(np.floor(A[0, 0] * x + A[0, 1] * y + A[0, 2] * z + b[0]))
            ky = np.int64(np.floor(A[1, 0] * x + A[1, 1] * y + A[1, 2] * z + b[1]))
            kz = np.int64(np.floor(A[2, 0] * x + A[2, 1] * y + A[2, 2] * z + b[2]))
            code = spread(kx) | spread(ky) << 1 | spread(kz) << 2
            place = probe(table_codes, code >> 9)
            if table_codes[place] < 0:
                continue
            slot = table_slots[place]
            value = part * source[n, v]
            if not values[slot, code & 511] >= value:
                values[slot, code & 511] = value


@numba.njit(cache=True)  # type: ignore[misc]
def accumulate(rows, values, robot, rule, total, seen):  # type: ignore[no-untyped-def]
    """Take the voxels of one robot into the sums. seen: bits of robots, OCCUPIED and FREE."""
    for n in range(rows.shape[0]):
        for i in range(512):
            value = values[n, i]
            if value != value:
                continue
            row = rows[n]
            before = seen[row, i]
            if rule == ADD or (rule == KEEP and not before & 1):
                total[row, i] += value
            elif rule == LARGEST:
                total[row, i] = value if before == 0 else max(total[row, i], value)
            seen[row, i] = before | np.int64(1) << robot | (OCCUPIED if value >= 0 else FREE)


@numba.njit(cache=True)  # type: ignore[misc]
def settle(total, seen, rule, low, high, values, labels):  # type: ignore[no-untyped-def]
    """Fill log-odds, NaN where unknown, and labels: robots, and bit 32 where they disagree."""
    for n in range(total.shape[0]):
        for i in range(512):
            who = seen[n, i]
            robots = who & ROBOTS
            if robots == 0:
                values[n, i] = np.nan
                labels[n, i] = 0
                continue
            value = total[n, i]
            alone = robots & (robots - 1) == 0 or (rule == KEEP and robots & 1)
            if rule != LARGEST and not alone:
                value = min(max(value, low), high)
            values[n, i] = value
            torn = who & OCCUPIED and who & FREE
            labels[n, i] = robots | (np.int64(1) << 32 if torn else np.int64(0))
