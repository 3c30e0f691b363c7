"""Insertion of VLP-16 scans: our octree against pyoctomap (OctoMap's C++), in one run, one thread.

    python benchmarks/octree.py                      # everything, about ten minutes
    python benchmarks/octree.py --scans 20 --peer-seconds 10

Both take the same scans one after the other, turn by turn; times are CPU time of the one thread.
The peer stops when its budget is spent; the ratio is over the scans that both did, and the files
of both trees are compared byte for byte there. Raw times go to `benchmarks/records/octree.json`.
"""

from __future__ import annotations

import argparse
import gc
import json
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

RECORDS = Path(__file__).parent / "records"
RESOLUTIONS = (0.4, 0.2, 0.1)
MAX_RANGE = 50.0
N_POINTS = 30_000
SEED = 20


class Yard:
    """A flat yard with boxes and round columns, in closed form. Metres."""

    def __init__(self, rng: np.random.Generator) -> None:
        centre = rng.uniform(-60, 60, (60, 2))
        centre = centre[np.abs(centre[:, 1]) > 6.0]  # the road along x stays free
        size = rng.uniform(0.5, 6.0, (len(centre), 2))
        height = rng.uniform(1.0, 9.0, len(centre))
        self.low = np.column_stack([centre - size / 2, np.zeros(len(centre))])
        self.high = np.column_stack([centre + size / 2, height])
        column = rng.uniform(-60, 60, (80, 2))
        self.column = column[np.abs(column[:, 1]) > 4.0]
        self.radius = rng.uniform(0.1, 0.5, len(self.column))
        self.column_height = rng.uniform(3.0, 12.0, len(self.column))

    def ranges(self, origin: np.ndarray, d: np.ndarray) -> np.ndarray:
        """Return the distance to the first surface along unit directions (N, 3), inf for none."""
        with np.errstate(divide="ignore", invalid="ignore"):
            t = np.where(d[:, 2] < 0, -origin[2] / d[:, 2], np.inf)
            for low, high in zip(self.low, self.high, strict=True):
                a, b = (low - origin) / d, (high - origin) / d
                enter, leave = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
                t = np.where((enter > 0) & (enter <= leave) & (enter < t), enter, t)
            flat = (d[:, :2] ** 2).sum(axis=1)
            for centre, radius, height in zip(
                self.column, self.radius, self.column_height, strict=True
            ):
                to = origin[:2] - centre
                half = d[:, :2] @ to
                root = half**2 - flat * (to @ to - radius**2)
                s = (-half - np.sqrt(root)) / flat
                meets = (root > 0) & (s > 0) & (s < t) & (origin[2] + s * d[:, 2] < height)
                t = np.where(meets, s, t)
        return t


def scans(n: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield origin (3,) and points (N, 3) float32 of n scans along a road, 0.5 m apart."""
    rng = np.random.default_rng(SEED)
    yard = Yard(rng)
    per_ring = N_POINTS // 16
    azimuth = np.tile(np.arange(per_ring) * (2 * np.pi / per_ring), 16)
    elevation = np.repeat(np.deg2rad(np.linspace(-15, 15, 16)), per_ring)
    flat = np.cos(elevation)
    d = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=1)
    for k in range(n):
        origin = np.array([-50.0 + 0.5 * k, 0.5 * np.sin(0.1 * k), 1.8])
        yaw = 0.05 * np.sin(0.13 * k)
        R = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
        turned = d @ R.T
        reach = yard.ranges(origin, turned) + rng.normal(0, 0.02, len(d))
        reach[~(reach < 100.0)] = 100.0  # no return: seen free up to the maximal range
        yield origin.astype(np.float32), (origin + turned * reach[:, None]).astype(np.float32)


def count_steps(origin: np.ndarray, points: np.ndarray, resolution: float) -> int:
    """Return the voxel borders that the rays of one scan cross."""
    d = points.astype(float) - origin
    reach = np.linalg.norm(d, axis=1)
    ends = origin + d * np.minimum(1.0, MAX_RANGE / reach)[:, None]
    crossed = np.abs(np.floor(ends / resolution) - np.floor(origin / resolution))
    return int(crossed.sum())


def time_insertion(resolution: float, n: int, peer_seconds: float) -> dict[str, Any]:
    """Insert the scans into both trees; return raw seconds per scan and what came of it."""
    import pyoctomap

    from commonmap.io.octomap import write_octree
    from commonmap.mapping.octree import Octree

    warm = Octree(resolution)
    warm.insert((0, 0, 0), np.ones((2, 3)), max_range=MAX_RANGE)
    warm.leaves()
    ours, peer = Octree(resolution), pyoctomap.OcTree(resolution)
    seconds: dict[str, list[float]] = {"ours": [], "peer": []}
    steps = 0
    identical = None
    for origin, points in scans(n):
        start = time.thread_time()
        ours.insert(origin, points, max_range=MAX_RANGE)
        seconds["ours"].append(time.thread_time() - start)
        steps += count_steps(origin, points, resolution)
        if identical is not None:
            continue
        points64, origin64 = points.astype(float), origin.astype(float)
        start = time.thread_time()
        peer.insertPointCloud(points64, origin64, MAX_RANGE)
        seconds["peer"].append(time.thread_time() - start)
        if sum(seconds["peer"]) > peer_seconds or len(seconds["peer"]) == n:
            with tempfile.TemporaryDirectory() as folder:
                start = time.thread_time()
                write_octree(Path(folder) / "ours.ot", ours.leaves())
                write_seconds = time.thread_time() - start
                peer.write(f"{folder}/peer.ot")
                contents = [(Path(folder) / f"{k}.ot").read_bytes() for k in ("ours", "peer")]
            identical = contents[0] == contents[1]
            n_bytes = len(contents[0])
    both = len(seconds["peer"])
    return {
        "resolution": resolution,
        "n_scans": n,
        "n_scans_of_both": both,
        "ratio": sum(seconds["peer"]) / sum(seconds["ours"][:both]),
        "ours_ms": 1e3 * float(np.mean(seconds["ours"])),
        "ours_ms_of_both": 1e3 * float(np.mean(seconds["ours"][:both])),
        "peer_ms": 1e3 * float(np.mean(seconds["peer"])),
        "identical_files": identical,
        "file_bytes": n_bytes,
        "write_seconds": write_seconds,
        "steps_per_scan": steps / n,
        "steps_per_second": steps / sum(seconds["ours"]),
        "ours_memory_bytes": ours.memory_bytes(),
        "seconds": seconds,
    }


def peak_memory(resolution: float, n: int, which: str) -> float:
    """Return the MB by which the peak of a process of its own grows while it inserts n scans."""
    command = [sys.executable, __file__, "--child", which, str(resolution), str(n)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return float(done.stdout.split()[-1])


def run_child(which: str, resolution: float, n: int) -> None:
    """Insert n scans into one tree and print the gain of the peak in MB."""
    work = list(scans(n))
    tree: Any
    if which == "ours":
        from commonmap.mapping.octree import Octree

        Octree(resolution).insert(*work[0], max_range=MAX_RANGE)  # loads the kernels
        tree = Octree(resolution)
    else:
        import pyoctomap

        tree = pyoctomap.OcTree(resolution)
        work = [(o.astype(float), p.astype(float)) for o, p in work]
    gc.collect()
    Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
    before = _peak_kb()
    for origin, points in work:
        if which == "ours":
            tree.insert(origin, points, max_range=MAX_RANGE)
        else:
            tree.insertPointCloud(points, origin, MAX_RANGE)
    print((_peak_kb() - before) / 1e3)


def _peak_kb() -> int:
    """Return the peak resident memory of this process since it began (Linux), kB."""
    status = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in status if line.startswith("VmHWM")).split()[1])


def copy_bandwidth() -> float:
    """Return bytes per second that numpy moves from memory to memory, read and written counted."""
    a = np.ones(1 << 24)
    b = np.empty_like(a)
    best = np.inf
    for _ in range(5):
        start = time.thread_time()
        b[:] = a
        best = min(best, time.thread_time() - start)
    return 2 * a.nbytes / best


def main() -> None:
    """Run and print a table; write the raw record."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--scans", type=int, default=200)
    parser.add_argument("--peer-seconds", type=float, default=120.0, help="per resolution")
    parser.add_argument("--memory-scans", type=int, default=20)
    parser.add_argument("--resolution", type=float, nargs="*", default=list(RESOLUTIONS))
    parser.add_argument("--record", type=Path, default=RECORDS / "octree.json")
    parser.add_argument("--child", nargs=3, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.child:
        run_child(args.child[0], float(args.child[1]), int(args.child[2]))
        return
    rows = []
    print(
        "voxel m | scans (both) | peer ms | ours ms | ratio | identical | Msteps/s"
        " | peak MB peer, ours"
    )
    for resolution in args.resolution:
        row = time_insertion(resolution, args.scans, args.peer_seconds)
        for which in ("peer", "ours"):
            row[f"{which}_peak_mb"] = peak_memory(resolution, args.memory_scans, which)
        rows.append(row)
        print(
            f"{resolution} | {args.scans} ({row['n_scans_of_both']}) | {row['peer_ms']:.0f} |"
            f" {row['ours_ms_of_both']:.1f} | {row['ratio']:.1f} | {row['identical_files']} |"
            f" {row['steps_per_second'] / 1e6:.0f} |"
            f" {row['peer_peak_mb']:.0f}, {row['ours_peak_mb']:.0f}",
            flush=True,
        )
    record = {
        "machine": platform.processor() or platform.machine(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "peer": "pyoctomap " + __import__("pyoctomap").__version__,
        "max_range": MAX_RANGE,
        "points_per_scan": N_POINTS // 16 * 16,
        "copy_bytes_per_second": copy_bandwidth(),
        "memory_scans": args.memory_scans,
        "rows": rows,
    }
    args.record.parent.mkdir(parents=True, exist_ok=True)
    args.record.write_text(json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main()
