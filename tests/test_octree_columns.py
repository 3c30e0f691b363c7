"""Columns of an octree: spans, slabs, free space, against a voxel-by-voxel count."""

from __future__ import annotations

import numpy as np
import pytest

from commonmap.errors import InputError
from commonmap.io.morton import prune
from commonmap.mapping.octree_columns import free_heights, octree_columns, octree_grid
from commonmap.types import Leaves
from octree_oracles import leaves_at, voxels_of


def stack(*values: float) -> Leaves:
    """Return a column of voxels of 1 m above the origin, NaN for unknown."""
    known = [(k, v) for k, v in enumerate(values) if v == v]
    return leaves_at([(32768, 32768, 32768 + k) for k, _ in known], [v for _, v in known], 1.0)


def test_one_column_by_hand() -> None:
    leaves = stack(1.0, -1.0, np.nan, -1.0, 1.0, -1.0)  # ground, free, unknown, free, roof, free
    grid = octree_columns(
        leaves, (-1.0, 0.0), 1.0, (3, 2), ground=np.zeros((3, 2)), slab_edges=[0.0, 1.0, 3.0, 6.0]
    )
    assert grid["lowest"][1, 0] == 0.0 and grid["highest"][1, 0] == 5.0
    assert grid["lowest_free"][1, 0] == 1.0 and grid["highest_free"][1, 0] == 6.0
    assert np.isnan(grid["lowest"]).sum() == 5
    assert grid["occupied"][:, 1, 0].tolist() == [True, False, True]
    assert grid["free_share"][:, 1, 0] == pytest.approx([0.0, 0.5, 2 / 3])
    assert grid["known_share"][:, 1, 0] == pytest.approx([1.0, 0.5, 1.0])
    assert grid["free"][:, 1, 0].tolist() == [False, True, False]
    assert not grid["occupied"][:, 0].any() and not grid["free"][:, 2].any()


def test_slabs_follow_the_ground() -> None:
    leaves = stack(1.0, -1.0, 1.0, -1.0)
    ground = np.array([[2.0]])
    grid = octree_columns(leaves, (0, 0), 1.0, (1, 1), ground=ground, slab_edges=[0.0, 1.0, 2.0])
    assert grid["occupied"][:, 0, 0].tolist() == [True, False]
    assert grid["free"][:, 0, 0].tolist() == [False, True]
    unknown = octree_columns(
        leaves, (0, 0), 1.0, (1, 1), ground=np.array([[np.nan]]), slab_edges=[0.0, 1.0]
    )
    assert not unknown["occupied"].any() and not unknown["known_share"].any()


def test_a_slab_thinner_than_a_voxel() -> None:
    grid = octree_columns(
        stack(1.0), (0, 0), 1.0, (1, 1), ground=np.zeros((1, 1)), slab_edges=[0, 0.25, 0.5, 0.75, 1]
    )
    assert grid["occupied"][:, 0, 0].tolist() == [True] * 4


@pytest.mark.parametrize("seed", range(3))
def test_pruned_leaves_give_the_same_as_their_voxels(seed: int) -> None:
    rng = np.random.default_rng(seed)
    keys: list[tuple[int, int, int]] = []
    values: list[float] = []
    for corner in rng.integers(0, 6, (12, 3)):  # cubes of 4^3 and single voxels
        v = float(rng.choice([-1.0, 1.0]))
        for d in np.ndindex(4, 4, 4):
            x, y, z = (32768 + 4 * corner + np.array(d)).tolist()
            keys.append((x, y, z))
            values.append(v)
    unique = dict(zip(keys, values, strict=True))
    leaves = leaves_at(list(unique), list(unique.values()), 0.5)
    coarse = prune(leaves)
    assert len(coarse.depth) < len(leaves.depth)
    ground = rng.uniform(0, 2, (12, 12))
    ground = np.floor(ground / 0.5) * 0.5  # whole voxels, so that shares can be counted
    edges = [0.0, 1.0, 2.0, 4.0]
    for one in (leaves, coarse):
        grid = octree_columns(one, (0, 0), 1.0, (12, 12), ground=ground, slab_edges=edges)
        occupied, free, known = count_slowly(leaves, ground, edges)
        assert np.array_equal(grid["occupied"], occupied)
        assert np.allclose(grid["free_share"], free, atol=1e-5)
        assert np.allclose(grid["known_share"], known, atol=1e-5)


def count_slowly(
    leaves: Leaves, ground: np.ndarray, edges: list[float]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    shape = (len(edges) - 1, 12, 12)
    occupied, free, known = np.zeros(shape, bool), np.zeros(shape), np.zeros(shape)
    for (x, y, z), value in voxels_of(leaves).items():
        i, j = (x - 32768) // 2, (y - 32768) // 2
        height = (z - 32768 + 0.5) * 0.5 - ground[i, j]
        for s in range(len(edges) - 1):
            if edges[s] <= height < edges[s + 1]:
                share = 0.125 / (edges[s + 1] - edges[s])
                occupied[s, i, j] |= value > 0
                known[s, i, j] += share
                free[s, i, j] += share if value <= 0 else 0.0
    return occupied, free, known


def test_free_heights_by_hand() -> None:
    # x = 0: ground, free, free, crown, free; 1: free, unknown; 2: unknown, free; 3: occupied twice
    f, o, u = -1.0, 1.0, np.nan
    columns = [[o, f, f, o, f], [f, u, f, f, f], [u, f, f, f, f], [o, o, f, f, f], [f] * 5]
    known = [(x, z, v) for x, row in enumerate(columns) for z, v in enumerate(row) if v == v]
    leaves = leaves_at(
        [(32768 + x, 32768, 32768 + z) for x, z, _ in known], [v for *_, v in known], 1.0
    )
    grid = octree_columns(
        leaves, (0, 0), 1.0, (6, 1), ground=np.zeros((6, 1)), slab_edges=np.arange(6.0)
    )
    expected = [3.0, 1.0, np.nan, np.nan, 5.0, np.nan]
    assert np.array_equal(free_heights(grid)[:, 0], expected, equal_nan=True)
    with pytest.raises(InputError, match="slabs"):
        free_heights(octree_columns(leaves, (0, 0), 1.0, (1, 1)))


def test_an_occupied_voxel_between_cells_counts_once() -> None:
    leaves = stack(1.0)
    grid = octree_columns(leaves, (-0.7, -0.7), 1.0, (3, 3))
    assert np.isfinite(grid["lowest"]).sum() == 1 and np.isfinite(grid["lowest"][1, 1])


def test_the_grid_holds_all_leaves() -> None:
    leaves = leaves_at([(32768, 32768, 0), (32778, 32770, 9)], [1.0, -1.0], 0.1)
    origin, shape = octree_grid(leaves, 0.25)
    assert origin.tolist() == [0.0, 0.0] and shape == (5, 2)
    with pytest.raises(InputError, match="extent"):
        octree_grid(leaves_at([], []), 0.25)


def test_impossible_grids_are_refused() -> None:
    leaves = stack(1.0)
    with pytest.raises(InputError, match="belong together"):
        octree_columns(leaves, (0, 0), 1.0, (1, 1), slab_edges=[0, 1])
    with pytest.raises(InputError, match="shape"):
        octree_columns(leaves, (0, 0), 1.0, (1, 1), ground=np.zeros((2, 1)), slab_edges=[0, 1])
    with pytest.raises(InputError, match="rising"):
        octree_columns(leaves, (0, 0), 1.0, (1, 1), ground=np.zeros((1, 1)), slab_edges=[1, 0])
    with pytest.raises(InputError, match="cells"):
        octree_columns(leaves, (0, 0), 0.0, (1, 1))
