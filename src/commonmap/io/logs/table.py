"""The logs that can be read, one row each, and the two functions that read them.

record = open_log("drone.pcap")
for scan in iter_scans("drone.pcap"):
    ...
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from commonmap.errors import InputError, MissingExtraError
from commonmap.io.logs.folders import (
    is_own_folder,
    iter_folder,
    iter_own,
    open_folder,
    open_own,
    scan_files,
)
from commonmap.io.logs.packets import iter_capture, open_capture
from commonmap.io.logs.pcap import capture_file
from commonmap.io.logs.record import Log, Options, require_topic
from commonmap.io.logs.rosbag import is_bag_folder, iter_rosbag, open_rosbag
from commonmap.io.source import PathLike, look, looks_like, reason
from commonmap.io.velodyne import check_model
from commonmap.types import Progress, Scan, no_progress


@dataclass(frozen=True)
class LogFormat:
    """A kind of log. suffixes: in lower case, with the dot; "/" is a folder. matches: whether a
    path that is there is of this kind. needs: modules to be installed."""

    name: str
    suffixes: tuple[str, ...]
    holds: str
    matches: Callable[[Path], bool]
    open: Callable[[Path, Options], Log]
    scans: Callable[[Log, Options, Progress], Iterator[Scan]]
    needs: tuple[str, ...] = ()

    def available(self) -> str | None:
        """Return None where such logs can be read, else why not."""
        absent = [module for module in self.needs if importlib.util.find_spec(module) is None]
        if not absent:
            return None
        return f"{self.name} needs {', '.join(absent)}: pip install {' '.join(absent)}"


def _starts(suffix: str, magic: bytes) -> Callable[[Path], bool]:
    def matches(path: Path) -> bool:
        return path.is_file() and (look(path)[2].startswith(magic) or path.suffix.lower() == suffix)

    return matches


def _is_ros2(path: Path) -> bool:
    if path.is_dir():
        return is_bag_folder(path)
    return path.is_file() and (
        look(path)[2].startswith((b"\x89MCAP", b"SQLite format 3"))
        or path.suffix.lower() in (".mcap", ".db3")
    )


LOGS: dict[str, LogFormat] = {
    row.name: row
    for row in (
        LogFormat(
            "pcap", (".pcap", ".pcapng", ".cap"), "network packets of a Velodyne",
            lambda path: capture_file(path) or path.suffix.lower() in (".pcap", ".pcapng"),
            open_capture, iter_capture, ("velodyne_decoder",),
        ),
        LogFormat(
            "ros1", (".bag",), "ROS 1 bag: PointCloud2 or VelodyneScan",
            _starts(".bag", b"#ROSBAG"), open_rosbag, iter_rosbag, ("rosbags",),
        ),
        LogFormat(
            "ros2", (".mcap", ".db3", "/"), "ROS 2 bag: PointCloud2 or VelodyneScan", _is_ros2,
            open_rosbag, iter_rosbag, ("rosbags",),
        ),
        LogFormat(
            "scans", ("/",), "folder of KITTI .bin with time and ring of each point",
            is_own_folder, open_own, iter_own,
        ),
        LogFormat(
            "files", ("/",), "folder of .bin (KITTI), .pcd or .ply, a scan each",
            lambda path: bool(scan_files(path)), open_folder, iter_folder,
        ),
    )
}  # fmt: skip
"""Name -> kind of log; the first that matches a path reads it."""


def find_log(path: PathLike) -> LogFormat | None:
    """Return the kind of log that a path is, None where it is none."""
    path = Path(path)
    if not path.exists():
        return None
    try:
        return next((row for row in LOGS.values() if row.matches(path)), None)
    except OSError:
        return None


def open_log(
    path: PathLike, *, topic: str | None = None, model: str | None = None,
    keep_partial: bool = False,
) -> Log:  # fmt: skip
    """Return what a log holds, without reading its points. Options as in `iter_scans`."""
    row, path = _require(path)
    return row.open(path, Options(topic, check_model(model), keep_partial))


def iter_scans(
    path: PathLike, *, topic: str | None = None, model: str | None = None,
    keep_partial: bool = False, deskewed: bool | None = None, progress: Progress = no_progress,
) -> Iterator[Scan]:  # fmt: skip
    """Yield the scans of a log one at a time, in the order of recording.

    topic: whose scans, where a log has several (of a capture, sender and port).
    model: of a Velodyne, a name of `velodyne.MODELS`, where its packets do not tell.
    keep_partial: keep what can be read of a log that is truncated or damaged; else it raises
        `InputError` at the fault.
    deskewed: the points of a scan were moved to one moment by whoever made the log (as those of
        the KITTI odometry set were); they get its stamp as their time. None looks at some scans
        of a folder whose points have no time, and takes it as given where they show it.

    Points without finite coordinates, or at the sensor, are left out. Channel and time are those
    of the log where it has them; else they are told from the geometry, with a warning of the
    logger "commonmap". What a log cannot be read as raises at the call; its faults on the way.
    """
    row, path = _require(path)
    options = Options(topic, check_model(model), keep_partial, deskewed)
    record = row.open(path, options)
    if record.topics:
        record = replace(record, topic=require_topic(path, record.topics, topic).name)
    elif topic is not None:
        raise InputError(f"{path} is a folder of scans: it has no topics ({topic!r} came)")
    return row.scans(record, options, progress)


def _require(path: PathLike) -> tuple[LogFormat, Path]:
    path = Path(path)
    if not path.exists():
        raise InputError(f"there is no file or folder {path}")
    try:
        row = next((row for row in LOGS.values() if row.matches(path)), None)
    except OSError as error:
        raise InputError(f"cannot read {path}: {reason(error)}") from None
    if row is None:
        kinds = "a log is " + "; ".join(
            f"{' '.join(r.suffixes)} ({r.holds})" for r in LOGS.values()
        )
        if path.is_dir():
            raise InputError(f"{path} holds no scans; {kinds}")
        raise InputError(f"{path} is no log: {looks_like(look(path)[2])}; {kinds}")
    missing = row.available()
    if missing is not None:
        raise MissingExtraError(missing)
    return row, path
