"""Files written part by part: the same bytes for any parts, and memory that stays small."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from commonmap.errors import InputError
from commonmap.io import octomap_stream
from commonmap.io.morton import prune
from commonmap.io.octomap import write_octree
from commonmap.mapping import octree_blocks
from commonmap.mapping.octree import Octree
from commonmap.types import LeafParts, Leaves
from octree_oracles import leaves_at, room_scan

NAMES = ("a.ot", "a.bt")


def mixed_leaves() -> Leaves:
    """Return leaves of many depths: scattered voxels, and a block joined up to 32^3."""
    rng = np.random.default_rng(5)
    keys = np.unique(rng.integers(0, 24, (4000, 3)), axis=0)
    keys[:, 2] += 32760
    cube = np.array(list(np.ndindex(32, 32, 37)))
    cube[:, 0] += 64
    values = [*rng.choice([-2.0, -0.5, 3.5], len(keys)), *np.full(len(cube), -2.0)]
    places = [(int(x), int(y), int(z)) for x, y, z in np.vstack([keys, cube])]
    return prune(leaves_at(places, values))


def split(leaves: Leaves, n: int) -> LeafParts:
    """Return the leaves in parts of n."""

    def make() -> Iterator[Leaves]:
        for k in range(0, len(leaves.depth), n):
            some = slice(k, k + n)
            yield Leaves(
                leaves.resolution, leaves.keys[some], leaves.depth[some], leaves.log_odds[some]
            )

    return LeafParts(leaves.resolution, make)


@pytest.mark.parametrize("name", NAMES)
def test_the_file_does_not_depend_on_the_parts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    leaves = mixed_leaves()
    assert len(np.unique(leaves.depth)) >= 3
    write_octree(tmp_path / name, leaves)
    for part in (1, 3, 64):
        write_octree(tmp_path / f"b{name}", split(leaves, part))
        assert (tmp_path / f"b{name}").read_bytes() == (tmp_path / name).read_bytes()
        monkeypatch.setattr(octomap_stream, "PART", part)
        write_octree(tmp_path / f"c{name}", leaves)
        assert (tmp_path / f"c{name}").read_bytes() == (tmp_path / name).read_bytes()


@pytest.mark.parametrize("blocks", [1, 7])
@pytest.mark.parametrize("pruned", [True, False])
def test_a_tree_is_written_block_by_block_as_all_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, blocks: int, pruned: bool
) -> None:
    room = Octree(0.2)
    room.insert((0, 0, 1.5), room_scan(np.array([0.0, 0.0, 1.5]), np.random.default_rng(7)))
    cube = Octree.from_leaves(leaves_at(list(np.ndindex(16, 16, 16)), [-2.0] * 4096))
    assert len(cube.leaves().depth) == 1  # of 8 blocks
    for tree in (room, cube, Octree(0.2)):
        every = tree.leaves(pruned=False)
        expected = prune(every) if pruned else every
        for name in NAMES:
            write_octree(tmp_path / name, expected)
            with monkeypatch.context() as patch:
                patch.setattr(octree_blocks, "PART_BLOCKS", blocks)
                write_octree(tmp_path / f"b{name}", tree.leaf_parts(pruned=pruned))
                found = tree.leaves(pruned=pruned)
            assert (tmp_path / f"b{name}").read_bytes() == (tmp_path / name).read_bytes()
            assert np.array_equal(found.keys, expected.keys)
            assert np.array_equal(found.depth, expected.depth)
            assert np.array_equal(found.log_odds, expected.log_odds)


def test_a_whole_tree_of_one_value_becomes_its_root(tmp_path: Path) -> None:
    corners = np.array(list(np.ndindex(2, 2, 2)), np.uint16)[:, ::-1] * 32768
    eight = Leaves(0.1, corners, np.ones(8, np.uint8), np.full(8, -1, np.float32))
    root = Leaves(0.1, np.zeros((1, 3), np.uint16), np.zeros(1, np.uint8), np.full(1, -1, "f4"))
    write_octree(tmp_path / "a.bt", split(eight, 3))
    write_octree(tmp_path / "b.bt", root)
    assert (tmp_path / "a.bt").read_bytes() == (tmp_path / "b.bt").read_bytes()


def test_parts_out_of_order_are_refused(tmp_path: Path) -> None:
    leaves = mixed_leaves()
    parts = list(split(leaves, 1000))
    for wrong in ([parts[1], parts[0]], [parts[0], parts[0]]):
        again = LeafParts(leaves.resolution, lambda wrong=wrong: iter(wrong))  # type: ignore[misc]
        with pytest.raises(InputError, match="Morton order"):
            write_octree(tmp_path / "a.ot", again)
    assert list(tmp_path.iterdir()) == []


def test_writing_a_tree_takes_no_room_for_its_leaves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(octree_blocks, "PART_BLOCKS", 64)
    monkeypatch.setattr(octomap_stream, "PART", 64 * 512)
    part = 64 * 512 * 80  # bytes: every voxel of a part a leaf, with its code and copies
    tree = Octree(0.1)
    tree.update(np.random.default_rng(11).uniform(-6.4, 6.4, (600_000, 3)), occupied=True)
    write_octree(tmp_path / "warm.ot", tree.leaf_parts())
    tracemalloc.start()
    write_octree(tmp_path / "a.ot", tree.leaf_parts())
    streamed = tracemalloc.get_traced_memory()[1]
    tracemalloc.reset_peak()
    write_octree(tmp_path / "b.ot", tree.leaves())
    whole = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert (tmp_path / "a.ot").read_bytes() == (tmp_path / "b.ot").read_bytes()
    leaves = 11 * len(tree.leaves().depth)  # bytes of keys, depth and log-odds
    assert part < 0.6 * leaves
    assert streamed < part
    assert whole < leaves + part
