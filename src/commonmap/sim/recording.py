"""What the robots' lidars record on the way: every turn, as raw logs in the formats of sensors.

FOLDER/log.pcap     packets of the sensor, as on the network (VLP-16)
FOLDER/log.mcap     ROS 2 bag: PointCloud2 and the true poses as odometry
FOLDER/kitti/       KITTI folder of .bin, with time and ring of each point
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator
from pathlib import Path

import numpy as np

from commonmap.errors import InputError
from commonmap.frames import apply, fit_motion, invert
from commonmap.io.logs.poses import interpolate
from commonmap.io.scans import iter_scans
from commonmap.sim.logs import write_kitti, write_mcap, write_pcap
from commonmap.sim.missions import Mission
from commonmap.sim.pairs import before_border
from commonmap.sim.scanning import RayCaster, place_points, scan_world, split_scans, turn_stamps
from commonmap.sim.vlp16 import LidarModel
from commonmap.sim.world import World
from commonmap.types import Cloud, Float64s, Progress, Scan, Trajectory, no_progress

TURNS = 50
"""Turns that are cast in one go: bounds the memory."""

MARGIN = 0.15
"""Share of a place along each border that a drone which needs odometry does not fly over."""

LOGS = ("pcap", "mcap", "kitti")
"""Formats of raw logs, and their names in a folder."""


def record(
    mission: Mission, world: World, lidar: LidarModel, *, rng: np.random.Generator,
    seconds: float | None = None, border: Float64s | None = None,
    step: str = "simulate", progress: Progress = no_progress,
) -> Iterator[Scan]:  # fmt: skip
    """Yield every turn of the lidar on a mission, as measured (not deskewed).

    seconds: only the first so many. border: (3,) of a line a x + b y = c of the world, beyond which
    nothing is returned.
    """
    caster = RayCaster(world)
    stamps = turn_stamps(mission.sensor, lidar)
    if seconds is not None:
        stamps = stamps[: max(1, round(seconds * lidar.rate))]
    for start in range(0, len(stamps), TURNS):
        progress(step, start / len(stamps))
        part = stamps[start : start + TURNS]
        returns = scan_world(caster, mission.sensor, lidar, part, rng=rng)
        for scan in split_scans(returns, part):
            yield scan if border is None else _before(scan, mission.sensor, border)


def _before(scan: Scan, sensor: Trajectory, border: Float64s) -> Scan:
    kept = before_border(place_points(sensor, scan.time, scan.xyz), border)
    return Scan(scan.xyz[kept], scan.time[kept], scan.ring[kept], scan.intensity[kept], scan.stamp)


def write_logs(
    folder: Path, turns: Callable[[], Iterable[Scan]], sensor: Trajectory, lidar: LidarModel,
    kinds: Collection[str], *, seconds: float | None = None,
) -> None:  # fmt: skip
    """Write the same turns as raw logs of some kinds (names of `LOGS`) into a folder that exists.

    turns: gives them from the first on, the same at each call. sensor: their true poses; a bag
    holds those of the first `seconds`, where given.
    """
    check_kinds(kinds)
    if "kitti" in kinds:
        write_kitti(folder / "kitti", turns())
        turns = _from(folder / "kitti")
    if "pcap" in kinds:
        write_pcap(folder / "log.pcap", turns(), lidar=lidar)
    if "mcap" in kinds:
        poses = Trajectory(sensor.time[::5], sensor.T_map_sensor[::5])
        if seconds is not None:
            kept = poses.time <= poses.time[0] + seconds + 1.0 / lidar.rate
            poses = Trajectory(poses.time[kept], poses.T_map_sensor[kept])
        write_mcap(folder / "log.mcap", turns(), poses=poses, n_channels=lidar.n_channels)


def check_kinds(kinds: Collection[str]) -> None:
    """Raise where a kind of raw log is not in `LOGS`."""
    for kind in kinds:
        if kind not in LOGS:
            raise InputError(f"a raw log is one of {', '.join(LOGS)}; {kind!r} came")


def _from(folder: Path) -> Callable[[], Iterable[Scan]]:
    return lambda: iter_scans(folder)


def fit_truth(
    cloud: Cloud, estimated: Trajectory, true: Trajectory, *, n_most: int = 200_000
) -> tuple[Float64s, float]:
    """Return T_world_map of a log's map, and how far its points are from their true places (RMS).

    With odometry that drifts no rigid motion is exact: this is the best one over the points.
    cloud: of the map, with time. estimated: of the sensor in the frame of the map. true: of the
    sensor in the world. Each point is taken back into the sensor's frame of its moment by the
    estimated pose and placed by the true one.
    """
    assert cloud.time is not None
    first = max(float(estimated.time[0]), float(true.time[0]))
    last = min(float(estimated.time[-1]), float(true.time[-1]))
    kept = np.flatnonzero((cloud.time >= first) & (cloud.time <= last))
    kept = kept[:: len(kept) // n_most + 1]
    time, xyz = cloud.time[kept], cloud.xyz[kept]
    T_sensor_map = invert(interpolate(estimated, time))
    local = np.einsum("nij,nj->ni", T_sensor_map[:, :3, :3], xyz) + T_sensor_map[:, :3, 3]
    placed = place_points(true, time, local)
    T_world_map = fit_motion(placed, xyz)
    off = apply(T_world_map, xyz) - placed
    return T_world_map, float(np.sqrt(np.mean(np.square(off).sum(axis=1))))
