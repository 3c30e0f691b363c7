"""What a command takes in: a map as it is, or the raw log of a lidar, made into a map first."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from commonmap.errors import InputError
from commonmap.io.formats import read_map
from commonmap.io.logs import (
    Log,
    find_log,
    iter_scans,
    open_log,
    read_acceleration,
    read_poses,
)
from commonmap.odometry import ODOMETRY
from commonmap.pipeline_logs import RobotMap, map_log
from commonmap.types import Cloud, Leaves, Progress, Scan, Trajectory, no_progress

log = logging.getLogger("commonmap")

DEFAULT_METHOD = "loam"


@dataclass(frozen=True)
class LogOptions:
    """How a log is read and turned into a map. topic: of its scans. poses: file with known poses,
    or a topic of the bag that holds them.

    method: a row of `ODOMETRY`, None takes "poses" where a file is given and LOAM else.
    keep_partial: keep what can be read of a damaged log. model, deskewed: see `iter_scans`.
    """

    method: str | None = None
    poses: Path | None = None
    topic: str | None = None
    keep_partial: bool = False
    model: str | None = None
    deskewed: bool | None = None

    def scans(self, path: Path, progress: Progress = no_progress) -> Iterator[Scan]:
        """Yield the scans of a log."""
        return iter_scans(
            path, topic=self.topic, model=self.model, keep_partial=self.keep_partial,
            deskewed=self.deskewed, progress=progress,
        )  # fmt: skip

    def open(self, path: Path) -> Log:
        """Return what is known of a log before it is read."""
        return open_log(path, topic=self.topic, model=self.model, keep_partial=self.keep_partial)

    def chosen(self) -> str:
        """Return the method, checked."""
        method = self.method or (DEFAULT_METHOD if self.poses is None else "poses")
        if method not in ODOMETRY:
            raise InputError(f"odometry is one of {', '.join(ODOMETRY)}; '{method}' came")
        if self.poses is not None and method != "poses":
            raise InputError(f"known poses are for odometry 'poses'; '{method}' came")
        return method


@dataclass(frozen=True, eq=False)
class Input:
    """A map to work with, and, where it was made of a log, what became of that."""

    name: str
    map: Cloud | Leaves
    robot: RobotMap | None = None


def is_log(path: Path) -> bool:
    """Return whether a path holds the raw log of a lidar."""
    return find_log(path) is not None


def options_of_both(
    paths: Sequence[Path], *, method: str | None, poses: Sequence[Path], topics: Sequence[str],
    keep_partial: bool = False, model: str | None = None, deskewed: bool | None = None,
) -> list[LogOptions]:  # fmt: skip
    """Return how each input is read: files of poses, and topics, belong to the logs in turn."""
    logs = [path for path in paths if is_log(path)]
    for given, what in ((poses, "--poses"), (topics, "--topic")):
        if len(given) not in (0, len(logs)):
            raise InputError(
                f"{what} is given once for each log, in their order: {len(logs)} expected, "
                f"{len(given)} came"
            )
    if method is not None and not logs:
        raise InputError("--odometry is for raw logs; neither input is one")
    options, k = [], 0
    for path in paths:
        if path in logs:
            options.append(
                LogOptions(
                    method, poses[k] if poses else None, topics[k] if topics else None,
                    keep_partial, model, deskewed,
                )
            )  # fmt: skip
            k += 1
        else:
            options.append(LogOptions())
    return options


def take(path: Path, options: LogOptions, progress: Progress) -> Input:
    """Return a map as it is in its file, or the map of a raw log."""
    if not path.exists():
        raise InputError(f"there is no file {path}")
    if is_log(path):
        robot = take_log(path, options, progress)
        return Input(path.name, robot.cloud, robot)
    progress(f"read {path.name}")
    return Input(path.name, read_map(path))


def take_log(path: Path, options: LogOptions, progress: Progress) -> RobotMap:
    """Return the level map of a raw log; what the user should know of it is told as notes."""
    method = options.chosen()
    known = _poses(path, options) if method == "poses" else None
    acceleration = None
    if method != "poses":
        acceleration = read_acceleration(
            path, topic=options.topic, keep_partial=options.keep_partial
        )
    read = 0.0

    def hear(step: str, share: float = 0.0) -> None:
        nonlocal read
        read = share

    robot = map_log(
        lambda: options.scans(path, hear), method=method, poses=known, acceleration=acceleration,
        deskewed=options.deskewed, share=lambda: read, name=path.name, progress=progress,
    )  # fmt: skip
    for note in robot.notes:
        log.warning("%s: %s", path.name, note)
    return robot


def _poses(path: Path, options: LogOptions) -> Trajectory:
    """Return the known poses of a log: of the file that was given, else its own."""
    found = options.open(path)
    partial = options.keep_partial
    if options.poses is not None:
        topic = str(options.poses)
        if not options.poses.exists() and topic in found.poses:
            return read_poses(path, topic=topic, keep_partial=partial)
        beside = path if path.is_dir() else None
        return read_poses(options.poses, beside=beside, keep_partial=partial)
    if not found.poses:
        raise InputError(f"{path} holds no poses itself; give a file of poses: --poses FILE")
    return read_poses(path, keep_partial=partial)
