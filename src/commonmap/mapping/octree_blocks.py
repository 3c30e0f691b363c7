"""Voxels of an octree in blocks of 8^3, and the way from there to pruned leaves and back.

A block holds the log-odds of 512 voxels in Morton order (x the lowest bit, as OctoMap's child
index), NaN where unknown. Blocks sorted by their own Morton code hold the whole tree in the order
of OctoMap's files, which makes pruning one pass without a search.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from commonmap.errors import InputError
from commonmap.io import morton
from commonmap.mapping import octree_kernels as kernels
from commonmap.types import TREE_DEPTH, Float32s, Leaves

BLOCK = 512
"""Voxels of a block, 8 along each axis."""

BLOCK_DEPTH = TREE_DEPTH - 3
"""Depth of the node that a block is."""

MAX_BLOCKS = 1 << 23
"""The most blocks (2 kB each) that leaves are expanded to."""


@dataclass(frozen=True, eq=False)
class Blocks:
    """A voxel map cut into blocks.

    resolution: edge of a voxel, metres.
    codes: (B,) int64, Morton codes of the blocks' keys (`key >> 3`), rising.
    values: (B, 512) float32 log-odds in Morton order inside the block, NaN where unknown.
    """

    resolution: float
    codes: NDArray[np.int64]
    values: Float32s


PART_BLOCKS = 1024
"""Blocks whose leaves are made at a time."""

NO_LABELS = np.zeros((0, 0), np.int64)


def blocks_to_leaves(blocks: Blocks, *, pruned: bool = True) -> Leaves:
    """Return the leaves of blocks in Morton order; pruned: as coarse as equal values allow."""
    order = np.arange(len(blocks.codes))
    return leaves_of(blocks.resolution, blocks.codes, blocks.values, order, pruned=pruned)


def blocks_to_labelled_leaves(
    blocks: Blocks, labels: NDArray[np.int64]
) -> tuple[Leaves, NDArray[np.int64]]:
    """Return pruned leaves and the label of each; voxels are joined where labels agree too.

    labels: (B, 512), one for each voxel of the blocks.
    """
    order = np.arange(len(blocks.codes))
    codes, depth, value, label = _fill(blocks.codes, blocks.values, labels, order, True)
    n = int(morton.join_siblings(codes, depth, value, label))
    leaves = Leaves(blocks.resolution, morton.decode(codes[:n]), depth[:n].copy(), value[:n].copy())
    return leaves, label[:n].copy()


def leaves_of(
    resolution: float,
    codes: NDArray[np.int64],
    values: Float32s,
    order: NDArray[np.int64],
    *,
    pruned: bool,
) -> Leaves:
    """Return the leaves of the blocks `codes[order]`, `values[order]`; `codes[order]` rises."""
    most = int(_counts(values, NO_LABELS, order, pruned).sum())
    keys, depth = np.empty((most, 3), np.uint16), np.empty(most, np.uint8)
    value = np.empty(most, np.float32)
    n = 0
    for part in leaf_parts(resolution, codes, values, order, pruned=pruned):
        some = slice(n, n + len(part.depth))
        keys[some], depth[some], value[some] = part.keys, part.depth, part.log_odds
        n = some.stop
    keys.resize((n, 3), refcheck=False)  # in place: no moment with all leaves twice
    depth.resize(n, refcheck=False)
    value.resize(n, refcheck=False)
    return Leaves(resolution, keys, depth, value)


def leaf_parts(
    resolution: float,
    codes: NDArray[np.int64],
    values: Float32s,
    order: NDArray[np.int64],
    *,
    pruned: bool,
) -> Iterator[Leaves]:
    """Yield what `leaves_of` returns, part by part."""
    runs = (order[n : n + PART_BLOCKS] for n in range(0, len(order), PART_BLOCKS))
    parts = (_fill(codes, values, NO_LABELS, run, pruned)[:3] for run in runs)
    for leaf_codes, depth, value in morton.join_parts(parts) if pruned else parts:
        yield Leaves(resolution, morton.decode(leaf_codes), depth, value)


def _counts(
    values: Float32s, labels: NDArray[np.int64], order: NDArray[np.int64], pruned: bool
) -> NDArray[np.int64]:
    counts = np.empty(len(order), np.int64)
    _count_leaves(values, labels, order, pruned, counts)
    return counts


def _fill(
    codes: NDArray[np.int64],
    values: Float32s,
    labels: NDArray[np.int64],
    order: NDArray[np.int64],
    pruned: bool,
) -> tuple[NDArray[np.int64], NDArray[np.uint8], Float32s, NDArray[np.int64]]:
    """Return code, depth, log-odds and label of the leaves, joined by eight voxels at most."""
    counts = _counts(values, labels, order, pruned)
    n = int(counts.sum())
    leaf_codes, depth = np.empty(n, np.int64), np.empty(n, np.uint8)
    value, label = np.empty(n, np.float32), np.zeros(n, np.int64)
    starts = np.cumsum(counts) - counts
    _fill_leaves(codes, values, labels, order, pruned, starts, leaf_codes, depth, value, label)
    return leaf_codes, depth, value, label


def hash_blocks(codes: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Return a hash table (codes, slots) in which `octree_kernels.probe` finds the blocks."""
    size = 1 << (2 * len(codes) + 16).bit_length()
    table = np.full(size, -1, np.int64), np.zeros(size, np.int32)
    kernels.rehash(codes, len(codes), *table)
    return table


def leaves_to_blocks(leaves: Leaves, *, name: str = "octree") -> Blocks:
    """Return leaves as blocks, every leaf expanded to voxels of the resolution."""
    ordered, codes = morton.sort(leaves)
    n_blocks = int(_count_blocks(codes, ordered.depth))
    if n_blocks > MAX_BLOCKS:
        raise InputError(
            f"{name}: expanded to voxels of {leaves.resolution:g} m it has {n_blocks * BLOCK:.2g}"
            f" of them, and {MAX_BLOCKS * BLOCK:.2g} are the most this works with"
        )
    block_codes = np.empty(n_blocks, np.int64)
    values = np.full((n_blocks, BLOCK), np.nan, np.float32)
    _fill_blocks(codes, ordered.depth, ordered.log_odds, block_codes, values)
    return Blocks(leaves.resolution, block_codes, values)


@numba.njit(cache=True, inline="always")  # type: ignore[misc]
def _uniform(values, labels, n, start):  # type: ignore[no-untyped-def]
    """Tell whether the 8 voxels of block `n` from `start` on are known and equal."""
    first = values[n, start]
    for i in range(start, start + 8):
        if values[n, i] != first:
            return False
        if labels.shape[0] and labels[n, i] != labels[n, start]:
            return False
    return bool(first == first)


@numba.njit(cache=True)  # type: ignore[misc]
def _count_leaves(values, labels, order, pruned, counts):  # type: ignore[no-untyped-def]
    for n in range(order.shape[0]):
        block = values[order[n]]
        count = 0
        for group in range(64):
            known = 0
            for i in range(group * 8, group * 8 + 8):
                if block[i] == block[i]:
                    known += 1
            if pruned and known == 8 and _uniform(values, labels, order[n], group * 8):
                known = 1
            count += known
        counts[n] = count


@numba.njit(cache=True)  # type: ignore[misc]
def _fill_leaves(  # type: ignore[no-untyped-def]
    codes, values, labels, order, pruned, starts, leaf_codes, depth, value, label
):
    for n in range(order.shape[0]):
        m = order[n]
        base = codes[m] << 9
        at = starts[n]
        for group in range(64):
            i = group * 8
            last = i + 8
            joined = pruned and _uniform(values, labels, m, i)
            while i < last:
                if values[m, i] == values[m, i]:
                    leaf_codes[at] = base | i
                    depth[at] = TREE_DEPTH - 1 if joined else TREE_DEPTH
                    value[at] = values[m, i]
                    if labels.shape[0]:
                        label[at] = labels[m, i]
                    at += 1
                i += 8 if joined else 1


@numba.njit(cache=True)  # type: ignore[misc]
def _count_blocks(codes, depth):  # type: ignore[no-untyped-def]
    count = 0
    last = np.int64(-1)
    for n in range(codes.shape[0]):
        if depth[n] <= BLOCK_DEPTH:
            count += np.int64(1) << (3 * (BLOCK_DEPTH - depth[n]))
        elif codes[n] >> 9 != last:
            last = codes[n] >> 9
            count += 1
    return count


@numba.njit(cache=True)  # type: ignore[misc]
def _fill_blocks(codes, depth, value, block_codes, values):  # type: ignore[no-untyped-def]
    at = -1
    for n in range(codes.shape[0]):
        code = codes[n] >> 9
        if depth[n] <= BLOCK_DEPTH:
            for k in range(np.int64(1) << (3 * (BLOCK_DEPTH - depth[n]))):
                at += 1
                block_codes[at] = code + k
                values[at] = value[n]
            continue
        if at < 0 or block_codes[at] != code:
            at += 1
            block_codes[at] = code
        first = codes[n] & 511
        for i in range(first, first + (1 << (3 * (TREE_DEPTH - depth[n])))):
            values[at, i] = value[n]
