"""OctoMap's files: literal bytes, round trips, the tools of OctoMap, files meant to do harm."""

from __future__ import annotations

import importlib.util
import logging
import shutil
import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from commonmap.errors import InputError
from commonmap.io.morton import count_nodes, prune
from commonmap.io.octomap import (
    LOG_ODDS_FREE,
    LOG_ODDS_OCCUPIED,
    read_octree,
    read_octree_header,
    read_scan_graph,
    write_octree,
)
from commonmap.mapping.octree import Octree
from commonmap.types import Float64s, Leaves
from octree_oracles import leaves_at, room_scan, voxels_of

DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "octomap"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="no shared data beside the repository")
needs_tools = pytest.mark.skipif(
    shutil.which("compare_octrees") is None, reason="octomap-tools are not installed"
)
needs_pyoctomap = pytest.mark.skipif(
    importlib.util.find_spec("pyoctomap") is None, reason="pyoctomap is not installed"
)

ADVICE = b"# (feel free to add / change comments, but leave the first line as it is!)\n#\n"


def ot(size: int, data: bytes, tree: str = "OcTree", res: str = "0.1") -> bytes:
    head = f"id {tree}\nsize {size}\nres {res}\ndata\n".encode()
    return b"# Octomap OcTree file\n" + ADVICE + head + data


def bt(size: int, data: bytes) -> bytes:
    head = f"id OcTree\nsize {size}\nres 0.1\ndata\n".encode()
    return b"# Octomap OcTree binary file\n" + ADVICE + head + data


def node(value: float, children: int, colour: bytes = b"") -> bytes:
    return struct.pack("<f", value) + colour + bytes([children])


TWO_LEAVES = Leaves(
    0.1,
    np.array([[0, 0, 0], [32768, 0, 32768]], np.uint16),
    np.array([1, 1], np.uint8),
    np.array([-0.5, 1.5], np.float32),
)


def test_ot_bytes_by_hand(tmp_path: Path) -> None:
    # the children of the root with index 0 and 5 (x and z upper): bits 1 + 32
    data = node(1.5, 33) + node(-0.5, 0) + node(1.5, 0)
    write_octree(tmp_path / "a.ot", TWO_LEAVES)
    assert (tmp_path / "a.ot").read_bytes() == ot(3, data)
    leaves = read_octree(tmp_path / "a.ot")
    assert leaves.resolution == 0.1
    assert leaves.keys.tolist() == [[0, 0, 0], [32768, 0, 32768]]
    assert leaves.depth.tolist() == [1, 1] and leaves.log_odds.tolist() == [-0.5, 1.5]


def test_bt_bytes_by_hand(tmp_path: Path) -> None:
    # two bits a child: child 0 free = 1, child 5 occupied = 2 at bits 10 and 11
    write_octree(tmp_path / "a.bt", TWO_LEAVES)
    assert (tmp_path / "a.bt").read_bytes() == bt(3, bytes([0b01, 0b1000]))
    leaves = read_octree(tmp_path / "a.bt")
    assert leaves.keys.tolist() == TWO_LEAVES.keys.tolist()
    assert leaves.log_odds.tolist() == [float(LOG_ODDS_FREE), float(LOG_ODDS_OCCUPIED)]


def test_leaves_out_of_order_are_written_in_order(tmp_path: Path) -> None:
    mixed = Leaves(0.1, TWO_LEAVES.keys[::-1], TWO_LEAVES.depth, TWO_LEAVES.log_odds[::-1])
    write_octree(tmp_path / "a.ot", mixed)
    write_octree(tmp_path / "b.ot", TWO_LEAVES)
    assert (tmp_path / "a.ot").read_bytes() == (tmp_path / "b.ot").read_bytes()


def test_an_empty_tree_round_trips(tmp_path: Path) -> None:
    for name in ("a.ot", "a.bt"):
        write_octree(tmp_path / name, Octree(0.25).leaves())
        assert read_octree_header(tmp_path / name).n_nodes == 0
        assert len(read_octree(tmp_path / name).depth) == 0


def test_a_lone_root_round_trips(tmp_path: Path) -> None:
    root = Leaves(0.1, np.zeros((1, 3), np.uint16), np.zeros(1, np.uint8), np.ones(1, np.float32))
    write_octree(tmp_path / "a.ot", root)
    assert (tmp_path / "a.ot").read_bytes() == ot(1, node(1.0, 0))
    assert read_octree(tmp_path / "a.ot").depth.tolist() == [0]
    write_octree(tmp_path / "a.bt", root)  # as eight children: a root alone has no bits
    assert read_octree(tmp_path / "a.bt").depth.tolist() == [1] * 8


def test_a_resolution_of_many_digits_is_kept(tmp_path: Path) -> None:
    leaves = Leaves(0.123456789, TWO_LEAVES.keys, TWO_LEAVES.depth, TWO_LEAVES.log_odds)
    write_octree(tmp_path / "a.ot", leaves)
    assert read_octree(tmp_path / "a.ot").resolution == 0.123456789


@settings(
    max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    keys=st.lists(st.tuples(*[st.integers(0, 65535)] * 3), unique=True, min_size=1, max_size=30),
    near=st.lists(st.tuples(*[st.integers(0, 3)] * 3), unique=True, max_size=40),
    seed=st.integers(0, 999),
)
def test_any_leaves_round_trip(
    tmp_path: Path, keys: list[tuple[int, int, int]], near: list[tuple[int, int, int]], seed: int
) -> None:
    keys = sorted(set(keys) | set(near))
    rng = np.random.default_rng(seed)
    leaves = leaves_at(keys, rng.choice([-2.0, -0.25, 0.5, 3.5], len(keys)).tolist())
    write_octree(tmp_path / "a.ot", leaves)
    again = read_octree(tmp_path / "a.ot")
    assert voxels_of(again) == voxels_of(leaves)
    assert count_nodes(leaves) == read_octree_header(tmp_path / "a.ot").n_nodes
    write_octree(tmp_path / "b.ot", again)
    assert (tmp_path / "a.ot").read_bytes() == (tmp_path / "b.ot").read_bytes()
    write_octree(tmp_path / "a.bt", leaves)
    signs = voxels_of(read_octree(tmp_path / "a.bt"))
    assert {k: v > 0 for k, v in signs.items()} == {k: v > 0 for k, v in voxels_of(leaves).items()}


def test_a_coloured_tree_is_read_for_its_occupancy(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    data = node(1.5, 33, b"RGB") + node(-0.5, 0, b"RGB") + node(1.5, 0, b"RGB")
    (tmp_path / "a.ot").write_bytes(ot(3, data, tree="ColorOcTree"))
    with caplog.at_level(logging.INFO, logger="commonmap"):
        leaves = read_octree(tmp_path / "a.ot")
    assert leaves.log_odds.tolist() == [-0.5, 1.5]
    assert "ColorOcTree" in caplog.text


@needs_pyoctomap
def test_a_coloured_tree_of_pyoctomap(tmp_path: Path) -> None:
    import pyoctomap

    tree = pyoctomap.ColorOcTree(0.1)
    tree.updateNode(np.array([0.05, 0.05, 0.05]), True)
    tree.updateNode(np.array([1.05, 0.05, 0.05]), False)
    tree.write(str(tmp_path / "a.ot"))
    leaves = read_octree(tmp_path / "a.ot")
    assert sorted(leaves.log_odds.tolist()) == pytest.approx([-0.4054651, 0.8472979])


DEEP = b"".join(node(0.0, 1) for _ in range(17)) + node(0.0, 0)
GOOD = node(1.5, 33) + node(-0.5, 0) + node(1.5, 0)


@pytest.mark.parametrize(
    ("content", "word"),
    [
        (b"", "starts with"),
        (b"ply\nformat ascii 1.0\n", "starts with"),
        (b"# Octomap OcTree file\nid OcTree\nsize 3\n", "data"),
        (b"# Octomap OcTree file\nid OcTree\nres 0.1\ndata\n", "size"),
        (ot(-3, GOOD), "count of nodes"),
        (ot(3, GOOD, res="-1"), "res"),
        (ot(3, GOOD, res="nan"), "res"),
        (ot(3, GOOD, res="wide"), "res"),
        (ot(3, GOOD, tree="CountingOcTree"), "CountingOcTree"),
        (ot(3, GOOD[:-1]), "ends after 2"),
        (ot(10**15, GOOD), "more than"),
        (ot(2, GOOD), "there are more"),
        (ot(4, GOOD), "there are 3"),
        (ot(18, DEEP), "deeper"),
        (ot(1, node(float("nan"), 0)), "finite"),
        (ot(3, b""), "ends after 0"),
        (bt(3, b"\x01"), "ends after"),
        (bt(10**15, b"\x01\x08"), "more than"),
        (bt(5, b"\x01\x08"), "there are 3"),
        (bt(40, b"\x03\x00" * 20), "deeper"),
        (bt(3, b""), "ends after"),
    ],
)
def test_a_bad_file_is_told_in_one_sentence(tmp_path: Path, content: bytes, word: str) -> None:
    path = tmp_path / "bad.ot"
    path.write_bytes(content)
    with pytest.raises(InputError, match=word) as error:
        read_octree(path)
    assert "bad.ot" in str(error.value) and "\n" not in str(error.value)


@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.binary(max_size=120), size=st.integers(0, 400), binary=st.booleans())
def test_any_bytes_are_read_or_refused(
    tmp_path: Path, data: bytes, size: int, binary: bool
) -> None:
    path = tmp_path / "any.ot"
    path.write_bytes(bt(size, data) if binary else ot(size, data))
    try:
        leaves = read_octree(path)
    except InputError:
        return
    assert count_nodes(leaves) <= size + 1
    assert len(leaves.depth) <= 4 * len(data) + 8


def test_bytes_after_the_tree_are_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "a.ot").write_bytes(ot(3, GOOD + b"xyz"))
    with caplog.at_level(logging.WARNING, logger="commonmap"):
        assert len(read_octree(tmp_path / "a.ot").depth) == 2
    assert "3 bytes" in caplog.text


def test_missing_file_and_wrong_ending(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_octree(tmp_path / "none.ot")
    with pytest.raises(InputError, match=r"\.ot or \.bt"):
        write_octree(tmp_path / "a.txt", TWO_LEAVES)


def test_leaves_that_overlap_or_lie_crooked_are_refused(tmp_path: Path) -> None:
    keys, depth = np.array([[0, 0, 0], [1, 1, 1]], np.uint16), np.array([15, 16], np.uint8)
    with pytest.raises(InputError, match="overlap"):
        write_octree(tmp_path / "a.ot", Leaves(0.1, keys, depth, np.ones(2, np.float32)))
    keys, depth = np.array([[1, 0, 0]], np.uint16), np.array([15], np.uint8)
    with pytest.raises(InputError, match="lower corner"):
        write_octree(tmp_path / "a.ot", Leaves(0.1, keys, depth, np.ones(1, np.float32)))
    with pytest.raises(InputError, match="finite"):
        write_octree(tmp_path / "a.ot", leaves_at([(1, 2, 3)], [np.nan]))
    assert list(tmp_path.iterdir()) == []


@needs_data
def test_the_office_floor_round_trips(tmp_path: Path) -> None:
    path = DATA / "geb079.bt"
    leaves = read_octree(path)
    assert count_nodes(leaves) == 532_566 == read_octree_header(path).n_nodes
    assert len(leaves.depth) == 428_144
    write_octree(tmp_path / "again.bt", leaves)
    assert (tmp_path / "again.bt").read_bytes() == path.read_bytes()
    write_octree(tmp_path / "again.ot", leaves)
    again = read_octree(tmp_path / "again.ot")
    assert np.array_equal(again.keys, leaves.keys) and np.array_equal(again.depth, leaves.depth)
    assert np.array_equal(again.log_odds, leaves.log_odds)
    assert np.array_equal(prune(leaves).keys, leaves.keys)


@needs_data
@needs_pyoctomap
def test_the_office_floor_is_the_same_for_pyoctomap(tmp_path: Path) -> None:
    import pyoctomap

    peer = pyoctomap.OcTree(0.1)
    assert peer.readBinary(str(DATA / "geb079.bt"))
    peer.write(str(tmp_path / "peer.ot"))
    write_octree(tmp_path / "ours.ot", read_octree(DATA / "geb079.bt"))
    assert (tmp_path / "peer.ot").read_bytes() == (tmp_path / "ours.ot").read_bytes()
    assert pyoctomap.OcTree(0.1).read(str(tmp_path / "ours.ot")).size() == 532_566


def run(*command: object) -> str:
    done = subprocess.run([str(c) for c in command], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


@needs_tools
@needs_pyoctomap
def test_octomap_tools_find_no_difference(tmp_path: Path) -> None:
    import pyoctomap

    rng = np.random.default_rng(7)
    tree, peer = Octree(0.2), pyoctomap.OcTree(0.2)
    for k in range(3):
        origin = np.array([0.5 * k, 0.0, 1.5])
        points = room_scan(origin, rng)
        tree.insert(origin, points, max_range=20.0)
        peer.insertPointCloud(points.astype(float), origin, 20.0)
    write_octree(tmp_path / "ours.ot", tree.leaves())
    peer.write(str(tmp_path / "peer.ot"))
    told = run("compare_octrees", tmp_path / "ours.ot", tmp_path / "peer.ot")
    assert "KLD: 0\n" in told + "\n"
    tree.update([[0.1, 0.1, 1.5]], occupied=True)
    write_octree(tmp_path / "other.ot", tree.leaves())
    told = run("compare_octrees", tmp_path / "other.ot", tmp_path / "peer.ot")
    assert "KLD: 0\n" not in told + "\n"
    tree = Octree.from_leaves(read_octree(tmp_path / "ours.ot"))
    run("convert_octree", tmp_path / "ours.ot", tmp_path / "ours.bt")
    write_octree(tmp_path / "we.bt", tree.leaves())
    assert (tmp_path / "ours.bt").read_bytes() == (tmp_path / "we.bt").read_bytes()


def boxes_drawn(path: Path) -> Float64s:
    """Return x, y, z and edge (N, 4) of the occupied leaves that OctoMap's bt2vrml finds."""
    run("bt2vrml", path)
    words = path.with_name(path.name + ".wrl").read_text().replace("}", " ").split()
    at = [n for n, word in enumerate(words) if word == "translation"]
    edge = [n for n, word in enumerate(words) if word == "size"]
    return np.array(
        [[*words[n + 1 : n + 4], words[m + 1]] for n, m in zip(at, edge, strict=True)]
    ).astype(float)


def read_back(path: Path, leaves: Leaves) -> Leaves:
    """Write leaves and return what is read from the file."""
    write_octree(path, leaves)
    return read_octree(path)


def occupied_boxes(leaves: Leaves) -> Float64s:
    """Return x, y, z and edge (N, 4) of the occupied leaves."""
    return np.column_stack([leaves.centres(), leaves.sizes()])[leaves.occupied]


@needs_tools
def test_octomap_tools_draw_the_leaves_that_we_wrote(tmp_path: Path) -> None:
    # both in the order of the file; the tool prints six digits
    tree = Octree(0.2)
    tree.insert((0, 0, 1.5), room_scan(np.array([0.0, 0.0, 1.5]), np.random.default_rng(7)))
    cell = [[x, y, z] for x in (9.3, 9.5) for y in (9.3, 9.5) for z in (9.3, 9.5)]
    tree.update(cell, occupied=True)  # eight that make one leaf of 0.4 m
    leaves = read_back(tmp_path / "a.bt", tree.leaves())
    drawn, ours = boxes_drawn(tmp_path / "a.bt"), occupied_boxes(leaves)
    assert drawn.shape == ours.shape and len(ours) > 500
    assert sorted(np.unique(ours[:, 3])) == pytest.approx([0.2, 0.4])
    assert np.allclose(drawn, ours, atol=1e-4)


@needs_data
@needs_tools
def test_octomap_tools_draw_the_office_floor_as_we_read_it(tmp_path: Path) -> None:
    shutil.copy(DATA / "geb079.bt", tmp_path / "a.bt")
    drawn, ours = boxes_drawn(tmp_path / "a.bt"), occupied_boxes(read_octree(tmp_path / "a.bt"))
    assert len(drawn) == 143_729
    assert np.allclose(drawn, ours, atol=1e-3)


@needs_data
@needs_tools
def test_octomap_tools_build_the_same_from_a_scan_graph(tmp_path: Path) -> None:
    graph = DATA / "spherical_scan.graph"
    scans = read_scan_graph(graph)
    assert [len(s.xyz) for s in scans] == [10_201]
    assert scans[0].T_map_sensor[:3, 3].tolist() == [1.0, 0.0, -0.5]
    run("graph2tree", "-i", graph, "-o", tmp_path / "peer.bt", "-res", "0.05")
    tree = Octree(0.05)
    origin = scans[0].T_map_sensor[:3, 3]
    tree.insert(origin, scans[0].xyz + origin.astype(np.float32))
    write_octree(tmp_path / "ours.bt", tree.leaves())
    assert (tmp_path / "ours.bt").read_bytes() == (tmp_path / "peer.bt").read_bytes()


@needs_data
def test_a_cut_scan_graph_is_refused(tmp_path: Path) -> None:
    whole = (DATA / "spherical_scan.graph").read_bytes()
    for cut in (2, 6, 100, len(whole) - 40):
        (tmp_path / "a.graph").write_bytes(whole[:cut])
        with pytest.raises(InputError, match=r"a\.graph"):
            read_scan_graph(tmp_path / "a.graph")
