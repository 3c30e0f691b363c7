"""Boxes, coarser trees and points asked of leaves, by hand, by brute force and by pyoctomap."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from commonmap.errors import InputError
from commonmap.io.morton import prune
from commonmap.mapping.octree import Octree
from commonmap.mapping.octree_queries import coarsen, depth_of, in_box, log_odds_at
from commonmap.types import Leaves
from octree_oracles import leaves_at, room_scan, voxels_of

needs_pyoctomap = pytest.mark.skipif(
    importlib.util.find_spec("pyoctomap") is None, reason="pyoctomap is not installed"
)

CORNER = leaves_at(
    [(32768, 32768, 32768), (32769, 32768, 32768), (32770, 32768, 32768), (32767, 32768, 32768)],
    [-1.0, 2.0, -0.5, 0.25],
    1.0,
)
"""Along x: voxels 0 to 2 m of the upper octant, then one below the origin, which comes first."""


def test_coarser_trees_by_hand() -> None:
    two = coarsen(CORNER, 15)
    assert two.keys.tolist() == [[32766, 32768, 32768], [32768] * 3, [32770, 32768, 32768]]
    assert two.depth.tolist() == [15, 15, 15] and two.log_odds.tolist() == [0.25, 2.0, -0.5]
    halves = coarsen(CORNER, 1)
    assert halves.keys.tolist() == [[0, 32768, 32768], [32768] * 3]
    assert halves.log_odds.tolist() == [0.25, 2.0]
    root = coarsen(CORNER, 0)
    assert root.keys.tolist() == [[0, 0, 0]] and root.log_odds.tolist() == [2.0]


def test_points_by_hand() -> None:
    points = [[0.5, 0.5, 0.5], [1.5, 0.5, 0.5], [-0.5, 0.5, 0.5], [-1.5, 0.5, 0.5], [9e9, 0, 0]]
    fine = log_odds_at(CORNER, points)
    assert fine[:3].tolist() == [-1.0, 2.0, 0.25] and np.isnan(fine[3:]).all()
    coarse = log_odds_at(CORNER, points, depth=15)
    assert coarse[:4].tolist() == [2.0, 2.0, 0.25, 0.25] and np.isnan(coarse[4])


def test_boxes_by_hand() -> None:
    def inside(low: list[float], high: list[float]) -> list[bool]:
        met: list[bool] = in_box(CORNER, low, high).tolist()
        return met

    assert inside([0.2, 0.2, 0.2], [1.0, 0.9, 0.9]) == [True, True, False, False]
    assert inside([-9, -9, -9], [-0.1, 9, 9]) == [False, False, False, True]
    assert inside([-np.inf] * 3, [np.inf] * 3) == [True] * 4
    assert inside([0, 1.0, 0], [9, 9, 9]) == [False] * 4
    coarse = Leaves(
        1.0, np.full((1, 3), 32768, np.uint16), np.array([13], np.uint8), np.ones(1, np.float32)
    )
    assert in_box(coarse, [7.5, 7.5, 7.5], [9, 9, 9]).tolist() == [True]
    assert in_box(coarse, [8.0, 0, 0], [9, 9, 9]).tolist() == [False]


def test_the_depth_of_an_edge() -> None:
    edges = (0.05, 0.1, 0.11, 0.2, 0.8, 1.0, 1e9)
    assert [depth_of(0.1, edge) for edge in edges] == [16, 16, 15, 15, 13, 12, 0]


@settings(max_examples=40, deadline=None)
@given(
    keys=st.lists(st.tuples(*[st.integers(32762, 32773)] * 3), unique=True, max_size=60),
    seed=st.integers(0, 999),
    depth=st.integers(13, 16),
)
def test_any_tree_answers_as_its_voxels_do(
    keys: list[tuple[int, int, int]], seed: int, depth: int
) -> None:
    rng = np.random.default_rng(seed)
    full = [(32768 + x, 32768 + y, 32768 + z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
    keys = sorted(set(keys) | set(full))
    values = [0.5 if k in full else float(rng.choice([-2.0, 0.0, 1.5])) for k in keys]
    leaves = prune(leaves_at(keys, values, 1.0))
    voxels = voxels_of(leaves)
    edge = 1 << (16 - depth)
    wanted: dict[tuple[int, ...], float] = {}
    for key, value in voxels.items():
        node = tuple(k // edge * edge for k in key)
        wanted[node] = max(wanted.get(node, -9.0), float(value))
    cut = coarsen(leaves, depth)
    assert voxels_of(coarsen(leaves, 16)) == voxels
    assert {
        tuple(k // edge * edge for k in key): float(v) for key, v in voxels_of(cut).items()
    } == wanted
    points = rng.uniform(-7, 6, (60, 3))
    got = log_odds_at(leaves, points, depth=depth)
    for point, value in zip(np.floor(points).astype(int) + 32768, got, strict=True):
        expected = wanted.get(tuple(int(k) // edge * edge for k in point))
        assert np.isnan(value) if expected is None else value == expected
    low = rng.uniform(-7, 3, 3)
    high = low + rng.uniform(0, 5, 3)
    met = in_box(leaves, low, high)
    first, last = np.floor(low) + 32768, np.floor(high) + 32768
    for key, leaf_depth, is_met in zip(leaves.keys, leaves.depth, met, strict=True):
        one = Leaves(1.0, key[None], np.array([leaf_depth]), np.ones(1, np.float32))
        inside = [all(first <= k) and all(np.array(k) <= last) for k in voxels_of(one)]
        assert is_met == any(inside)


def test_an_empty_tree_answers_too() -> None:
    empty = Octree(0.1).leaves()
    assert len(coarsen(empty, 4).depth) == 0
    assert np.isnan(log_odds_at(empty, [[0.0, 0.0, 0.0]])).all()
    assert in_box(empty, [0, 0, 0], [1, 1, 1]).shape == (0,)


def test_a_tree_and_its_leaves_answer_alike() -> None:
    rng = np.random.default_rng(3)
    tree = Octree(0.2)
    tree.insert((0, 0, 1.5), room_scan(np.array([0.0, 0.0, 1.5]), rng))
    points = rng.uniform(-9, 9, (3000, 3))
    points[0] = np.nan
    asked = log_odds_at(tree.leaves(), points)
    assert np.array_equal(asked, tree.log_odds_at(points), equal_nan=True)
    assert 0 < np.isnan(asked).sum() < 3000


@needs_pyoctomap
def test_pyoctomap_answers_alike() -> None:
    import pyoctomap

    rng = np.random.default_rng(5)
    tree, peer = Octree(0.2), pyoctomap.OcTree(0.2)
    for k in range(2):
        origin = np.array([0.5 * k, -0.3 * k, 1.5], np.float32)
        points = room_scan(origin.astype(float), rng)
        tree.insert(origin, points, max_range=20.0)
        peer.insertPointCloud(points.astype(float), origin.astype(float), 20.0)
    leaves = tree.leaves()

    def told(nodes: object) -> set[tuple[float, ...]]:
        found = [(*node.getCoordinate(), node.getSize()) for node in nodes]  # type: ignore[attr-defined]
        return {tuple(np.round(row, 3).tolist()) for row in found}

    def ours(some: Leaves) -> set[tuple[float, ...]]:
        rows = np.column_stack([some.centres(), some.sizes()])
        return {tuple(row) for row in np.round(rows, 3).tolist()}

    asked = rng.uniform((-8, -8, -2), (8, 8, 3), (500, 3))
    for depth in (14, 12, 5):
        assert ours(coarsen(leaves, depth)) == told(peer.begin_leafs(depth))
    for depth in (16, 14, 12, 3, 1):
        nodes = [peer.search(point, depth) for point in asked]
        expected = [np.nan if node is None else node.getLogOdds() for node in nodes]
        got = log_odds_at(leaves, asked, depth=depth)
        assert np.array_equal(got, np.array(expected, np.float32), equal_nan=True)
    low, high = np.array([-2.3, -1.1, 0.3]), np.array([1.7, 2.2, 2.9])
    met = in_box(leaves, low, high)
    mine = ours(Leaves(0.2, leaves.keys[met], leaves.depth[met], leaves.log_odds[met]))
    theirs = told(peer.begin_leafs_bbx(low, high))
    assert len(mine) > 1000 and mine <= theirs
    for x, y, z, edge in theirs - mine:  # coarse leaves that end where the box begins
        ends = np.array([x, y, z]) + edge / 2
        assert edge > 0.2 and np.isclose(ends, np.floor(low / 0.2) * 0.2, atol=1e-3).any()


def test_impossible_questions_are_refused() -> None:
    with pytest.raises(InputError, match="depth"):
        coarsen(CORNER, 17)
    with pytest.raises(InputError, match="lower to its upper"):
        in_box(CORNER, [1, 0, 0], [-1, 1, 1])
    with pytest.raises(InputError, match="corner"):
        in_box(CORNER, [1, 0], [1, 1, 1])
    with pytest.raises(InputError, match="edge"):
        depth_of(0.1, 0.0)
