"""The ground: slopes, what stands on it, blunders below it, holes in it, and reading it out."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from commonmap.errors import EmptyMapError
from commonmap.mapping.ground import Ground, _lowest, fill, find_ground, typical_spacing
from commonmap.types import Float64s


def slope_z(xy: Float64s, degrees: float, heading: float = 0.7) -> Float64s:
    """Return z of a plane that rises by an angle towards `heading`."""
    along = math.cos(heading) * xy[:, 0] + math.sin(heading) * xy[:, 1]
    return np.asarray(math.tan(math.radians(degrees)) * along)


def slope_points(
    rng: np.random.Generator, degrees: float, *, edge: float = 40.0, n: int = 40_000
) -> Float64s:
    """Return noisy points of a square plane, 25 a square metre, noise 2 cm."""
    xy = rng.uniform(-0.5 * edge, 0.5 * edge, (n, 2))
    return np.column_stack([xy, slope_z(xy, degrees) + rng.normal(0.0, 0.02, n)])


def inner_grid(edge: float = 40.0, rim: float = 1.0) -> Float64s:
    """Return positions every 0.37 m, no nearer to the border than `rim`."""
    line = np.arange(-0.5 * edge + rim, 0.5 * edge - rim, 0.37)
    return np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)


def errors(ground: Ground, degrees: float, xy: Float64s | None = None) -> Float64s:
    """Return found minus true height of a slope's ground."""
    where = inner_grid() if xy is None else xy
    return np.asarray(ground.height_at(where) - slope_z(where, degrees))


@pytest.mark.parametrize("degrees", [0.0, 15.0, 30.0])
def test_a_noisy_slope_is_found_within_centimetres(degrees: float) -> None:
    ground = find_ground(slope_points(np.random.default_rng(1), degrees))
    error = errors(ground, degrees)
    # The lowest of a cell's points lies at its lower edge: half a cell of slope below its centre
    lag = 0.5 * ground.cell * math.tan(math.radians(degrees))
    assert np.abs(error - np.median(error)).mean() < 0.02 + 0.15 * lag
    assert -lag * math.sqrt(2.0) - 0.06 < np.median(error) < 0.02
    assert np.abs(error).max() < 1.5 * lag + 0.12
    assert ground.seen.mean() > 0.99


@pytest.mark.parametrize("degrees", [0.0, 20.0])
def test_a_canopy_over_seen_ground_is_not_ground(degrees: float) -> None:
    rng = np.random.default_rng(2)
    floor = slope_points(rng, degrees)
    xy = rng.uniform(-20, 20, (60_000, 2))
    crown = np.column_stack([xy, slope_z(xy, degrees) + rng.uniform(4.0, 12.0, len(xy))])
    # under the crowns only one ground point in ten is left, in clumps
    hidden = np.sin(floor[:, 0]) * np.sin(0.8 * floor[:, 1]) > 0.0
    floor = floor[~hidden | (rng.random(len(floor)) < 0.1)]
    with_trees = find_ground(np.concatenate([floor, crown]), cell=0.5)
    error = errors(with_trees, degrees)
    assert np.abs(error).max() < 0.6
    assert np.abs(error - np.median(error)).mean() < 0.08


def test_walls_and_posts_are_not_ground() -> None:
    rng = np.random.default_rng(3)
    floor = slope_points(rng, 10.0)
    # a wall of 0.3 m that hides the ground below it, seen from a metre up only
    floor = floor[(np.abs(floor[:, 0]) > 0.6) | (np.abs(floor[:, 1]) > 10.0)]
    xy = np.column_stack([rng.uniform(-0.15, 0.15, 20_000), rng.uniform(-10, 10, 20_000)])
    wall = np.column_stack([xy, slope_z(xy, 10.0) + rng.uniform(1.0, 4.0, len(xy))])
    ground = find_ground(np.concatenate([floor, wall]))
    error = errors(ground, 10.0)
    assert np.abs(error).max() < 0.35
    on_wall = np.column_stack([np.zeros(40), np.linspace(-9.5, 9.5, 40)])
    assert np.abs(errors(ground, 10.0, on_wall)).max() < 0.35


@pytest.mark.parametrize("degrees", [0.0, 8.0])
def test_a_wide_flat_roof_is_not_ground(degrees: float) -> None:
    rng = np.random.default_rng(4)
    floor = slope_points(rng, degrees, edge=80.0, n=80_000)
    inside = (np.abs(floor[:, 0]) < 20.0) & (np.abs(floor[:, 1]) < 15.0)
    roof = floor[inside].copy()
    roof[:, 2] = 8.0 + rng.normal(0.0, 0.02, len(roof))
    ground = find_ground(np.concatenate([floor[~inside], roof]))
    line_x, line_y = np.arange(-19.0, 19.5, 1.0), np.arange(-14.0, 14.5, 1.0)
    under = np.stack(np.meshgrid(line_x, line_y), axis=-1).reshape(-1, 2)
    assert np.abs(errors(ground, degrees, under)).max() < 0.5
    i, j = np.floor((under - ground.origin) / ground.cell).astype(int).T
    assert not ground.seen[i, j].any()
    assert np.abs(errors(ground, degrees, inner_grid(80.0))).max() < 0.6


def test_low_blunders_do_not_pull_the_ground_down() -> None:
    rng = np.random.default_rng(5)
    floor = slope_points(rng, 5.0)
    clean = find_ground(floor)
    low = floor[rng.choice(len(floor), 12, replace=False)].copy()
    low[:, 2] -= rng.uniform(5.0, 10.0, len(low))
    ground = find_ground(np.concatenate([floor, low]), cell=clean.cell)
    assert np.abs(errors(ground, 5.0)).max() < 0.25
    assert np.abs(ground.height_at(low[:, :2]) - clean.height_at(low[:, :2])).max() < 0.1


@pytest.mark.parametrize("degrees", [0.0, 15.0, 30.0])
def test_a_hole_is_filled_along_the_slope(degrees: float) -> None:
    floor = slope_points(np.random.default_rng(6), degrees)
    hole = (np.abs(floor[:, 0] - 3.0) < 5.0) & (np.abs(floor[:, 1]) < 5.0)
    ground = find_ground(floor[~hole])
    line = np.linspace(-4.0, 4.0, 15)
    inside = np.stack(np.meshgrid(line + 3.0, line), axis=-1).reshape(-1, 2)
    lag = 0.5 * ground.cell * math.tan(math.radians(degrees)) * math.sqrt(2.0)
    assert np.abs(errors(ground, degrees, inside)).max() < 0.12 + lag
    i, j = np.floor((inside - ground.origin) / ground.cell).astype(int).T
    assert not ground.seen[i, j].any()


def test_height_at_is_bilinear_between_centres_and_constant_outside() -> None:
    # centres at x = 11, 13, 15 and y = 21, 23
    z = np.array([[0.0, 10.0], [4.0, 14.0], [8.0, 50.0]])
    ground = Ground(np.array([10.0, 20.0]), 2.0, z, np.ones((3, 2), bool))
    xy = np.array(
        [
            [11.0, 21.0],  # a centre
            [12.0, 21.0],  # half way along x
            [11.0, 22.5],  # three quarters along y
            [14.5, 22.5],  # 0.25 * (0.25 * 4 + 0.75 * 14) + 0.75 * (0.25 * 8 + 0.75 * 50)
            [15.0, 23.0],  # the last centre
            [0.0, 0.0],  # outside: the first centre
            [99.0, 21.5],  # outside along x, a quarter along y: 8 + 0.25 * 42
        ]
    )
    expected = [0.0, 2.0, 7.5, 32.5, 50.0, 0.0, 18.5]
    assert ground.height_at(xy) == pytest.approx(expected, abs=1e-12)


def test_height_at_of_a_single_cell_and_of_no_position() -> None:
    ground = Ground(np.zeros(2), 1.0, np.array([[3.0]]), np.ones((1, 1), bool))
    assert ground.height_at(np.array([[0.5, 0.5], [-7.0, 9.0]])).tolist() == [3.0, 3.0]
    assert ground.height_at(np.zeros((0, 2))).shape == (0,)


def test_the_lowest_point_of_each_cell_by_hand() -> None:
    # cells of 1 m are half-open: x = 1.0 belongs to cell 1, and i runs along x
    xyz = np.array([[0.0, 0.0, 5.0], [0.99, 0.2, 4.0], [1.0, 0.0, 3.0], [0.5, 2.0, -1.0]])
    z = _lowest(xyz, np.zeros(2), 1.0, 2, 3)
    assert np.array_equal(z, [[4.0, np.nan, -1.0], [3.0, np.nan, np.nan]], equal_nan=True)


def test_coordinates_of_utm_size_change_nothing() -> None:
    points = slope_points(np.random.default_rng(7), 12.0, edge=20.0, n=10_000)
    far = np.array([470_640.0, 3_810_236.0, 2_278.0])
    near, there = find_ground(points, cell=0.5), find_ground(points + far, cell=0.5)
    where = inner_grid(20.0)
    assert there.origin == pytest.approx(near.origin + far[:2], abs=1e-6)
    gap = there.height_at(where + far[:2]) - near.height_at(where) - far[2]
    assert np.abs(gap).max() < 1e-3


def fill_twin(z: Float64s) -> Float64s:
    """Return push-pull by loops; the plane is passed in by the caller as exactly zero."""
    levels = [(np.where(np.isfinite(z), z, 0.0), np.isfinite(z).astype(float))]
    while max(levels[-1][0].shape) > 1:
        value, weight = levels[-1]
        nx, ny = -(-value.shape[0] // 2), -(-value.shape[1] // 2)
        coarse, heavy = np.zeros((nx, ny)), np.zeros((nx, ny))
        for i in range(nx):
            for j in range(ny):
                part = weight[2 * i : 2 * i + 2, 2 * j : 2 * j + 2]
                total = float(part.sum())
                if total > 0.0:
                    block = value[2 * i : 2 * i + 2, 2 * j : 2 * j + 2]
                    coarse[i, j] = float((block * part).sum()) / total
                heavy[i, j] = min(total, 1.0)
        levels.append((coarse, heavy))
    filled = levels[-1][0]
    for value, weight in levels[-2::-1]:
        finer = np.zeros_like(value)
        for i in range(value.shape[0]):
            for j in range(value.shape[1]):
                a, b = i // 2, j // 2
                c = min(max(a + (1 if i % 2 else -1), 0), filled.shape[0] - 1)
                d = min(max(b + (1 if j % 2 else -1), 0), filled.shape[1] - 1)
                pulled = (
                    0.5625 * filled[a, b]
                    + 0.1875 * (filled[c, b] + filled[a, d])
                    + 0.0625 * filled[c, d]
                )
                finer[i, j] = weight[i, j] * value[i, j] + (1 - weight[i, j]) * pulled
        filled = finer
    return np.where(np.isfinite(z), z, filled)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(
    st.tuples(st.integers(1, 13), st.integers(1, 13)).flatmap(
        lambda shape: hnp.arrays(bool, shape)
    ),
    st.integers(0, 2**31),
)
def test_fill_equals_its_slow_twin(known: np.ndarray, seed: int) -> None:
    z = np.random.default_rng(seed).normal(size=known.shape)
    z[~known] = np.nan
    if not known.any():
        assert np.array_equal(fill(z), np.zeros(known.shape))
        return
    trend = plane_twin(z)
    expected = np.where(known, z, fill_twin(z - trend) + trend)
    assert fill(z) == pytest.approx(expected, abs=1e-6)


def plane_twin(z: Float64s) -> Float64s:
    """Return the reweighted plane, by numpy's least squares with the ridge as extra rows."""
    i, j = np.nonzero(np.isfinite(z))
    A = np.column_stack([i - i.mean(), j - j.mean(), np.ones(len(i))])
    w, x = np.ones(len(i)), np.zeros(3)
    for _ in range(4):
        root = np.sqrt(w)[:, None]
        rows = np.vstack([A * root, math.sqrt(1e-9 * len(i)) * np.eye(3)])
        right = np.append(z[i, j] * root[:, 0], np.zeros(3))
        x = np.linalg.lstsq(rows, right, rcond=None)[0]
        residual = z[i, j] - A @ x
        w = 1.0 / (1.0 + (residual / (2.0 * (1.4826 * np.median(np.abs(residual)) + 1e-3))) ** 2)
    I, J = np.indices(z.shape)
    return np.asarray(x[0] * (I - i.mean()) + x[1] * (J - j.mean()) + x[2])


def test_fill_of_a_plane_with_holes_is_the_plane() -> None:
    I, J = np.indices((23, 17))
    plane = 0.3 * I - 0.8 * J + 5.0
    z = np.where(np.random.default_rng(8).random(plane.shape) < 0.3, plane, np.nan)
    assert fill(z) == pytest.approx(plane, abs=1e-4)


def test_fill_keeps_known_cells_to_the_bit() -> None:
    z = np.random.default_rng(9).normal(size=(9, 20))
    z[2:5, 3:11] = np.nan
    filled = fill(z)
    known = np.isfinite(z)
    assert np.array_equal(filled[known], z[known])
    assert np.isfinite(filled).all()


def test_typical_spacing_of_a_square_lattice() -> None:
    line = np.arange(0.0, 30.0, 0.25)
    xy = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    assert typical_spacing(np.column_stack([xy, np.zeros(len(xy))])) == pytest.approx(0.25)
    sparse = xy[::37]
    spacing = typical_spacing(np.column_stack([sparse, np.zeros(len(sparse))]))
    assert spacing == pytest.approx(0.25 * math.sqrt(37.0), rel=0.15)


@pytest.mark.parametrize("n", [0, 1, 2])
def test_fewer_than_three_points_raise(n: int) -> None:
    with pytest.raises(EmptyMapError, match=f"three points.*{n} came"):
        find_ground(np.zeros((n, 3)))


def test_three_points_in_one_column_have_a_ground() -> None:
    ground = find_ground(np.array([[1.0, 1.0, 4.0], [1.0, 1.0, 3.0], [1.0, 1.0, 9.0]]))
    assert ground.z.shape == (1, 1)
    assert ground.height_at(np.array([[1.0, 1.0]])) == pytest.approx([3.0])


def test_the_ground_is_the_same_for_any_order_of_the_points() -> None:
    rng = np.random.default_rng(10)
    points = slope_points(rng, 10.0, edge=15.0, n=5_000)
    first, second = find_ground(points), find_ground(points[rng.permutation(len(points))])
    assert first.z.tobytes() == second.z.tobytes()
    assert np.array_equal(first.seen, second.seen)
