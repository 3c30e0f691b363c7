"""Points of a map, whatever it came as: a cloud, an octree, or a plain array."""

from __future__ import annotations

import numpy as np

from commonmap.errors import EmptyMapError
from commonmap.frames import check_points
from commonmap.types import TREE_DEPTH, Cloud, Float64s, Leaves

MAX_VOXELS = 20_000_000
"""Pruned leaves are opened up to about this many voxels; beyond, each stands for itself."""


def points_of(item: Cloud | Leaves | Float64s, name: str = "map") -> Float64s:
    """Return the finite points (N, 3) float64 of a map: of an octree, its occupied voxels' centres.

    Raises InputError for an array of another shape and EmptyMapError where no point is left.
    """
    if isinstance(item, Leaves):
        xyz = voxel_centres(item)
    else:
        xyz = check_points(item.xyz if isinstance(item, Cloud) else item, name)
    finite = np.isfinite(xyz).all(axis=1)
    if not finite.all():
        xyz = xyz[finite]
    if len(xyz) == 0:
        kind = "occupied voxel" if isinstance(item, Leaves) else "finite point"
        raise EmptyMapError(f"the {name} holds no {kind}; a map needs at least a few hundred")
    return np.ascontiguousarray(xyz)


def voxel_centres(leaves: Leaves) -> Float64s:
    """Return the centres (N, 3) of the smallest voxels of all occupied leaves."""
    occupied = leaves.occupied
    keys = leaves.keys[occupied].astype(np.int64)
    width = np.left_shift(1, TREE_DEPTH - leaves.depth[occupied].astype(np.int64))
    if float((width.astype(np.float64) ** 3).sum()) > MAX_VOXELS:
        return leaves.centres()[occupied]
    found = []
    for w in np.unique(width):
        corner = keys[width == w]
        steps = np.arange(w)
        offset = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
        found.append((corner[:, None, :] + offset[None, :, :]).reshape(-1, 3))
    if not found:
        return np.zeros((0, 3))
    return (np.concatenate(found) - (1 << (TREE_DEPTH - 1)) + 0.5) * leaves.resolution
