"""The layer that says up to which height a column was seen free."""

from __future__ import annotations

import numpy as np
import pytest

from commonmap import frames, pipeline
from commonmap.mapping.octree import Octree
from commonmap.merging import free_space
from commonmap.merging.free_space import free_height_layer
from commonmap.types import Bools, Float64s, GridMap, Leaves

CELL = 0.5


def known_box(tree: Octree, low: Float64s, high: Float64s, *, occupied: bool) -> None:
    """Make every voxel of a box occupied or free."""
    axes = [np.arange(a + CELL / 2, b, CELL) for a, b in zip(low, high, strict=True)]
    tree.update(np.stack(np.meshgrid(*axes), -1).reshape(-1, 3), occupied=occupied)


def canopy_leaves(z: float = 0.0) -> Leaves:
    """Return ground at z over 8 x 8 m, free to z + 4 for x < 6, and a crown at z + 2 for x < 3."""
    tree = Octree(CELL)
    known_box(tree, np.array([0, 0, z - 0.5]), np.array([8, 8, z]), occupied=True)
    known_box(tree, np.array([3.0, 0, z]), np.array([6, 8, z + 4]), occupied=False)
    known_box(tree, np.array([0.0, 0, z]), np.array([3, 8, z + 2]), occupied=False)
    known_box(tree, np.array([0.0, 0, z + 2]), np.array([3, 8, z + 3]), occupied=True)
    known_box(tree, np.array([0.0, 0, z + 3]), np.array([3, 8, z + 4]), occupied=False)
    return tree.leaves()


def plan(ground: float, top: float) -> GridMap:
    full = np.full((16, 16), ground, np.float32)
    height = np.full((16, 16), top, np.float32)
    return GridMap(np.zeros(2), CELL, {"ground": full, "height": height})


def columns() -> Bools:
    """Return x of the cells, (16,)."""
    return np.asarray((np.arange(16) + 0.5) * CELL)


@pytest.mark.parametrize("strip", [1, 1 << 21])
@pytest.mark.parametrize("z", [0.0, 2.0])
def test_under_a_crown_a_column_is_free_up_to_the_crown(
    monkeypatch: pytest.MonkeyPatch, strip: int, z: float
) -> None:
    monkeypatch.setattr(free_space, "STRIP", strip)
    found = free_height_layer(plan(z, 4.0), canopy_leaves(z), np.zeros(3))
    x = columns()
    assert np.allclose(found[x < 3], 2.0)
    assert np.allclose(found[(x > 3) & (x < 6)], 4.0)
    assert np.isnan(found[x > 6]).all()  # nobody looked


def test_the_origin_of_the_octree_is_heeded() -> None:
    heights = plan(100.0, 4.0)
    moved = GridMap(np.array([1000.0, 2000.0]), CELL, heights.layers)
    found = free_height_layer(moved, canopy_leaves(), np.array([1000.0, 2000.0, 100.0]))
    assert np.allclose(found[columns() < 3], 2.0)


def test_of_ends_alone_nothing_is_free() -> None:
    tree = Octree(CELL)
    known_box(tree, np.zeros(3) - 0.5, np.array([8, 8, 0.0]), occupied=True)
    assert np.isnan(free_height_layer(plan(0.0, 4.0), tree.leaves(), np.zeros(3))).all()


def test_a_merged_map_has_the_layer() -> None:
    leaves = canopy_leaves()
    common = pipeline.merge_maps(leaves, leaves, frames.from_rotation(np.eye(3), np.zeros(3)))
    found = common.heights["free_height"]
    x = common.heights.origin[0] + (np.arange(found.shape[0]) + 0.5) * common.heights.cell
    inner = found[:, 4:12]
    assert np.allclose(np.nanmedian(inner[(x > 0) & (x < 3)]), 2.0, atol=0.6)
    assert np.isnan(inner[x > 6.5]).all()
