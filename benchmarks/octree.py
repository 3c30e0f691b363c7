# ruff: noqa: E402 (threads are limited before numpy loads)
"""Insertion of VLP-16 scans: our octree against pyoctomap (OctoMap's C++), in one run.

    python benchmarks/octree.py                      # everything, three quarters of an hour
    python benchmarks/octree.py --scans 20 --peer-seconds 10
    python benchmarks/octree.py --resolution 0.2     # one row anew, the others of the record stay
    python benchmarks/octree.py --stream             # a log mapped as it comes, odometry included

Each tree takes the same scans in a process of its own: pyoctomap, ours on one thread, ours on two.
Ratios are of the CPU time of one thread. Two threads are told by wall time, which other jobs on the
machine lengthen, and by the CPU time of the thread that does most, which they do not. Files are
compared by their SHA-256. Where `--peer-seconds` stops the peer early, ratio and files are of the
scans that it did. Peaks are by how much the peak of resident memory grows over all scans, and over
writing the file. Raw times go to `benchmarks/records/octree.json`; a row is of one run.

`--stream`: turns of a VLP-16 on a simulated drive go one by one through LOAM, and each, deskewed,
into the octree as soon as its pose is final; all on one thread.
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import hashlib
import json
import os
import platform
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import numpy as np

RECORDS = Path(__file__).parent / "records"
RESOLUTIONS = (0.4, 0.2, 0.1)
MAX_RANGE = 50.0
N_POINTS = 30_000
SEED = 20
TURN = 0.1
"""Seconds a turn of the lidar takes."""


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


class Ours:
    """Our octree. threads: how many work on a scan."""

    def __init__(self, resolution: float, threads: int) -> None:
        from commonmap.mapping.octree import Octree

        warm = Octree(resolution, threads=threads)  # loads the kernels
        warm.insert((0, 0, 0), np.ones((2, 3)), max_range=MAX_RANGE)
        warm.leaves()
        self.tree = Octree(resolution, threads=threads)

    def insert(self, origin: np.ndarray, points: np.ndarray) -> None:
        self.tree.insert(origin, points, max_range=MAX_RANGE)

    def write(self, path: Path) -> None:
        from commonmap.io.octomap import write_octree

        write_octree(path, self.tree.leaf_parts())

    def figures(self) -> dict[str, Any]:
        """Return what the tree says of itself."""
        return {"memory_bytes": self.tree.memory_bytes()}


class Peer:
    """pyoctomap's OcTree with its defaults, which are ours; it takes float64."""

    def __init__(self, resolution: float) -> None:
        import pyoctomap

        self.tree = pyoctomap.OcTree(resolution)

    def insert(self, origin: np.ndarray, points: np.ndarray) -> None:
        self.tree.insertPointCloud(points, origin, MAX_RANGE)

    def write(self, path: Path) -> None:
        self.tree.write(str(path))

    def figures(self) -> dict[str, Any]:
        """Return what the tree says of itself."""
        return {"memory_bytes": self.tree.memoryUsage()}


def run_child(which: str, resolution: float, n: int, budget: float) -> None:
    """Insert up to n scans into one tree and print the raw figures as JSON.

    An interrupt (SIGINT) ends it early, with what was done.
    """
    work = list(scans(n))
    kind = np.float64 if which == "peer" else np.float32
    tree = Peer(resolution) if which == "peer" else Ours(resolution, int(which))
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)  # what was freed counts as memory again when it is taken
    Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
    before = _peak_mb()
    cpu: list[float] = []
    wall: list[float] = []
    stop: list[int] = []
    signal.signal(signal.SIGINT, lambda number, frame: stop.append(number))
    for origin, points in work:
        origin, points = origin.astype(kind), points.astype(kind)
        start, cpu_start = time.perf_counter(), time.thread_time()
        tree.insert(origin, points)
        cpu.append(time.thread_time() - cpu_start)
        wall.append(time.perf_counter() - start)
        if stop or sum(cpu) > budget:
            break
    peak = _peak_mb() - before
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        tree.write(Path(folder) / "map.ot")
        write_seconds = time.perf_counter() - start
        peak_written = _peak_mb() - before
        file_bytes = (Path(folder) / "map.ot").stat().st_size
        with open(Path(folder) / "map.ot", "rb") as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
    figures = {
        "scans": len(cpu),
        "cpu_seconds": cpu,
        "wall_seconds": wall,
        "peak_mb": peak,
        "peak_mb_written": peak_written,
        "write_seconds": write_seconds,
        "file_bytes": file_bytes,
        "sha256": sha256,
        **tree.figures(),
    }
    print(json.dumps(figures))


def in_child(which: str, resolution: float, n: int, budget: float = np.inf) -> dict[str, Any]:
    """Return the figures of `run_child`, run in a process of its own."""
    command = [sys.executable, __file__, "--child", which, str(resolution), str(n), str(budget)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    figures: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return figures | {"load": os.getloadavg()[0]}


def compare(resolution: float, n: int, peer_seconds: float, bandwidth: float) -> dict[str, Any]:
    """Return the row of one resolution: raw figures of each tree, and what follows of them."""
    peer = in_child("peer", resolution, n, peer_seconds)
    both = peer["scans"]
    one, two = in_child("1", resolution, n), in_child("2", resolution, n)
    again = one if both == n else in_child("1", resolution, both)
    steps = [count_steps(*scan, resolution) for scan in scans(n)]
    speed = sum(steps) / sum(one["cpu_seconds"])
    return {
        "resolution": resolution,
        "copy_bytes_per_second": bandwidth,
        "scans": n,
        "scans_of_both": both,
        "ratio": sum(peer["cpu_seconds"]) / sum(one["cpu_seconds"][:both]),
        "identical_files": peer["sha256"] == again["sha256"],
        "identical_files_of_two_threads": one["sha256"] == two["sha256"],
        "two_threads_wall": float(np.median(np.divide(one["wall_seconds"], two["wall_seconds"]))),
        "two_threads_cpu": sum(one["cpu_seconds"]) / sum(two["cpu_seconds"]),
        "steps_per_scan": sum(steps) / n,
        "steps_per_second": speed,
        "share_of_bandwidth": speed * 8.0 / bandwidth,
        "peer": peer,
        "one_thread": one,
        "two_threads": two,
    }


def say(row: dict[str, Any]) -> None:
    """Print one row of the table."""
    ms = {k: 1e3 * float(np.mean(row[k]["cpu_seconds"])) for k in ("peer", "one_thread")}
    same = row["identical_files"] and row["identical_files_of_two_threads"]
    peaks = ", ".join(f"{row[k]['peak_mb']:.0f}" for k in ("peer", "one_thread", "two_threads"))
    print(
        f"{row['resolution']} | {row['scans_of_both']} | {ms['peer']:.0f} |"
        f" {ms['one_thread']:.1f} | {row['ratio']:.1f} | {row['two_threads_wall']:.2f},"
        f" {row['two_threads_cpu']:.2f} | {same} | {row['steps_per_second'] / 1e6:.0f}"
        f" ({100 * row['share_of_bandwidth']:.1f} %) | {peaks}",
        flush=True,
    )


def _peak_mb() -> float:
    """Return the peak resident memory of this process since it began anew (Linux), MB."""
    status = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in status if line.startswith("VmHWM")).split()[1]) / 1e3


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


def _map_turns(turns: list[Any], resolution: float) -> tuple[list[float], list[float]]:
    """Return the CPU seconds of odometry, a turn each, and of mapping the turn before each."""
    from commonmap.mapping.octree import Octree
    from commonmap.odometry import georeference
    from commonmap.odometry.loam import Loam
    from commonmap.types import Trajectory

    loam, tree = Loam(), Octree(resolution)
    odometry: list[float] = []
    mapping: list[float] = []
    for k, turn in enumerate(turns):
        start = time.thread_time()
        loam.add(turn)
        odometry.append(time.thread_time() - start)
        if k == 0:
            continue
        start = time.thread_time()
        last = slice(max(0, k - 2), k + 1)
        known = Trajectory(np.array(loam.moments[last]), np.array(loam.poses[last]))
        for cloud in georeference([turns[k - 1]], known):
            assert cloud.origin is not None
            tree.insert(cloud.origin, cloud.xyz, max_range=MAX_RANGE)
        mapping.append(time.thread_time() - start)
    return odometry, mapping


def map_stream(world_kind: str, seconds: float, resolution: float) -> dict[str, Any]:
    """Return CPU seconds a turn of odometry and of mapping over a simulated drive."""
    from commonmap.sim.missions import Area, drive
    from commonmap.sim.scanning import RayCaster, scan_world, split_scans, turn_stamps
    from commonmap.sim.vlp16 import find_lidar
    from commonmap.sim.worlds import build_world

    rng = np.random.default_rng(SEED)
    world = build_world(world_kind, rng)
    mission = drive(world, Area(0.0, 0.0, 0.7 * world.size, 0.7 * world.size), rng)
    lidar = find_lidar("vlp16")
    stamps = turn_stamps(mission.sensor, lidar)[: int(seconds / TURN)]
    turns = []
    for part in np.array_split(stamps, max(1, len(stamps) // 50)):
        seen = scan_world(RayCaster(world), mission.sensor, lidar, part, rng=rng)
        turns += split_scans(seen, part)
    _map_turns(turns[:5], resolution)  # loads the kernels
    odometry, mapping = _map_turns(turns, resolution)
    return {
        "world": world_kind,
        "resolution": resolution,
        "turns": len(turns),
        "points_per_turn": float(np.mean([len(t.xyz) for t in turns])),
        "odometry_seconds": odometry,
        "mapping_seconds": mapping,
        "share_of_one_core": (sum(odometry) + sum(mapping)) / (TURN * len(turns)),
        "load": os.getloadavg()[0],
    }


def say_stream(row: dict[str, Any]) -> None:
    """Print one row of the stream's table."""
    ms = [1e3 * np.array(row[k]) for k in ("odometry_seconds", "mapping_seconds")]
    both = ms[0][1:] + ms[1]
    print(
        f"{row['world']} | {row['turns']} | {row['points_per_turn']:.0f} | {ms[0].mean():.1f} |"
        f" {ms[1].mean():.1f} | {np.percentile(both, 99):.1f} | {row['share_of_one_core']:.2f}",
        flush=True,
    )


def main() -> None:
    """Run and print a table; write the raw record."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--scans", type=int, default=200)
    parser.add_argument("--peer-seconds", type=float, default=np.inf, help="per resolution")
    parser.add_argument("--resolution", type=float, nargs="*", default=list(RESOLUTIONS))
    parser.add_argument("--stream", action="store_true", help="the stream instead")
    parser.add_argument("--worlds", nargs="*", default=["paper", "city", "forest"])
    parser.add_argument("--stream-seconds", type=float, default=60.0)
    parser.add_argument("--record", type=Path, help="where the raw record goes")
    parser.add_argument("--child", nargs=4, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.child:
        which, resolution, n, budget = args.child
        run_child(which, float(resolution), int(n), float(budget))
        return
    rows: list[dict[str, Any]] = []
    bandwidth = copy_bandwidth()
    record = {
        "machine": platform.processor() or platform.machine(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "peer": "pyoctomap " + __import__("pyoctomap").__version__,
        "max_range": MAX_RANGE,
        "points_per_scan": N_POINTS // 16 * 16,
        "rows": rows,
    }
    path = args.record or RECORDS / ("octree_stream.json" if args.stream else "octree.json")
    if args.stream:
        print("world | turns | points | odometry ms | mapping ms | both, 99 % | share of a core")
        for world in args.worlds:
            rows.append(map_stream(world, args.stream_seconds, 0.2))
            say_stream(rows[-1])
            path.write_text(json.dumps(record, indent=1) + "\n")
    else:
        print(
            "voxel m | scans | peer ms | ours ms | ratio | two threads: wall, CPU | identical"
            " | Msteps/s (of bandwidth) | peak MB: peer, ours on one, on two"
        )
        if path.exists():
            rows += json.loads(path.read_text())["rows"]
        for resolution in args.resolution:
            row = compare(resolution, args.scans, args.peer_seconds, bandwidth)
            say(row)
            rows[:] = [old for old in rows if old["resolution"] != resolution] + [row]
            rows.sort(key=lambda row: -row["resolution"])
            path.write_text(json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main()
