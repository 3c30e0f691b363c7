# ruff: noqa: E402 (threads are limited before numpy loads)
"""Memory over a log of one hour: 36,000 turns of a VLP-16 from a capture to a level map.

    python benchmarks/hour_log.py                 # about 8 minutes of one core, 3.4 GB of disk
    python benchmarks/hour_log.py --minutes 5

A drone circles over a village, a round a minute (radius 30 m, 20 m up, lidar 45 deg down, sway).
One round is simulated, three of four firings left out to spare time; the capture repeats its
packets with the time going on, over the full hour, as the clocks of sensor and host would.
`map_log` reads it twice, as `commonmap odometry LOG -o way.tum --cloud map.laz` does: once for the
way, once for the map. Resident memory is noted every 100 turns. No loop is closed: what the
odometry has drifted by at the end of each round is told as well.
Figures go to `benchmarks/records/hour_log.json`, the curve to `docs/images/hour_log.png`.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import numpy as np
from scipy.spatial.transform import Rotation

from commonmap.io.logs import iter_scans
from commonmap.pipeline_logs import RobotMap, map_log
from commonmap.sim.logs import write_pcap
from commonmap.sim.missions import Area, flight_level, mount
from commonmap.sim.scanning import RayCaster, scan_world, split_scans, turn_stamps
from commonmap.sim.vlp16 import VLP16
from commonmap.sim.worlds import build_world
from commonmap.types import Float64s, Scan, Trajectory

RECORDS = Path(__file__).parent / "records"
FIGURE = Path(__file__).parents[1] / "docs" / "images" / "hour_log.png"
ROUND = 60.0
"""Seconds."""
RADIUS = 30.0
START = 1_700_001_000.0
"""Seconds since 1970 at the start: the full hour comes 20 minutes later."""

RECORD = np.dtype(
    [("seconds", "<u4"), ("fraction", "<u4"), ("lengths", "<u4", 2), ("frame", "u1", 42),
     ("data", "u1", 1200), ("stamp_us", "<u4"), ("factory", "u1", 2)]
)  # fmt: skip
"""A packet of a VLP-16 in a classic pcap."""


def circle(seed: int) -> Iterator[Scan]:
    """Yield the turns of one round, three of four firings left out."""
    rng = np.random.default_rng(seed)
    world = build_world("village", rng)
    clock = np.arange(0.0, ROUND + 0.3, 0.02)
    angle = 2 * np.pi * clock / ROUND
    wave = [np.sin(k * angle + k) for k in (7, 11, 13)]  # back where it began after a round
    z = flight_level(world, Area(0.0, 0.0, 2 * RADIUS, 2 * RADIUS), 20.0)
    turns = np.stack([angle + np.pi / 2, 0.03 * wave[0], 0.03 * wave[1]], axis=1)
    T = np.tile(np.eye(4), (len(clock), 1, 1))
    T[:, :3, :3] = Rotation.from_euler("ZYX", turns).as_matrix()
    T[:, :3, 3] = np.stack(
        [RADIUS * np.cos(angle), RADIUS * np.sin(angle), z + 0.2 * wave[2]], axis=1
    )
    sensor = Trajectory(clock + START, T @ mount(z=-0.15, pitch=np.pi / 4))
    stamps = turn_stamps(sensor, VLP16)[: round(10 * ROUND)]
    caster = RayCaster(world)
    for part in np.array_split(stamps, 12):
        for scan in split_scans(scan_world(caster, sensor, VLP16, part, rng=rng), part):
            kept = np.floor((scan.time - scan.stamp) / VLP16.sequence_period).astype(int) % 4 == 0
            yield Scan(
                scan.xyz[kept], scan.time[kept], scan.ring[kept], scan.intensity[kept], scan.stamp
            )


def repeat(one: Path, path: Path, rounds: int) -> None:
    """Write a capture that repeats the packets of another, the time going on."""
    with open(one, "rb") as file:
        head = file.read(24)
        packets = np.fromfile(file, RECORD)
    first = packets["stamp_us"].astype(np.int64)
    begin = packets["seconds"].copy()
    with open(path, "wb") as out:
        out.write(head)
        for k in range(rounds):
            packets["seconds"] = begin + round(k * ROUND)
            packets["stamp_us"] = (first + round(1e6 * k * ROUND)) % 3_600_000_000
            packets.tofile(out)


def resident() -> float:
    """Return the resident memory of this process, MB."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def drift_by_round(T: Float64s) -> list[float]:
    """Return how far the sensor seems to be, at the end of each round, from where it began, m."""
    n = round(10 * ROUND)
    return [float(np.linalg.norm(T[k, :3, 3] - T[0, :3, 3])) for k in range(n, len(T), n)]


def main() -> int:
    """Run, write the record and draw the curve."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--minutes", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", "--output", type=Path, default=RECORDS / "hour_log.json")
    parser.add_argument("--figure", type=Path, default=FIGURE)
    args = parser.parse_args()
    curve: list[tuple[int, float, float]] = []
    begin = time.process_time()

    def watched(path: Path) -> Iterator[Scan]:
        for n, scan in enumerate(iter_scans(path)):
            yield scan
            if n % 100 == 99:
                seconds = time.process_time() - begin
                curve.append((n + 1, round(resident(), 1), round(seconds, 1)))

    with tempfile.TemporaryDirectory() as name:
        one, path = Path(name) / "one.pcap", Path(name) / "log.pcap"
        write_pcap(one, circle(args.seed))
        repeat(one, path, round(60 * args.minutes / ROUND))
        size = path.stat().st_size
        # what simulating the round took is no memory of the log's: a second, short log before it
        map_log(lambda: iter_scans(one), max_points=100_000)
        begin, before = time.process_time(), resident()
        robot = map_log(lambda: watched(path))
    values = record(robot, curve, size, before, args.minutes)
    args.output.write_text(json.dumps(values) + "\n", encoding="utf-8")
    draw(values, args.figure)
    print(json.dumps({key: value for key, value in values.items() if key != "curve"}))
    return 0


def record(
    robot: RobotMap, curve: list[tuple[int, float, float]], size: int, before: float, minutes: int
) -> dict[str, object]:
    """Return the figures of a run."""
    return {
        "command": " ".join(["python benchmarks/hour_log.py", *sys.argv[1:]]),
        "minutes": minutes, "capture_mb": round(size / 1e6), "turns": robot.n_turns,
        "way_m": round(robot.way, 1), "lost": robot.odometry.n_lost,
        "points": len(robot.cloud.xyz), "voxel_m": robot.voxel, "before_mb": round(before, 1),
        "end_mb": round(resident(), 1), "most_mb": max(mb for _, mb, _ in curve),
        "cpu_s": curve[-1][2], "curve_columns": ["turn", "resident_mb", "cpu_s"],
        "drift_by_round_m": [round(d, 3) for d in drift_by_round(robot.trajectory.T_map_sensor)],
        "curve": curve[:: max(1, len(curve) // 240)],
    }  # fmt: skip


def draw(values: dict[str, object], path: Path) -> None:
    """Draw resident memory against turns, for both passes."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    curve = np.array(values["curve"], dtype=np.float64)
    second = int(np.argmax(np.diff(curve[:, 0], prepend=0.0) < 0)) or len(curve)
    figure, axes = plt.subplots(figsize=(6.0, 3.0), layout="constrained")
    axes.plot(curve[:second, 0], curve[:second, 1], label="first pass: odometry")
    axes.plot(curve[second:, 0], curve[second:, 1], label="second pass: map")
    axes.set(xlabel="turns (10 a second)", ylabel="resident memory, MB", ylim=(0, None))
    axes.legend(frameon=False)
    figure.savefig(path, dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    sys.exit(main())
