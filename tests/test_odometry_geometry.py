"""Formulas of odometry against literal numbers, slow twins and other libraries."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from commonmap.frames import from_rotation, invert
from commonmap.odometry.distances import eigen3, point_to_line, point_to_plane
from commonmap.odometry.features import choose, exclude, noise_floor, roughness
from commonmap.odometry.geometry import (
    complete_scan,
    complete_scans,
    find_lack,
)
from commonmap.odometry.local_map import LocalMap, thin
from commonmap.odometry.map_match import match_map
from commonmap.odometry.motion import (
    T_to_motion,
    damp_rate,
    deskew,
    interpolate_motion,
    motion_to_T,
    sweep_motion,
)
from commonmap.odometry.solve import (
    NOTHING,
    Prior,
    Rows,
    bisquare,
    find_openness,
    levenberg_marquardt_step,
    minimise,
    normal_equations,
    pretended,
    settle,
)
from commonmap.sim.scanning import firing_pattern
from commonmap.sim.vlp16 import VLP16
from commonmap.types import Float64s, Scan

seeds = st.integers(0, 2**32 - 1)


# ---------------------------------------------------------------- Eqs. 2 and 3


def test_distance_to_a_line_in_numbers() -> None:
    x, j, l = np.array([1.0, 3.0, 4.0]), np.zeros(3), np.array([2.0, 0.0, 0.0])
    assert point_to_line(x, j, l) == pytest.approx(5.0)


def test_distance_to_a_plane_in_numbers() -> None:
    normal = np.empty(3)
    j, l, m = np.array([0.0, 0, 1]), np.array([1.0, 0, 1]), np.array([0.0, 1, 1])
    d = point_to_plane(np.array([7.0, -3.0, 3.5]), j, l, m, normal)
    assert d == pytest.approx(2.5)
    assert normal.tolist() == [0.0, 0.0, 1.0]


@given(seeds)
@settings(max_examples=40, deadline=None)
def test_distances_do_not_depend_on_the_frame(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(4, 3))
    R, t = Rotation.random(random_state=seed % 1000).as_matrix(), rng.normal(size=3)
    moved = points @ R.T + t
    n, n_moved = np.empty(3), np.empty(3)
    x, j, l, m = points
    x2, j2, l2, m2 = moved
    assert point_to_line(x2, j2, l2) == pytest.approx(point_to_line(x, j, l), abs=1e-9)
    d, d_moved = point_to_plane(x, j, l, m, n), point_to_plane(x2, j2, l2, m2, n_moved)
    assert d_moved == pytest.approx(d, abs=1e-7)
    assert n_moved == pytest.approx(R @ n, abs=1e-6)


@given(seeds, st.sampled_from([(1, 1, 1), (1, 1, 1e-3), (1, 1e-2, 1e-5), (1, 1e-6, 0), (0, 0, 0)]))
@settings(max_examples=60, deadline=None)
def test_eigenvectors_agree_with_lapack(seed: int, scale: tuple[float, float, float]) -> None:
    rng = np.random.default_rng(seed)
    Q = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    S = Q @ np.diag(rng.uniform(0.5, 1.0, 3) * scale) @ Q.T
    S = (S + S.T) / 2
    values, vectors = np.empty(3), np.empty((3, 3))
    eigen3(S, values, vectors)
    assert values == pytest.approx(np.linalg.eigvalsh(S), abs=1e-7 * max(S.max(), 1e-9))
    assert vectors.T @ vectors == pytest.approx(np.eye(3), abs=1e-6)
    assert vectors @ np.diag(values) @ vectors.T == pytest.approx(S, abs=1e-5)


# ---------------------------------------------------------------- Eqs. 4 and 5


def test_motion_of_a_quarter_turn_in_numbers() -> None:
    T = motion_to_T(np.array([1.0, 2.0, 3.0, 0.0, 0.0, np.pi / 2]))
    expected = np.array([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
    assert pytest.approx(expected, abs=1e-12) == T


def test_interpolation_is_linear() -> None:
    motion = np.array([1.0, 0.0, -2.0, 0.0, 0.0, 0.4])
    assert interpolate_motion(motion, 0.25).tolist() == [0.25, 0.0, -0.5, 0.0, 0.0, 0.1]


@given(seeds, st.floats(0.0, np.pi))
@settings(max_examples=60, deadline=None)
def test_rotation_vectors_agree_with_scipy(seed: int, angle: float) -> None:
    axis = np.random.default_rng(seed).normal(size=3)
    theta = angle * axis / np.linalg.norm(axis)
    T = motion_to_T(np.concatenate([np.zeros(3), theta]))
    assert T[:3, :3] == pytest.approx(Rotation.from_rotvec(theta).as_matrix(), abs=1e-9)
    back = motion_to_T(T_to_motion(T))
    assert pytest.approx(T, abs=1e-9) == back


def test_deskew_in_numbers() -> None:
    # at 10 m/s along x a thing 5 m ahead is measured at 4.5 m, 50 ms after the reference moment
    rate = np.array([10.0, 0, 0, 0, 0, 0])
    out = deskew(np.array([[4.5, 1.0, 0.0]]), np.array([0.05]), rate, np.zeros(6))
    assert out[0] == pytest.approx([5.0, 1.0, 0.0])
    # turning left at 1 rad/s: what is straight ahead 0.1 s later lay 0.1 rad to the left
    rate = np.array([0.0, 0, 0, 0, 0, 1])
    out = deskew(np.array([[2.0, 0.0, 0.0]]), np.array([0.1]), rate, np.zeros(6))
    assert out[0] == pytest.approx([2 * np.cos(0.1), 2 * np.sin(0.1), 0.0])


def test_sweep_motion_passes_through_both_neighbours() -> None:
    before, after = np.array([-1.0, 0, 0, 0, 0, -0.1]), np.array([3.0, 1, 0, 0, 0, 0.2])
    rate, bend = sweep_motion(before, 0.1, after, 0.2)
    assert -0.1 * rate + 0.01 * bend == pytest.approx(before)
    assert 0.2 * rate + 0.04 * bend == pytest.approx(after)
    rate, bend = sweep_motion(before, 0.1)
    assert rate == pytest.approx(-before / 0.1)
    assert not bend.any()


def reach_of_errors(damped: bool, a: float = -0.5) -> Float64s:
    """Return the error of speed of 20 sweeps after one error of 1 m/s, in one dimension.

    All points are measured at `a` sweeps from the reference moment. Point p of a sweep is deskewed
    to p + r a with the rate r in use; the step that lays it on the last sweep's point, deskewed
    with its rate s, is 1 + (s - r) a: solved for r as the iteration does.
    """
    errors, last_used, used = [1.0], 1.0, 1.0
    last = 1.0
    for _ in range(20):
        rate = 0.0
        for _ in range(200):
            used = float(damp_rate(np.array([rate]), np.array([last]))[0]) if damped else rate
            rate += 0.3 * ((last_used - used) * a - rate)
        last_used, last = used, rate
        errors.append(rate)
    return np.array(errors)


def test_deskewing_does_not_oscillate() -> None:
    naive = reach_of_errors(damped=False)
    assert naive[1:4] == pytest.approx([-1.0, 1.0, -1.0], abs=1e-3)  # the trap: for ever
    assert abs(naive[-1]) == pytest.approx(1.0, abs=0.01)
    assert abs(reach_of_errors(damped=True)[10:]).max() < 0.02


# ---------------------------------------------------------------- Eq. 1 and the choice of features


def ring_of(points: Float64s) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    xyz = points.astype(np.float32)
    range_ = np.linalg.norm(xyz, axis=1).astype(np.float32)
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0]).astype(np.float32)
    return xyz, range_, azimuth, np.array([0, len(xyz)])


def test_roughness_in_numbers() -> None:
    points = np.array([[3.0, 0, 0], [3, 1, 0], [4, 2, 0], [3, 3, 0], [3, 4, 0]])
    xyz, range_, _, start = ring_of(points)
    kappa = roughness(xyz, range_, start, 2)
    # sum of X_i - X_j over the four neighbours of (4, 2) is (4, 0); |X_i| = sqrt(20)
    assert kappa[2] == pytest.approx(4.0 / (4 * np.sqrt(20.0)))
    assert np.isnan(kappa[[0, 1, 3, 4]]).all()


@given(seeds, st.integers(1, 6))
@settings(max_examples=20, deadline=None)
def test_roughness_agrees_with_its_slow_twin(seed: int, half: int) -> None:
    xyz, range_, _, start = ring_of(np.random.default_rng(seed).uniform(1, 9, (40, 3)))
    kappa = roughness(xyz, range_, start, half)
    x = xyz.astype(np.float64)
    for i in range(half, 40 - half):
        group = [j for j in range(i - half, i + half + 1) if j != i]
        total = np.linalg.norm(sum(x[i] - x[j] for j in group))
        assert kappa[i] == pytest.approx(total / (len(group) * np.linalg.norm(x[i])), rel=1e-4)


def wall(azimuth_deg: Float64s, distance: float) -> Float64s:
    """Return points on the wall x = distance."""
    a = np.radians(azimuth_deg)
    return np.stack([np.full_like(a, distance), distance * np.tan(a), 0 * a], axis=1)


def test_a_corner_is_an_edge_and_a_wall_is_flat() -> None:
    y = np.linspace(-3, 3, 240)
    corner = np.stack([5.0 + np.abs(y), y, 0 * y], axis=1)
    corner[:, :2] += 0.002 * np.sin(37 * y)[:, None]
    xyz, range_, azimuth, start = ring_of(corner)
    kappa = roughness(xyz, range_, start, 5)
    out = exclude(range_, azimuth, start, 5, 0.004)
    edge, plane = choose(kappa, range_, out, start, 5, noise_floor(kappa, range_))
    best = np.flatnonzero(edge == 2)
    assert len(best) and np.abs(y[best]).max() < 0.15
    assert (plane >= 1)[np.abs(y) > 0.5].mean() > 0.8
    assert not ((edge > 0) & (plane > 0)).any()


def test_points_behind_the_rim_of_an_occlusion_are_excluded() -> None:
    spacing = np.radians(0.2)
    a = np.arange(-10, 10, 0.2)
    points = np.where((a < 0)[:, None], wall(a, 5.0), wall(a, 8.0))
    _, range_, azimuth, start = ring_of(points)
    out = exclude(range_, azimuth, start, 5, spacing)
    rim = int(np.argmax(a >= 0))
    assert out[rim : rim + 5].all()  # behind
    assert not out[rim - 5 : rim].any()  # the rim of the near wall is a good edge
    backwards = exclude(range_[::-1].copy(), azimuth[::-1].copy(), start, 5, spacing)
    assert (backwards[::-1] == out).all()


def test_points_on_a_grazing_surface_are_excluded() -> None:
    a = np.radians(np.arange(2.0, 8.0, 0.2))
    points = np.stack([1.0 / np.tan(a), np.ones_like(a), 0 * a], axis=1)  # the wall y = 1
    _, range_, azimuth, start = ring_of(points)
    out = exclude(range_, azimuth, start, 3, np.radians(0.2))
    assert out[1:10].all()
    assert not exclude(*ring_of(wall(np.arange(-6, 6, 0.2), 5.0))[1:], 3, np.radians(0.2)).any()


# ---------------------------------------------------------------- Eq. 8 and degeneracy


def test_levenberg_marquardt_step_in_numbers() -> None:
    H, g = np.diag([1.0, 2, 4, 1, 1, 1]), np.array([1.0, 2, 4, 0, 0, 3])
    assert levenberg_marquardt_step(H, g, 0.0) == pytest.approx([-1, -1, -1, 0, 0, -3])
    assert levenberg_marquardt_step(H, g, 1.0) == pytest.approx([-0.5, -0.5, -0.5, 0, 0, -1.5])


def rows_of(points: Float64s, normals: Float64s, tilt: float = 1e-4) -> Rows:
    n = len(points)
    return Rows(points, points.copy(), normals, np.full(n, 0.02), np.full(n, tilt), np.arange(n))


def box(rng: np.random.Generator, axes: str, n: int = 400) -> Rows:
    """Return rows on the walls of a box of 8 m whose normals point along some axes."""
    points, normals = [], []
    for axis in axes:
        k = "xyz".index(axis)
        p = rng.uniform(-4, 4, (n, 3))
        p[:, k] = rng.choice([-4.0, 4.0], n) if axis != "z" else -2.0
        points.append(p)
        normals.append(np.tile(np.eye(3)[k], (n, 1)) + 0.01 * rng.normal(size=(n, 3)))
    u = np.concatenate(normals)
    return rows_of(np.concatenate(points), u / np.linalg.norm(u, axis=1)[:, None])


@given(seeds)
@settings(max_examples=20, deadline=None)
def test_the_jacobian_agrees_with_differences(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows = box(rng, "xyz", 5)
    T = motion_to_T(rng.normal(size=6) * 0.1)
    w = rng.uniform(0.5, 1.5, len(rows))

    def cost(step: Float64s) -> float:
        M = T @ motion_to_T(step)
        R, t = np.ascontiguousarray(M[:3, :3]), M[:3, 3].copy()
        return float(normal_equations(R, t, rows.p, rows.c, rows.u, w)[2])

    g = normal_equations(T[:3, :3].copy(), T[:3, 3].copy(), rows.p, rows.c, rows.u, w)[1]
    for k in range(6):
        e = np.zeros(6)
        e[k] = 1e-5
        assert (cost(e) - cost(-e)) / 2e-5 == pytest.approx(2 * g[k], rel=1e-3, abs=1e-5)


@pytest.mark.parametrize("seed", range(5))
def test_the_solver_recovers_a_known_motion(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows = box(rng, "xyz")
    T_true = motion_to_T(np.concatenate([rng.normal(size=3) * 0.3, rng.normal(size=3) * 0.05]))
    p = rows.p @ T_true[:3, :3] - T_true[:3, 3] @ T_true[:3, :3]
    moved = Rows(p, rows.c, rows.u, rows.sigma, rows.tilt, rows.feature)
    T = minimise(np.eye(4), moved, np.ones(len(rows)), None, iterations=20)
    assert pytest.approx(T_true, abs=1e-5) == T


@pytest.mark.parametrize(
    ("axes", "open_axes"), [("z", {0, 1, 5}), ("yz", {0}), ("xyz", set())],
    ids=["field", "corridor", "room"],
)  # fmt: skip
def test_degenerate_directions_are_found_and_left_alone(axes: str, open_axes: set[int]) -> None:
    rng = np.random.default_rng(3)
    rows = box(rng, axes)
    w = 1.0 / rows.sigma**2
    found = find_openness(np.eye(3), rows, w, lever=5.0, tolerance=0.5)
    assert len(found.directions) == len(open_axes)
    for direction in found.directions:
        assert np.abs(direction[sorted(open_axes)]).max() > 0.7
    T0 = motion_to_T(np.array([0.5, 0.4, 0.1, 0.0, 0.0, 0.1]))
    T = minimise(T0, rows, w, found, iterations=10)
    for axis in range(6):
        value = T_to_motion(T)[axis]
        if axis in open_axes:
            assert value == pytest.approx(T_to_motion(T0)[axis], abs=0.05)
        else:
            assert value == pytest.approx(0.0, abs=0.02)


def test_what_the_noise_of_normals_pretends_equals_its_slow_twin() -> None:
    rng = np.random.default_rng(6)
    rows = box(rng, "xyz", 20)
    anchors = rows.c + rng.normal(size=rows.c.shape)
    w, tilt = rng.uniform(0, 2, len(rows)), rng.uniform(0, 1, len(rows))
    T = motion_to_T(rng.normal(size=6) * 0.3)
    R, t = np.ascontiguousarray(T[:3, :3]), T[:3, 3].copy()
    H, g, cost = np.zeros((6, 6)), np.zeros(6), 0.0
    for p, c, u, s in zip(rows.p, anchors, rows.u, w * tilt, strict=True):
        A = np.vstack([np.eye(3), np.cross(p, np.eye(3)).T])
        v, off = R.T @ u, R.T @ (R @ p + t - c)
        within = np.eye(3) - np.outer(v, v)
        H += s * A @ within @ A.T
        g += s * A @ within @ off
        cost += s * off @ within @ off
    found = pretended(R, t, rows.p, anchors, rows.u, w, tilt)
    assert found[0] == pytest.approx(H, rel=1e-9, abs=1e-9)
    assert found[1] == pytest.approx(g, rel=1e-9, abs=1e-9)
    assert found[2] == pytest.approx(cost)


def test_noisy_normals_do_not_hold_the_sensor_back() -> None:
    """Where the map lags behind, noise of its normals must not make a moving robot stand still."""
    rng = np.random.default_rng(9)
    n, noise = 4000, 0.05
    anchors = np.column_stack([rng.uniform(-10, 10, (n, 2)), np.zeros(n)])
    slope = 0.08 * rng.normal(size=(n, 2))  # a rolling field
    true, seen = (
        np.column_stack([s, np.ones(n)]) for s in (slope, slope + noise * rng.normal(size=(n, 2)))
    )
    p = anchors.copy()
    p[:, 2] = -0.3 * true[:, 0]  # 0.3 m ahead along x they lie on the true planes
    normals = seen / np.linalg.norm(seen, axis=1)[:, None]
    rows = Rows(p, anchors, normals, np.full(n, 0.02), np.full(n, noise**2), np.arange(n))
    x = []
    for correct in (True, False):
        T, _, _ = settle(np.eye(4), rows, None, NOTHING, lever=5.0, tolerance=0.5, correct=correct)
        x.append(T[0, 3])
    assert x[0] == pytest.approx(0.3, abs=0.03)
    assert x[1] < 0.25


def test_a_prior_gives_what_the_scene_does_not_hold() -> None:
    rng = np.random.default_rng(3)
    rows = box(rng, "z")
    T_prior = motion_to_T(np.array([0.5, 0.4, 0.1, 0.0, 0.0, 0.1]))
    prior = Prior(T_prior, np.full(6, 100.0))
    T = np.eye(4)
    for _ in range(5):
        T, open_, _ = settle(T, rows, None, prior, lever=5.0, tolerance=0.5)
    assert len(open_.directions) == 3
    x, y, z, _, _, yaw = T_to_motion(T)
    assert (x, y, yaw) == pytest.approx((0.5, 0.4, 0.1), abs=0.05)
    assert abs(z) < 0.02


def test_bisquare_gives_outliers_no_weight() -> None:
    whitened = np.concatenate([np.random.default_rng(0).normal(size=500), [30.0, -50.0]])
    weight, spread = bisquare(whitened)
    assert spread == pytest.approx(1.0, abs=0.15)
    assert weight[-2:].tolist() == [0.0, 0.0]
    assert weight[np.abs(whitened) < 1].min() > 0.85


# ---------------------------------------------------------------- the local map


@given(seeds, st.integers(1, 8))
@example(6791955, 1)  # rounded to float32 a point lies in the next voxel
@settings(max_examples=15, deadline=None)
def test_the_map_agrees_with_a_dictionary(seed: int, per_voxel: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(3000, 3)) * rng.choice([2.0, 50.0])
    local = LocalMap(0.5, per_voxel=per_voxel, reach=60.0, capacity=64)
    for part in np.array_split(points, 3):
        local.insert(part)
    twin: dict[tuple[int, ...], list[np.ndarray]] = {}
    for p in points.astype(np.float32).astype(np.float64):
        kept = twin.setdefault(tuple(np.floor(p / 0.5).astype(int)), [])
        near = any(((q - p) ** 2).sum() < local.apart**2 for q in kept)
        if len(kept) < per_voxel and not near:
            kept.append(p)
    expected = np.array([p for kept in twin.values() for p in kept], dtype=np.float32)
    assert np.array_equal(local.all_points(), expected)
    local.crop(np.zeros(3))
    centres = (np.array(list(twin)) + 0.5) * 0.5
    assert local.n == (np.linalg.norm(centres, axis=1) <= 60.0).sum()
    before = local.all_points()
    local.insert(before[:500].astype(np.float64))
    assert np.array_equal(local.all_points(), before)  # all of them are there already
    for v in range(0, local.n, 97):  # the sums that planes are fitted from are of these points
        x = local.points[v, : local.count[v]].astype(np.float64)
        x -= (np.floor(x[0] / 0.5) + 0.5) * 0.5
        products = [x[:, a] * x[:, b] for a, b in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
        expected = np.array([*x.T, *products]).sum(axis=1)
        assert local.sums[v] == pytest.approx(expected, abs=1e-9)


def test_memory_of_the_map_is_bounded_on_a_long_way() -> None:
    rng = np.random.default_rng(1)
    local = LocalMap(0.5, per_voxel=4, reach=20.0)
    held = []
    for k in range(150):
        centre = np.array([4.0 * k, 0.0, 0.0])
        local.insert(centre + rng.uniform(-18, 18, (2000, 3)) * [1, 1, 0.1])
        local.crop(centre)
        held.append(local.n_bytes)
    assert max(held[75:]) <= max(held[:75])
    assert local.n < 10_000


def test_thin_keeps_the_first_point_of_each_cell() -> None:
    points = np.array([[0.1, 0, 0], [0.9, 0, 0], [1.1, 0, 0], [-0.1, 0, 0], [0.2, 0, 0.0]])
    assert thin(points, 1.0).tolist() == [0, 2, 3]
    assert len(thin(np.zeros((0, 3)), 1.0)) == 0


# ---------------------------------------------------------------- rings and times


def turn_of_vlp16(rng: np.random.Generator) -> tuple[Scan, np.ndarray]:
    time, direction, laser = firing_pattern(VLP16)
    xyz = direction * rng.uniform(3, 30, len(time))[:, None]
    ring = VLP16.ring[laser]
    kept = rng.uniform(size=len(time)) < 0.9
    zero = np.zeros(int(kept.sum()))
    scan = Scan(
        xyz[kept].astype(np.float32), zero + 7.0, zero.astype(np.uint16), zero.astype(np.float32),
        7.0,
    )  # fmt: skip
    return scan, np.stack([time[kept], ring[kept]])


def test_rings_and_times_are_derived_and_told() -> None:
    scan, (time, ring) = turn_of_vlp16(np.random.default_rng(5))
    notes: list[str] = []
    whole = complete_scan(scan, 0.1, notes, find_lack(scan))
    assert np.array_equal(whole.ring, ring)
    assert np.quantile(np.abs(whole.time - 7.0 - time), 0.99) < 2e-4
    assert len(notes) == 2 and "16 rings" in notes[0] and "time per point" in notes[1]
    complete_scan(scan, 0.1, notes, find_lack(scan))
    assert len(notes) == 2
    assert find_lack(whole) == (False, False)


def test_a_sparse_turn_does_not_make_a_log_lack_rings() -> None:
    scan, (time, ring) = turn_of_vlp16(np.random.default_rng(5))
    full = Scan(scan.xyz, time + 7.0, ring.astype(np.uint16), scan.intensity, 7.0)
    one = np.flatnonzero(ring == 3)[:4]
    late = time[one] + 7.1
    sparse = Scan(scan.xyz[one], late, full.ring[one], scan.intensity[one], 7.1)
    notes: list[str] = []
    assert list(complete_scans([sparse, full, sparse], notes)) == [sparse, full, sparse]
    assert notes == []


def test_inverse_of_a_motion_is_that_of_its_matrix() -> None:
    T = from_rotation(Rotation.from_euler("xyz", [0.1, 0.2, 0.3]).as_matrix(), [1, 2, 3])
    assert pytest.approx(np.eye(4), abs=1e-9) == motion_to_T(T_to_motion(invert(T))) @ T


def test_one_ring_with_noisy_ranges_is_no_plane() -> None:
    """A ring and the beam span a false plane, which would hold a moving sensor back."""
    rng = np.random.default_rng(8)
    y = np.linspace(-0.5, 0.5, 200)
    ring = np.stack([5.0 + 0.03 * rng.standard_normal(200), y, 0 * y], axis=1)  # on the wall x = 5
    fine, coarse = (LocalMap(v, per_voxel=50, reach=50.0) for v in (0.3, 0.9))
    fine.insert(ring)
    coarse.insert(ring)
    assert len(match_map(ring[::10].copy(), 20, np.eye(4), fine, coarse, coarse)) == 0
    for z in (-0.25, -0.15, 0.15, 0.25):
        fine.insert(ring + np.array([0.0, 0.0, z]))
    rows = match_map(ring[40:160:10].copy(), 12, np.eye(4), fine, coarse, coarse)
    assert len(rows) == 12
    assert np.abs(rows.u[:, 0]).min() > 0.95
