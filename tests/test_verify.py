"""What the points and the halves of the overlap say of a pose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from commonmap.config import Config
from commonmap.frames import difference, from_xyz_yaw
from commonmap.matching.decide import is_lost
from commonmap.matching.halves import measure_halves
from commonmap.matching.maps import Points, build_layers, choose_grid, prepare
from commonmap.matching.refine import walk
from commonmap.matching.search import Peaks, search
from commonmap.matching.verify import Maps, ground_misfit, verify
from commonmap.types import Float64s
from matching_scenes import look, make_place


def hills(rng: np.random.Generator, lift: float = 0.0) -> Float64s:
    """Return 40,000 points of a ground of waves a metre high, 12 m long, on 40 x 40 m."""
    xy = rng.uniform(-20.0, 20.0, (40_000, 2))
    z = np.sin(2.0 * np.pi * xy[:, 0] / 12.0) * np.sin(2.0 * np.pi * xy[:, 1] / 12.0)
    return np.column_stack([xy, z + lift])


def test_the_same_hills_fit_and_shifted_ones_do_not() -> None:
    rng = np.random.default_rng(1)
    off = Config().with_values(level={"mode": "off"})
    base = prepare(hills(rng), "target", off)
    xyz = hills(rng, lift=3.0)
    points = Points(xyz, np.zeros(len(xyz)), np.zeros(len(xyz), bool), 0.1)
    here = base.T_prepared_map
    fit = ground_misfit(base, points, here)
    shifted = ground_misfit(base, points, here @ from_xyz_yaw(6.0, 0.0, 0.0, 0.0))
    assert fit is not None and fit < 0.2  # the step of 3 m does not count
    # waves of amplitude 1 against their opposite: twice sin sin, whose median absolute value is 0.2
    assert shifted is not None and 0.5 < shifted < 1.2
    away = ground_misfit(base, points, here @ from_xyz_yaw(900.0, 0.0, 0.0, 0.0))
    assert away is None


def maps_of(base_side: float, draft_side: float) -> Maps:
    """Return the maps of two patches of even ground with posts, 25 points a square metre."""
    rng = np.random.default_rng(2)

    def patch(side: float) -> Float64s:
        ground = rng.uniform(-0.5 * side, 0.5 * side, (int(25 * side**2), 2))
        posts = np.repeat(rng.uniform(-0.5 * side, 0.5 * side, (40, 2)), 100, axis=0)
        z = rng.uniform(0.0, 4.0, len(posts))
        return np.vstack(
            [np.column_stack([ground, 0.0 * ground[:, 0]]), np.column_stack([posts, z])]
        )

    off = Config().with_values(level={"mode": "off"})
    base, draft = (
        prepare(patch(base_side), "target", off),
        prepare(patch(draft_side), "source", off),
    )
    cell, edges, max_height = choose_grid(base, draft, off)
    layers = [build_layers(item, cell, edges, max_height) for item in (base, draft)]
    return Maps(base, draft, layers[0], layers[1], cell, edges, max_height, cell)


def around(xyz: Float64s, low: Float64s, high: Float64s) -> Float64s:
    """Return the points inside a box of the plan."""
    return xyz[((xyz[:, :2] > low) & (xyz[:, :2] < high)).all(axis=1)]


def on_itself() -> Maps:
    """Return the maps of a patch of 40 m and the same once more."""
    maps = maps_of(40.0, 40.0)
    return replace(maps, draft=maps.base, draft_layers=maps.base_layers)


def test_looks_share_a_small_base_and_see_what_each_would_see_alone() -> None:
    maps = on_itself()
    shared = maps.with_target()
    assert shared.target is not None
    whole = maps.source()
    corner = (whole.points.xyz[:, 0] < 5.0) & (whole.points.xyz[:, 1] < 9.0)
    source = replace(whole, points=whole.points.where(corner))
    alone, together = (m.target_near(source, np.eye(4)) for m in (maps, shared))
    assert together is shared.target
    # but for the voxels on the border, what is about the source is the same
    low, high = source.points.xyz.min(axis=0)[:2], source.points.xyz.max(axis=0)[:2]
    np.testing.assert_array_equal(
        around(alone.points.xyz, low, high), around(together.points.xyz, low, high)
    )
    assert len(alone.points.xyz) < 0.6 * len(together.points.xyz)
    # and a walk on either ends at the same place
    T = from_xyz_yaw(0.4, -0.3, 0.2, 0.02)
    one, other = (walk(t.surface, source.walkers, T, cell=maps.cell) for t in (alone, together))
    metres, radians = difference(
        one.arrived().T_target_source, other.arrived().T_target_source, np.zeros(3)
    )
    assert metres < 0.02
    assert radians < 0.002


def test_a_large_base_is_not_thinned_as_a_whole() -> None:
    maps = maps_of(60.0, 20.0)
    assert maps.with_target() is maps


def peaks_at(*poses: tuple[float, float, float], score: float = 500.0) -> Peaks:
    """Return peaks about the source's origin, each with less evidence than the one before."""
    scores = np.array([score * 0.5**n for n in range(len(poses))])
    overlap = np.full(len(poses), 0.9)
    return Peaks(np.array(poses), scores, overlap, np.zeros(2), np.zeros((4, 2)), 0.5)


@pytest.mark.parametrize(
    ("decoy_score", "sure", "settles"), [(1.0, False, True), (1e9, False, False), (1e9, True, True)]
)
def test_points_settle_only_where_the_search_leaves_the_pose_a_chance(
    decoy_score: float, sure: bool, settles: bool
) -> None:
    maps = on_itself()
    found, decoy = peaks_at((0.2, -0.1, 0.0)), peaks_at((9.0, 4.0, 2.0), score=decoy_score)
    _, refined, figures = verify(maps, found, found, decoy, on_evidence=True, sure=sure, workers=1)
    assert refined.converged
    assert is_lost(figures) == (decoy_score > 1.0)
    metres, _ = difference(refined.T_target_source, np.eye(4), np.zeros(3))
    assert metres < 0.02
    assert (refined.settled is not None) == settles
    # what did not settle is told as hardly known at all
    assert np.array_equal(refined.covariance, np.eye(6)) == (not settles)


def test_the_looks_do_not_depend_on_the_threads() -> None:
    maps = maps_of(40.0, 40.0)
    found, decoy = peaks_at((0.2, -0.1, 0.0), (8.0, 5.0, 1.0)), peaks_at((9.0, 4.0, 2.0))
    found = replace(found, score=np.array([500.0, 450.0]))  # so close that both are looked at
    one, two = (
        verify(maps, found, found, decoy, on_evidence=True, sure=True, workers=n) for n in (1, 2)
    )
    assert one[2] == two[2]
    assert one[1].T_target_source.tobytes() == two[1].T_target_source.tobytes()
    assert one[1].covariance.tobytes() == two[1].covariance.tobytes()


def halves_of(seed_target: int, seed_source: int, workers: int = 2) -> tuple[float, float] | None:
    rng = np.random.default_rng(100 + seed_source)
    target = look(make_place(seed_target, 40.0), rng)
    source = look(make_place(seed_source, 40.0), rng, roofs=False, edge=24.0)
    base, draft = prepare(target, "target", Config()), prepare(source, "source", Config())
    cell, edges, max_height = choose_grid(base, draft, Config())
    one, other = (build_layers(item, cell, edges, max_height).slabs for item in (base, draft))
    found = search(one, other, min_overlap=0.1)
    return measure_halves(one, other, found, cell, workers=workers)


@pytest.mark.parametrize("seed", [3, 4, 5])
def test_both_halves_of_a_right_pose_find_it_again(seed: int) -> None:
    halves = halves_of(seed, seed)
    assert halves is not None
    assert min(halves) > 1.2


# of other seeds the lucky overlap holds too little to be cut in two
@pytest.mark.parametrize("seed", [3, 6, 8, 9, 10, 11, 12, 13])
def test_a_lucky_overlap_falls_apart(seed: int) -> None:
    halves = halves_of(seed, seed + 50)
    assert halves is not None
    assert min(halves) < 1.1
    assert halves[0] * halves[1] < 1.6


def test_the_halves_do_not_depend_on_the_threads() -> None:
    assert halves_of(6, 6, workers=1) == halves_of(6, 6, workers=2)
