"""How threads share one scan, as Numba kernels: rays are dealt out, bits are joined.

Each thread walks its rays over bits of its own (`octree_kernels.trace`), so none waits for another,
and what comes of it does not depend on their number.
"""

from __future__ import annotations

import numba
import numpy as np

from commonmap.mapping.octree_kernels import OUT, TILE_BLOCKS, key_of, tile_of


@numba.njit(cache=True)  # type: ignore[misc]
def share_rays(origins, ends, state, factor, bounds):  # type: ignore[no-untyped-def]
    """Fill `bounds` (P + 1,): cuts between rays so that P parts have as many voxels to pass."""
    n_rays = ends.shape[0]
    stride = 0 if origins.shape[0] == 1 else 1
    passed = np.empty(n_rays + 1, np.int64)
    passed[0] = 0
    for n in range(n_rays):
        steps = np.int64(1)
        for a in range(3):
            start, end = key_of(origins[n * stride, a], factor), key_of(ends[n, a], factor)
            if state[n] != OUT and start >= 0:
                steps += abs(end - start)
        passed[n + 1] = passed[n] + steps
    n_parts = bounds.shape[0] - 1
    for part in range(n_parts + 1):
        bounds[part] = np.searchsorted(passed, passed[n_rays] * part // n_parts)


@numba.njit(cache=True)  # type: ignore[misc]
def count_new_tiles(tiles, n_tiles, table):  # type: ignore[no-untyped-def]
    """Return how many of the tiles are not in another's table."""
    count = 0
    for tile in range(n_tiles):
        count += table[tiles[tile]] < 0
    return count


@numba.njit(cache=True)  # type: ignore[misc]
def join_bits(  # type: ignore[no-untyped-def]
    tiles, n_tiles, words, touched, table,
    into_tiles, n_into, into_words, into_touched, into_table,
):  # fmt: skip
    """Add the bits of one thread to another's, clear them, and return the other's tiles."""
    for tile in range(n_tiles):
        into, n_into = tile_of(tiles[tile] << 15, into_table, into_tiles, n_into)
        for cube in range(TILE_BLOCKS):
            if not touched[tile << 6 | cube]:
                continue
            touched[tile << 6 | cube] = 0
            into_touched[into << 6 | cube] = 1
            for w in range(cube * 8, cube * 8 + 8):
                into_words[into << 9 | w] |= words[tile << 9 | w]
                words[tile << 9 | w] = 0
        table[tiles[tile]] = -1
    return n_into
