"""Up to which height the columns of the common map were seen free: room to pass under a canopy."""

from __future__ import annotations

import numpy as np

from commonmap.mapping.octree_columns import free_heights, octree_columns
from commonmap.types import KEY_ORIGIN, Float32s, Float64s, GridMap, Leaves

MAX_SLABS = 64
"""Slabs that the height above ground is cut into, at most; none is thinner than a voxel."""

STRIP = 1 << 21
"""Cells times slabs that are worked on at a time."""


def free_height_layer(heights: GridMap, leaves: Leaves, octree_origin: Float64s) -> Float32s:
    """Return up to which height above ground (nx, ny) each column was seen free, metres, else NaN.

    heights: with the layers ground and height, in the target's frame. leaves: the common octree,
    whose frame is the target's less `octree_origin` (3,). Free space is followed upwards from the
    ground without a gap; what lies above is occupied, or nobody looked there. Slabs are one voxel
    thick, or the tallest height divided by 64 where that is more.
    """
    ground = heights["ground"]
    nx, ny = ground.shape
    found = np.full((nx, ny), np.nan, np.float32)
    top = float(np.nanmax(heights["height"], initial=0.0))
    if leaves.occupied.all() or not np.isfinite(ground).any():
        return found
    thick = max(leaves.resolution, top / MAX_SLABS)
    edges = np.arange(int(np.ceil(top / thick - 1e-6)) + 2) * thick
    corner = heights.origin - octree_origin[:2]
    base = ground - octree_origin[2]
    size = leaves.sizes()
    low = (leaves.keys[:, 0].astype(np.float64) - KEY_ORIGIN) * leaves.resolution
    order = np.argsort(low, kind="stable")
    low, reach = low[order], float(size.max())
    rows = max(1, STRIP // (ny * len(edges)))
    for first in range(0, nx, rows):
        strip = slice(first, min(first + rows, nx))
        x = corner[0] + np.array([strip.start, strip.stop]) * heights.cell
        start, stop = np.searchsorted(low, [x[0] - reach, x[1]])
        some = np.sort(order[start:stop])
        columns = octree_columns(
            Leaves(leaves.resolution, leaves.keys[some], leaves.depth[some], leaves.log_odds[some]),
            (x[0], corner[1]), heights.cell, (strip.stop - strip.start, ny),
            ground=base[strip], slab_edges=edges,
        )  # fmt: skip
        found[strip] = free_heights(columns)
    return found
