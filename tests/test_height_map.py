"""The height map: which cell and which slab a point falls in, and what is known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from commonmap.errors import EmptyMapError, InputError
from commonmap.mapping.ground import Ground
from commonmap.mapping.height_map import (
    NICE_CELLS,
    build_height_map,
    choose_cell,
    choose_slabs,
    find_slabs,
    robust_extent,
)
from commonmap.mapping.points import points_of
from commonmap.matching.slabs import pack_slabs
from commonmap.types import Cloud, Float64s, GridMap, Leaves

EDGES = np.array([0.25, 0.5, 1.0, 2.0])


def flat(z: float = 0.0) -> Ground:
    """Return a level ground that lies everywhere at `z`."""
    return Ground(np.zeros(2), 1.0, np.full((1, 1), z), np.ones((1, 1), bool))


def build(points: list[list[float]], *, cell: float = 1.0, **more: object) -> GridMap:
    """Return the map of a few points on level ground at zero, in the slabs EDGES."""
    options: dict[str, object] = {"slab_edges": EDGES, "ground": flat(), **more}
    return build_height_map(np.array(points, float), cell=cell, **options)  # type: ignore[arg-type]


def test_cell_i_runs_along_x_and_is_half_open() -> None:
    # cells of 2 m from origin (2, -4): [2, 4) is i = 0, [4, 6) is i = 1; [-4, -2) is j = 0
    grid = build(
        [[2.5, -3.5, 0.0], [3.999, -2.001, 0.1], [4.0, -3.0, 0.2], [2.0, -2.0, 0.3], [7.9, 1.9, 0]],
        cell=2.0,
    )
    assert grid.origin.tolist() == [2.0, -4.0]
    assert grid.shape == (3, 3)
    assert grid["count"].tolist() == [[2, 1, 0], [1, 0, 0], [0, 0, 1]]
    assert grid["known"].tolist() == [
        [True, True, False],
        [True, False, False],
        [False, False, True],
    ]


def test_heights_are_above_the_ground_and_z_is_not() -> None:
    ground = flat(100.0)
    grid = build([[0.5, 0.5, 100.4], [0.5, 0.6, 101.5], [1.5, 0.5, 99.8]], ground=ground)
    assert grid["height"][:, 0] == pytest.approx([1.5, 0.0])  # under the ground counts as on it
    assert grid["lowest"][:, 0] == pytest.approx([100.4, 99.8])
    assert grid["highest"][:, 0] == pytest.approx([101.5, 99.8])
    assert grid["ground"][:, 0] == pytest.approx([100.0, 100.0])


def test_unknown_cells_are_nan_in_every_layer_of_metres() -> None:
    grid = build([[0.5, 0.5, 0.3], [2.5, 0.5, 0.3]])
    for name in ("ground", "height", "lowest", "highest"):
        assert np.isnan(grid[name][1, 0])
        assert np.isfinite(grid[name][[0, 2], 0]).all()
    assert not grid["known"][1, 0]
    assert not grid["slab_known"][:, 1, 0].any()
    assert not grid["slab_occupied"][:, 1, 0].any()


@pytest.mark.parametrize(
    ("height", "slabs"),
    [
        (0.2499, []),
        (0.25, [0]),
        (0.4999, [0]),
        (0.5, [1]),
        (1.0, [2]),
        (1.9999, [2]),
        (2.0, []),
        (50.0, []),
        (-0.9, []),
    ],
)
def test_slab_edges_are_half_open(height: float, slabs: list[int]) -> None:
    grid = build([[0.5, 0.5, height]])
    assert np.nonzero(grid["slab_occupied"][:, 0, 0])[0].tolist() == slabs
    assert grid["slab_known"][:, 0, 0].tolist() == [True] * 3


def test_max_height_leaves_higher_points_out_of_every_layer() -> None:
    points = [[0.5, 0.5, 0.3], [0.5, 0.5, 1.0], [0.5, 0.5, 0.999], [3.5, 0.5, 1.7]]
    grid = build(points, max_height=1.0)
    assert grid.shape == (1, 1)  # the cell that saw only 1.7 m is not part of the map
    assert grid["count"].tolist() == [[2]]
    assert grid["height"][0, 0] == pytest.approx(0.999)
    assert grid["highest"][0, 0] == pytest.approx(0.999)
    assert grid["slab_occupied"][:, 0, 0].tolist() == [True, True, False]


def test_points_more_than_a_metre_under_the_ground_are_left_out() -> None:
    grid = build([[0.5, 0.5, 0.3], [0.5, 0.5, -1.0], [0.5, 0.5, -0.99], [0.5, 0.5, -8.0]])
    assert grid["count"].tolist() == [[2]]
    assert grid["lowest"][0, 0] == pytest.approx(-0.99)


def test_utm_sized_coordinates_keep_their_cells() -> None:
    far = np.array([470_641.0, 3_810_235.0, 2_278.0])
    rng = np.random.default_rng(1)
    points = rng.uniform(0.0, 8.0, (500, 3)) * [1.0, 1.0, 0.25]
    points = np.round(points * 1024.0) / 1024.0  # exact in both frames
    near = build_height_map(points, cell=0.25, slab_edges=EDGES, ground=flat())
    there = build_height_map(points + far, cell=0.25, slab_edges=EDGES, ground=flat(far[2]))
    assert there.origin.tolist() == (near.origin + far[:2]).tolist()
    for name in ("known", "count", "slab_occupied"):
        assert np.array_equal(there[name], near[name])
    assert there["height"] == pytest.approx(near["height"], abs=1e-9, nan_ok=True)


def test_a_cell_that_is_no_binary_fraction_is_half_open_at_utm_size() -> None:
    # 0.1 m cells far from zero: the cell of each point is floor((x - origin) / cell), none is lost
    x = 470_641.0 + np.arange(200) * 0.1 + 0.05
    points = np.column_stack([x, np.full(200, 3_810_235.05), np.full(200, 0.3)])
    grid = build_height_map(points, cell=0.1, slab_edges=EDGES, ground=flat())
    assert grid["count"].sum() == 200
    assert (grid["count"] == 1).all()
    assert grid.shape == (200, 1)


def test_the_ground_is_found_where_none_is_given() -> None:
    rng = np.random.default_rng(2)
    xy = rng.uniform(0.0, 20.0, (12_000, 2))
    floor = np.column_stack([xy, 3.0 + 0.2 * xy[:, 0]])
    post = np.column_stack([rng.uniform(10.0, 10.2, (400, 2)), rng.uniform(5.1, 8.0, 400)])
    grid = build_height_map(np.concatenate([floor, post]), cell=0.5, slab_edges=EDGES)
    assert grid["height"][20, 20] == pytest.approx(3.0, abs=0.2)
    elsewhere = np.delete(grid["height"].ravel(), 20 * grid.shape[1] + 20)
    assert np.nanmax(elsewhere) < 0.25


@st.composite
def point_sets(draw: st.DrawFn) -> tuple[Float64s, float, float | None]:
    """Draw points, a cell and a max_height; coordinates often fall on cell and slab edges."""
    n = draw(st.integers(1, 40))
    seed = draw(st.integers(0, 2**32 - 1))
    rng = np.random.default_rng(seed)
    points = np.where(
        rng.random((n, 3)) < 0.5, rng.uniform(-6, 6, (n, 3)), rng.integers(-24, 24, (n, 3)) / 4.0
    )
    points[:, 2] = points[:, 2] / 2.0
    cell = draw(st.sampled_from([0.25, 0.5, 1.0, 0.3]))
    return points, cell, draw(st.sampled_from([None, 1.0, 0.75]))


@settings(max_examples=60, deadline=None, derandomize=True)
@given(point_sets())
def test_height_map_equals_its_slow_twin(case: tuple[Float64s, float, float | None]) -> None:
    points, cell, max_height = case
    limit = math.inf if max_height is None else max_height
    used = [p for p in points.tolist() if -1.0 < p[2] < limit]
    if not used:
        with pytest.raises(EmptyMapError, match="nothing to match"):
            build_height_map(
                points, cell=cell, slab_edges=EDGES, ground=flat(), max_height=max_height
            )
        return
    columns: dict[tuple[int, int], list[float]] = {}
    i0 = math.floor(min(p[0] for p in used) / cell)
    j0 = math.floor(min(p[1] for p in used) / cell)
    for x, y, z in used:
        index = (math.floor((x - i0 * cell) / cell), math.floor((y - j0 * cell) / cell))
        columns.setdefault(index, []).append(z)
    grid = build_height_map(
        points, cell=cell, slab_edges=EDGES, ground=flat(), max_height=max_height
    )
    assert grid.origin.tolist() == [i0 * cell, j0 * cell]
    assert grid.shape == (1 + max(i for i, _ in columns), 1 + max(j for _, j in columns))
    assert int(grid["known"].sum()) == len(columns)
    for (i, j), z in columns.items():
        assert grid["known"][i, j]
        assert grid["count"][i, j] == len(z)
        assert grid["lowest"][i, j] == min(z)
        assert grid["highest"][i, j] == max(z)
        assert grid["height"][i, j] == max(max(z), 0.0)
        for k in range(3):
            inside = any(EDGES[k] <= h < EDGES[k + 1] for h in z)
            assert grid["slab_occupied"][k, i, j] == inside
            assert grid["slab_known"][k, i, j]


@settings(max_examples=60, deadline=None, derandomize=True)
@given(point_sets())
def test_slabs_alone_are_those_of_the_height_map(
    case: tuple[Float64s, float, float | None],
) -> None:
    points, cell, max_height = case
    ground = flat()
    height = ground.height_above(points)
    try:
        grid = build_height_map(
            points, cell=cell, slab_edges=EDGES, ground=ground, max_height=max_height
        )
    except EmptyMapError as problem:
        with pytest.raises(EmptyMapError) as told:
            find_slabs(points, height, cell=cell, slab_edges=EDGES, max_height=max_height)
        assert str(told.value) == str(problem)
        return
    expected = pack_slabs(grid.origin, cell, grid["slab_occupied"], grid["slab_known"])
    origin, occupied, known = find_slabs(
        points, height, cell=cell, slab_edges=EDGES, max_height=max_height
    )
    assert origin.tolist() == grid.origin.tolist()
    assert np.array_equal(occupied, expected.occupied)
    assert np.array_equal(known, expected.known)


def test_thirty_two_slabs_alone() -> None:
    points = np.array([[0.5, 0.5, 31.5], [0.5, 0.5, 0.0]])
    edges = np.linspace(0.0, 32.0, 33)
    _, occupied, known = find_slabs(points, points[:, 2], cell=1.0, slab_edges=edges)
    assert occupied.tolist() == [[0x80000001]]
    assert known.tolist() == [[0xFFFFFFFF]]


@pytest.mark.parametrize("cell", [0.0, -1.0, math.nan, math.inf])
def test_a_cell_that_is_no_length_raises(cell: float) -> None:
    with pytest.raises(InputError, match="cell"):
        build([[0.0, 0.0, 0.3]], cell=cell)


@pytest.mark.parametrize("edges", [[1.0], [1.0, 1.0], [2.0, 1.0], list(range(34)), [0.0, math.nan]])
def test_slab_edges_that_do_not_rise_raise(edges: list[float]) -> None:
    with pytest.raises(InputError, match="slab_edges"):
        build([[0.0, 0.0, 0.3]], slab_edges=np.array(edges, float))


def test_thirty_two_slabs_fit() -> None:
    edges = np.linspace(0.0, 32.0, 33)
    grid = build([[0.5, 0.5, 31.5], [0.5, 0.5, 0.0]], slab_edges=edges)
    assert np.nonzero(grid["slab_occupied"][:, 0, 0])[0].tolist() == [0, 31]


def test_slabs_under_one_metre_are_even() -> None:
    edges = choose_slabs(np.array([0.5, 3.0]), cell=0.5, max_height=1.0)
    assert edges == pytest.approx([0.2, 0.4, 0.6, 0.8, 1.0])


def test_slabs_double_up_to_what_stands_there() -> None:
    heights = np.concatenate([np.zeros(500), np.linspace(0.3, 7.0, 1000)])
    assert choose_slabs(heights, cell=0.5).tolist() == [0.25, 0.5, 1.0, 2.0, 4.0, 8.0]
    limited = choose_slabs(heights, cell=0.5, max_height=5.0)
    assert limited[-1] == 5.0
    assert np.all(np.diff(limited) > 0)


@settings(max_examples=50, deadline=None, derandomize=True)
@given(st.lists(st.floats(-1.0, 200.0), max_size=30), st.none() | st.floats(0.05, 60.0))
def test_slabs_always_serve_a_height_map(heights: list[float], max_height: float | None) -> None:
    edges = choose_slabs(np.array(heights), cell=0.5, max_height=max_height)
    assert 2 <= len(edges) <= 33
    assert np.all(np.diff(edges) > 0)
    assert edges[0] > 0
    if max_height is not None:
        assert edges[-1] == pytest.approx(max_height)


def test_the_cell_comes_from_the_sparser_map() -> None:
    rng = np.random.default_rng(3)
    dense = np.column_stack([rng.uniform(0, 12, (20_000, 2)), np.zeros(20_000)])
    sparse = np.column_stack([rng.uniform(0, 12, (400, 2)), np.zeros(400)])
    assert choose_cell(dense, sparse) == choose_cell(sparse, dense)
    assert choose_cell(dense, dense) < choose_cell(dense, sparse)
    assert choose_cell(dense, dense) in NICE_CELLS


def test_a_far_blunder_does_not_widen_the_extent() -> None:
    points = np.random.default_rng(4).uniform(0.0, 10.0, (1000, 3))
    points[0] = [5000.0, 0.0, 0.0]
    assert robust_extent(points) < 10.0


def test_points_of_an_octree_are_its_smallest_occupied_voxels() -> None:
    # an occupied leaf two voxels wide at the origin, a free one beside it; edge 0.5 m
    leaves = Leaves(
        0.5,
        np.array([[32768, 32768, 32768], [32770, 32768, 32768]], np.uint16),
        np.array([15, 16], np.uint8),
        np.array([0.85, -0.4], np.float32),
    )
    points = points_of(leaves)
    expected = {(x, y, z) for x in (0.25, 0.75) for y in (0.25, 0.75) for z in (0.25, 0.75)}
    assert len(points) == 8
    assert {(x, y, z) for x, y, z in points.tolist()} == expected


def test_points_of_a_cloud_are_its_finite_rows() -> None:
    xyz = np.array([[1.0, 2, 3], [np.nan, 0, 0], [4, 5, np.inf], [7, 8, 9]])
    assert points_of(Cloud(xyz)).tolist() == [[1, 2, 3], [7, 8, 9]]
    assert points_of(xyz.astype(np.float32)).dtype == np.float64


def test_nothing_left_raises_and_names_the_map() -> None:
    with pytest.raises(EmptyMapError, match="draft holds no finite point"):
        points_of(np.full((4, 3), np.nan), "draft")
    free = Leaves(
        0.1, np.zeros((1, 3), np.uint16), np.array([16], np.uint8), np.array([-1.0], np.float32)
    )
    with pytest.raises(EmptyMapError, match="base holds no occupied voxel"):
        points_of(free, "base")
    with pytest.raises(InputError, match="shape"):
        points_of(np.zeros((4, 2)))
