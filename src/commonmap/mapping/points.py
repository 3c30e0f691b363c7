"""Points of a map, whatever it came as: a cloud, an octree, or a plain array."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

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


def bounds(xyz: Float64s) -> tuple[Float64s, Float64s]:
    """Return the lowest and highest coordinates, each (3,), of (N, 3) points, N > 0.

    One pass over the rows; numpy's reductions along the long axis take ten times as long.
    """
    low, high = _bounds(np.ascontiguousarray(xyz, dtype=np.float64))
    return low, high


def sample(xyz: Float64s, n_most: int) -> Float64s:
    """Return every k-th point, k the smallest that leaves at most `n_most`."""
    return xyz[:: max(1, -(-len(xyz) // n_most))]


@numba.njit(cache=True)  # type: ignore[misc]
def _bounds(xyz: NDArray[np.float64]):  # type: ignore[no-untyped-def]
    low, high = xyz[0].copy(), xyz[0].copy()
    for n in range(xyz.shape[0]):
        for a in range(3):
            low[a] = min(low[a], xyz[n, a])
            high[a] = max(high[a], xyz[n, a])
    return low, high
