# ruff: noqa: E402 (threads are limited before numpy loads)
"""Odometry on simulated drives and flights: our LOAM against KISS-ICP 1.3, in one run, one thread.

    python benchmarks/odometry.py                               # about half an hour
    python benchmarks/odometry.py --worlds paper --seconds 20
    python benchmarks/odometry.py --methods loam                # the peer's rows stay as they are

Each log is every turn of a VLP-16 (motion distortion, noise, drop-outs, rough ground, sway) from
`sim.drive` and `sim.fly`; a drone that would be back sooner flies slower. Measures, both over the
poses at each method's own moments:

- ATE: root mean square distance of positions after the best rigid motion, as evo's `evo_ape -a`.
- segment: mean error of position over stretches of 10 m, percent, and of rotation, deg/m (KITTI's
  measure with one length).

KISS-ICP runs with voxels of 0.5 and 1.0 m, else as it comes. What its pose stands for is not told
by its documentation, so it is scored at the begin, the middle and the end of the turn and keeps the
best. Times are CPU time of one thread. `--hint` starts it with the true speed of the first turn.
Raw figures go to `benchmarks/records/odometry.json`, where each run replaces the rows of the same
log and method and keeps the others: a long run may be cut into pieces. Each row tells of its own
run (`run`), so that times are compared only where both were measured in one.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from commonmap.frames import angle, invert
from commonmap.odometry.loam import Loam
from commonmap.sim.missions import Area, drive, fly
from commonmap.sim.scanning import RayCaster, scan_world, split_scans, turn_stamps
from commonmap.sim.vlp16 import find_lidar
from commonmap.sim.worlds import build_world
from commonmap.types import Float64s, Scan, Trajectory

RECORDS = Path(__file__).parent / "records"
ROBOTS = {"ugv": 0.0, "uav-90": np.pi / 2, "uav-45": np.pi / 4}
"""Robot and how far its lidar looks down."""


def make_log(kind: str, robot: str, seed: int, seconds: float) -> tuple[list[Scan], Trajectory]:
    """Return the turns of a robot and the true poses of its lidar."""
    rng = np.random.default_rng(seed)
    world = build_world(kind, rng)
    side = 0.7 * world.size
    area = Area(0.0, 0.0, side, side)
    if robot == "ugv":
        mission = drive(world, area, rng)
    else:
        state, speed = rng.bit_generator.state, 4.0
        mission = fly(world, area, rng, pitch=ROBOTS[robot])
        while np.ptp(mission.sensor.time) < seconds + 0.2:
            speed *= 0.95
            rng.bit_generator.state = state
            mission = fly(world, area, rng, pitch=ROBOTS[robot], speed=speed)
    lidar = find_lidar("vlp16")
    stamps = turn_stamps(mission.sensor, lidar)[: int(10 * seconds)]
    caster = RayCaster(world)
    scans: list[Scan] = []
    for part in np.array_split(stamps, max(1, len(stamps) // 50)):
        scans += split_scans(scan_world(caster, mission.sensor, lidar, part, rng=rng), part)
    return scans, mission.sensor


def poses_at(sensor: Trajectory, moments: Float64s) -> Float64s:
    """Return the true poses at some times."""
    moments = np.clip(moments, sensor.time[0], sensor.time[-1])
    T = np.tile(np.eye(4), (len(moments), 1, 1))
    for k in range(3):
        T[:, k, 3] = np.interp(moments, sensor.time, sensor.T_map_sensor[:, k, 3])
    turn = Slerp(sensor.time, Rotation.from_matrix(sensor.T_map_sensor[:, :3, :3]))
    T[:, :3, :3] = turn(moments).as_matrix()
    return T


def score(T: Float64s, T_true: Float64s) -> dict[str, float]:
    """Return ATE (m), segment errors (percent, deg/m) and the way gone (m)."""
    a, b = T[:, :3, 3], T_true[:, :3, 3]
    U, _, Vt = np.linalg.svd((a - a.mean(0)).T @ (b - b.mean(0)))
    R = Vt.T @ np.diag([1.0, 1.0, np.linalg.det(Vt.T @ U.T)]) @ U.T
    error = (a - a.mean(0)) @ R.T + b.mean(0) - b
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(b, axis=0), axis=1))])
    metres, degrees = [], []
    for i in range(len(way)):
        j = int(np.searchsorted(way, way[i] + 10.0))
        if j == len(way):
            break
        E = invert(invert(T_true[i]) @ T_true[j]) @ invert(T[i]) @ T[j]
        metres.append(float(np.linalg.norm(E[:3, 3])))
        degrees.append(float(np.degrees(angle(E))))
    return {
        "ate_m": float(np.sqrt((error**2).sum(axis=1).mean())),
        "segment_percent": 10.0 * float(np.mean(metres)) if metres else float("nan"),
        "segment_deg_per_m": 0.1 * float(np.mean(degrees)) if degrees else float("nan"),
        "way_m": float(way[-1]),
    }


def times_of(ms: list[float]) -> dict[str, float]:
    """Return the CPU time a scan: median and 99th percentile, ms."""
    return {"ms_median": float(np.median(ms)), "ms_p99": float(np.percentile(ms, 99))}


def run_loam(scans: list[Scan], sensor: Trajectory) -> dict[str, Any]:
    """Return the figures of our LOAM."""
    loam = Loam()
    ms = []
    for scan in scans:
        begin = time.thread_time()
        loam.add(scan)
        ms.append(1e3 * (time.thread_time() - begin))
    moments = np.array(loam.moments)
    held = loam.fine.n_bytes + loam.coarse.n_bytes + loam.edges.n_bytes
    return {
        "method": "loam", "voxel_m": loam.voxel, "map_mb": held / 1e6,
        "n_lost": sum(h.lost for h in loam.health),
        "n_degenerate": sum(len(h.degenerate) > 0 for h in loam.health),
        **score(np.array(loam.poses), poses_at(sensor, moments)), **times_of(ms),
    }  # fmt: skip


def run_kiss(scans: list[Scan], sensor: Trajectory, voxel: float, *, hint: bool) -> dict[str, Any]:
    """Return the figures of KISS-ICP at one voxel size, at its best moment of the turn."""
    from kiss_icp.config import KISSConfig
    from kiss_icp.config.config import DataConfig, MappingConfig, RegistrationConfig
    from kiss_icp.kiss_icp import KissICP

    config = KISSConfig(
        data=DataConfig(max_range=100.0, min_range=0.5, deskew=True),
        mapping=MappingConfig(voxel_size=voxel),
        registration=RegistrationConfig(max_num_threads=1),
    )
    icp = KissICP(config)
    stamps = np.array([scan.stamp for scan in scans])
    if hint:
        first = poses_at(sensor, stamps[:2])
        icp.last_delta = invert(first[0]) @ first[1]
    ms, poses = [], []
    for scan in scans:
        points = scan.xyz.astype(np.float64)
        share = (scan.time - scan.stamp) / 0.1
        begin = time.process_time()
        icp.register_frame(points, share)
        ms.append(1e3 * (time.process_time() - begin))
        poses.append(np.array(icp.last_pose))
    T = np.array(poses)
    scores = [score(T, poses_at(sensor, stamps + shift)) for shift in (0.0, 0.05, 0.1)]
    best = min(scores, key=lambda s: s["ate_m"])
    return {"method": "kiss-icp", "voxel_m": voxel, **best, **times_of(ms)}


def warm_up() -> None:
    """Compile what is compiled on first use."""
    scans, _ = make_log("paper", "ugv", 0, 1.0)
    loam = Loam()
    for scan in scans:
        loam.add(scan)


def run_all(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Yield the figures of each method on each log."""
    warm_up()
    for kind in args.worlds:
        for robot in args.robots:
            scans, sensor = make_log(kind, robot, args.seed, args.seconds)
            log = {
                "world": kind, "robot": robot, "seed": args.seed, "n_scans": len(scans),
                "run": args.run,
            }  # fmt: skip
            if "loam" in args.methods:
                yield log | run_loam(scans, sensor)
            if "kiss-icp" in args.methods:
                for voxel in (0.5, 1.0):
                    yield log | run_kiss(scans, sensor, voxel, hint=args.hint)


def which(row: dict[str, Any]) -> tuple[Any, ...]:
    """Return what a row is of."""
    voxel = row["voxel_m"] if row["method"] != "loam" else 0.0
    return row["world"], row["robot"], row["seed"], row["n_scans"], row["method"], voxel


def table(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Yield the lines of a Markdown table, one line a log."""
    yield (
        "| world | robot | way, m | ATE, m: LOAM | KISS .5 / 1 | ratio | segment, %: LOAM | "
        "KISS .5 / 1 | ratio | deg/m: LOAM | KISS | ms: LOAM (p99) | KISS .5 / 1 |"
    )
    yield "|---" * 13 + "|"
    logs: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for row in rows:
        logs.setdefault(which(row)[:4], []).append(row)
    for of_log in logs.values():
        if len(of_log) != 3:
            continue
        b, c, a = sorted(of_log, key=which)
        ate, seg, turn = "ate_m", "segment_percent", "segment_deg_per_m"
        yield (
            f"| {a['world']} | {a['robot']} | {a['way_m']:.0f} | {a[ate]:.3f} | "
            f"{b[ate]:.3f} / {c[ate]:.3f} | {a[ate] / min(b[ate], c[ate]):.2f} | {a[seg]:.2f} | "
            f"{b[seg]:.2f} / {c[seg]:.2f} | {a[seg] / min(b[seg], c[seg]):.2f} | {a[turn]:.3f} | "
            f"{min(b[turn], c[turn]):.3f} | {a['ms_median']:.1f} ({a['ms_p99']:.0f}) | "
            f"{b['ms_median']:.0f} / {c['ms_median']:.0f} |"
        )


def main() -> int:
    """Run, print the table, write the record."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    worlds = ["paper", "city", "village", "forest", "industrial", "field"]
    parser.add_argument("--worlds", nargs="+", default=worlds, choices=worlds)
    parser.add_argument("--robots", nargs="+", default=["ugv", "uav-90"], choices=list(ROBOTS))
    methods = ["loam", "kiss-icp"]
    parser.add_argument("--methods", nargs="+", default=methods, choices=methods)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--hint", action="store_true")
    parser.add_argument("-o", "--output", type=Path, default=RECORDS / "odometry.json")
    args = parser.parse_args()
    args.run = f"{time.strftime('%Y-%m-%d %H:%M')} python benchmarks/odometry.py " + " ".join(
        sys.argv[1:]
    )
    args.output.parent.mkdir(exist_ok=True)
    rows: list[dict[str, Any]] = []
    if args.output.exists():
        rows = json.loads(args.output.read_text(encoding="utf-8"))["rows"]
    for row in run_all(args):
        rows = [old for old in rows if which(old) != which(row)] + [row]
        print(
            f"{row['world']:10s} {row['robot']:7s} {row['method']:8s} voxel {row['voxel_m']:.2f}  "
            f"ATE {row['ate_m']:7.3f} m  segment {row['segment_percent']:6.2f} %  "
            f"{row['ms_median']:5.1f} ms",
            flush=True,
        )
        record = {
            "machine": platform.processor() or platform.machine(),
            "python": platform.python_version(),
            "rows": rows,
        }
        args.output.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    print("\n".join(table(rows)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
