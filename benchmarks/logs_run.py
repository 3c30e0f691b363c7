"""From two raw logs to the common map: `commonmap run drone.pcap ground.mcap`, against the truth.

    python benchmarks/logs_run.py                       # ten seeds, 120 s a log: about 25 minutes
    python benchmarks/logs_run.py --seeds 0 1 --seconds 60
    python benchmarks/logs_run.py --seeds 3 --logs /tmp/logs   # logs made once; other rows stay

For each seed a place is made (the kinds take turns), a drone flies over it and a ground robot
drives in it for so many seconds; each lidar's packets, or messages, are written as a sensor would,
and the command is run as a user would run it, on two threads. The truth is the best motion between
each map and the true places of its points; the answer is judged in the middle of the draft. The
level is judged by the same motion. CPU seconds are of the command and what it starts; wall seconds
say little where other jobs share the machine, so the load is told beside them.
Raw figures go to `benchmarks/records/logs_run.json`; rows of other seeds that are there stay.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from commonmap.frames import difference, invert
from commonmap.io.las import read_las
from commonmap.io.trajectory import read_trajectory
from commonmap.odometry import compare
from commonmap.pipeline_logs import move_trajectory
from commonmap.sim.missions import Mission
from commonmap.sim.pairs import plan_missions
from commonmap.sim.recording import MARGIN, fit_truth, record, write_logs
from commonmap.sim.vlp16 import VLP16
from commonmap.sim.world import World
from commonmap.types import Float64s, Scan

RECORDS = Path(__file__).parent / "records"
KINDS = ("paper", "city", "village", "forest", "industrial")
LOGS = {"base": "pcap", "draft": "mcap"}


def simulate(folder: Path, seed: int, seconds: float) -> tuple[str, dict[str, Mission]]:
    """Write the raw logs of two robots; return the kind of place and the missions."""
    kind = KINDS[seed % len(KINDS)]
    rng = np.random.default_rng([seed, 120])
    plan = plan_missions(kind, rng=rng, margin=MARGIN, seconds=seconds + 0.2)
    missions = {"base": plan.flight, "draft": plan.ground}
    worlds = {"base": plan.world, "draft": plan.source_world}
    for part, mission in missions.items():
        own = int(rng.integers(2**31))
        if not (folder / part / f"log.{LOGS[part]}").exists():
            (folder / part).mkdir(parents=True, exist_ok=True)
            write(folder / part, mission, worlds[part], own, seconds, LOGS[part])
    return kind, missions


def write(
    folder: Path, mission: Mission, world: World, seed: int, seconds: float, kind: str
) -> None:
    """Write one robot's raw log."""

    def turns() -> Iterator[Scan]:
        return record(mission, world, VLP16, rng=np.random.default_rng(seed), seconds=seconds)

    write_logs(folder, turns, mission.sensor, VLP16, [kind])


def run_command(folder: Path, out: Path) -> dict[str, Any]:
    """Run the command on the two logs; return what it cost and said."""
    command = [
        sys.executable, "-m", "commonmap.cli", "run", str(folder / "base" / "log.pcap"),
        str(folder / "draft" / "log.mcap"), "-o", str(out), "-q",
    ]  # fmt: skip
    threads = {"NUMBA_NUM_THREADS": "2", "OMP_NUM_THREADS": "2", "OPENBLAS_NUM_THREADS": "2"}
    before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run(command, env={**os.environ, **threads}, check=False)
    wall = time.perf_counter() - begin
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {
        "code": done.returncode, "wall_s": wall, "cpu_s": cpu, "load": os.getloadavg()[0],
        "peak_mb": after.ru_maxrss / 1024,
    }  # fmt: skip


def judge(out: Path, missions: dict[str, Mission]) -> dict[str, Any]:
    """Return how far the answer, the ways and the levels are from the truth."""
    match = json.loads((out / "match.json").read_text(encoding="utf-8"))
    T = None if match["T_target_source"] is None else np.array(match["T_target_source"])
    row: dict[str, Any] = {"accepted": match["accepted"], "reason": match["reason"]}
    T_world: dict[str, Float64s] = {}
    health = json.loads((out / "odometry.json").read_text(encoding="utf-8"))
    for part, mission in missions.items():
        way = read_trajectory(out / f"{part}_trajectory.tum")
        if part == "draft" and T is not None:
            way = move_trajectory(invert(T), way)
        cloud = read_las(out / f"{part}.laz")
        T_world[part], off = fit_truth(cloud, way, mission.sensor)
        errors = compare(way, mission.sensor)
        row[part] = {
            "ape_m": errors.ape, "relative_percent": 100 * errors.relative, "way_m": errors.way,
            "map_rms_m": off, "points": len(cloud.xyz),
            "level_deg": math.degrees(math.acos(min(1.0, T_world[part][2, 2]))),
            "lost": health[part]["turns_lost"], "degenerate": health[part]["turns_degenerate"],
        }  # fmt: skip
        centre = cloud.xyz.mean(axis=0)
    if T is not None:
        metres, radians = difference(T, invert(T_world["base"]) @ T_world["draft"], centre)
        row |= {"metres": metres, "degrees": math.degrees(radians)}
    return row


def main() -> int:
    """Run, print a line a seed, write the record."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--seeds", nargs="+", type=int, default=list(range(10)))
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--logs", type=Path, help="keep the simulated logs here, use those there")
    parser.add_argument("--only-simulate", action="store_true")
    parser.add_argument("-o", "--output", type=Path, default=RECORDS / "logs_run.json")
    args = parser.parse_args()
    old = json.loads(args.output.read_text(encoding="utf-8")) if args.output.is_file() else {}
    found = {r["seed"]: r for r in old.get("rows", []) if old.get("seconds") == args.seconds}
    for seed in args.seeds:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name) if args.logs is None else args.logs / str(seed)
            kind, missions = simulate(folder, seed, args.seconds)
            if args.only_simulate:
                continue
            row = {"seed": seed, "kind": kind, **run_command(folder, Path(name) / "out")}
            if row["code"] in (0, 3):
                row |= judge(Path(name) / "out", missions)
        found[seed] = row
        print(json.dumps(row), flush=True)
        rows = [found[seed] for seed in sorted(found)]
        values = {
            "command": "python benchmarks/logs_run.py",
            "machine": f"{platform.machine()}, {os.cpu_count()} cores, shared with other jobs",
            "seconds": args.seconds, "rows": rows,
        }  # fmt: skip
        args.output.write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")
    rows = list(found.values())
    good = [r for r in rows if r.get("metres", 9) < 0.2 and r.get("degrees", 9) < 0.3]
    print(f"{len(good)} of {len(rows)} within 0.2 m and 0.3 deg")
    return 0


if __name__ == "__main__":
    sys.exit(main())
