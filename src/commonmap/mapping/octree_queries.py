"""Questions to the leaves of an octree: what lies in a box, what a coarser tree says, one point.

All work on the arrays of `Leaves` and give arrays, so that any octree can be asked, whether it was
built here, read from a file or merged. Answers are those of OctoMap's iterators (`begin_leafs` and
`begin_leafs_bbx` with a maximal depth) and of its `search`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from commonmap.errors import InputError
from commonmap.frames import check_points
from commonmap.io import morton
from commonmap.types import KEY_ORIGIN, TREE_DEPTH, Bools, Float32s, Leaves


def depth_of(resolution: float, edge: float) -> int:
    """Return the greatest depth of a tree whose nodes are at least `edge` metres wide.

    resolution: of the tree, metres. An edge below it gives the depth of its voxels, 16; one beyond
    the whole tree the root, 0.
    """
    if not (math.isfinite(edge) and edge > 0):
        raise InputError(f"the edge of a node must be metres above 0; {edge} came")
    levels = math.ceil(math.log2(edge / resolution) - 1e-9)
    return TREE_DEPTH - min(max(levels, 0), TREE_DEPTH)


def coarsen(leaves: Leaves, depth: int) -> Leaves:
    """Return the tree cut off at `depth` (0 the root, 16 the voxels), in Morton order.

    A node that had children becomes a leaf with the largest log-odds among its leaves, which is
    what an inner node of OctoMap holds: nothing occupied is lost, unknown parts of it are.
    """
    if not 0 <= depth <= TREE_DEPTH:
        raise InputError(f"depth must be from 0 to {TREE_DEPTH}; {depth} came")
    ordered, codes = morton.sort(leaves)
    kept = np.minimum(ordered.depth, depth).astype(np.uint8)
    codes &= -(np.int64(1) << (3 * (TREE_DEPTH - kept.astype(np.int64))))
    first = np.flatnonzero(np.diff(codes, prepend=np.int64(-1)))
    value = np.maximum.reduceat(ordered.log_odds, first) if len(first) else ordered.log_odds
    return Leaves(leaves.resolution, morton.decode(codes[first]), kept[first], value)


def in_box(leaves: Leaves, low: ArrayLike, high: ArrayLike) -> Bools:
    """Return (N,) which leaves have a voxel in the box from point `low` to point `high` (3,).

    Metres, frame of the tree. The voxels of both points belong to the box, as in OctoMap; a coarse
    leaf counts as a whole. Infinite sides leave the box open. (OctoMap's iterator also returns
    coarse leaves that end where the box begins.)
    """
    first = _keys_of(low, leaves.resolution)
    last = _keys_of(high, leaves.resolution)
    if (first > last).any():
        raise InputError(f"a box runs from its lower to its upper corner; {low!r}, {high!r} came")
    keys = leaves.keys.astype(np.int64)
    edge = np.int64(1) << (TREE_DEPTH - leaves.depth.astype(np.int64))
    met: Bools = np.all((keys <= last) & (keys + edge[:, None] > first), axis=1)
    return met


def log_odds_at(leaves: Leaves, points: ArrayLike, *, depth: int = TREE_DEPTH) -> Float32s:
    """Return the log-odds (N,) at points (N, 3), NaN where unknown: `search` of OctoMap.

    depth: of the deepest node asked, see `coarsen`.
    """
    tree = coarsen(leaves, depth)
    xyz = check_points(points)
    with np.errstate(invalid="ignore"):
        keys = np.floor(xyz * (1.0 / leaves.resolution)) + KEY_ORIGIN
        inside = np.all((keys >= 0) & (keys < 2 * KEY_ORIGIN), axis=1)
    keys[~inside] = 0
    wanted = morton.encode(keys.astype(np.uint16))
    codes = morton.encode(tree.keys)
    at = np.searchsorted(codes, wanted, side="right") - 1
    values = np.full(len(xyz), np.nan, np.float32)
    asked = np.flatnonzero(inside & (at >= 0))
    at = at[asked]
    size = np.int64(1) << (3 * (TREE_DEPTH - tree.depth[at].astype(np.int64)))
    held = wanted[asked] - codes[at] < size
    values[asked[held]] = tree.log_odds[at[held]]
    return values


def _keys_of(corner: ArrayLike, resolution: float) -> NDArray[np.float64]:
    """Return the keys (3,) of the voxel of a corner, not limited to the tree."""
    xyz = np.asarray(corner, dtype=np.float64)
    if xyz.shape != (3,) or np.isnan(xyz).any():
        raise InputError(f"a corner of a box must be x, y, z in metres; {corner!r} came")
    keys: NDArray[np.float64] = np.floor(xyz * (1.0 / resolution)) + KEY_ORIGIN
    return keys
