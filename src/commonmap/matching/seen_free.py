"""What the rays of a map saw free, as slabs: the unknown stays unknown, under crowns and roofs too.

A column with points counts as known in all its slabs where only points are at hand. Rays tell more:
a slab is known where it was seen free, or where something stands in it. How much that helps is
measured by `benchmarks/octree_knowledge.py`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from commonmap.mapping.octree import Octree
from commonmap.mapping.octree_build import insert_cloud
from commonmap.mapping.octree_columns import octree_columns
from commonmap.mapping.points import move_cloud, sampled
from commonmap.matching.maps import Layers, Prepared
from commonmap.matching.slabs import pack_slabs
from commonmap.types import Bools, Cloud, Float64s, Leaves

MOST_RAYS = 500_000
"""Rays of a map that are traced: on cells of the search more say nothing new."""

FREE_SHARE = 0.5
"""A slab of a column was seen free where at least this share of its volume was."""


def know_by_rays(layers: Layers, item: Cloud | Leaves | Float64s, prepared: Prepared) -> Layers:
    """Return the layers with slabs that are known where rays say so; as they are without rays.

    item: the map as it came. A cloud has rays where it has their origins, an octree where it has
    free leaves and needs no turning to be level.
    """
    free = see_free(layers, item, prepared)
    if free is None:
        return layers
    grid = layers.grid
    occupied = grid["slab_occupied"]
    slabs = pack_slabs(grid.origin, grid.cell, occupied, free | occupied)
    return replace(layers, slabs=slabs)


def see_free(layers: Layers, item: Cloud | Leaves | Float64s, prepared: Prepared) -> Bools | None:
    """Return (n_slabs, nx, ny), which slabs of the layers' grid were seen free; None without rays.

    The octree of a cloud has voxels as wide as the grid's cells.
    """
    grid, T = layers.grid, prepared.T_prepared_map
    shift = np.zeros(3)
    if isinstance(item, Cloud) and item.origin is not None:
        tree = Octree(grid.cell)
        insert_cloud(move_cloud(T, _some_rays(item)), tree, discretize=True)
        leaves = tree.leaves()
    elif isinstance(item, Leaves) and not item.occupied.all() and np.allclose(T[:3, :3], np.eye(3)):
        leaves, shift = item, T[:3, 3]
    else:
        return None
    shape = grid["known"].shape
    i, j = np.indices(shape).reshape(2, -1)
    middle = grid.origin + (np.column_stack([i, j]) + 0.5) * grid.cell
    ground = prepared.ground.height_at(middle).reshape(shape)
    assert grid.slab_edges is not None
    columns = octree_columns(
        leaves, grid.origin - shift[:2], grid.cell, shape, ground=ground - shift[2],
        slab_edges=grid.slab_edges,
    )  # fmt: skip
    return np.asarray(columns["free_share"] >= FREE_SHARE)


def _some_rays(cloud: Cloud) -> Cloud:
    """Return the cloud with at most `MOST_RAYS` of its rays, and nothing else of it."""
    assert cloud.origin is not None
    n = len(cloud.xyz)
    few = slice(None) if n <= MOST_RAYS else sampled(n, MOST_RAYS)
    time = None if cloud.time is None else cloud.time[few]
    return Cloud(xyz=cloud.xyz[few], origin=cloud.origin[few], time=time)
