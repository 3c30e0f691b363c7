# ruff: noqa: E402 (threads are limited before numpy loads)
"""Levelling of logs: how far from level the maps of simulated robots are.

    python benchmarks/level_logs.py                     # six worlds, three robots, 60 s a log

The logs are those of `benchmarks/odometry.py` (UGV, and UAV with its lidar 90 and 45 deg down);
each goes through LOAM, becomes a map and is levelled, as `commonmap odometry` does it. The truth is
the vertical of the best rigid motion between the map and the true places of its points. Told beside
it: what the axis of turning alone and what upright things alone (`find_level`) give.
Raw figures go to `benchmarks/records/level_logs.json`.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
from pathlib import Path
from typing import Any

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import numpy as np
from odometry import ROBOTS, make_log

from commonmap.frames import invert
from commonmap.mapping.level import find_level
from commonmap.mapping.level_log import find_turn_axis
from commonmap.mapping.points import move_cloud
from commonmap.pipeline_logs import map_log, move_trajectory
from commonmap.sim.recording import fit_truth
from commonmap.types import Float64s

RECORDS = Path(__file__).parent / "records"
WORLDS = ("paper", "city", "village", "forest", "industrial", "field")


def off(up: Float64s, true: Float64s) -> float:
    """Return the angle between two directions, degrees."""
    return math.degrees(math.acos(float(np.clip(up @ true, -1.0, 1.0))))


def judge(world: str, robot: str, seed: int, seconds: float) -> dict[str, Any]:
    """Return how far from level one log's map is."""
    scans, sensor = make_log(world, robot, seed, seconds)
    made = map_log(lambda: iter(scans))
    T_world_map, _ = fit_truth(made.cloud, made.trajectory, sensor)
    true = T_world_map[2, :3]
    # the map as it was before levelling
    T_start_map = invert(made.levelling.T_level_map)
    cloud = move_cloud(T_start_map, made.cloud)
    trajectory = move_trajectory(T_start_map, made.trajectory)
    true_start = T_start_map[:3, :3] @ true
    axis = find_turn_axis(cloud, trajectory)
    alone = find_level(cloud.xyz)
    return {
        "world": world, "robot": robot, "seed": seed, "turns": made.n_turns,
        "level_deg": off(np.array([0.0, 0.0, 1.0]), true),
        "axis_deg": None if axis is None else off(axis, true_start),
        "upright_deg": off(alone.T_level_map[2, :3], true_start),
        "tilt_deg": math.degrees(made.levelling.tilt), "reason": made.levelling.reason,
    }  # fmt: skip


def main() -> int:
    """Run, print a line a log, write the record."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--worlds", nargs="+", default=list(WORLDS), choices=WORLDS)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("-o", "--output", type=Path, default=RECORDS / "level_logs.json")
    args = parser.parse_args()
    rows = []
    for world in args.worlds:
        for robot in ROBOTS:
            row = judge(world, robot, args.seed, args.seconds)
            rows.append(row)
            axis = float("nan") if row["axis_deg"] is None else row["axis_deg"]
            print(
                f"{world:10s} {robot:7s} level {row['level_deg']:5.2f} deg   axis {axis:6.2f}   "
                f"upright things {row['upright_deg']:6.2f}   {row['reason']}",
                flush=True,
            )
            command = " ".join(["python benchmarks/level_logs.py", *sys.argv[1:]])
            record = {"command": command, "seconds": args.seconds, "rows": rows}
            args.output.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
