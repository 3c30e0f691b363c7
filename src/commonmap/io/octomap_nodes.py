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
def write_full(codes, depth, value, out_value, out_children):  # type: ignore[no-untyped-def]
    """Fill value and children byte of every node, in pre-order, from leaves in Morton order.

    An inner node has the largest value of its leaves, as OctoMap keeps it.
    """
    path = np.zeros(TREE_DEPTH + 1, np.int64)
    node = 0
    for n in range(codes.shape[0]):
        above = -1 if n == 0 else shared_depth(codes[n - 1], codes[n])
        for d in range(above + 1, depth[n] + 1):
            path[d] = node
            out_value[node] = value[n]
            out_children[node] = 0
            if d > 0:
                child = (codes[n] >> (3 * (TREE_DEPTH - d))) & 7
                out_children[path[d - 1]] |= 1 << child
            node += 1
        for d in range(above, -1, -1):
            if not value[n] > out_value[path[d]]:
                break
            out_value[path[d]] = value[n]


@numba.njit(cache=True)  # type: ignore[misc]
def write_binary(codes, depth, occupied, out):  # type: ignore[no-untyped-def]
    """Fill the 16 bits of every inner node, in pre-order, from leaves in Morton order."""
    path = np.zeros(TREE_DEPTH + 1, np.int64)
    node = 0
    for n in range(codes.shape[0]):
        above = -1 if n == 0 else shared_depth(codes[n - 1], codes[n])
        for d in range(above + 1, depth[n] + 1):
            if d < depth[n]:
                path[d] = node
                out[node] = 0
                node += 1
            if d > 0:
                child = (codes[n] >> (3 * (TREE_DEPTH - d))) & 7
                kind = 3 if d < depth[n] else (2 if occupied[n] else 1)
                out[path[d - 1]] |= kind << (2 * child)
