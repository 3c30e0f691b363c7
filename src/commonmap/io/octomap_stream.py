"""Writes the node stream of an octree's file part by part, in the order of the leaves.

An inner node stands before its leaves and says what they hold. So its place is left open, and
filled in when the last of its leaves is known: at once where that is in the same part, else by
going back in the file, which concerns 16 nodes a part at most.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from commonmap.errors import InputError
from commonmap.io import morton, octomap_nodes
from commonmap.types import TREE_DEPTH, Float32s, LeafParts, Leaves

PART = 1 << 18
"""Leaves that are worked on at a time."""

FULL_NODE = np.dtype([("value", "<f4"), ("children", "u1")])
BINARY_NODE = np.dtype("<u2")


def count_nodes(leaves: Leaves | LeafParts, *, binary: bool) -> int:
    """Return the nodes, inner and leaf, that a file of these leaves has, or raise what is wrong.

    binary: a `.bt` file, whose leaves are joined where all are occupied or all free.
    """
    n = 0
    before = -1
    for codes, depth, _ in _parts(leaves, binary):
        n += int(morton.count_inner(codes, depth, before)) + len(codes)
        before = int(codes[-1])
    return n


def write_nodes(file: BinaryIO, leaves: Leaves | LeafParts, *, binary: bool) -> None:
    """Write the nodes of all leaves where the file stands."""
    start = file.tell()
    node = BINARY_NODE if binary else FULL_NODE
    walk = np.array([0, -1, 0], np.int64)
    levels = np.zeros(TREE_DEPTH, np.int64), np.zeros(TREE_DEPTH, np.float32)
    mask = np.zeros(TREE_DEPTH, np.uint16)
    late = np.zeros(TREE_DEPTH, np.int64), np.zeros(TREE_DEPTH, np.float32)
    late_mask = np.zeros(TREE_DEPTH, np.uint16)

    def mend(n: int) -> None:
        records = _records(late[1][:n], late_mask[:n], binary)
        for number, record in zip(late[0][:n], records, strict=True):
            file.seek(start + int(number) * node.itemsize)
            file.write(record.tobytes())
        file.seek(0, 2)

    for codes, depth, value in _parts(leaves, binary):
        n = int(morton.count_inner(codes, depth, walk[1])) + (0 if binary else len(codes))
        new_value, new_mask = np.zeros(n, np.float32), np.zeros(n, np.uint16)
        n_late = octomap_nodes.fill_nodes(
            codes, depth, value, binary, walk, *levels, mask, new_value, new_mask, *late, late_mask
        )
        file.write(_records(new_value, new_mask, binary).tobytes())
        mend(n_late)
    mend(octomap_nodes.close_nodes(walk, *levels, mask, *late, late_mask))


def _records(value: Float32s, mask: NDArray[np.uint16], binary: bool) -> NDArray[Any]:
    if binary:
        return mask.astype(BINARY_NODE)
    records = np.empty(len(value), FULL_NODE)
    records["value"], records["children"] = value, mask
    return records


def _parts(leaves: Leaves | LeafParts, binary: bool) -> Iterator[morton.Part]:
    """Yield what is to be written, part by part, none of them empty."""
    parts = _checked(_slices(leaves) if isinstance(leaves, Leaves) else leaves)
    if binary:
        parts = _split_root(morton.join_parts(_signs(parts)))
    for part in parts:
        if len(part[0]):
            yield part


def _slices(leaves: Leaves) -> Iterator[Leaves]:
    leaves = morton.in_order(leaves)
    for n in range(0, len(leaves.depth), PART):
        some = slice(n, n + PART)
        yield Leaves(
            leaves.resolution, leaves.keys[some], leaves.depth[some], leaves.log_odds[some]
        )


def _checked(parts: Iterable[Leaves]) -> Iterator[morton.Part]:
    """Yield the parts with their codes; raise where leaves are not in order, or no numbers."""
    end = 0
    for part in parts:
        if not np.isfinite(part.log_odds).all():
            raise InputError("the log-odds of an octree must be finite; NaN or infinity came")
        part, codes = morton.sort(part)
        if len(codes) == 0:
            continue
        if codes[0] < end:
            raise InputError("parts of an octree must follow in Morton order; one does not")
        end = int(codes[-1]) + (1 << (3 * (TREE_DEPTH - int(part.depth[-1]))))
        yield codes, part.depth, part.log_odds


def _signs(parts: Iterable[morton.Part]) -> Iterator[morton.Part]:
    for codes, depth, value in parts:
        yield codes, depth, np.where(value >= 0, np.float32(1), np.float32(-1))


def _split_root(parts: Iterable[morton.Part]) -> Iterator[morton.Part]:
    """Pass on the parts; a root that is a leaf becomes eight: alone it has no bits."""
    for codes, depth, value in parts:
        if len(depth) and depth[0] == 0:
            codes = np.arange(8, dtype=np.int64) << (3 * (TREE_DEPTH - 1))
            depth, value = np.ones(8, np.uint8), np.repeat(value, 8)
        yield codes, depth, value
