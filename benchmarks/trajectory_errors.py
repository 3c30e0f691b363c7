"""Our errors of trajectories against those of evo, which others judge by.

    pip install evo; python benchmarks/trajectory_errors.py

True ways of a simulated drive and flight, and the same with drift and noise, in another frame. Of
both: the absolute error after alignment (`evo_ape -a`) and the relative error of position and
rotation over stretches of 10 m (`evo_rpe --delta 10 --delta_unit m --all_pairs`). evo takes pairs
of poses whose distance is 10 m within a tolerance, we the first that are 10 m apart, as the KITTI
benchmark does, so the relative errors agree nearly, not exactly.
Raw figures go to `benchmarks/records/trajectory_errors.json`.
"""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np

from commonmap.frames import from_xyz_yaw, quaternion
from commonmap.odometry import compare
from commonmap.sim.drift import add_drift
from commonmap.sim.pairs import plan_missions
from commonmap.types import Trajectory

RECORD = Path(__file__).parent / "records" / "trajectory_errors.json"


def judge_by_evo(estimated: Trajectory, true: Trajectory) -> dict[str, float]:
    """Return evo's figures, ours in name and unit."""
    from evo.core import metrics
    from evo.core.trajectory import PoseTrajectory3D

    def take(way: Trajectory) -> Any:
        xyzw = quaternion(way.T_map_sensor)
        return PoseTrajectory3D(way.T_map_sensor[:, :3, 3], np.roll(xyzw, 1, axis=1), way.time)

    a, b = take(true), take(estimated)
    b.align(a)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((a, b))
    figures = {"ape": ape.get_statistic(metrics.StatisticsType.rmse)}
    for name, relation in (
        ("relative", metrics.PoseRelation.translation_part),
        ("turn", metrics.PoseRelation.rotation_angle_rad),
    ):
        rpe = metrics.RPE(relation, 10.0, metrics.Unit.meters, rel_delta_tol=0.02, all_pairs=True)
        rpe.process_data((a, b))
        figures[name] = rpe.get_statistic(metrics.StatisticsType.mean) / 10.0
    return figures


def main() -> int:
    """Compare, print, write the record."""
    rows = []
    for seed, scene in enumerate(("paper", "city", "forest")):
        rng = np.random.default_rng(seed)
        plan = plan_missions(scene, rng=rng)
        for name, mission in (("drive", plan.ground), ("flight", plan.flight)):
            some = slice(None, None, 5)
            sensor = mission.sensor
            true = Trajectory(sensor.time[some], sensor.T_map_sensor[some])
            drifted = add_drift(sensor, mission.distance, 0.01, rng).T_map_sensor[some].copy()
            drifted[:, :3, 3] += rng.normal(0.0, 0.02, (len(drifted), 3))
            moved = Trajectory(true.time, from_xyz_yaw(50.0, -20.0, 3.0, 2.0) @ drifted)
            ours, evo = compare(moved, true), judge_by_evo(moved, true)
            row: dict[str, Any] = {"scene": scene, "way": name}
            for key in ("ape", "relative", "turn"):
                row[key] = {"ours": getattr(ours, key), "evo": evo[key]}
            rows.append(row)
            print(
                f"{scene:7s} {name:7s} APE {ours.ape:.6f} / {evo['ape']:.6f} m   relative "
                f"{100 * ours.relative:.4f} / {100 * evo['relative']:.4f} %   "
                f"{math.degrees(ours.turn):.5f} / {math.degrees(evo['turn']):.5f} deg/m"
            )
    RECORD.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
