"""Octrees moved and fused: nothing lost, nothing invented, whatever the motion."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from commonmap import frames
from commonmap.errors import InputError
from commonmap.io.morton import count_nodes
from commonmap.io.octomap import read_octree, write_octree
from commonmap.mapping.octree import Octree, log_odds
from commonmap.merging.octrees import MERGE_RULES, merge, resample
from commonmap.types import Float64s, Leaves
from octree_oracles import leaves_at, room_scan, voxels_of

f32 = np.float32
DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "octomap"


def room(seed: int = 0, resolution: float = 0.2) -> Leaves:
    rng = np.random.default_rng(seed)
    tree = Octree(resolution)
    for k in range(3):
        origin = np.array([0.6 * k, 0.2 * k, 1.5])
        tree.insert(origin, room_scan(origin, rng), max_range=12.0)
    return tree.leaves()


def random_motion(rng: np.random.Generator) -> Float64s:
    R = Rotation.random(random_state=int(rng.integers(1 << 30))).as_matrix()
    return frames.from_rotation(R, rng.uniform(-20, 20, 3))


def occupied(leaves: Leaves) -> Float64s:
    return Octree.from_leaves(leaves).occupied_centres()


def value_at(leaves: Leaves, points: object) -> list[float]:
    values: list[float] = Octree.from_leaves(leaves).log_odds_at(np.asarray(points, float)).tolist()
    return values


def test_shares_by_hand() -> None:
    # a voxel of +2 beside a voxel of -1 along x, moved by a quarter voxel in x
    leaves = leaves_at([(32768, 32768, 32768), (32769, 32768, 32768)], [2.0, -1.0], 1.0)
    T = frames.from_rotation(np.eye(3), (1 / 3, 0, 0))
    moved = voxels_of(resample(leaves, T, 1.0))
    # voxel 0: 2/3 occupied; voxel 1: 1/3 occupied, 2/3 free, mean 0, at least 2 * 1/3;
    # voxel 2: only 1/3 known: unknown
    assert moved == {
        (32768, 32768, 32768): f32(2.0),
        (32769, 32768, 32768): f32(2 / 3),
    }


def test_half_a_voxel_of_free_space_is_known_and_less_is_not() -> None:
    leaves = leaves_at([(32768, 32768, 32768)], [-1.0], 1.0)
    T = frames.from_rotation(np.eye(3), (1 / 3, 0, 0))
    assert voxels_of(resample(leaves, T, 1.0)) == {(32768, 32768, 32768): f32(-1.0)}


@pytest.mark.parametrize("shift", [(0, 0, 0), (3, -7, 12), (-1, 0, 0)])
def test_whole_voxel_shifts_are_exact(shift: tuple[int, int, int]) -> None:
    leaves = room()
    T = frames.from_rotation(np.eye(3), 0.2 * np.array(shift))
    expected = {
        (x + shift[0], y + shift[1], z + shift[2]): v for (x, y, z), v in voxels_of(leaves).items()
    }
    assert voxels_of(resample(leaves, T, 0.2)) == expected
    back = resample(resample(leaves, T, 0.2), frames.invert(T), 0.2)
    assert np.array_equal(back.keys, leaves.keys)
    assert np.array_equal(back.log_odds, leaves.log_odds)


def test_quarter_turns_are_exact() -> None:
    leaves = room()
    T = frames.from_xyz_yaw(0, 0, 0, np.pi / 2)
    back = resample(resample(leaves, T, 0.2), frames.invert(T), 0.2)
    assert voxels_of(back) == voxels_of(leaves)


def test_the_identity_changes_nothing() -> None:
    leaves = room()
    same = resample(leaves, np.eye(4), 0.2)
    assert np.array_equal(same.keys, leaves.keys)
    merged = merge(leaves, [])
    assert np.array_equal(merged.leaves.keys, leaves.keys)
    assert np.array_equal(merged.leaves.log_odds, leaves.log_odds)
    assert (merged.provenance == 1).all() and not merged.conflict.any()


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("ratio", [0.5, 1.0, 2.5])
def test_bounds_of_any_motion(seed: int, ratio: float) -> None:
    rng = np.random.default_rng(seed)
    leaves, T = room(seed), random_motion(rng)
    moved = resample(leaves, T, 0.2 * ratio)
    edge = 0.2 * max(ratio, 1.0)
    before, after = frames.apply(T, occupied(leaves)), occupied(moved)
    lost = cKDTree(after).query(before)[0].max()
    new = cKDTree(before).query(after)[0].max()
    assert lost <= np.sqrt(3) / 2 * edge + 1e-6
    assert new <= np.sqrt(3) * edge + 1e-6


@pytest.mark.parametrize("seed", range(3))
def test_bounds_there_and_back(seed: int) -> None:
    rng = np.random.default_rng(10 + seed)
    leaves, T = room(seed), random_motion(rng)
    back = resample(resample(leaves, T, 0.2), frames.invert(T), 0.2)
    before, after = occupied(leaves), occupied(back)
    assert cKDTree(after).query(before)[0].max() <= np.sqrt(3) * 0.2 + 1e-6
    assert cKDTree(before).query(after)[0].max() <= 2 * np.sqrt(3) * 0.2 + 1e-6
    known = voxels_of(back)
    same = np.mean([known.get(k, f32(0)) > 0 for k, v in voxels_of(leaves).items() if v > 0])
    assert same > 0.95
    free = np.mean([known.get(k, f32(1)) <= 0 for k, v in voxels_of(leaves).items() if v <= 0])
    assert free > 0.6


@pytest.mark.parametrize("seed", range(8))
def test_a_wall_one_voxel_thick_keeps_no_hole(seed: int) -> None:
    # a digital plane with edge-connected steps, between free space on both sides; after the motion
    # no ray across it may slip through
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=3)
    normal /= np.abs(normal).max()
    axis = int(np.abs(normal).argmax())
    u, v = np.meshgrid(np.arange(-20, 20), np.arange(-20, 20), indexing="ij")
    others = [a for a in range(3) if a != axis]
    height = np.rint(-(normal[others[0]] * u + normal[others[1]] * v) / normal[axis]).astype(int)
    keys, values = [], []
    for layer in range(-6, 7):
        key = np.zeros((u.size, 3), int)
        key[:, others[0]], key[:, others[1]] = u.ravel(), v.ravel()
        key[:, axis] = height.ravel() + layer
        keys.append(key)
        values.append(np.full(u.size, 0.85 if layer == 0 else -2.0))
    wall = leaves_at(
        [tuple(k) for k in (np.concatenate(keys) + 32768).tolist()],
        np.concatenate(values).tolist(),
        1.0,
    )
    T = random_motion(rng)
    tree = Octree.from_leaves(resample(wall, T, 1.0))
    # rays from one side to the other through the middle of the wall, in the wall's own frame
    at = rng.uniform(-9, 9, (400, 2))
    start, end = np.zeros((400, 3)), np.zeros((400, 3))
    for points, side in ((start, 3.5), (end, -3.5)):
        points[:, others[0]], points[:, others[1]] = at[:, 0], at[:, 1]
        plane = -(normal[others[0]] * at[:, 0] + normal[others[1]] * at[:, 1]) / normal[axis]
        points[:, axis] = plane + side
    a, b = frames.apply(T, start), frames.apply(T, end)
    hits = tree.cast_rays(a, b - a, max_range=7.0, ignore_unknown=True)
    assert hits.hit.all()


def test_free_stays_free_and_unknown_unknown() -> None:
    rng = np.random.default_rng(4)
    cube = [(32768 + i, 32768 + j, 32768 + k) for i in range(9) for j in range(9) for k in range(9)]
    leaves = leaves_at(cube, [-1.5] * len(cube), 1.0)
    T = random_motion(rng)
    tree = Octree.from_leaves(resample(leaves, T, 0.7))
    inner = rng.uniform(1.3, 7.7, (500, 3))
    assert np.allclose(tree.log_odds_at(frames.apply(T, inner)), -1.5)
    outer = rng.uniform(-12, 21, (2000, 3))
    outer = outer[((outer < -1.3) | (outer > 10.3)).any(axis=1)]
    assert np.isnan(tree.log_odds_at(frames.apply(T, outer))).all()
    assert not tree.leaves().occupied.any()


def test_a_lone_voxel_never_vanishes() -> None:
    leaves = leaves_at([(32768, 32768, 32768)], [0.85], 0.1)
    for resolution in (0.05, 0.1, 0.37, 2.0):
        for seed in range(5):
            T = random_motion(np.random.default_rng(seed))
            centre = frames.apply(T, np.array([[0.05, 0.05, 0.05]]))
            assert value_at(resample(leaves, T, resolution), centre)[0] > 0


def test_a_coarse_leaf_is_split() -> None:
    leaves = Leaves(
        0.1,
        np.array([[32768, 32768, 32768]], np.uint16),
        np.array([13], np.uint8),
        np.array([2.0], np.float32),
    )
    other = leaves_at([(32769, 32768, 32768)], [-1.0])
    merged = merge(leaves, [(other, np.eye(4))])
    voxels = voxels_of(merged.leaves)
    assert len(voxels) == 512
    assert voxels[(32769, 32768, 32768)] == 1.0 and voxels[(32768, 32768, 32768)] == 2.0
    assert merged.conflict.sum() == 1 and merged.seen_by(1).sum() == 1 and merged.seen_by(0).all()


A, B, C = (32768, 32768, 32768), (32769, 32768, 32768), (32770, 32768, 32768)


@pytest.mark.parametrize(
    ("mode", "expected"),
    [
        ("add", {A: 1.5, B: 3.511, C: -0.5}),
        ("keep-target", {A: 2.0, B: 3.0, C: -0.5}),
        ("occupied-wins", {A: 2.0, B: 3.0, C: -0.5}),
    ],
)
def test_rules_by_hand(mode: str, expected: dict[tuple[int, int, int], float]) -> None:
    target, source = leaves_at([A, B], [2.0, 3.0]), leaves_at([A, B, C], [-0.5, 1.0, -0.5])
    merged = merge(target, [(source, np.eye(4))], mode=mode)
    got = voxels_of(merged.leaves)
    assert {k: round(float(v), 3) for k, v in got.items()} == expected
    order = {tuple(k): n for n, k in enumerate(merged.leaves.keys.tolist())}
    assert [int(merged.provenance[order[k]]) for k in (A, B, C)] == [3, 3, 2]
    assert [bool(merged.conflict[order[k]]) for k in (A, B, C)] == [True, False, False]


def test_log_odds_of_zero_say_occupied() -> None:
    zero, free = leaves_at([A, B], [0.0, 0.0]), leaves_at([A], [-0.5])
    merged = merge(zero, [(free, np.eye(4))])
    assert merged.conflict.tolist() == [True, False]
    T = frames.from_xyz_yaw(0.1, 0.0, 0.0, 0.0)
    moved = resample(zero, T, 0.1)
    assert moved.occupied.all() and len(moved.depth) == 2
    third = frames.from_xyz_yaw(0.1 / 3, 0.0, 0.0, 0.0)  # fills two thirds of A and a third of B
    assert voxels_of(resample(leaves_at([A], [0.0]), third, 0.1)) == {A: 0.0, B: 0.0}
    torn = merge(zero, [(leaves_at([A, B], [-0.5, 0.5]), np.eye(4))], mode="occupied-wins")
    assert torn.leaves.log_odds.tolist() == [0.0, 0.5] and torn.leaves.occupied.all()


def test_every_rule_is_tested() -> None:
    assert set(MERGE_RULES) == {"add", "keep-target", "occupied-wins"}


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 9999), n=st.integers(2, 4))
def test_order_changes_nothing_but_rounding(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    maps = []
    for _ in range(n):
        keys = sorted({tuple(k) for k in rng.integers(32766, 32771, (40, 3)).tolist()})
        maps.append(leaves_at(keys, rng.uniform(-1, 1.5, len(keys)).astype(np.float32).tolist()))
    one = merge(maps[0], [(m, np.eye(4)) for m in maps[1:]])
    order = rng.permutation(n)
    two = merge(maps[order[0]], [(maps[k], np.eye(4)) for k in order[1:]])
    a, b = voxels_of(one.leaves), voxels_of(two.leaves)
    assert a.keys() == b.keys()
    assert all(abs(float(a[k] - b[k])) <= 4e-7 for k in a)
    assert one.conflict.sum() == two.conflict.sum()
    expected: dict[tuple[int, int, int], float] = {}
    for m in maps:
        for k, v in voxels_of(m).items():
            expected[k] = expected.get(k, 0.0) + float(v)
    low, high = float(log_odds(0.1192)), float(log_odds(0.971))
    assert all(abs(min(max(expected[k], low), high) - float(a[k])) < 1e-6 for k in a)


def test_merging_with_itself_moved_and_moved_back() -> None:
    rng = np.random.default_rng(6)
    leaves, T = room(), random_motion(rng)
    moved = resample(leaves, T, 0.2)
    merged = merge(leaves, [(moved, frames.invert(T))])
    voxels = voxels_of(merged.leaves)
    original = voxels_of(leaves)
    assert original.keys() <= voxels.keys()
    kept = np.mean([(voxels[k] > 0) == (v > 0) for k, v in original.items()])
    assert kept > 0.95
    centres = occupied(merged.leaves)
    assert cKDTree(occupied(leaves)).query(centres)[0].max() <= 2 * np.sqrt(3) * 0.2 + 1e-6


def test_the_merged_tree_can_be_written_and_read(tmp_path: Path) -> None:
    merged = merge(room(0), [(room(1), frames.from_xyz_yaw(1.0, 2.0, 0.1, 0.3))], resolution=0.25)
    write_octree(tmp_path / "m.ot", merged.leaves)
    again = read_octree(tmp_path / "m.ot")
    assert np.array_equal(again.keys, merged.leaves.keys) and again.resolution == 0.25
    assert set(np.unique(merged.provenance)) == {1, 2, 3}


@pytest.mark.skipif(find_spec("pyoctomap") is None, reason="pyoctomap is not installed")
def test_pyoctomap_reads_a_merged_tree(tmp_path: Path) -> None:
    import pyoctomap

    merged = merge(room(0), [(room(1), frames.from_xyz_yaw(1.0, 2.0, 0.1, 0.3))]).leaves
    write_octree(tmp_path / "m.ot", merged)
    peer = pyoctomap.OcTree(0.1).read(str(tmp_path / "m.ot"))
    assert peer.size() == count_nodes(merged)
    for centre, value in list(zip(merged.centres(), merged.log_odds, strict=True))[::97]:
        assert peer.search(centre).getLogOdds() == value


def test_impossible_wishes_are_refused() -> None:
    leaves = leaves_at([A], [1.0])
    with pytest.raises(InputError, match="mode"):
        merge(leaves, [], mode="mean")
    with pytest.raises(InputError, match="at most 32"):
        merge(leaves, [(leaves, np.eye(4))] * 32)
    with pytest.raises(InputError, match="resolution"):
        resample(leaves, np.eye(4), 0.0)
    with pytest.raises(InputError, match="beyond"):
        resample(leaves, frames.from_xyz_yaw(9000, 0, 0, 0), 0.1)
    with pytest.raises(InputError, match="coarser"):
        resample(leaves_at([A], [1.0], 100.0), np.eye(4), 0.3)
    with pytest.raises(InputError, match="4x4"):
        resample(leaves, np.eye(3), 0.1)


@pytest.mark.skipif(not DATA.is_dir(), reason="no shared data beside the repository")
def test_the_office_floor_moved() -> None:
    leaves = read_octree(DATA / "geb079.bt")
    T = frames.from_xyz_yaw(3.21, -1.7, 0.33, 0.7)
    moved = resample(leaves, T, 0.2)
    before, after = frames.apply(T, occupied(leaves)), occupied(moved)
    assert cKDTree(after).query(before)[0].max() <= np.sqrt(3) / 2 * 0.2 + 1e-6
    assert cKDTree(before).query(after)[0].max() <= np.sqrt(3) * 0.2 + 1e-6
