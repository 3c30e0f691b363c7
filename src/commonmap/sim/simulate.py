"""A simulated mission of two robots as files: what `commonmap simulate -o DIR` leaves behind.

DIR/truth.json                what is true: T_target_source, frames, seeds, settings, version
DIR/uav/, DIR/ugv/            target and source robot, each with
    cloud.laz                 its map in its own frame, with ray origins, time, intensity
    poses.tum                 poses of its lidar as it knows them, own frame
    truth.tum                 true poses of its lidar, frame of the world
    scans/000000.bin          one turn: float32 x, y, z, intensity a return, not deskewed
    scans/000000.npy          the same returns: time (float64, s) and ring (uint16)
    log.pcap, log.mcap, kitti/  every turn as raw logs, where asked for (`sim.recording`)
"""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from commonmap.errors import InputError
from commonmap.frames import quaternion
from commonmap.io.atomic import writing_folder
from commonmap.io.las import write_las
from commonmap.sim.missions import Mission
from commonmap.sim.pairs import Pair, before_border, simulate_pair
from commonmap.sim.recording import check_kinds, record, write_logs
from commonmap.sim.scanning import RayCaster, place_points, scan_world, split_scans, turn_stamps
from commonmap.sim.vlp16 import LidarModel, find_lidar
from commonmap.sim.world import World
from commonmap.types import Cloud, Float64s, Progress, Scan, Trajectory, no_progress
from commonmap.version import __version__

ENTRIES = ("truth.json", "uav", "ugv")
"""What a simulation's folder holds, and therefore what a new one may replace."""

RETURN = np.dtype([("time", "<f8"), ("ring", "<u2")])
"""A row of a scan's `.npy` file."""


def write_simulation(
    folder: str | os.PathLike[str],
    kind: str | World,
    rng: np.random.Generator,
    *,
    seed_world: int | None = None,
    overlap: float = 1.0,
    drift: float = 0.003,
    tilt: float = 0.0,
    change: float = 0.0,
    lidar_target: str | LidarModel = "vlp16",
    lidar_source: str | LidarModel = "vlp16",
    size: float | None = None,
    relief: float | None = None,
    margin: float = 0.0,
    scans_every: int = 5,
    azimuth_decimation: int = 1,
    logs: Collection[str] = (),
    seconds: float | None = None,
    progress: Progress = no_progress,
) -> Pair:
    """Simulate two robots in one place and write what they recorded, and the truth; return both.

    The folder appears whole or not at all; one that an earlier simulation wrote is replaced.

    scans_every: write every so many turns of the lidar (1 is all of them, 10 a second, which
        odometry needs: some 7 MB/s a robot); 0 writes no scans.
    azimuth_decimation: fire only every so many firing sequences in the scans that are written.
    logs: raw logs of every turn, names of `recording.LOGS`. seconds: of the logs, at most.
    The others are those of `simulate_pair`.
    """
    if scans_every < 0:
        raise InputError(f"scans_every must be 0 or more; {scans_every} came")
    check_kinds(logs)
    progress("simulate")
    pair = simulate_pair(
        kind, rng=rng, seed_world=seed_world, overlap=overlap, drift=drift, tilt=tilt,
        change=change, lidar_target=lidar_target, lidar_source=lidar_source, size=size,
        relief=relief, margin=margin,
    )  # fmt: skip
    models = {"uav": find_lidar(lidar_target), "ugv": find_lidar(lidar_source)}
    with writing_folder(folder, replaces=ENTRIES) as part:
        for robot, cloud, known, mission, world in (
            ("uav", pair.target, pair.target_trajectory, pair.target_mission, pair.world),
            ("ugv", pair.source, pair.source_trajectory, pair.source_mission, pair.source_world),
        ):
            progress(f"write {robot}")
            border = pair.border if robot == "uav" else None
            _write_robot(
                part / robot, cloud, known, mission, world, models[robot], border, rng,
                scans_every, azimuth_decimation, progress,
            )  # fmt: skip
            if logs:
                _record_robot(
                    part / robot, mission, world, models[robot], border, int(rng.integers(2**31)),
                    logs, seconds, progress,
                )  # fmt: skip
        truth = tell_truth(pair, rng) | {
            "lidars": {robot: model.name for robot, model in models.items()},
            "scans_every": scans_every,
            "azimuth_decimation": azimuth_decimation,
            "logs": list(logs),
        }
        (part / "truth.json").write_text(json.dumps(truth, indent=2) + "\n", encoding="utf-8")
    return pair


def tell_truth(pair: Pair, rng: np.random.Generator) -> dict[str, Any]:
    """Return what is true of a pair, ready for JSON. Matrices are 4x4, row by row."""
    return {
        "version": __version__,
        "kind": pair.kind,
        "seed": _seed(rng),
        "seed_world": pair.seed_world,
        "T_target_source": pair.T_target_source.tolist(),
        "T_world_target": pair.T_world_target.tolist(),
        "T_world_source": pair.T_world_source.tolist(),
        "T_uav_lidar": pair.target_mission.T_body_sensor.tolist(),
        "T_ugv_lidar": pair.source_mission.T_body_sensor.tolist(),
        "overlap": pair.overlap,
        "drift": pair.drift,
        "tilt": pair.tilt,
        "change": pair.change,
        "world_size": pair.world.size,
        "border": None if pair.border is None else pair.border.tolist(),
        "n_target": len(pair.target.xyz),
        "n_source": len(pair.source.xyz),
    }


def _seed(rng: np.random.Generator) -> int | None:
    """Return the seed that a generator was made of, where it tells."""
    entropy = getattr(getattr(rng.bit_generator, "seed_seq", None), "entropy", None)
    return int(entropy) if isinstance(entropy, int) else None


def _write_robot(
    folder: Path, cloud: Cloud, known: Trajectory, mission: Mission, world: World,
    lidar: LidarModel, border: Float64s | None, rng: np.random.Generator, scans_every: int,
    azimuth_decimation: int, progress: Progress,
) -> None:  # fmt: skip
    """Write what one robot leaves behind into a new folder."""
    folder.mkdir()
    write_las(folder / "cloud.laz", cloud)
    write_tum(folder / "poses.tum", known)
    write_tum(folder / "truth.tum", mission.sensor)
    if scans_every == 0:
        return
    (folder / "scans").mkdir()
    caster = RayCaster(world)
    stamps = turn_stamps(mission.sensor, lidar)[::scans_every]
    chunk = 50
    number = 0
    for start in range(0, len(stamps), chunk):
        progress(f"write {folder.name} scans", start / len(stamps))
        turns = stamps[start : start + chunk]
        returns = scan_world(
            caster, mission.sensor, lidar, turns, rng=rng, azimuth_decimation=azimuth_decimation
        )
        for scan in split_scans(returns, turns):
            if border is not None:
                true = place_points(mission.sensor, scan.time, scan.xyz)
                scan = _pick(scan, before_border(true, border))
            if len(scan.xyz):
                write_scan(folder / "scans" / f"{number:06d}", scan)
            number += 1


def _record_robot(
    folder: Path, mission: Mission, world: World, lidar: LidarModel, border: Float64s | None,
    seed: int, logs: Collection[str], seconds: float | None, progress: Progress,
) -> None:  # fmt: skip
    """Write what the lidar of a robot records on its way as raw logs."""

    def turns() -> Iterator[Scan]:
        rng = np.random.default_rng(seed)
        step = f"record {folder.name}"
        return record(
            mission, world, lidar, rng=rng, seconds=seconds, border=border, step=step,
            progress=progress,
        )  # fmt: skip

    write_logs(folder, turns, mission.sensor, lidar, logs, seconds=seconds)


def _pick(scan: Scan, kept: np.ndarray[Any, np.dtype[np.bool_]]) -> Scan:
    """Return the returns of a scan where `kept`."""
    return Scan(scan.xyz[kept], scan.time[kept], scan.ring[kept], scan.intensity[kept], scan.stamp)


def write_scan(stem: Path, scan: Scan) -> None:
    """Write one turn as `stem.bin` (KITTI: float32 x, y, z, intensity) and `stem.npy`."""
    columns = np.column_stack([scan.xyz, scan.intensity]).astype("<f4")
    stem.with_suffix(".bin").write_bytes(columns.tobytes())
    rows = np.empty(len(scan.time), dtype=RETURN)
    rows["time"], rows["ring"] = scan.time, scan.ring
    np.save(stem.with_suffix(".npy"), rows, allow_pickle=False)


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write poses as TUM lines: time, x, y, z, quaternion x, y, z, w."""
    rows = np.column_stack(
        [trajectory.time, trajectory.T_map_sensor[:, :3, 3], quaternion(trajectory.T_map_sensor)]
    )
    np.savetxt(path, rows, fmt=["%.6f", *["%.6f"] * 3, *["%.9f"] * 4])
