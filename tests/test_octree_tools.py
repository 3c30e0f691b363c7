"""OctoMap's own command line tools on scans that both sides insert, and on files that we wrote.

The tools are Debian's package octomap-tools. What they print and write is compared as it is.
"""

from __future__ import annotations

import re
import shutil
import struct
import subprocess
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from commonmap.io.octomap import GraphScan, read_scan_graph, write_octree
from commonmap.mapping.octree import Octree
from octree_oracles import room_scan

TOOLS = ("log2graph", "graph2tree", "compare_octrees", "convert_octree", "eval_octree_accuracy")
pytestmark = pytest.mark.skipif(
    not all(map(shutil.which, TOOLS)), reason="octomap-tools are not installed"
)

RESOLUTION = 0.2
EVERY = 5
"""Of the scans, the one of these that `eval_octree_accuracy` keeps for the test."""


def run(*command: object) -> str:
    done = subprocess.run([str(c) for c in command], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


@pytest.fixture(scope="module", params=[0.0, 1.0], ids=["straight", "turning"])
def graph(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a scan graph of six scans in a room, made by OctoMap from a text log."""
    folder = tmp_path_factory.mktemp("graph")
    rng = np.random.default_rng(9)
    lines = []
    for k in range(6):
        origin = np.array([0.4 * k, -0.2 * k, 1.5])
        angles = request.param * k * np.array([0.02, -0.03, 0.3])
        R = Rotation.from_euler("xyz", angles).as_matrix()
        lines.append("NODE " + " ".join(str(value) for value in (*origin, *angles)))
        points = (room_scan(origin, rng) - origin)[::3] @ R
        lines += ["{:.6f} {:.6f} {:.6f}".format(*p) for p in points]
    (folder / "room.log").write_text("\n".join(lines) + "\n")
    run("log2graph", folder / "room.log", folder / "room.graph")
    return folder / "room.graph"


def quaternions(graph: Path, scans: list[GraphScan]) -> list[NDArray[np.float32]]:
    """Return w, x, y, z of each pose as the file has them, in single precision as OctoMap."""
    data, at, found = graph.read_bytes(), 4, []
    for scan in scans:
        at += 4 + 28 * len(scan.xyz) + 28 + 4  # points, translation, and how many numbers follow
        found.append(np.array(struct.unpack_from("<4d", data, at), np.float32))
        at += 32 + 4
    return found


def turn(q: NDArray[np.float32], xyz: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return points (N, 3) turned by q as OctoMap does: `q v q^-1` in single precision."""

    def multiply(a: Any, b: Any) -> Any:
        (u, x, y, z), (U, X, Y, Z) = a, b
        return (
            u * U - x * X - y * Y - z * Z, y * Z - Y * z + u * X + U * x,
            z * X - Z * x + u * Y + U * y, x * Y - X * y + u * Z + U * z,
        )  # fmt: skip

    right = multiply(q, (np.zeros(len(xyz), np.float32), *xyz.T))
    turned: NDArray[np.float32] = np.stack(
        multiply(right, q * np.array([1, -1, -1, -1], np.float32))[1:], 1
    )
    return turned


def tree_of(graph: Path, numbers: Iterable[int], **how: Any) -> Octree:
    """Return our tree of some scans of a graph."""
    tree = Octree(RESOLUTION)
    scans = read_scan_graph(graph)
    q = quaternions(graph, scans)
    for number in numbers:
        t = scans[number].T_map_sensor[:3, 3].astype(np.float32)
        tree.insert(t, turn(q[number], scans[number].xyz) + t, **how)
    return tree


@pytest.mark.parametrize(
    ("options", "how"),
    [
        ((), {}),
        (("-m", "6"), {"max_range": 6.0}),
        (("-discretize",), {"discretize": True}),
    ],
)
def test_graph2tree_and_we_make_the_same_files(
    graph: Path, tmp_path: Path, options: tuple[str, ...], how: dict[str, Any]
) -> None:
    peer = tmp_path / "peer.bt"
    run("graph2tree", "-i", graph, "-o", peer, "-res", RESOLUTION, *options)
    tree = tree_of(graph, range(6), **how)
    write_octree(tmp_path / "ours.ot", tree.leaf_parts())
    write_octree(tmp_path / "ours.bt", tree.leaf_parts())
    assert (tmp_path / "ours.bt").read_bytes() == peer.read_bytes()
    assert (tmp_path / "ours.ot").read_bytes() == (tmp_path / "peer.bt.ot").read_bytes()
    told = run("compare_octrees", tmp_path / "ours.ot", tmp_path / "peer.bt.ot")
    assert re.search(r"KLD: 0$", told, re.MULTILINE)
    run("convert_octree", tmp_path / "ours.ot", tmp_path / "again.bt")
    assert (tmp_path / "again.bt").read_bytes() == peer.read_bytes()


def test_eval_octree_accuracy_counts_what_we_count(graph: Path) -> None:
    told = run("eval_octree_accuracy", graph, "-res", RESOLUTION)
    found = re.search(r"correct: (\d+)\s+#wrong: (\d+)\s+#unknown: (\d+)", told)
    assert found is not None, told
    tested = EVERY - 1
    tree = tree_of(graph, [n for n in range(6) if n != tested])
    seen = tree_of(graph, [tested]).leaves(pruned=False)  # what that scan calls free and occupied
    known = tree.log_odds_at(seen.centres())
    unknown = np.isnan(known)
    right = ~unknown & ((known >= 0) == seen.occupied)
    counts = int(right.sum()), int((~right & ~unknown).sum()), int(unknown.sum())
    assert counts[0] > 3000 and counts[1] > 0 and counts[2] > 0
    assert tuple(map(int, found.groups())) == counts
