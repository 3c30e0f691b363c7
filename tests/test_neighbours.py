"""Nearest points and normals by columns of the plan, against SciPy's tree and eigenvectors."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from scipy.spatial import cKDTree

from commonmap.matching.neighbours import Normals, PlanIndex, index_points
from commonmap.types import Float64s


def find_normals(index: PlanIndex, k: int) -> Float64s:
    """Return the normals of all points."""
    return Normals(index, k)[np.arange(len(index.points))]


def surfaces(seed: int) -> Float64s:
    """Return points of a floor, a wall, a post and a tree's crown, and one far away."""
    rng = np.random.default_rng(seed)
    floor = np.column_stack([rng.uniform(0, 8, (2000, 2)), rng.normal(0, 0.02, 2000)])
    wall = np.column_stack(
        [rng.uniform(0, 8, 800), rng.normal(3, 0.02, 800), rng.uniform(0, 4, 800)]
    )
    post = np.column_stack([rng.normal(6, 0.05, (200, 2)), rng.uniform(0, 9, 200)])
    crown = rng.normal((2.0, 6.0, 5.0), 0.7, (500, 3))
    return np.concatenate([floor, wall, post, crown, [[40.0, -30.0, 2.0]]])


@pytest.mark.parametrize("reach", [0.05, 0.4, 2.0, 30.0, math.inf])
@pytest.mark.parametrize("spacing", [0.02, 0.2, 3.0])
def test_the_nearest_point_is_that_of_a_tree(reach: float, spacing: float) -> None:
    xyz = surfaces(1)
    rng = np.random.default_rng(2)
    asked = np.concatenate([
        xyz[::7] + rng.normal(0, 0.1, xyz[::7].shape), rng.uniform(-60, 60, (300, 3)),
    ])  # fmt: skip
    index = index_points(xyz, spacing)
    distance, number = index.query(asked, distance_upper_bound=reach)
    expected, which = cKDTree(xyz).query(asked, distance_upper_bound=reach)
    assert np.isfinite(expected).any()
    assert np.array_equal(np.isfinite(distance), np.isfinite(expected))
    hit = np.isfinite(expected)
    assert distance[hit] == pytest.approx(expected[hit], rel=1e-12)
    assert np.array_equal(number, which)


@pytest.mark.parametrize("spacing", [0.05, 0.5])
@pytest.mark.parametrize("k", [3, 12, 20])
def test_normals_are_the_thinnest_direction_of_the_nearest(spacing: float, k: int) -> None:
    xyz = surfaces(3)
    normals = find_normals(index_points(xyz, spacing), k)
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1.0)
    for near, normal in zip(xyz[cKDTree(xyz).query(xyz, k=k)[1]], normals, strict=True):
        values, axes = np.linalg.eigh(np.cov(near.T))
        across = float(normal @ np.cov(near.T) @ normal)
        assert across == pytest.approx(values[0], rel=1e-5, abs=1e-9 * values[2])
        if values[1] > 2.0 * values[0] + 1e-6:
            assert abs(normal @ axes[:, 0]) > 1.0 - 1e-6


def test_points_that_have_no_plane_have_a_normal_all_the_same() -> None:
    same = np.ones((30, 3))
    assert find_normals(index_points(same, 0.1), 20)[0].tolist() == [0.0, 0.0, 1.0]
    line = np.column_stack([np.arange(30.0), np.zeros(30), np.zeros(30)])
    normals = find_normals(index_points(line, 1.0), 5)
    assert np.abs(np.linalg.norm(normals, axis=1) - 1.0).max() < 1e-9
    two = find_normals(index_points(line[:2], 1.0), 20)  # fewer points than neighbours
    assert np.isfinite(two).all()
    with pytest.raises(ValueError, match="33 came"):
        find_normals(index_points(line, 1.0), 33)


def test_normals_on_demand_are_those_of_all() -> None:
    index = index_points(surfaces(4), 0.2)
    every = find_normals(index, 12)
    normals = Normals(index, 12)
    rng = np.random.default_rng(4)
    for _ in range(4):  # some again
        which = rng.integers(0, len(every), 900)
        assert np.array_equal(normals[which], every[which])
    assert normals[np.zeros(0, np.int64)].shape == (0, 3)


def test_a_query_skips_what_holds_nothing_and_no_more() -> None:
    # a ring of points with nothing for 20 m within, and one point far outside
    rng = np.random.default_rng(5)
    turn = rng.uniform(0.0, 2.0 * np.pi, 3000)
    ring = np.column_stack([20.0 * np.cos(turn), 20.0 * np.sin(turn), rng.uniform(0, 3, 3000)])
    xyz = np.concatenate([ring, [[70.0, 3.0, 1.0]]])
    index = index_points(xyz, 0.3)
    assert index.gap.max() > 30  # columns of half a metre
    asked = np.concatenate([rng.uniform(-21, 21, (500, 3)), rng.uniform(-90, 90, (200, 3))])
    for reach in (0.5, 9.0, math.inf):
        distance, number = index.query(asked, distance_upper_bound=reach)
        expected, which = cKDTree(xyz).query(asked, distance_upper_bound=reach)
        assert np.array_equal(number, which)
        assert distance == pytest.approx(expected)


def test_gaps_by_hand() -> None:
    # two points, 1 m columns of 5 x 3: the farther way to the nearer one counts
    xyz = np.array([[0.5, 0.5, 0.0], [4.5, 2.5, 0.0]])
    index = index_points(xyz, 2.0 / 3.0)
    assert index.shape == (5, 3)
    assert index.gap.reshape(5, 3).tolist() == [
        [0, 1, 2], [1, 1, 2], [2, 2, 2], [2, 1, 1], [2, 1, 0],
    ]  # fmt: skip


def test_threads_may_share_normals() -> None:
    xyz = surfaces(4)
    index = index_points(xyz, 0.1)
    expected = find_normals(index, 20)
    rng = np.random.default_rng(6)
    wanted = [rng.integers(0, len(xyz), 400) for _ in range(40)]
    normals = Normals(index, 20)
    with ThreadPoolExecutor(8) as pool:
        for which, found in zip(wanted, pool.map(normals.__getitem__, wanted), strict=True):
            assert np.array_equal(found, expected[which])
