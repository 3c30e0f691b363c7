"""The octree against OctoMap: published numbers, the bits of pyoctomap's files, and a slow twin."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from commonmap import frames
from commonmap.errors import InputError
from commonmap.io.morton import count_nodes, decode, encode, prune
from commonmap.io.octomap import read_octree, read_octree_header, write_octree
from commonmap.mapping import octree_kernels, octree_threads
from commonmap.mapping.octree import Octree, log_odds, octree_from_points
from commonmap.mapping.octree_blocks import blocks_to_leaves, leaves_to_blocks
from commonmap.types import Leaves
from octree_oracles import DictOctree, leaves_at, room_scan, turned_points, voxels_of

f32 = np.float32
SPHERE_ORIGIN = np.array([0.01, 0.01, 0.02], np.float32)
HAS_PYOCTOMAP = importlib.util.find_spec("pyoctomap") is not None
needs_pyoctomap = pytest.mark.skipif(not HAS_PYOCTOMAP, reason="pyoctomap is not installed")


def test_parameters_are_octomaps_to_the_last_bit() -> None:
    tree = Octree(0.1)
    got = [tree.hit, tree.miss, tree.clamp_min, tree.clamp_max]
    assert [float(v) for v in got] == [
        0.8472978472709656,
        -0.40546509623527527,
        -2.0000278949737549,
        3.5110306739807129,
    ]


def test_morton_code_has_x_lowest() -> None:
    keys = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [2, 0, 0], [65535] * 3], np.uint16)
    assert encode(keys).tolist() == [1, 2, 4, 8, (1 << 48) - 1]
    assert np.array_equal(decode(encode(keys)), keys)


def test_one_ray_by_hand() -> None:
    # voxels of 1 m; from voxel 32768 three free voxels along x, then the end
    tree = Octree(1.0)
    tree.insert((0.5, 0.5, 0.5), [[3.5, 0.5, 0.5]])
    hit, miss = log_odds(0.7), log_odds(0.4)
    expected = {(32768 + i, 32768, 32768): miss for i in range(3)} | {(32771, 32768, 32768): hit}
    assert voxels_of(tree.leaves()) == expected


def test_insert_ray_number_of_octomap() -> None:
    # OctoMap unit_tests.cpp, InsertRay: the size is that after writeBinary (maximum likelihood)
    points = SPHERE_ORIGIN + turned_points((2.01, 0.01, 0.01), 360, np.pi / 180)
    tree = Octree(0.05, hit=0.7, miss=0.4)
    tree.insert_rays(SPHERE_ORIGIN, points)
    leaves = tree.leaves()
    sign = Leaves(0.05, leaves.keys, leaves.depth, np.where(leaves.occupied, f32(1), f32(-1)))
    assert count_nodes(prune(sign)) == 50_615


def test_insert_scan_number_of_octomap() -> None:
    # OctoMap unit_tests.cpp, InsertScan
    points = SPHERE_ORIGIN + turned_points((2.01, 0.01, 0.01), 360, np.pi / 180)
    tree = Octree(0.05)
    tree.insert(SPHERE_ORIGIN, points)
    assert tree.count_nodes() == 53_959


def test_ray_casting_numbers_of_octomap() -> None:
    # OctoMap test_raycasting.cpp: 500 x 500 rays in a sphere of 2 m, none may miss
    step = 2 * np.pi / 500
    tree = Octree(0.05)
    tree.insert(SPHERE_ORIGIN, SPHERE_ORIGIN + turned_points((2.01, 0.01, 0.01), 500, step))
    hits = tree.cast_rays(SPHERE_ORIGIN, turned_points((1.0, 0.0, 0.0), 500, step), max_range=3.0)
    assert hits.hit.all()
    assert np.linalg.norm(hits.end - SPHERE_ORIGIN, axis=1).mean() == pytest.approx(2.0, abs=0.05)


def test_pruning_numbers_of_octomap() -> None:
    # OctoMap test_pruning.cpp. One voxel; its diagonal neighbour; the cell of eight but one; the
    # eighth; a cube of 32^3 voxels on the grid; the same not pruned; one voxel of the cube hit once
    # more; a voxel far away.
    tree = Octree(float(f32(0.01)))
    first = np.array([[-0.05, -0.02, 1.0]], np.float32)

    def update(*offsets: tuple[int, int, int]) -> int:
        key = np.floor(first.astype(np.float64) * (1 / tree.resolution))
        centres = (key + np.array(offsets) + 0.5) * tree.resolution
        tree.update(centres, occupied=True)
        return tree.count_nodes()

    assert tree.count_nodes() == 0
    tree.update(first, occupied=True)
    sizes = [tree.count_nodes()]
    sizes.append(update((1, 1, 1)))
    sizes.append(update((1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1)))
    sizes.append(update((0, 1, 1)))
    line = [f32(0.005)]
    while f32(line[-1] + f32(0.01)) <= f32(0.32):
        line.append(f32(line[-1] + f32(0.01)))
    cube = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)
    tree.update(cube, occupied=True)
    sizes.append(tree.count_nodes())
    sizes.append(tree.count_nodes(pruned=False))
    tree.update(np.array([[0.1, 0.1, 0.1]], np.float32), occupied=True)
    sizes.append(tree.count_nodes())
    tree.update([[-2.0, -2.0, -2.0]], occupied=True)
    sizes.append(tree.count_nodes())
    assert sizes == [17, 18, 23, 16, 27, 37_483, 67, 83]


def test_cube_ray_casting_of_octomap() -> None:
    # OctoMap test_raycasting.cpp, second part: a free cube of 2 m with a wall at x = 0.9 to 1
    tree = Octree(0.1)
    line = np.arange(-0.95, 1.0, 0.1)
    grid = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)
    tree.update(grid[grid[:, 0] < 0.9], occupied=False)
    tree.update(grid[grid[:, 0] > 0.9], occupied=True)
    assert tree.cast_ray((0, 0, 0), (1, 0, 0)) == pytest.approx([0.95, 0.05, 0.05])
    assert tree.cast_ray((0, 0, 0), (0, 1, 0)) is None
    beyond = tree.cast_rays((0, 0, 0), [[0, 1, 0], [-1, 0, 0]], ignore_unknown=True)
    assert not beyond.hit.any()
    assert beyond.end[0] == pytest.approx([0.05, 3276.75, 0.05])
    assert beyond.end[1, 0] == pytest.approx(-3276.75)
    near = tree.cast_rays((0, 0, 0), [[-1, 0, 0]], ignore_unknown=True, max_range=0.9)
    assert abs(np.linalg.norm(near.end[0]) - 0.9) < 0.1
    assert tree.log_odds_at(near.end) <= 0


@pytest.mark.parametrize("max_range", [-1.0, 7.5])
def test_scans_equal_the_slow_twin(max_range: float) -> None:
    rng = np.random.default_rng(3)
    tree, twin = Octree(0.5), DictOctree(0.5)
    for k in range(4):
        origin = np.array([0.7 * k, -0.4 * k, 1.2], np.float32)
        points = room_scan(origin.astype(float), rng, 25)
        tree.insert(origin, points, max_range=max_range)
        twin.insert(origin, points, max_range)
    assert voxels_of(tree.leaves()) == twin.voxels
    assert voxels_of(tree.leaves(pruned=False)) == twin.voxels
    assert len(tree.leaves().depth) < len(twin.voxels)


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_any_scan_equals_the_slow_twin(data: st.DataObject) -> None:
    number = st.one_of(
        st.floats(-6, 6, width=32), st.integers(-6, 6).map(float), st.sampled_from([0.25, -0.5])
    )
    point = st.tuples(number, number, number)
    resolution = data.draw(st.sampled_from([0.1, 0.25, 0.3, 1.0]))
    tree, twin = Octree(resolution), DictOctree(resolution)
    for _ in range(data.draw(st.integers(1, 3))):
        origin = np.array(data.draw(point), np.float32)
        points = np.array(data.draw(st.lists(point, min_size=1, max_size=6)), np.float32)
        max_range = data.draw(st.sampled_from([-1.0, 2.0, 50.0]))
        tree.insert(origin, points, max_range=max_range)
        twin.insert(origin, points, max_range)
    assert voxels_of(tree.leaves()) == twin.voxels


@needs_pyoctomap
@pytest.mark.parametrize(
    ("resolution", "max_range", "discretize"),
    [(0.4, 20.0, False), (0.2, -1.0, False), (0.1, 20.0, False), (0.2, 20.0, True)],
)
def test_files_equal_pyoctomaps(
    tmp_path: Path, resolution: float, max_range: float, discretize: bool
) -> None:
    import pyoctomap

    rng = np.random.default_rng(5)
    tree, peer = Octree(resolution), pyoctomap.OcTree(resolution)
    for k in range(5):
        origin = np.array([0.5 * k, -0.3 * k, 1.5], np.float32)
        points = room_scan(origin.astype(float), rng)
        tree.insert(origin, points, max_range=max_range, discretize=discretize)
        peer.insertPointCloud(
            points.astype(float), origin.astype(float), max_range, False, discretize
        )
    write_octree(tmp_path / "ours.ot", tree.leaves())
    peer.write(str(tmp_path / "peer.ot"))
    assert (tmp_path / "ours.ot").read_bytes() == (tmp_path / "peer.ot").read_bytes()
    write_octree(tmp_path / "ours.bt", tree.leaves())
    peer.writeBinary(str(tmp_path / "peer.bt"))
    assert (tmp_path / "ours.bt").read_bytes() == (tmp_path / "peer.bt").read_bytes()
    assert tree.count_nodes() == read_octree_header(tmp_path / "ours.ot").n_nodes


@needs_pyoctomap
@pytest.mark.parametrize("ignore_unknown", [False, True])
def test_cast_rays_equal_pyoctomaps(ignore_unknown: bool) -> None:
    import pyoctomap

    rng = np.random.default_rng(8)
    tree, peer = Octree(0.2), pyoctomap.OcTree(0.2)
    points = room_scan(np.array([0.0, 0.0, 1.5]), rng)
    tree.insert((0, 0, 1.5), points)
    peer.insertPointCloud(points.astype(float), np.array([0, 0, 1.5]), -1.0)
    directions = rng.normal(size=(400, 3))
    hits = tree.cast_rays((0, 0, 1.5), directions, max_range=15.0, ignore_unknown=ignore_unknown)
    end = np.zeros(3)
    for k, direction in enumerate(directions):
        got = peer.castRay(np.array([0, 0, 1.5]), direction, end, ignore_unknown, 15.0)
        assert bool(got) == hits.hit[k]
        if got:
            assert np.array_equal(end.astype(np.float32), hits.end[k])
    assert 0 < hits.hit.sum() < len(directions)


def test_an_end_voxel_is_not_freed_by_its_own_scan() -> None:
    tree = Octree(1.0)
    tree.insert((0.5, 0.5, 0.5), [[2.5, 0.5, 0.5], [5.5, 0.5, 0.5]])
    assert tree.log_odds_at([[2.5, 0.5, 0.5]])[0] == log_odds(0.7)
    tree = Octree(1.0)
    tree.insert_rays((0.5, 0.5, 0.5), [[2.5, 0.5, 0.5], [5.5, 0.5, 0.5]])
    assert tree.log_odds_at([[2.5, 0.5, 0.5]])[0] == log_odds(0.7) + log_odds(0.4)


def test_clamping_stops_at_the_limits() -> None:
    tree = Octree(1.0)
    for _ in range(30):
        tree.insert((0.5, 0.5, 0.5), [[2.5, 0.5, 0.5]])
    values = tree.log_odds_at([[0.5, 0.5, 0.5], [2.5, 0.5, 0.5], [9.0, 9.0, 9.0]])
    assert values[0] == tree.clamp_min and values[1] == tree.clamp_max and np.isnan(values[2])


def test_one_origin_per_point_equals_single_rays_where_they_are_apart() -> None:
    origins = np.array([[0.5, 0.5, 0.5], [0.5, 5.5, 0.5]])
    points = np.array([[4.5, 0.5, 0.5], [4.5, 5.5, 0.5]])
    tree, single = Octree(1.0), Octree(1.0)
    tree.insert(origins, points)
    single.insert_rays(origins, points)
    assert voxels_of(tree.leaves()) == voxels_of(single.leaves())


def test_the_sensor_frame_is_moved_into_the_map() -> None:
    T = frames.from_xyz_yaw(10.0, 0.0, 0.0, np.pi / 2)
    tree = Octree(1.0)
    tree.insert((0.5, -0.5, 0.5), [[3.5, -0.5, 0.5]], T_map_sensor=T)
    assert tree.occupied_centres().tolist() == [[10.5, 3.5, 0.5]]


def test_not_finite_and_far_points_are_left_out() -> None:
    tree = Octree(0.1)
    points = np.array([[np.nan, 0, 0], [np.inf, 0, 0], [1e9, 0, 0], [1.05, 0.05, 0.05]])
    tree.insert((0.05, 0.05, 0.05), points)
    assert len(tree.occupied_centres()) == 1
    tree.insert((0.05, 0.05, 0.05), points, max_range=3.0)
    assert np.isfinite(tree.leaves().log_odds).all()


def test_rays_near_the_border_of_the_tree() -> None:
    tree, twin = Octree(0.1), DictOctree(0.1)
    origin = np.array([-3276.75, -3276.75, 3276.65], np.float32)
    points = np.array([[-3276.7, -3274.0, 3276.6], [-3273.0, -3276.78, 3270.0]], np.float32)
    tree.insert(origin, points)
    twin.insert(origin, points)
    assert voxels_of(tree.leaves()) == twin.voxels


def test_a_scan_that_spans_too_much_is_refused_with_a_sentence() -> None:
    with pytest.raises(InputError, match="max_range"):
        Octree(0.01).insert((-300, -300, -300), [[300, 300, 300]])


@pytest.mark.parametrize(
    ("kwargs", "word"),
    [
        ({"resolution": 0.0}, "resolution"),
        ({"resolution": 0.1, "hit": 0.4}, "hit"),
        ({"resolution": 0.1, "clamp_min": 0.6}, "clamp_min"),
        ({"resolution": 0.1, "threads": 0}, "threads"),
    ],
)
def test_impossible_parameters_are_refused(kwargs: dict[str, Any], word: str) -> None:
    with pytest.raises(InputError, match=word):
        Octree(**kwargs)


def test_impossible_arrays_are_refused() -> None:
    tree = Octree(0.1)
    with pytest.raises(InputError, match=r"\(N, 3\)"):
        tree.insert((0, 0, 0), np.zeros((4, 2)))
    with pytest.raises(InputError, match="origin"):
        tree.insert(np.zeros((2, 3)), np.zeros((3, 3)))


def test_discretised_rays_begin_at_the_origin_of_the_first_point_of_their_voxel() -> None:
    rng = np.random.default_rng(5)
    start = np.array([0.0, 0.0, 1.5])
    points = room_scan(start, rng)
    one, each = Octree(0.2), Octree(0.2)
    one.insert(start, points, discretize=True)
    each.insert(np.broadcast_to(start, points.shape), points, discretize=True)
    assert np.array_equal(one.leaves().log_odds, each.leaves().log_odds)
    mixed, by_hand = Octree(1.0), Octree(1.0)
    ends = [[5.2, 0.5, 0.5], [5.7, 0.5, 0.5], [0.5, 5.5, 0.5]]
    mixed.insert([[0.5, 0.5, 0.5], [5.5, 9.5, 0.5], [3.5, 5.5, 0.5]], ends, discretize=True)
    by_hand.insert([[0.5, 0.5, 0.5], [3.5, 5.5, 0.5]], [[5.5, 0.5, 0.5], [0.5, 5.5, 0.5]])
    assert np.array_equal(mixed.leaves().keys, by_hand.leaves().keys)
    assert np.array_equal(mixed.leaves().log_odds, by_hand.leaves().log_odds)


def test_leaves_go_in_and_come_out() -> None:
    rng = np.random.default_rng(1)
    tree = Octree(0.2)
    tree.insert((0, 0, 1.5), room_scan(np.array([0.0, 0.0, 1.5]), rng))
    leaves = tree.leaves()
    again = Octree.from_leaves(leaves)
    assert np.array_equal(again.leaves().keys, leaves.keys)
    assert np.array_equal(again.leaves().log_odds, leaves.log_odds)
    blocks = tree.blocks()
    assert np.array_equal(blocks.values, leaves_to_blocks(leaves).values, equal_nan=True)
    assert np.array_equal(blocks_to_leaves(blocks).depth, leaves.depth)
    tree.insert((0, 0, 1.5), room_scan(np.array([0.0, 0.0, 1.5]), rng))
    assert not np.array_equal(tree.leaves().log_odds, leaves.log_odds)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(*[st.integers(32760, 32775)] * 3), unique=True, max_size=60),
    st.integers(0, 2**16 - 1),
)
def test_pruning_keeps_every_voxel(keys: list[tuple[int, int, int]], seed: int) -> None:
    rng = np.random.default_rng(seed)
    full = [(32768 + x, 32768 + y, 32768 + z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
    keys = sorted(set(keys) | set(full), key=lambda _: rng.random())
    values = [1.0 if k in full else float(rng.choice([-1.0, 1.0])) for k in keys]
    leaves = leaves_at(keys, values)
    pruned = prune(leaves)
    assert voxels_of(pruned) == voxels_of(leaves)
    assert len(pruned.depth) <= len(keys) - 7
    assert voxels_of(blocks_to_leaves(leaves_to_blocks(leaves))) == voxels_of(leaves)


def test_a_whole_tree_of_coarse_leaves_is_not_expanded() -> None:
    root = Leaves(0.1, np.zeros((1, 3), np.uint16), np.zeros(1, np.uint8), np.ones(1, np.float32))
    assert count_nodes(root) == 1
    with pytest.raises(InputError, match="most"):
        leaves_to_blocks(root)


def test_points_without_origins_are_occupied_and_nothing_is_free() -> None:
    xyz = np.array([[0.05, 0.05, 0.05]] * 3 + [[1.0, 0.0, 0.0], [np.nan, 0, 0], [1e9, 0, 0]])
    leaves = octree_from_points(xyz, 0.1)
    assert leaves.occupied.all() and len(leaves.depth) == 2
    tree = Octree.from_leaves(leaves)
    values = tree.log_odds_at([[0.05, 0.05, 0.05], [1.05, 0.05, 0.05], [0.5, 0.05, 0.05]])
    hit = log_odds(0.7)
    assert values[0] == f32(f32(hit + hit) + hit) and values[1] == hit and np.isnan(values[2])


def test_two_trees_of_one_input_give_the_same_bytes(tmp_path: Path) -> None:
    contents = []
    for name in ("a.ot", "b.ot"):
        rng = np.random.default_rng(2)
        tree = Octree(0.2)
        for k in range(3):
            origin = np.array([0.5 * k, 0.0, 1.5])
            tree.insert(origin, room_scan(origin, rng), max_range=10.0)
        write_octree(tmp_path / name, tree.leaves())
        contents.append((tmp_path / name).read_bytes())
    assert contents[0] == contents[1]
    assert len(read_octree(tmp_path / "a.ot").depth) > 1000


@pytest.mark.parametrize("threads", [2, 3])
def test_any_number_of_threads_gives_the_same_bytes(tmp_path: Path, threads: int) -> None:
    rng = np.random.default_rng(11)
    one, many = Octree(0.1), Octree(0.1, threads=threads)
    for k in range(4):
        origin = np.array([0.5 * k, 0.2 * k, 1.5])
        points = room_scan(origin, rng)
        points[7] = np.nan
        for tree in (one, many):
            tree.insert(origin, points, max_range=20.0)
            tree.insert(origin + np.zeros_like(points), points[::-1], max_range=5.0)
            tree.insert((1e9, 0, 0), points[:3])
            tree.insert(origin, points[:1])
    write_octree(tmp_path / "one.ot", one.leaves())
    write_octree(tmp_path / "many.ot", many.leaves())
    assert (tmp_path / "one.ot").read_bytes() == (tmp_path / "many.ot").read_bytes()
    assert one.count_nodes() > 100_000


def test_threads_share_the_voxels_to_pass() -> None:
    # ten rays: the first passes 92 voxels, the others 2; one far out and one from nowhere count 1
    ends = np.full((12, 3), 0.5, np.float32)
    ends[0, 0], ends[1:10, 0], ends[10, 0] = 91.5, 1.5, np.inf
    starts = np.full((12, 3), 0.5, np.float32)
    starts[11] = np.nan
    state = np.zeros(12, np.uint8)
    state[10] = octree_kernels.OUT
    bounds = np.empty(3, np.int64)
    octree_threads.share_rays(starts, ends, state, 1.0, bounds)
    assert bounds.tolist() == [0, 1, 12]
    octree_threads.share_rays(starts[::-1], ends[::-1], state[::-1], 1.0, bounds)
    assert bounds.tolist() == [0, 12, 12]


def test_log_odds_of_zero_are_occupied(tmp_path: Path) -> None:
    # a hit of 0.6 and a miss of 0.4 cancel to the last bit
    tree = Octree(1.0, hit=0.6, miss=0.4)
    tree.update([[0.5, 0.5, 0.5]], occupied=True)
    tree.update([[0.5, 0.5, 0.5]], occupied=False)
    assert tree.log_odds_at([[0.5, 0.5, 0.5]]).tolist() == [0.0]
    assert tree.leaves().occupied.tolist() == [True]
    assert tree.cast_ray((0.5, 0.5, 0.5), (1, 0, 0)) is not None
    write_octree(tmp_path / "a.bt", tree.leaves())
    assert read_octree(tmp_path / "a.bt").log_odds[0] > 0


@needs_pyoctomap
def test_log_odds_of_zero_are_occupied_for_pyoctomap(tmp_path: Path) -> None:
    import pyoctomap

    tree, peer = Octree(0.1, hit=0.6, miss=0.4), pyoctomap.OcTree(0.1)
    peer.setProbHit(0.6)
    peer.setProbMiss(0.4)
    for x in (0.05, 1.05):
        for occupied in (True, False):
            tree.update([[x, 0.05, 0.05]], occupied=occupied)
            peer.updateNode(np.array([x, 0.05, 0.05]), occupied)
    write_octree(tmp_path / "ours.bt", tree.leaves())
    peer.writeBinary(str(tmp_path / "peer.bt"))
    assert (tmp_path / "ours.bt").read_bytes() == (tmp_path / "peer.bt").read_bytes()


@needs_pyoctomap
@pytest.mark.parametrize("discretize", [False, True])
def test_leaves_not_pruned_are_those_of_octomaps_lazy_mode(
    tmp_path: Path, discretize: bool
) -> None:
    import pyoctomap

    rng = np.random.default_rng(6)
    tree, peer = Octree(0.2), pyoctomap.OcTree(0.2)
    for k in range(3):
        origin = np.array([0.5 * k, -0.3 * k, 1.5], np.float32)
        points = room_scan(origin.astype(float), rng)
        tree.insert(origin, points, max_range=20.0, discretize=discretize)
        peer.insertPointCloud(points.astype(float), origin.astype(float), 20.0, True, discretize)
    peer.updateInnerOccupancy()
    peer.write(str(tmp_path / "peer.ot"))
    write_octree(tmp_path / "ours.ot", tree.leaves(pruned=False))
    assert (tmp_path / "ours.ot").read_bytes() == (tmp_path / "peer.ot").read_bytes()
    assert tree.count_nodes(pruned=False) > tree.count_nodes()
    peer.writeBinary(str(tmp_path / "peer.bt"))  # prunes
    write_octree(tmp_path / "ours.bt", tree.leaves())
    assert (tmp_path / "ours.bt").read_bytes() == (tmp_path / "peer.bt").read_bytes()


def test_the_bits_of_a_scan_take_little_memory() -> None:
    rng = np.random.default_rng(9)
    tree = Octree(0.4)
    for k in range(5):
        origin = np.array([0.5 * k, 0.0, 1.5])
        tree.insert(origin, room_scan(origin, rng), max_range=20.0)
    first = tree.memory_bytes()
    assert first < 8e6
    for k in range(20):
        origin = np.array([0.1 * k, 0.0, 1.5])
        tree.insert(origin, room_scan(origin, rng), max_range=20.0)
    assert tree.memory_bytes() < 1.5 * first


def test_a_ray_too_short_for_float32_to_square() -> None:
    tree = Octree(0.1)
    tree.insert((0, 0, 0), [[0, 0, -1.7e-26]])
    tree.insert_rays((0, 0, 0), [[0, 0, -1.7e-26]])
    values = tree.log_odds_at([[0.05, 0.05, 0.05], [0.05, 0.05, -0.05]])
    assert values.tolist() == [float(2 * tree.miss), float(2 * tree.hit)]
