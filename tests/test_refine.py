"""The refinement: six degrees of freedom to the millimetre, an honest covariance, and its basin."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from commonmap.frames import from_xyz_yaw
from commonmap.mapping.ground import Ground
from commonmap.mapping.points import (
    first_of_voxels,
    floor_int,
    rows_of,
    sample,
    sample_where,
    thin,
)
from commonmap.matching.covariance import Pairs, pair_points
from commonmap.matching.inliers import share_of_inliers
from commonmap.matching.refine import (
    choose_walkers,
    find_surface,
    lift,
    refine,
    settle,
    walk,
    walking_voxel,
)
from commonmap.types import Float64s
from matching_scenes import apart, look, make_place, moved, rigid

CELL = 0.5


def turned(xyz_turn: tuple[float, float, float], shift: tuple[float, float, float]) -> Float64s:
    """Return the motion of a rotation vector in degrees and a shift in metres."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(np.radians(xyz_turn)).as_matrix()
    T[:3, 3] = shift
    return T


def shift_about(offset: Float64s, T: Float64s, source: Float64s) -> Float64s:
    """Return T followed by the offset, its rotation about the middle of the moved source."""
    to_middle = np.eye(4)
    to_middle[:3, 3] = moved(T, source).mean(axis=0)
    return np.asarray(to_middle @ offset @ np.linalg.inv(to_middle) @ T)


def plane(
    rng: np.random.Generator,
    corner: tuple[float, float, float],
    u: tuple[float, float, float],
    v: tuple[float, float, float],
    n: int,
) -> Float64s:
    """Return n exact points of the parallelogram corner + s u + t v."""
    st_ = rng.uniform(0.0, 1.0, (n, 2))
    return np.asarray(np.array(corner) + st_[:, :1] * np.array(u) + st_[:, 1:] * np.array(v))


def yard(rng: np.random.Generator, *, ends: bool = True) -> Float64s:
    """Return exact planes: a floor of 20 x 12 m, two long walls, and walls across unless open."""
    parts = [
        plane(rng, (-10, -6, 0), (20, 0, 0), (0, 12, 0), 24_000),
        plane(rng, (-10, -6, 0), (20, 0, 0), (0, 0, 4), 9_000),
        plane(rng, (-10, 6, 0), (20, 0, 0), (0, 0, 4), 9_000),
    ]
    if ends:
        parts.append(plane(rng, (-10, -6, 0), (0, 12, 0), (0, 0, 4), 6_000))
        parts.append(plane(rng, (5, -2, 0), (0, 4, 0), (0, 0, 3), 3_000))
        parts.append(plane(rng, (5, -2, 0), (3, 0, 0), (0, 0, 3), 3_000))
    return np.concatenate(parts)


@pytest.mark.parametrize(
    "offset",
    [
        turned((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        turned((0.8, -0.5, 1.2), (0.3, -0.25, 0.2)),
        turned((-1.0, 1.0, -1.0), (-0.35, 0.2, -0.15)),
    ],
)
def test_a_known_offset_of_six_degrees_of_freedom_is_undone(offset: Float64s) -> None:
    rng = np.random.default_rng(1)
    T = rigid(40.0, -25.0, 3.0, 2.0)
    target = moved(T, yard(rng))
    source = yard(rng)[::2]
    refined = refine(target, source, shift_about(offset, T, source), cell=CELL)
    assert refined.converged
    metres, degrees = apart(refined.T_target_source, T, source)
    assert metres < 0.005
    assert degrees < 0.02
    assert refined.rms < 0.02
    assert refined.moved[0] < 3.0 * CELL


def test_the_same_points_are_laid_on_themselves() -> None:
    target = look(make_place(2), np.random.default_rng(2))
    start = turned((0.3, 0.2, -0.6), (0.2, 0.1, -0.1))
    refined = refine(target, target, start, cell=CELL)
    metres, degrees = apart(refined.T_target_source, np.eye(4), target)
    assert metres < 0.01
    assert degrees < 0.01


def test_two_noisy_looks_agree_to_centimetres() -> None:
    place = make_place(3)
    target = look(place, np.random.default_rng(3))
    source = look(place, np.random.default_rng(4), roofs=False, edge=24.0)
    start = turned((0.4, -0.4, 1.0), (0.25, -0.2, 0.2))
    refined = refine(target, source, start, cell=CELL)
    metres, degrees = apart(refined.T_target_source, np.eye(4), source)
    assert refined.converged
    assert metres < 0.03
    assert degrees < 0.1


def test_walkers_are_one_point_a_voxel_and_fewer_on_the_wider_one() -> None:
    rng = np.random.default_rng(8)
    cloud = yard(rng)
    walkers = choose_walkers(cloud, 0.9)
    some = thin(cloud, 0.3)
    assert len(some) < 8_000
    assert np.array_equal(walkers.some, some)
    assert np.array_equal(walkers.few, thin(some, 0.9))
    T = rigid(3.0, -2.0, 0.5, 0.3)
    for name in ("few", "some"):
        there = moved(T, getattr(walkers, name))
        assert getattr(walkers.moved(T), name) == pytest.approx(there, abs=1e-12)


def test_a_walk_on_a_wider_surface_than_the_source_reaches_ends_at_the_same_place() -> None:
    rng = np.random.default_rng(9)
    target, source = yard(rng), yard(rng)
    far = moved(rigid(300.0, 40.0, 20.0, 0.5), yard(rng))
    start = turned((0.4, -0.3, 0.6), (0.3, 0.2, -0.1))
    walkers = choose_walkers(source, CELL)
    ways = [
        walk(find_surface(thin(xyz, walking_voxel(CELL)), 0.2), walkers, start, cell=CELL)
        for xyz in (target, np.concatenate([target, far]))
    ]
    one, other = (way.arrived().T_target_source for way in ways)
    assert one == pytest.approx(other, abs=1e-9)
    metres, degrees = apart(one, np.eye(4), source)
    assert metres < 0.03
    assert degrees < 0.1
    # and the finest points go on from there
    settled = settle(ways[1], np.concatenate([target, far]), source)
    assert settled.converged and settled.settled is not None
    metres, degrees = apart(settled.T_target_source, np.eye(4), source)
    assert metres < 0.005
    assert degrees < 0.02


def test_a_walk_over_nothing_arrives_nowhere() -> None:
    rng = np.random.default_rng(10)
    start = rigid(400.0, 0.0, 0.0, 0.3)
    surface = find_surface(thin(yard(rng), 0.2), 0.2)
    way = walk(surface, choose_walkers(yard(rng), CELL), start, cell=CELL)
    assert way.pairs is None
    for refined in (way.arrived(), settle(way, yard(rng), yard(rng))):
        assert not refined.converged
        assert refined.settled is None
        assert refined.rms == math.inf
        assert refined.T_target_source == pytest.approx(start, abs=1e-9)
        assert np.array_equal(refined.covariance, np.eye(6))


def test_leaving_the_basin_gives_the_start_back() -> None:
    # 14 deg off: the registration finds the way, but that is not the pose that was searched
    rng = np.random.default_rng(5)
    target = yard(rng)
    start = rigid(0.0, 0.0, 0.0, math.radians(14.0))
    refined = refine(target, yard(rng), start, cell=1.0)
    assert not refined.converged
    assert refined.T_target_source == pytest.approx(start, abs=1e-12)


def test_no_common_points_are_no_convergence() -> None:
    rng = np.random.default_rng(6)
    start = rigid(500.0, 0.0, 0.0, 0.3)
    refined = refine(yard(rng), yard(rng), start, cell=CELL)
    assert not refined.converged
    assert np.array_equal(refined.T_target_source, start)
    assert refined.rms == math.inf
    few = refine(yard(rng), np.zeros((5, 3)), start, cell=CELL)
    assert not few.converged


def noisy(xyz: Float64s, rng: np.random.Generator) -> Float64s:
    """Return the points with 2 cm of noise."""
    return np.asarray(xyz + rng.normal(0.0, 0.02, xyz.shape))


def test_the_covariance_is_positive_definite_and_largest_along_a_corridor() -> None:
    rng = np.random.default_rng(7)
    closed = refine(noisy(yard(rng), rng), noisy(yard(rng), rng), np.eye(4), cell=CELL)
    corridor = refine(
        noisy(yard(rng, ends=False), rng), noisy(yard(rng, ends=False), rng), np.eye(4), cell=CELL
    )
    for refined in (closed, corridor):
        C = refined.covariance
        assert C.shape == (6, 6)
        assert np.array_equal(C, C.T)
        assert np.linalg.eigvalsh(C).min() > 0.0
    # nothing across the corridor tells how far along it the robot is
    assert corridor.covariance[0, 0] > 4.0 * closed.covariance[0, 0]
    assert corridor.covariance[0, 0] > 4.0 * corridor.covariance[1, 1]
    assert corridor.covariance[0, 0] > 4.0 * corridor.covariance[2, 2]


def test_the_covariance_owns_up_to_what_a_corridor_cannot_tell() -> None:
    rng = np.random.default_rng(8)
    target, source = (noisy(yard(rng, ends=False), rng) for _ in range(2))
    refined = refine(target, source, rigid(0.3, 0.0, 0.0, 0.0), cell=CELL)
    error = moved(refined.T_target_source, refined.centre[None])[0] - refined.centre
    assert abs(error[0]) < 4.0 * math.sqrt(refined.covariance[0, 0])
    # along the corridor next to nothing is known, across it and upwards it is
    assert refined.covariance[0, 0] > 20.0**2 * refined.covariance[1, 1]
    assert math.sqrt(refined.covariance[2, 2]) < 0.02


def test_the_covariance_covers_the_errors_of_many_looks() -> None:
    # each look draws its noise anew: errors over their standard deviation stay near one
    place = make_place(8, 24.0, n_boxes=5, n_posts=8)
    z = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        target, source = look(place, rng, noise=0.03), look(place, rng, noise=0.03, roofs=False)
        refined = refine(target, source, np.eye(4), cell=CELL)
        at = moved(refined.T_target_source, refined.centre[None])[0] - refined.centre
        z.append(at / np.sqrt(np.diag(refined.covariance)[:3]))
    rms = math.sqrt(float(np.mean(np.square(z))))
    assert 0.05 < rms < 3.0


def test_the_result_is_the_same_whatever_runs_beside_it() -> None:
    place = make_place(9, 24.0)
    target = look(place, np.random.default_rng(9))
    source = look(place, np.random.default_rng(10), edge=14.0)
    start = turned((0.2, 0.3, 0.5), (0.2, 0.1, 0.0))
    one = refine(target, source, start, cell=CELL)
    with ThreadPoolExecutor(2) as pool:
        runs = [pool.submit(refine, target, source, start, cell=CELL) for _ in range(4)]
    for again in (run.result() for run in runs):
        assert one.T_target_source.tobytes() == again.T_target_source.tobytes()
        assert one.covariance.tobytes() == again.covariance.tobytes()


def test_the_lift_is_the_median_step_between_the_grounds() -> None:
    seen = np.ones((20, 20), bool)
    target = Ground(np.array([0.0, 0.0]), 1.0, np.full((20, 20), 7.0), seen)
    z = np.full((10, 10), 2.0)
    z[0, :3] = 50.0  # a few cells that are wrong
    source = Ground(np.array([0.0, 0.0]), 1.0, z, np.ones((10, 10), bool))
    T = lift(rigid(5.0, 5.0, 0.0, 0.4), target, source)
    assert T[2, 3] == pytest.approx(5.0)
    assert T[:2] == pytest.approx(rigid(5.0, 5.0, 0.0, 0.4)[:2])


def test_only_ground_that_both_saw_counts_for_the_lift() -> None:
    seen = np.zeros((20, 20), bool)
    seen[:10] = True
    z = np.where(seen, 3.0, -80.0)
    target = Ground(np.zeros(2), 1.0, z, seen)
    source = Ground(np.zeros(2), 1.0, np.zeros((20, 20)), np.ones((20, 20), bool))
    assert lift(np.eye(4), target, source)[2, 3] == pytest.approx(3.0)


def test_the_lift_of_maps_that_do_not_meet_changes_nothing() -> None:
    ground = Ground(np.zeros(2), 1.0, np.full((4, 4), 9.0), np.ones((4, 4), bool))
    far = rigid(100.0, 0.0, 0.0, 0.0)
    assert np.array_equal(lift(far, ground, ground), far)


def test_thin_gives_the_mean_of_each_voxel() -> None:
    xyz = np.array([[0.1, 0.1, 0.1], [0.3, 0.5, 0.9], [1.0, 0.0, 0.0], [-0.1, 0.0, 0.0]])
    got = {tuple(np.round(p, 9)) for p in thin(xyz, 1.0).tolist()}
    assert got == {(0.2, 0.3, 0.5), (1.0, 0.0, 0.0), (-0.1, 0.0, 0.0)}
    assert thin(np.zeros((0, 3)), 1.0).shape == (0, 3)


@settings(max_examples=25, deadline=None, derandomize=True)
@given(st.integers(0, 2**31), st.sampled_from([0.25, 0.5, 1.0]))
def test_thin_equals_its_slow_twin(seed: int, voxel: float) -> None:
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(-3.0, 3.0, (int(rng.integers(1, 200)), 3))
    groups: dict[tuple[int, ...], list[Float64s]] = {}
    for p in xyz:
        groups.setdefault(tuple(math.floor(c / voxel) for c in p), []).append(p)
    expected = sorted(tuple(np.mean(g, axis=0)) for g in groups.values())
    got = sorted(tuple(p) for p in thin(xyz, voxel).tolist())
    assert np.array(got) == pytest.approx(np.array(expected), abs=1e-9)


@settings(max_examples=25, deadline=None, derandomize=True)
@given(st.integers(0, 2**31), st.sampled_from([0.1, 0.25, 1.0]))
def test_the_first_point_of_each_voxel_is_that_of_a_dictionary(seed: int, voxel: float) -> None:
    rng = np.random.default_rng(seed)
    xyz = rng.normal(size=(int(rng.integers(1, 500)), 3)) * [3.0, 3.0, 1.0]
    first: dict[tuple[int, ...], int] = {}
    for n, key in enumerate(np.floor(xyz / voxel).astype(int).tolist()):
        first.setdefault(tuple(key), n)
    assert first_of_voxels(xyz, voxel).tolist() == list(first.values())


@given(st.floats(-1e15, 1e15))
def test_floor_int_is_the_floor(value: float) -> None:
    assert floor_int(value) == math.floor(value)


def test_wanted_points_are_those_of_a_mask() -> None:
    rng = np.random.default_rng(0)
    xyz, wanted = rng.normal(size=(1000, 3)), rng.random(1000) < 0.4
    assert np.array_equal(rows_of(xyz, wanted), xyz[wanted])
    assert rows_of(xyz, np.zeros(1000, bool)).shape == (0, 3)
    assert np.array_equal(sample_where(xyz, wanted, 1000), xyz[wanted])
    assert np.array_equal(sample_where(xyz, wanted, 50), sample(xyz[wanted], 50))


def test_the_last_steps_reach_no_further_than_the_cell_allows(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    reaches: list[float] = []

    def spy(*args: Any, reach: float, **options: Any) -> Pairs | None:
        reaches.append(reach)
        return pair_points(*args, reach=reach, **options)

    monkeypatch.setattr("commonmap.matching.refine.pair_points", spy)
    rng = np.random.default_rng(3)
    base, draft = (xyz + rng.normal(0.0, 0.12, xyz.shape) for xyz in (yard(rng), yard(rng)))
    assert refine(base, draft, np.eye(4), cell=0.2).converged
    assert reaches[0] == pytest.approx(0.6)
    assert reaches[-1] == pytest.approx(0.15)  # residuals of 0.1 m do not widen it
    assert reaches == sorted(reaches, reverse=True)


def test_thin_stays_near_its_limit() -> None:
    xyz = np.random.default_rng(11).uniform(0.0, 10.0, (20_000, 3))
    assert len(thin(xyz, 0.01, 1_000)) < 1_300


def test_inliers_by_hand() -> None:
    # a floor under everything, one target post at x = 0; source posts at x = 0 and x = 5
    line = np.arange(-10.0, 10.0, 0.25)
    floor = np.column_stack(
        [g.ravel() for g in np.meshgrid(line, line)] + [np.zeros(len(line) ** 2)]
    )
    heights = np.arange(0.5, 3.0, 0.1)
    post = np.column_stack([np.zeros(25), np.zeros(25), heights])
    target = np.concatenate([floor, post])
    stands = target[:, 2] > 0.25
    source = np.concatenate([post, post + np.array([5.0, 0, 0]), post + np.array([900.0, 0, 0])])
    still = np.eye(4)
    share = share_of_inliers(target, stands, source, source[:, 2] > 0.25, still, reach=0.5)
    assert share == pytest.approx(0.5)  # the one at 900 m lies over nothing known
    none = np.zeros(len(source), bool)
    assert share_of_inliers(target, stands, source, none, still, reach=0.5) == 0.0
    none = np.zeros(len(target), bool)
    assert share_of_inliers(target, none, source, source[:, 2] > 0, still, reach=1.0) == 0.0
    away = from_xyz_yaw(500.0, 0.0, 0.0, 0.0)
    assert share_of_inliers(target, stands, source, source[:, 2] > 0.25, away, reach=0.5) == 0.0
    half = from_xyz_yaw(-5.0, 0.0, 0.3, 0.0)  # the other post now, and a little higher
    assert share_of_inliers(target, stands, source, source[:, 2] > 0.25, half, reach=0.5) == 0.5


def test_thinning_keeps_points_apart_however_wide_the_cloud() -> None:
    far = np.array([[0.0] * 3, [4e4] * 3, [6e4] * 3])  # 8e18 voxels: more than can be numbered
    thinned = thin(far, 0.03)
    assert np.array_equal(thinned[np.argsort(thinned[:, 0])], far)
