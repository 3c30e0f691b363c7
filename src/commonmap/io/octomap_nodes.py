"""The node streams of OctoMap's files, as Numba kernels. Called by `commonmap.io.octomap`.

Both streams hold the nodes in pre-order, children 0 to 7, x being the lowest bit of the index.
Full (.ot): per node its value (float32), further bytes by kind of tree, and one byte that says
which children exist. Binary (.bt): per inner node 16 bits, two a child: 0 not there, 1 free leaf,
2 occupied leaf, 3 inner node; leaves and the root hold nothing.
"""

from __future__ import annotations

import numba
import numpy as np

from commonmap.io.morton import shared_depth
from commonmap.types import TREE_DEPTH

TRUNCATED = -1
TOO_DEEP = -2


@numba.njit(cache=True)  # type: ignore[misc]
def read_full(children, n_nodes, leaf_node, codes, depth):  # type: ignore[no-untyped-def]
    """Walk a full stream; return (leaves, nodes), leaves negative on an error.

    children: (n,) the children byte of every whole node record of the file. n_nodes: what the
    header promised; the walk ends one node after it at the latest. leaf_node: (n,) is filled with
    the record of each leaf; codes, depth: (n,) with where it lies.
    """
    pending = np.zeros(TREE_DEPTH + 1, np.int64)
    base = np.zeros(TREE_DEPTH + 1, np.int64)
    leaves = 0
    node = 0
    d = 0
    code = np.int64(0)
    if n_nodes == 0:
        return 0, 0
    while True:
        if node >= children.shape[0]:
            return TRUNCATED, node
        pending[d] = children[node]
        base[d] = code
        if pending[d] == 0:
            leaf_node[leaves] = node
            codes[leaves] = code
            depth[leaves] = d
            leaves += 1
        elif d == TREE_DEPTH:
            return TOO_DEEP, node
        node += 1
        while pending[d] == 0:
            d -= 1
            if d < 0:
                return leaves, node
        if node >= n_nodes:
            return leaves, node + 1
        child = 0
        while not (pending[d] >> child) & 1:
            child += 1
        pending[d] &= ~(np.int64(1) << child)
        d += 1
        code = base[d - 1] + (np.int64(child) << (3 * (TREE_DEPTH - d)))


@numba.njit(cache=True)  # type: ignore[misc]
def read_binary(data, fill, codes, depth, occupied):  # type: ignore[no-untyped-def]
    """Walk a binary stream; return (leaves, nodes, bytes used), leaves negative on an error."""
    pending = np.zeros(TREE_DEPTH + 1, np.int64)
    base = np.zeros(TREE_DEPTH + 1, np.int64)
    at = 0
    leaves = 0
    nodes = 1
    d = 0
    code = np.int64(0)
    while True:
        if at + 2 > data.shape[0]:
            return TRUNCATED, nodes, at
        if d == TREE_DEPTH:
            return TOO_DEEP, nodes, at
        word = np.int64(data[at]) | np.int64(data[at + 1]) << 8
        at += 2
        pending[d] = word
        base[d] = code
        deeper = False
        while not deeper:
            if pending[d] == 0:
                d -= 1
                if d < 0:
                    return leaves, nodes, at
                continue
            child = 0
            while not (pending[d] >> (2 * child)) & 3:
                child += 1
            kind = (pending[d] >> (2 * child)) & 3
            pending[d] &= ~(np.int64(3) << (2 * child))
            nodes += 1
            code = base[d] + (np.int64(child) << (3 * (TREE_DEPTH - d - 1)))
            if kind == 3:
                d += 1
                deeper = True
            else:
                if fill:
                    codes[leaves] = code
                    depth[leaves] = d + 1
                    occupied[leaves] = kind == 2
                leaves += 1


@numba.njit(cache=True)  # type: ignore[misc]
def fill_nodes(  # type: ignore[no-untyped-def]
    codes,
    depth,
    value,
    binary,
    walk,
    at,
    best,
    mask,
    out_value,
    out_mask,
    mend,
    mend_value,
    mend_mask,
):
    """Make the nodes of the next leaves of a stream; return how many older ones are to mend.

    codes, depth, value: (N,) leaves in Morton order, all after those of earlier calls.
    binary: nodes are the inner ones, and their mask has two bits a child; else all nodes, one bit a
    child, and an inner node has the largest value of its leaves, as OctoMap keeps it.
    walk: (3,) number of the next node, code of the last leaf (-1: none), how many inner nodes are
    open, from the root on. at, best, mask: (16,) number, value and mask of these so far.
    out_value, out_mask: are filled from the first new node on; an inner node when it is closed.
    mend, mend_value, mend_mask: (16,) number, value and mask of nodes of earlier calls that this
    one closed.
    """
    first = walk[0]
    mends = 0
    for n in range(codes.shape[0]):
        above = -1 if walk[1] < 0 else shared_depth(walk[1], codes[n])
        while walk[2] > above + 1:
            mends = _close(walk, at, best, mask, first, out_value, out_mask,
                           mends, mend, mend_value, mend_mask)  # fmt: skip
        for d in range(above + 1, depth[n] + 1):
            inner = d < depth[n]
            if d > 0:
                child = (codes[n] >> (3 * (TREE_DEPTH - d))) & 7
                if not binary:
                    mask[d - 1] |= 1 << child
                elif inner:
                    mask[d - 1] |= 3 << (2 * child)
                else:
                    mask[d - 1] |= (2 if value[n] >= 0 else 1) << (2 * child)
            if inner:
                at[d], best[d], mask[d] = walk[0], value[n], 0
                walk[2] = d + 1
                walk[0] += 1
        if depth[n] > 0 and value[n] > best[depth[n] - 1]:
            best[depth[n] - 1] = value[n]
        if not binary:
            out_value[walk[0] - first] = value[n]
            out_mask[walk[0] - first] = 0
            walk[0] += 1
        walk[1] = codes[n]
    return mends


@numba.njit(cache=True)  # type: ignore[misc]
def close_nodes(walk, at, best, mask, mend, mend_value, mend_mask):  # type: ignore[no-untyped-def]
    """Close the nodes that are open after the last leaf; return how many are to mend."""
    none_value, none_mask = np.empty(0, np.float32), np.empty(0, np.uint16)
    mends = 0
    while walk[2] > 0:
        mends = _close(walk, at, best, mask, walk[0], none_value, none_mask,
                       mends, mend, mend_value, mend_mask)  # fmt: skip
    return mends


@numba.njit(cache=True, inline="always")  # type: ignore[misc]
def _close(  # type: ignore[no-untyped-def]
    walk, at, best, mask, first, out_value, out_mask, mends, mend, mend_value, mend_mask
):
    """Close the deepest open node: into the new nodes, or to the list of those to mend."""
    d = walk[2] - 1
    walk[2] = d
    if d > 0 and best[d] > best[d - 1]:
        best[d - 1] = best[d]
    if at[d] >= first:
        out_value[at[d] - first] = best[d]
        out_mask[at[d] - first] = mask[d]
        return mends
    mend[mends], mend_value[mends], mend_mask[mends] = at[d], best[d], mask[d]
    return mends + 1
