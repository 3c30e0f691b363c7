"""From the turns of a lidar to a level map: odometry, georeferencing, levelling, on one page.

No file is opened here: turns come in, answers go out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from commonmap.errors import InputError
from commonmap.io.logs.imu import Acceleration
from commonmap.mapping.level import Levelling, no_levelling
from commonmap.mapping.level_log import level_log
from commonmap.mapping.points import move_cloud
from commonmap.odometry import (
    Accumulator,
    LoamOptions,
    Odometry,
    PlaceableTurns,
    TrajectoryErrors,
    Trouble,
    describe_health,
    estimate,
    find_troubles,
    georeference,
)
from commonmap.types import Cloud, Float64s, Progress, Scan, Trajectory, no_progress

MAX_POINTS = 1_500_000
"""Points of a log's map; voxels widen until there are no more."""

LOST_SHARE = 0.5
"""A log of which more turns than this are lost gives no map."""


@dataclass(frozen=True, eq=False)
class RobotMap:
    """What a robot's log became.

    cloud: deskewed, thinned, with time and ray origins, in the frame of the map: level, z up, its
    origin where the sensor was at first (of known poses: in the frame of the poses). Where odometry
    was lost for long, the cloud is of the longest part of the log before or after.
    trajectory: of the sensor in the same frame. odometry: the answer as estimated, its health in
    the frame of the map. levelling: how the first sensor frame was turned. voxel: metres, of the
    thinning. n_turns: of the log. n_left_out: turns that are not in the cloud, since their pose is
    a guess or not known. notes: sentences for the user. sound: the turns of the part that is mapped
    (with odometry).
    """

    cloud: Cloud
    trajectory: Trajectory
    odometry: Odometry
    levelling: Levelling
    voxel: float
    n_turns: int
    n_left_out: int
    notes: tuple[str, ...]
    sound: range = range(0)

    @property
    def troubles(self) -> tuple[Trouble, ...]:
        """When, and along which directions of the map, the poses are not to be relied on."""
        return find_troubles(self.odometry.health)

    @property
    def way(self) -> float:
        """Metres that the sensor went."""
        steps = np.diff(self.trajectory.T_map_sensor[:, :3, 3], axis=0)
        return float(np.linalg.norm(steps, axis=1).sum())


def map_log(
    read: Callable[[], Iterable[Scan]],
    *,
    method: str = "loam",
    poses: Trajectory | None = None,
    acceleration: Acceleration | None = None,
    deskewed: bool | None = None,
    max_points: int = MAX_POINTS,
    share: Callable[[], float] | None = None,
    name: str = "the log",
    progress: Progress = no_progress,
) -> RobotMap:
    """Return the level map of a log and the way of the sensor in it.

    read: gives the turns from the first on; it is called twice, and no more than a few turns are in
        memory at a time.
    method: a row of `ODOMETRY`. poses: known poses of the sensor, for method "poses"; the map is
        then in their frame, as it is. acceleration: of an IMU, where the log has one.
    deskewed: whether the maker of the log moved the points of a turn to one moment; None tries.
    share: tells what share of the log has been read, for the progress. name: of the log there.
    """
    # 1. where the sensor was at each turn; the frame is that of the sensor at the start
    turns = _telling(read(), f"odometry of {name}", share, progress)
    options = LoamOptions(deskew=None if deskewed is None else not deskewed)
    answer = estimate(turns, method=method, poses=poses, options=options)
    _require_some(answer, name)

    # 2. every point at its place, deskewed; what lies in one voxel is kept once: (N, 3)
    gathered = Accumulator(max_points=max_points)
    turns = _telling(read(), f"map of {name}", share, progress)
    counted = PlaceableTurns(answer, turns)
    for cloud in georeference(counted, answer.trajectory):
        gathered.add(cloud)
    cloud = gathered.cloud()

    # 3. level: upright things and the robot's attitude say where up is
    progress(f"level the map of {name}")
    levelling = no_levelling("the frame is that of the known poses")
    if method != "poses":
        levelling = level_log(cloud, counted.sound_way, acceleration)
    T = levelling.T_level_map
    answer = _turned(answer, T)
    notes = _notes(answer, levelling, counted)
    return RobotMap(
        move_cloud(T, cloud), answer.trajectory, answer, levelling, gathered.voxel,
        counted.n, counted.n_left_out, notes, counted.sound,
    )  # fmt: skip


def move_trajectory(T_a_b: Float64s, trajectory: Trajectory) -> Trajectory:
    """Return a trajectory of map frame b in map frame a."""
    return Trajectory(trajectory.time, T_a_b @ trajectory.T_map_sensor)


def describe_robot(robot: RobotMap, errors: TrajectoryErrors | None = None) -> dict[str, Any]:
    """Return what is to be known of a robot's odometry as plain values, for JSON.

    Directions are those of the robot's own map: shift along x, y, z and turn about x, y, z.
    """
    health = robot.odometry.health
    values: dict[str, Any] = {
        "method": robot.odometry.method,
        "turns": robot.n_turns,
        "way": robot.way,
        "turns_lost": robot.odometry.n_lost,
        "turns_degenerate": robot.odometry.n_degenerate,
        "turns_left_out": robot.n_left_out,
        "mapped": [health[k].moment for k in (robot.sound.start, robot.sound.stop - 1)]
        if robot.sound
        else None,
        "median_residual": float(np.nanmedian([h.residual for h in health]))
        if any(np.isfinite(h.residual) for h in health)
        else None,
        "troubles": [
            {
                "kind": trouble.kind,
                "begin": trouble.begin,
                "end": trouble.end,
                "turns": trouble.n,
                "directions": trouble.directions.tolist(),
            }
            for trouble in robot.troubles
        ],
        "level": robot.levelling.reason,
        "T_level_start": robot.levelling.T_level_map.tolist(),
        "voxel": robot.voxel,
        "points": len(robot.cloud.xyz),
        "notes": list(robot.notes),
    }
    if errors is not None:
        values["errors"] = {
            "ape_rms": errors.ape,
            "ape_max": errors.ape_max,
            "relative_share": errors.relative,
            "relative_radians_per_metre": errors.turn,
            "stretch": errors.stretch,
        }
    return values


def _telling(
    scans: Iterable[Scan], step: str, share: Callable[[], float] | None, progress: Progress
) -> Iterator[Scan]:
    progress(step)
    for number, scan in enumerate(scans):
        yield scan
        if share is not None and number % 20 == 19:
            progress(step, share())


def _require_some(answer: Odometry, name: str) -> None:
    if answer.n_lost > LOST_SHARE * max(len(answer.health), 1):
        raise InputError(
            f"odometry of {name} is lost in {answer.n_lost} of {len(answer.health)} turns: this "
            "is no map; hand in poses that are known, if there are any (--odometry poses)"
        )


def _turned(answer: Odometry, T: Float64s) -> Odometry:
    """Return the answer in a frame turned by T, its sentences on troubles told anew."""
    told = set(describe_health(answer.health))
    health = tuple(h.turned(T[:3, :3]) for h in answer.health)
    notes = (*(n for n in answer.notes if n not in told), *describe_health(health))
    trajectory = move_trajectory(T, answer.trajectory)
    return replace(answer, trajectory=trajectory, health=health, notes=notes)


def _notes(answer: Odometry, levelling: Levelling, counted: PlaceableTurns) -> tuple[str, ...]:
    notes = [*answer.notes]
    if counted.n_apart:
        way = counted.sound_way.time
        notes.append(
            f"odometry was lost for too long to know how the parts of the log lie to each other: "
            f"the map is of its longest part, {way[0]:.2f} to {way[-1]:.2f} s "
            f"({len(counted.sound)} of {counted.n} turns)"
        )
    if counted.n_left_out - counted.n_apart:
        n = counted.n_left_out - counted.n_apart
        notes.append(f"{n} turns whose poses are not known are left out of the map")
    if answer.n_degenerate or answer.n_lost:
        notes.append(
            "the map may be bent where the scene did not hold the pose; see the times told"
        )
    if answer.method != "poses":
        notes.append(f"the map was {levelling.reason}" if levelling.tilt else levelling.reason)
    return tuple(notes)
