"""What the correction of a draft's drift is worth: simulated pairs, truth known point by point.

    python benchmarks/areas.py --seeds 1 2        writes benchmarks/records/areas.jsonl

Of each pair: the distance of the draft's points from where they truly are, at the rigid pose that
`match` found and with the correction on top, whether or not held-out areas support it; and whether
they do. Pairs whose match is refused are recorded as such.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from commonmap.config import Config
from commonmap.frames import apply, invert
from commonmap.matching.areas import lay_on_base, make_field, tile
from commonmap.matching.maps import choose_grid, choose_points, prepare
from commonmap.pipeline import match_maps
from commonmap.sim.pairs import Pair, simulate_pair
from commonmap.types import Float64s, Trajectory

RECORDS = Path(__file__).parent / "records" / "areas.jsonl"
KINDS = ("city", "village", "forest", "industrial", "field", "paper")
DRIFTS = (0.0, 0.003, 0.01)
SIZE = 10.0


def poses_at(way: Trajectory, time: Float64s) -> tuple[Float64s, Rotation]:
    """Return positions (N, 3) and rotations of a sensor at these times."""
    T = way.T_map_sensor
    xyz = np.column_stack([np.interp(time, way.time, T[:, a, 3]) for a in range(3)])
    turn = Slerp(way.time, Rotation.from_matrix(T[:, :3, :3]))
    return xyz, turn(np.clip(time, way.time[0], way.time[-1]))


def true_places(pair: Pair) -> Float64s:
    """Return where each point of the draft truly is, (N, 3), in the target's frame."""
    assert pair.source.time is not None
    known, turned = poses_at(pair.source_trajectory, pair.source.time)
    true, turned_true = poses_at(pair.source_mission.sensor, pair.source.time)
    world = turned_true.apply(turned.inv().apply(pair.source.xyz - known)) + true
    return apply(invert(pair.T_world_target), world)


def describe(errors: Float64s) -> list[float]:
    """Return the median, 99 % quantile and maximum of errors in metres."""
    return [round(float(v), 4) for v in (*np.quantile(errors, [0.5, 0.99]), errors.max())]


def measure(kind: str, drift: float, seed: int) -> dict[str, Any]:
    """Return the record of one pair."""
    pair = simulate_pair(
        kind, rng=np.random.default_rng(seed), drift=drift, max_points=600_000,
        azimuth_decimation=8,
    )  # fmt: skip
    config = Config()
    found = match_maps(pair.target, pair.source, config=config)
    record: dict[str, Any] = {"kind": kind, "drift": drift, "seed": seed}
    if found.T_target_source is None:
        return {**record, "accepted": False}
    base, draft = prepare(pair.target, "target", config), prepare(pair.source, "source", config)
    cell, edges, max_height = choose_grid(base, draft, config)
    tiling = tile(choose_points(draft, cell, edges, max_height).xyz, SIZE)
    T = base.T_prepared_map @ found.T_target_source @ invert(draft.T_prepared_map)
    bent = lay_on_base(base, draft, T, tiling, cell)
    true = true_places(pair)
    off = np.linalg.norm(apply(found.T_target_source, pair.source.xyz) - true, axis=1)
    record |= {"accepted": True, "rigid": describe(off), "applied": False}
    if bent is None:
        return record
    straight = make_field(bent[0], bent[1], draft, tiling).apply(pair.source.xyz)
    off = np.linalg.norm(apply(found.T_target_source, straight) - true, axis=1)
    return {
        **record,
        "applied": bent[0].supported,
        "corrected": describe(off),
        "before": round(bent[0].before, 5),
        "gain": round(bent[0].gain, 5),
        "gain_z": round(bent[0].gain_z, 2),
    }


def main() -> None:
    """Measure all kinds and drifts at the seeds given."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])  # type: ignore[union-attr]
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    seeds = parser.parse_args().seeds
    with RECORDS.open("w", encoding="utf-8") as file:
        for seed in seeds:
            for kind in KINDS:
                for drift in DRIFTS:
                    line = json.dumps(measure(kind, drift, seed))
                    print(line, flush=True)
                    file.write(line + "\n")
                    file.flush()


if __name__ == "__main__":
    main()
