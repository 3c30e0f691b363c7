"""The inner loops of the octree: rays through voxels, one update a voxel and scan (Numba).

How one scan goes in (`commonmap.mapping.octree.Octree.insert` calls these in turn):

1. `clip` cuts rays at the maximal range and finds the box of keys that the scan can touch.
2. `trace` walks every ray and sets one bit for each voxel it frees. Bits live in tiles of 32^3
   voxels (4 kB) that exist only where a ray went. The address of a voxel is a dilated integer: the
   lowest 15 bits are its Morton code inside the tile, the rest names the tile, and a step along one
   axis is one addition and two masks whatever borders it crosses. Nothing in the loop branches
   but its end.
   With several threads each walks its share of the rays (`octree_threads`) over its own bits, and
   the bits are joined: set in any order they are the same bits.
3. `keep_ends` takes the bit of every end voxel away: a voxel with a hit is never freed by its scan.
4. `locate` finds or makes the block of 8^3 log-odds behind each cube of bits that was touched.
5. `apply_misses` and `apply_hits` add to the log-odds, once a voxel, and `forget` clears the bits.

Arithmetic follows OctoMap step by step (float32 points, directions and log-odds, float64 ray
parameters), so that the result is OctoMap's to the last bit. The traversal is that of Amanatides
and Woo 1987 as OctoMap's `computeRayKeys` has it.
"""

from __future__ import annotations

import numba
import numpy as np

from commonmap.io.morton import spread
from commonmap.types import KEY_ORIGIN

FAR = np.finfo(np.float64).max
HIT, MISS, OUT = 0, 1, 2
KEY_LIMIT = 2 * KEY_ORIGIN
TILE_WORDS = 512
TILE_BLOCKS = 64


@numba.njit(cache=True, inline="always")  # type: ignore[misc]
def key_of(coordinate, factor):  # type: ignore[no-untyped-def]
    """Return the key of a coordinate, or -1 outside of the tree. factor: 1 / resolution."""
    scaled = np.floor(factor * np.float64(coordinate)) + KEY_ORIGIN
    if scaled >= 0.0 and scaled < KEY_LIMIT:
        return np.int64(scaled)
    return np.int64(-1)


@numba.njit(cache=True)  # type: ignore[misc]
def clip(origins, points, factor, max_range, ends, state):  # type: ignore[no-untyped-def]
    """Fill end and state (HIT, MISS, OUT) of each ray; return the box of their keys (2, 3)."""
    box = np.empty((2, 3), np.int64)
    box[0] = KEY_LIMIT
    box[1] = -1
    stride = 0 if origins.shape[0] == 1 else 1
    reach = np.float32(max_range)
    for n in range(points.shape[0]):
        x0, y0, z0 = origins[n * stride, 0], origins[n * stride, 1], origins[n * stride, 2]
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        state[n] = HIT
        if max_range >= 0.0:
            dx, dy, dz = x - x0, y - y0, z - z0
            norm = np.sqrt(np.float64(dx * dx + dy * dy + dz * dz))
            if not norm <= max_range:
                state[n] = MISS
                length = np.float32(norm)
                x = x0 + dx / length * reach
                y = y0 + dy / length * reach
                z = z0 + dz / length * reach
        ends[n, 0], ends[n, 1], ends[n, 2] = x, y, z
        kx, ky, kz = key_of(x, factor), key_of(y, factor), key_of(z, factor)
        ox, oy, oz = key_of(x0, factor), key_of(y0, factor), key_of(z0, factor)
        if kx < 0 or ky < 0 or kz < 0:
            state[n] = OUT
            continue
        box[0, 0], box[1, 0] = min(box[0, 0], kx), max(box[1, 0], kx)
        box[0, 1], box[1, 1] = min(box[0, 1], ky), max(box[1, 1], ky)
        box[0, 2], box[1, 2] = min(box[0, 2], kz), max(box[1, 2], kz)
        if ox < 0 or oy < 0 or oz < 0:
            continue
        box[0, 0], box[1, 0] = min(box[0, 0], ox), max(box[1, 0], ox)
        box[0, 1], box[1, 1] = min(box[0, 1], oy), max(box[1, 1], oy)
        box[0, 2], box[1, 2] = min(box[0, 2], oz), max(box[1, 2], oz)
    return box


@numba.njit(cache=True, inline="always")  # type: ignore[misc]
def ray(origin, end, key, resolution, length):  # type: ignore[no-untyped-def]
    """Return (step, tMax, tDelta) of a ray along one axis, as OctoMap computes them."""
    direction = (end - origin) / length
    if direction == 0.0 or direction != direction:
        return 0, FAR, FAR
    step = 1 if direction > 0.0 else -1
    border = (np.float64(key - KEY_ORIGIN) + 0.5) * resolution
    border += np.float64(np.float32(step * resolution * 0.5))
    t_max = (border - np.float64(origin)) / np.float64(direction)
    return step, t_max, resolution / np.float64(abs(direction))


@numba.njit(cache=True, inline="always")  # type: ignore[misc]
def _dilate(k, low, axis, shift):  # type: ignore[no-untyped-def]
    """Return the bits that key `k` contributes to an address. low: lowest tile of the box."""
    inside = spread(k & 31) << axis
    return inside | ((k >> 5) - low) << shift


@numba.njit(cache=True)  # type: ignore[misc]
def tile_of(here, table, tiles, n_tiles):  # type: ignore[no-untyped-def]
    """Return the tile of an address, a new one where there is none, and their number."""
    tile = np.int64(table[here >> 15])
    if tile < 0:
        tile = n_tiles
        table[here >> 15] = tile
        tiles[tile] = here >> 15
        n_tiles += 1
    return tile, n_tiles


@numba.njit(cache=True)  # type: ignore[misc]
def mark_ends(  # type: ignore[no-untyped-def]
    first, ends, state, resolution, low, bits, table, tiles, n_tiles, touched, at
):
    """Fill the address of each hit, -1 where there is none; return (points done, tiles).

    Arguments as of `trace`. Stops early where tiles run out.
    """
    factor = 1.0 / resolution
    shift_x = np.int64(15)
    shift_y = shift_x + bits[0]
    shift_z = shift_y + bits[1]
    for n in range(first, ends.shape[0]):
        at[n] = -1
        if state[n] != HIT:
            continue
        if n_tiles >= tiles.shape[0]:
            return n, n_tiles
        end = (
            _dilate(key_of(ends[n, 0], factor), low[0], 0, shift_x)
            | _dilate(key_of(ends[n, 1], factor), low[1], 1, shift_y)
            | _dilate(key_of(ends[n, 2], factor), low[2], 2, shift_z)
        )
        tile, n_tiles = tile_of(end, table, tiles, n_tiles)
        touched[tile << 6 | (end >> 9) & 63] = 1
        at[n] = tile << 15 | end & 0x7FFF
    return ends.shape[0], n_tiles


@numba.njit(cache=True, inline="always")  # type: ignore[misc]
def _advance(here, x, y, z, dx, dy, dz, sx, sy, sz, mx, my, mz):  # type: ignore[no-untyped-def]
    """Step over the border that comes first, without a branch; return address and ray parameters.

    x, y, z: ray parameter of the next border along each axis; d: their growth; s: what a step adds
    to the bits of the address under the mask m.
    """
    x_y, x_z, y_z = x < y, x < z, y < z
    go_x = x_y & x_z
    go_y = (not x_y) & y_z
    mask = mx if go_x else (my if go_y else mz)
    step = sx if go_x else (sy if go_y else sz)
    here = (here & ~mask) | (((here & mask) + step) & mask)
    x += dx if go_x else 0.0
    y += dy if go_y else 0.0
    z += 0.0 if go_x | go_y else dz
    return here, x, y, z


@numba.njit(cache=True, inline="always")  # type: ignore[misc]
def _start(  # type: ignore[no-untyped-def]
    n, stride, origins, ends, resolution, factor, low, shift_x, shift_y, shift_z
):
    """Return where ray `n` begins and ends and how it runs: begin equals end for an empty ray."""
    x0, y0, z0 = origins[n * stride, 0], origins[n * stride, 1], origins[n * stride, 2]
    x1, y1, z1 = ends[n, 0], ends[n, 1], ends[n, 2]
    kx, ky, kz = key_of(x0, factor), key_of(y0, factor), key_of(z0, factor)
    lx, ly, lz = key_of(x1, factor), key_of(y1, factor), key_of(z1, factor)
    if kx < 0 or ky < 0 or kz < 0:
        kx, ky, kz = lx, ly, lz
    end = (
        _dilate(lx, low[0], 0, shift_x)
        | _dilate(ly, low[1], 1, shift_y)
        | _dilate(lz, low[2], 2, shift_z)
    )
    here = (
        _dilate(kx, low[0], 0, shift_x)
        | _dilate(ky, low[1], 1, shift_y)
        | _dilate(kz, low[2], 2, shift_z)
    )
    dx, dy, dz = x1 - x0, y1 - y0, z1 - z0
    length = np.float32(np.sqrt(np.float64(dx * dx + dy * dy + dz * dz)))
    if not length > 0:
        length = np.float32(1.0)  # below what float32 can square, 1e-19 m: any length will do
    sx, tx, ddx = ray(x0, x1, kx, resolution, length)
    sy, ty, ddy = ray(y0, y1, ky, resolution, length)
    sz, tz, ddz = ray(z0, z1, kz, resolution, length)
    reach = (abs(kx - lx) + abs(ky - ly) + abs(kz - lz)) // 32 + 8
    return here, end, np.float64(length), tx, ty, tz, ddx, ddy, ddz, sx, sy, sz, reach


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def trace(  # type: ignore[no-untyped-def]
    first, last, origins, ends, state, resolution, low, bits, table, tiles, n_tiles, words, touched
):
    """Set the bit of every voxel that rays first..last pass before their end.

    Returns (rays done, tiles). low: (3,) lowest tile of the box; bits: (3,) bits of a tile's number
    along each axis. table: tile of an address, or -1; tiles: the address of each tile; words,
    touched: bits, and marks of cubes of 8^3, of all tiles. Stops early where tiles may run out; it
    may then be called again from the ray it stopped at.

    Two rays go side by side: the processor works on one while it waits for the other.
    """
    factor = 1.0 / resolution
    stride = 0 if origins.shape[0] == 1 else 1
    shift_x = np.int64(15)
    shift_y = shift_x + bits[0]
    shift_z = shift_y + bits[1]
    one = np.int64(1)
    mx = np.int64(0o11111) | ((one << bits[0]) - 1) << shift_x
    my = np.int64(0o22222) | ((one << bits[1]) - 1) << shift_y
    mz = np.int64(0o44444) | ((one << bits[2]) - 1) << shift_z
    capacity = tiles.shape[0]
    a_here = a_end = b_here = b_end = np.int64(0)
    a_sx = a_sy = a_sz = b_sx = b_sy = b_sz = np.int64(0)
    a_x = a_y = a_z = a_dx = a_dy = a_dz = a_length = 0.0
    b_x = b_y = b_z = b_dx = b_dy = b_dz = b_length = 0.0
    a_on = b_on = False
    n = first
    short = False
    a_reach = b_reach = np.int64(0)  # tiles that each ray may still need
    while True:
        while not (a_on and b_on) and n < last and not short:
            if state[n] == OUT:
                n += 1
                continue
            here, end, length, x, y, z, dx, dy, dz, sx, sy, sz, reach = _start(
                n, stride, origins, ends, resolution, factor, low, shift_x, shift_y, shift_z
            )
            if here == end:
                n += 1
                continue
            if n_tiles + (a_reach if a_on else b_reach) + reach > capacity:
                short = True
                break
            n += 1
            sx = -mx if sx > 0 else -one
            sy = -my if sy > 0 else -one
            sz = -mz if sz > 0 else -one
            if not a_on:
                a_on, a_here, a_end, a_length = True, here, end, length
                a_x, a_y, a_z, a_dx, a_dy, a_dz = x, y, z, dx, dy, dz
                a_sx, a_sy, a_sz, a_reach = sx, sy, sz, reach
            else:
                b_on, b_here, b_end, b_length = True, here, end, length
                b_x, b_y, b_z, b_dx, b_dy, b_dz = x, y, z, dx, dy, dz
                b_sx, b_sy, b_sz, b_reach = sx, sy, sz, reach
        if not (a_on or b_on):
            return n, n_tiles
        while a_on and b_on:
            tile = np.int64(table[a_here >> 15])
            if tile < 0:
                tile = n_tiles
                table[a_here >> 15] = n_tiles
                tiles[n_tiles] = a_here >> 15
                n_tiles += 1
            words[tile << 9 | (a_here >> 6) & 511] |= one << (a_here & 63)
            touched[tile << 6 | (a_here >> 9) & 63] = 1
            tile = np.int64(table[b_here >> 15])
            if tile < 0:
                tile = n_tiles
                table[b_here >> 15] = n_tiles
                tiles[n_tiles] = b_here >> 15
                n_tiles += 1
            words[tile << 9 | (b_here >> 6) & 511] |= one << (b_here & 63)
            touched[tile << 6 | (b_here >> 9) & 63] = 1
            a_here, a_x, a_y, a_z = _advance(
                a_here, a_x, a_y, a_z, a_dx, a_dy, a_dz, a_sx, a_sy, a_sz, mx, my, mz
            )
            b_here, b_x, b_y, b_z = _advance(
                b_here, b_x, b_y, b_z, b_dx, b_dy, b_dz, b_sx, b_sy, b_sz, mx, my, mz
            )
            a_on = (a_here != a_end) & (not min(min(a_x, a_y), a_z) > a_length)
            b_on = (b_here != b_end) & (not min(min(b_x, b_y), b_z) > b_length)
        if n < last and not short:
            continue
        while a_on:
            tile = np.int64(table[a_here >> 15])
            if tile < 0:
                tile = n_tiles
                table[a_here >> 15] = n_tiles
                tiles[n_tiles] = a_here >> 15
                n_tiles += 1
            words[tile << 9 | (a_here >> 6) & 511] |= one << (a_here & 63)
            touched[tile << 6 | (a_here >> 9) & 63] = 1
            a_here, a_x, a_y, a_z = _advance(
                a_here, a_x, a_y, a_z, a_dx, a_dy, a_dz, a_sx, a_sy, a_sz, mx, my, mz
            )
            a_on = (a_here != a_end) & (not min(min(a_x, a_y), a_z) > a_length)
        while b_on:
            tile = np.int64(table[b_here >> 15])
            if tile < 0:
                tile = n_tiles
                table[b_here >> 15] = n_tiles
                tiles[n_tiles] = b_here >> 15
                n_tiles += 1
            words[tile << 9 | (b_here >> 6) & 511] |= one << (b_here & 63)
            touched[tile << 6 | (b_here >> 9) & 63] = 1
            b_here, b_x, b_y, b_z = _advance(
                b_here, b_x, b_y, b_z, b_dx, b_dy, b_dz, b_sx, b_sy, b_sz, mx, my, mz
            )
            b_on = (b_here != b_end) & (not min(min(b_x, b_y), b_z) > b_length)


@numba.njit(cache=True)  # type: ignore[misc]
def keep_ends(at, words):  # type: ignore[no-untyped-def]
    """Take away the bit of every voxel with a hit."""
    for n in range(at.shape[0]):
        if at[n] >= 0:
            words[at[n] >> 6] &= ~(np.int64(1) << (at[n] & 63))


@numba.njit(cache=True, inline="always")  # type: ignore[misc]
def probe(table_codes, code):  # type: ignore[no-untyped-def]
    """Return the place of a block code in the hash table, or the free place where it belongs."""
    last = table_codes.shape[0] - 1
    h = np.uint64(code) * np.uint64(0x9E3779B97F4A7C15)
    place = np.int64(h >> np.uint64(24)) & last
    while table_codes[place] >= 0 and table_codes[place] != code:
        place = (place + 1) & last
    return place


@numba.njit(cache=True)  # type: ignore[misc]
def rehash(codes, n_blocks, table_codes, table_slots):  # type: ignore[no-untyped-def]
    """Fill an empty hash table with the slots of all blocks."""
    for slot in range(n_blocks):
        place = probe(table_codes, codes[slot])
        table_codes[place] = codes[slot]
        table_slots[place] = slot


@numba.njit(cache=True)  # type: ignore[misc]
def find_blocks(wanted, table_codes, table_slots, slots):  # type: ignore[no-untyped-def]
    """Fill the slot of each block code, -1 where there is none."""
    for n in range(wanted.shape[0]):
        place = probe(table_codes, wanted[n])
        slots[n] = table_slots[place] if table_codes[place] >= 0 else -1


@numba.njit(cache=True)  # type: ignore[misc]
def make_blocks(wanted, codes, n_blocks, table_codes, table_slots, slots):  # type: ignore[no-untyped-def]
    """As `find_blocks`, with a new slot for each block that is not there; return their number."""
    for n in range(wanted.shape[0]):
        place = probe(table_codes, wanted[n])
        if table_codes[place] < 0:
            table_codes[place] = wanted[n]
            table_slots[place] = n_blocks
            codes[n_blocks] = wanted[n]
            n_blocks += 1
        slots[n] = table_slots[place]
    return n_blocks


@numba.njit(cache=True)  # type: ignore[misc]
def count_touched(touched, n_tiles):  # type: ignore[no-untyped-def]
    """Return how many cubes of bits were touched."""
    count = 0
    for c in range(n_tiles * TILE_BLOCKS):
        count += touched[c]
    return count


@numba.njit(cache=True)  # type: ignore[misc]
def locate(tiles, n_tiles, touched, low, bits, cubes, wanted):  # type: ignore[no-untyped-def]
    """List the touched cubes, in order of tiles, with the Morton code of the block behind each.

    A cube beyond the tree is left out. Returns how many there are.
    """
    count = 0
    limit = KEY_LIMIT >> 5
    for tile in range(n_tiles):
        address = tiles[tile]
        tx = (address & ((1 << bits[0]) - 1)) + low[0]
        ty = ((address >> bits[0]) & ((1 << bits[1]) - 1)) + low[1]
        tz = (address >> (bits[0] + bits[1])) + low[2]
        if min(tx, ty, tz) < 0 or max(tx, ty, tz) >= limit:
            continue
        code = (spread(tx) | spread(ty) << 1 | spread(tz) << 2) << 6
        for cube in range(TILE_BLOCKS):
            if touched[tile << 6 | cube]:
                cubes[count] = tile << 6 | cube
                wanted[count] = code | cube
                count += 1
    return count


@numba.njit(cache=True)  # type: ignore[misc]
def clear_blocks(values, first, last):  # type: ignore[no-untyped-def]
    """Make the voxels of new blocks unknown."""
    for slot in range(first, last):
        values[slot] = np.float32(np.nan)


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def apply_misses(cubes, slots, first, last, words, values, miss, low, high):  # type: ignore[no-untyped-def]
    """Add a miss to each voxel whose bit is set, clamped to low..high, in cubes first..last."""
    start = min(max(miss, low), high)
    for n in range(first, last):
        block = values[slots[n]]
        for w in range(8):
            word = words[cubes[n] * 8 + w]
            if word == 0:
                continue
            for b in range(64):
                old = block[w * 64 + b]
                new = min(max(old + miss, low), high)
                new = old if old <= low else new
                new = start if old != old else new
                block[w * 64 + b] = new if (word >> b) & 1 else old


@numba.njit(cache=True)  # type: ignore[misc]
def apply_hits(at, slot_of, words, values, hit, low, high):  # type: ignore[no-untyped-def]
    """Add a hit to each end voxel, once, clamped to low..high. slot_of: slot of each cube."""
    for n in range(at.shape[0]):
        if at[n] < 0:
            continue
        bit = np.int64(1) << (at[n] & 63)
        if words[at[n] >> 6] & bit:
            continue
        words[at[n] >> 6] |= bit
        slot = slot_of[at[n] >> 9]
        if slot < 0:
            continue
        i = at[n] & 511
        old = values[slot, i]
        if old != old:
            old = np.float32(0.0)
        if old < high:
            values[slot, i] = min(max(old + hit, low), high)


@numba.njit(cache=True)  # type: ignore[misc]
def forget(cubes, tiles, n_tiles, words, touched, table):  # type: ignore[no-untyped-def]
    """Clear bits and marks of one scan."""
    for n in range(cubes.shape[0]):
        for w in range(8):
            words[cubes[n] * 8 + w] = 0
    for c in range(n_tiles * TILE_BLOCKS):
        touched[c] = 0
    for tile in range(n_tiles):
        table[tiles[tile]] = -1
