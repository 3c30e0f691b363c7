"""Products of a merge on places small enough to work out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from commonmap import pipeline
from commonmap.config import Config, MergeConfig
from commonmap.errors import EmptyMapError, InputError
from commonmap.frames import apply, from_xyz_yaw, invert
from commonmap.mapping.octree import octree_from_points
from commonmap.merging import products
from commonmap.types import Cloud, Float64s, GridMap, Leaves

CELL = 0.5
PLAIN = MergeConfig(step_height=0.2, robot_height=2.0)


def flat(low: tuple[float, float], high: tuple[float, float], step: float = 0.25) -> Float64s:
    """Return points of level ground at z = 0, at the middles of squares of edge `step`."""
    x, y = (np.arange(a + step / 2, b, step) for a, b in zip(low, high, strict=True))
    X, Y = np.meshgrid(x, y, indexing="ij")
    return np.column_stack([X.ravel(), Y.ravel(), np.zeros(X.size)])


def pole(x: float, y: float, low: float, high: float) -> Float64s:
    """Return points every 5 cm along an upright line."""
    z = np.arange(low, high, 0.05)
    return np.column_stack([np.full(len(z), x), np.full(len(z), y), z])


def at(grid: GridMap, x: float, y: float) -> tuple[int, int]:
    """Return the cell that holds a position, by the words of docs/conventions.md."""
    i, j = np.floor((np.array([x, y]) - grid.origin) / grid.cell).astype(int)
    return int(i), int(j)


# The target sees all of a 12 x 8 m yard and a pole at (3, 3); the source the right part of it, the
# same ground, and a pole at (9, 3) where the target saw bare ground. A branch hangs at (6, 6).
TARGET = np.concatenate([flat((0, 0), (12, 8)), pole(3.1, 3.1, 0.0, 1.5), pole(6.1, 6.1, 2.5, 3)])
SOURCE = np.concatenate([flat((6, 0), (16, 8)), pole(9.1, 3.1, 0.0, 1.2)])


@pytest.fixture(scope="module")
def heights() -> GridMap:
    return products.merge_heights(TARGET, SOURCE, cell=CELL, config=PLAIN)


def test_heights_by_hand(heights: GridMap) -> None:
    assert heights.shape == (32, 16)
    np.testing.assert_allclose(heights.origin, [0.0, 0.0])
    assert heights["height_target"][at(heights, 3.1, 3.1)] == pytest.approx(1.45, abs=0.05)
    assert np.isnan(heights["height_source"][at(heights, 3.1, 3.1)])
    assert heights["height"][at(heights, 9.1, 3.1)] == pytest.approx(1.15, abs=0.05)
    assert heights["height_target"][at(heights, 9.1, 3.1)] == pytest.approx(0.0, abs=0.05)
    np.testing.assert_allclose(heights["ground"], 0.0, atol=0.05)


def test_who_saw_what_by_hand(heights: GridMap) -> None:
    seen_by = heights["seen_by"]
    assert (seen_by[:12] == 1).all()  # x below 6: the target alone
    assert (seen_by[12:24] == 3).all()  # 6 to 12: both
    assert (seen_by[24:] == 2).all()  # beyond 12: the source alone


def test_conflict_is_where_one_saw_bare_ground(heights: GridMap) -> None:
    # The target's pole stands where the source saw nothing at all: no conflict
    assert np.argwhere(heights["conflict"]).tolist() == [list(at(heights, 9.1, 3.1))]


def test_a_neighbour_takes_the_conflict_away() -> None:
    shifted = np.concatenate([TARGET, pole(9.6, 3.1, 0.0, 1.2)])
    heights = products.merge_heights(shifted, SOURCE, cell=CELL, config=PLAIN)
    assert not heights["conflict"][at(heights, 9.1, 3.1)]


def test_roles_may_change_places(heights: GridMap) -> None:
    swapped = products.merge_heights(SOURCE, TARGET, cell=CELL, config=PLAIN)
    np.testing.assert_array_equal(swapped["conflict"], heights["conflict"])
    np.testing.assert_array_equal(swapped["highest_target"], heights["highest_source"])


def test_navigation_by_hand(heights: GridMap) -> None:
    occupancy = products.navigation_map(heights, config=PLAIN)["occupancy"]
    assert occupancy.dtype == np.int8
    assert occupancy[at(heights, 3.1, 3.1)] == 100
    assert occupancy[at(heights, 9.1, 3.1)] == 100
    assert occupancy[at(heights, 6.1, 6.1)] == 0  # the branch is above the robot
    assert (occupancy == 100).sum() == 2
    assert (occupancy == 0).sum() == 32 * 16 - 2


def test_a_low_branch_is_in_the_way() -> None:
    tall = MergeConfig(step_height=0.2, robot_height=2.7)
    heights = products.merge_heights(TARGET, SOURCE, cell=CELL, config=tall)
    assert heights["obstacle"][at(heights, 6.1, 6.1)]


def test_unseen_is_unknown_unless_the_octree_knows_it_free() -> None:
    hole = np.concatenate([flat((0, 0), (4, 8)), flat((8, 0), (12, 8))])
    heights = products.merge_heights(hole, hole, cell=CELL, config=PLAIN)
    without = products.navigation_map(heights, config=PLAIN)["occupancy"]
    assert (without[8:16] == -1).all()
    # One free leaf of 2 m at (4, 0, 0): four by four cells; one that floats above the robot
    leaves = Leaves(
        0.5,
        np.array([[32768 + 8, 32768, 32768], [32768 + 12, 32768, 32768 + 8]], np.uint16),
        np.array([14, 14], np.uint8),
        np.array([-1.0, -1.0], np.float32),
    )
    free = products.navigation_map(heights, leaves=leaves, config=PLAIN)["occupancy"]
    expected = without.copy()
    expected[8:12, 0:4] = 0
    np.testing.assert_array_equal(free, expected)
    moved = products.navigation_map(
        heights, leaves=leaves, octree_origin=np.array([0.0, 2.0, 0.0]), config=PLAIN
    )["occupancy"]
    expected = without.copy()
    expected[8:12, 4:8] = 0
    np.testing.assert_array_equal(moved, expected)


def test_cloud_keeps_every_point_and_who_saw_its_place() -> None:
    T_target_source = from_xyz_yaw(10.0, 0.0, 0.0, np.pi / 2)
    target = Cloud(np.array([[10.05, 1.05, 0.05], [0.05, 0.05, 0.05]]), crs="EPSG:32612")
    source = Cloud(np.array([[1.02, -0.02, 0.02], [5.0, 0.0, 0.0], [np.nan, 0, 0]]))
    cloud = products.merge_clouds(target, source, T_target_source, voxel=0.1)
    np.testing.assert_allclose(cloud.xyz[2:], [[10.02, 1.02, 0.02], [10.0, 5.0, 0.0]], atol=1e-9)
    assert cloud.seen_by is not None and cloud.colour is not None
    assert cloud.seen_by.tolist() == [3, 1, 3, 2]
    assert cloud.colour[1].tolist() == list(products.COLOURS[1])
    assert cloud.crs == "EPSG:32612"


def test_octree_of_rays_keeps_free_and_unknown_apart() -> None:
    # Two robots at x = 0 and x = 4 look along y = 0 at walls at x = 2
    z = np.arange(0.05, 1.0, 0.1)
    wall = np.column_stack([np.full(len(z), 2.05), np.full(len(z), 0.05), z])
    origin = np.tile(np.array([[0.05, 0.05, 0.55]], np.float32), (len(z), 1))
    base = Cloud(wall, origin=origin, time=np.linspace(0.0, 0.35, len(z)))
    T_target_source = from_xyz_yaw(4.1, 0.1, 0.0, np.pi)
    other = Cloud(
        apply(invert(T_target_source), wall),
        origin=np.tile(np.array([[0.05, 0.05, 0.55]], np.float32), (len(z), 1)),
    )
    tree = products.merge_octrees(
        base, other, T_target_source, resolution=0.1, octree_origin=np.zeros(3)
    )
    centres, sizes = tree.leaves.centres(), tree.leaves.sizes()

    def at_point(p: list[float]) -> tuple[bool, int] | None:
        inside = (np.abs(centres - p) <= sizes[:, None] / 2).all(axis=1)
        found = np.flatnonzero(inside)
        if not len(found):
            return None
        return bool(tree.leaves.occupied[found[0]]), int(tree.provenance[found[0]])

    assert at_point([2.05, 0.05, 0.55]) == (True, 3)
    assert at_point([1.05, 0.05, 0.55]) == (False, 1)
    assert at_point([3.05, 0.05, 0.55]) == (False, 2)
    assert at_point([1.05, 0.95, 0.55]) is None


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        ([-50, -50, 0], [50, 50, 20], [0, 0, 0]),
        ([470627, 3810222, 2278], [470654, 3810248, 2313], [470600, 3810200, 0]),
    ],
)
def test_octree_origin(low: list[float], high: list[float], expected: list[float]) -> None:
    origin = products.choose_octree_origin(np.array([low, high], float), 0.1)
    np.testing.assert_array_equal(origin, expected)


def test_octree_too_wide_is_told() -> None:
    with pytest.raises(InputError, match=r"spans at most 6553 m.*coarser"):
        products.choose_octree_origin(np.array([[0.0, 0, 0], [9000.0, 0, 0]]), 0.1)


def test_height_map_of_absurd_resolution_is_told() -> None:
    with pytest.raises(InputError, match="coarser"):
        products.merge_heights(TARGET, SOURCE, cell=1e-4, config=PLAIN)


def test_merge_of_maps_in_utm_keeps_the_frame_of_the_base() -> None:
    shift = np.array([470600.0, 3810200.0, 2280.0])
    near = pipeline.merge_maps(TARGET, SOURCE, np.eye(4))
    T_far = np.eye(4)
    T_far[:3, 3] = shift
    far = pipeline.merge_maps(TARGET + shift, SOURCE, T_far)
    np.testing.assert_allclose(far.cloud.xyz - shift, near.cloud.xyz, atol=1e-6)
    np.testing.assert_array_equal(far.octree_origin, [470600.0, 3810200.0, 0.0])
    np.testing.assert_allclose(far.heights.origin - shift[:2], near.heights.origin, atol=1e-6)
    np.testing.assert_array_equal(far.navigation["occupancy"], near.navigation["occupancy"])
    centres = far.leaves.centres() + far.octree_origin - shift
    assert len(centres) == len(near.leaves.centres())
    assert np.abs(centres - near.leaves.centres()).max() < 1e-6


def test_merge_takes_octrees_on_either_side() -> None:
    config = Config.from_dict({"merge": {"resolution": 0.25}})
    cloud = pipeline.merge_maps(TARGET, SOURCE, np.eye(4), config=config)
    leaves = octree_from_points(TARGET, 0.25)
    common = pipeline.merge_maps(leaves, Cloud(SOURCE), np.eye(4))
    assert common.leaves.resolution == 0.25  # that of the octree that came
    occupied = {tuple(row) for row in np.round(common.leaves.centres() / 0.125).astype(int)}
    assert occupied == {tuple(row) for row in np.round(cloud.leaves.centres() / 0.125).astype(int)}


def test_merge_is_the_same_each_time() -> None:
    first = pipeline.merge_maps(TARGET, SOURCE, np.eye(4))
    second = pipeline.merge_maps(TARGET, SOURCE, np.eye(4))
    assert first.leaves.log_odds.tobytes() == second.leaves.log_odds.tobytes()
    assert first.cloud.xyz.tobytes() == second.cloud.xyz.tobytes()
    for name in first.heights.layers:
        assert first.heights[name].tobytes() == second.heights[name].tobytes()


def test_merge_of_nothing_is_told() -> None:
    with pytest.raises(EmptyMapError, match="source holds no finite point"):
        pipeline.merge_maps(TARGET, np.full((5, 3), np.nan), np.eye(4))
    with pytest.raises(InputError, match="4x4"):
        pipeline.merge_maps(TARGET, SOURCE, np.eye(3))
    with pytest.raises(InputError, match=r"\(N, 3\)"):
        pipeline.merge_maps([[1, 2]], SOURCE, np.eye(4))
