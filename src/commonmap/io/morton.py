"""Leaves of an octree in Morton order: codes, sorting, pruning, counting nodes.

The Morton code of a voxel interleaves the 16 bits of its three keys, x lowest, so that bits
`3 b`, `3 b + 1`, `3 b + 2` are bit `b` of x, y, z and three bits together are the child index of
OctoMap. Leaves sorted by code stand in the order in which OctoMap's files hold them, and a leaf of
depth `d` covers the codes `code` to `code + 8**(16 - d)`, the end not included.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numba
import numpy as np
from numpy.typing import NDArray

from commonmap.errors import InputError
from commonmap.types import TREE_DEPTH, Float32s, Leaves

Codes = NDArray[np.int64]

Part = tuple[Codes, NDArray[np.uint8], Float32s]
"""Some leaves in Morton order: codes, depth, log-odds, (N,) each."""


@numba.njit(cache=True, inline="always")  # type: ignore[misc]
def spread(k):  # type: ignore[no-untyped-def]
    """Return the 16 bits of `k` at every third bit."""
    v = np.int64(k) & 0xFFFF
    v = (v | (v << 16)) & 0x0000FF0000FF
    v = (v | (v << 8)) & 0x00F00F00F00F
    v = (v | (v << 4)) & 0x0C30C30C30C3
    v = (v | (v << 2)) & 0x249249249249
    return v


@numba.njit(cache=True, inline="always")  # type: ignore[misc]
def gather(code):  # type: ignore[no-untyped-def]
    """Return every third bit of `code`: the inverse of `spread`."""
    v = np.int64(code) & 0x249249249249
    v = (v | (v >> 2)) & 0x0C30C30C30C3
    v = (v | (v >> 4)) & 0x00F00F00F00F
    v = (v | (v >> 8)) & 0x0000FF0000FF
    v = (v | (v >> 16)) & 0xFFFF
    return v


@numba.njit(cache=True)  # type: ignore[misc]
def _encode(keys):  # type: ignore[no-untyped-def]
    codes = np.empty(keys.shape[0], np.int64)
    for n in range(keys.shape[0]):
        codes[n] = spread(keys[n, 0]) | spread(keys[n, 1]) << 1 | spread(keys[n, 2]) << 2
    return codes


@numba.njit(cache=True)  # type: ignore[misc]
def _decode(codes):  # type: ignore[no-untyped-def]
    keys = np.empty((codes.shape[0], 3), np.uint16)
    for n in range(codes.shape[0]):
        keys[n, 0] = gather(codes[n])
        keys[n, 1] = gather(codes[n] >> 1)
        keys[n, 2] = gather(codes[n] >> 2)
    return keys


def encode(keys: NDArray[np.uint16]) -> Codes:
    """Return the Morton codes (N,) int64 of keys (N, 3) uint16."""
    codes: Codes = _encode(np.ascontiguousarray(keys, dtype=np.uint16))
    return codes


def decode(codes: Codes) -> NDArray[np.uint16]:
    """Return the keys (N, 3) uint16 of Morton codes (N,)."""
    keys: NDArray[np.uint16] = _decode(np.ascontiguousarray(codes, dtype=np.int64))
    return keys


@numba.njit(cache=True)  # type: ignore[misc]
def _check(keys, depth):  # type: ignore[no-untyped-def]
    """0: sorted and apart; 1: not sorted; 2: a leaf off its own grid; 3: deeper than the tree."""
    end = np.int64(0)
    state = 0
    for n in range(keys.shape[0]):
        if depth[n] > TREE_DEPTH:
            return 3
        code = spread(keys[n, 0]) | spread(keys[n, 1]) << 1 | spread(keys[n, 2]) << 2
        size = np.int64(1) << (3 * (TREE_DEPTH - depth[n]))
        if code & (size - 1):
            return 2
        if code < end:
            state = 1
        end = code + size
    return state


def in_order(leaves: Leaves) -> Leaves:
    """Return the leaves in Morton order, or raise where they overlap."""
    state = _check(leaves.keys, leaves.depth)
    if state == 1:
        order = np.argsort(encode(leaves.keys), kind="stable")
        leaves = Leaves(
            leaves.resolution, leaves.keys[order], leaves.depth[order], leaves.log_odds[order]
        )
        state = _check(leaves.keys, leaves.depth)
        if state == 1:
            raise InputError("leaves of an octree must not overlap; two of them share a voxel")
    if state == 2:
        raise InputError(
            "the key of a leaf must be its lower corner, a multiple of 2**(16 - depth); one is not"
        )
    if state == 3:
        raise InputError(f"an octree is {TREE_DEPTH} levels deep; a leaf says it lies deeper")
    return leaves


def sort(leaves: Leaves) -> tuple[Leaves, Codes]:
    """Return the leaves in Morton order and their codes, or raise where leaves overlap."""
    ordered = in_order(leaves)
    return ordered, encode(ordered.keys)


@numba.njit(cache=True)  # type: ignore[misc]
def join_siblings(codes, depth, value, label):  # type: ignore[no-untyped-def]
    """Join eight sibling leaves of one value and label into their parent, in place; return how many
    leaves are left. codes: rising."""
    top = 0
    for n in range(codes.shape[0]):
        code, d, v, w = codes[n], depth[n], value[n], label[n]
        codes[top], depth[top], value[top], label[top] = code, d, v, w
        top += 1
        while d > 0 and top >= 8:
            size = np.int64(1) << (3 * (TREE_DEPTH - d))
            first = codes[top - 1] - 7 * size
            if (codes[top - 1] // size) & 7 != 7 or codes[top - 8] != first:
                break
            same = True
            for m in range(top - 8, top):
                if depth[m] != d or value[m] != v or label[m] != w:
                    same = False
                    break
            if not same:
                break
            top -= 7
            d -= 1
            depth[top - 1] = d
    return top


def prune(leaves: Leaves) -> Leaves:
    """Return the leaves in Morton order, every eight equal siblings joined, as OctoMap does."""
    ordered, codes = sort(leaves)
    depth, value = ordered.depth.copy(), ordered.log_odds.copy()
    n = int(join_siblings(codes, depth, value, np.zeros(len(codes), np.int64)))
    return Leaves(leaves.resolution, decode(codes[:n]), depth[:n].copy(), value[:n].copy())


def join_parts(parts: Iterable[Part]) -> Iterator[Part]:
    """Join equal siblings as `join_siblings` does, of leaves that come part by part.

    The last leaves of a part are held back: at most 7 of each level can still be joined with later
    ones.
    """
    held: Part = np.empty(0, np.int64), np.empty(0, np.uint8), np.empty(0, np.float32)
    for part in parts:
        codes = np.concatenate([held[0], part[0]])
        depth = np.concatenate([held[1], part[1]])
        value = np.concatenate([held[2], part[2]])
        n = int(join_siblings(codes, depth, value, np.zeros(len(codes), np.int64)))
        cut = max(n - 7 * TREE_DEPTH, 0)
        held = codes[cut:n].copy(), depth[cut:n].copy(), value[cut:n].copy()
        yield codes[:cut], depth[:cut], value[:cut]
    yield held


@numba.njit(cache=True, inline="always")  # type: ignore[misc]
def shared_depth(a, b):  # type: ignore[no-untyped-def]
    """Return the depth of the deepest node that holds both voxels; `a` and `b` differ."""
    x = a ^ b
    d = TREE_DEPTH
    while x:
        x >>= 3
        d -= 1
    return d


@numba.njit(cache=True)  # type: ignore[misc]
def count_inner(codes, depth, before):  # type: ignore[no-untyped-def]
    """Return how many inner nodes sorted leaves need that the leaf of code `before` has not.

    before: -1 for none; then the root is among them.
    """
    inner = 0
    for n in range(codes.shape[0]):
        above = -1 if before < 0 else shared_depth(before, codes[n])
        inner += depth[n] - 1 - above
        before = codes[n]
    return inner


def count_nodes(leaves: Leaves) -> int:
    """Return the number of nodes, inner and leaf, of the octree: OctoMap's `size()`."""
    ordered, codes = sort(leaves)
    return int(count_inner(codes, ordered.depth, -1)) + len(codes)
