"""ROS bags: ROS 1 (.bag) and ROS 2 (folder, .mcap, .db3), read message by message with rosbags.

The layouts of the messages are those of the ROS distributions, not the definitions in the bag, so
a bag without definitions, or with odd ones of other topics, opens as well.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path, PosixPath
from typing import Any

from commonmap.errors import InputError
from commonmap.io.logs.livox import read_custom
from commonmap.io.logs.pointcloud2 import CloudReader, PointCloud2, PointField
from commonmap.io.logs.record import Log, Options, Teller, Topic, choose_topic, require_topic, shown
from commonmap.io.logs.salvage import salvage
from commonmap.io.source import log, look, looks_like, open_bounded, parsing, reason
from commonmap.io.velodyne import TurnReader
from commonmap.types import Progress, Scan, no_progress

POINTS = "sensor_msgs/msg/PointCloud2"
PACKETS = "velodyne_msgs/msg/VelodyneScan"
TF = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
LIVOX = (
    "livox_ros_driver/msg/CustomMsg",
    "livox_ros_driver2/msg/CustomMsg",
    "livox_interfaces/msg/CustomMsg",
)
POSE_TYPES = (
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
)
VELODYNE_DEFINITIONS = {
    PACKETS: "std_msgs/Header header\nvelodyne_msgs/VelodynePacket[] packets\n",
    "velodyne_msgs/msg/VelodynePacket": "{time} stamp\nuint8[1206] data\n",
}


@dataclass(frozen=True)
class Message:
    """A message as the bag holds it. time: nanoseconds, when it was recorded."""

    topic: str
    type: str
    time: int
    data: bytes | memoryview
    is_ros1: bool


class BoundedPath(PosixPath):
    """A path whose files never read, nor make room for, more bytes than they hold."""

    def open(self, *args: Any, **kwargs: Any) -> Any:
        """Open for reading, in binary."""
        return open_bounded(self)


def bag_path(path: Path) -> Path:
    """Return what rosbags is to open: of a folder without metadata.yaml, the one bag in it."""
    if not path.is_dir() or (path / "metadata.yaml").is_file():
        return path
    bags = sorted([*path.glob("*.mcap"), *path.glob("*.db3")])
    if len(bags) != 1:
        raise InputError(
            f"{path} has no metadata.yaml and {len(bags)} bags; a ROS 2 bag is a folder with a "
            "metadata.yaml, or one .mcap or .db3"
        )
    return bags[0]


def is_bag_folder(path: Path) -> bool:
    """Return whether a folder is that of a ROS 2 bag."""
    if not path.is_dir():
        return False
    return (path / "metadata.yaml").is_file() or any(path.glob("*.mcap")) or any(path.glob("*.db3"))


@contextlib.contextmanager
def open_bag(path: Path) -> Iterator[Any]:
    """Yield a reader of rosbags, or raise one sentence that says why there is none."""
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2

    path = bag_path(path)
    kind = "a ROS bag"
    if path.is_file():
        _, _, head = look(path)
        starts = {".bag": b"#ROSBAG", ".mcap": b"\x89MCAP", ".db3": b"SQLite format 3"}
        wanted = starts.get(path.suffix.lower())
        if wanted is not None and not head.startswith(wanted):
            raise InputError(f"{path} should be {kind}, but {looks_like(head)}")
        bounded: Path = BoundedPath(path)
        is_ros1 = head.startswith(b"#ROSBAG")
    else:
        bounded, is_ros1 = path, False
    with contextlib.ExitStack() as stack:
        try:
            reader = Reader1(bounded) if is_ros1 else Reader2(bounded)
            stack.enter_context(reader)
        except (KeyboardInterrupt, SystemExit, InputError):
            raise
        except MemoryError:
            raise InputError(f"{path} is damaged: a length in it makes no sense") from None
        except Exception as error:
            raise InputError(
                f"{path} cannot be opened as {kind} ({reason(error)}): it is truncated or damaged; "
                "keep_partial (--keep-partial) reads what is there"
            ) from error
        yield reader


def open_rosbag(path: Path, options: Options) -> Log:
    """Return what a bag holds."""
    kind = "ROS 1 bag" if path.suffix == ".bag" else "ROS 2 bag"
    try:
        with open_bag(path) as reader:
            topics = _topics(reader.connections)
            span = (reader.start_time * 1e-9, (reader.end_time - 1) * 1e-9)
            empty = reader.message_count == 0
    except InputError:
        if not options.keep_partial:
            raise
        found: dict[tuple[str, str], int] = {}
        times = []
        for message in _salvaged(path):
            key = message.topic, message.type
            found[key] = found.get(key, 0) + 1
            times.append(message.time)
        topics = tuple(Topic(*key, n, _holds(key[1])) for key, n in sorted(found.items()))
        empty = not times
        span = (min(times) * 1e-9, max(times) * 1e-9) if times else (0.0, 0.0)
    if empty:
        raise InputError(f"{path} holds no messages")
    chosen = choose_topic(path, topics, options.topic)
    return Log(
        path=path, kind=kind, topics=topics, topic=None if chosen is None else chosen.name,
        n_scans=None if chosen is None else chosen.count, time_span=span,
        poses=tuple(topic.name for topic in topics if topic.holds == "poses"),
    )  # fmt: skip


def iter_messages(
    path: Path, topics: Sequence[str], *, keep_partial: bool = False
) -> Iterator[Message]:
    """Yield the messages of some topics in the order of recording."""
    last = -1
    try:
        with open_bag(path) as reader:
            chosen = [c for c in reader.connections if c.topic in topics]
            is_ros1 = type(reader).__module__.startswith("rosbags.rosbag1")
            if not chosen:
                return
            with parsing(path, "a ROS bag"):
                for connection, time, data in reader.messages(chosen):
                    last = time
                    yield Message(connection.topic, connection.msgtype, time, data, is_ros1)
    except InputError as error:
        if not keep_partial:
            raise
        if last >= 0:
            log.warning("%s; what comes before is kept", error)
            return
        for message in _salvaged(path):
            if message.topic in topics:
                yield message


def iter_rosbag(record: Log, options: Options, progress: Progress = no_progress) -> Iterator[Scan]:
    """Yield the scans of one topic of a bag."""
    path, topic = record.path, require_topic(record.path, record.topics, record.topic)
    first, last = record.time_span or (0.0, 0.0)
    turns = TurnReader(path, options.model)
    clouds = CloudReader(Teller(path), deskewed=bool(options.deskewed))
    n = 0
    for message in iter_messages(path, [topic.name], keep_partial=options.keep_partial):
        share = (message.time * 1e-9 - first) / max(last - first, 1e-9)
        progress(f"reading {path.name}", min(max(share, 0.0), 1.0))
        try:
            with parsing(path, f"{shown(topic.type)} of {shown(topic.name)}"):
                scans = list(_scans_of(message, turns, clouds))
        except InputError as error:
            if not options.keep_partial:
                raise
            log.warning("%s; the message is left out", error)
            continue
        n += len(scans)
        yield from scans
    scan = turns.finish()
    if scan is not None:
        n += 1
        yield scan
    if n == 0:
        raise InputError(f"{path}: topic {shown(topic.name)} holds no points, or no whole turn")


def _scans_of(message: Message, turns: TurnReader, clouds: CloudReader) -> Iterator[Scan]:
    """Yield the scans that a message completes."""
    if message.type == PACKETS:
        for packet in decode(message).packets:
            scan = turns.push(_seconds(packet.stamp), packet.data.tobytes())
            if scan is not None:
                yield scan
        return
    if message.type in LIVOX:
        cloud = read_custom(message.data, is_ros1=message.is_ros1)
    else:
        cloud = cloud_of(decode(message))
    scan = clouds.scan(cloud)
    if scan is not None:
        yield scan


def cloud_of(message: Any) -> PointCloud2:
    """Return a decoded PointCloud2."""
    return PointCloud2(
        stamp=_seconds(message.header.stamp), frame=str(message.header.frame_id),
        height=message.height, width=message.width,
        fields=[PointField(f.name, f.offset, f.datatype, f.count) for f in message.fields],
        is_bigendian=bool(message.is_bigendian), point_step=message.point_step,
        row_step=message.row_step, data=message.data,
    )  # fmt: skip


def decode(message: Message) -> Any:
    """Return a message as the record of its type."""
    store = _store(message.is_ros1)
    type_ = TF[0] if message.type in TF else message.type
    if message.is_ros1:
        return store.deserialize_ros1(message.data, type_)
    return store.deserialize_cdr(message.data, type_)


def _seconds(stamp: Any) -> float:
    return float(stamp.sec) + float(stamp.nanosec) * 1e-9


@cache
def _store(is_ros1: bool) -> Any:
    """Return the layouts of messages of ROS 1, or of ROS 2."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    for name, text in VELODYNE_DEFINITIONS.items():
        text = text.format(time="time" if is_ros1 else "builtin_interfaces/Time")
        store.register(get_types_from_msg(text, name))
    return store


def _holds(type_: str) -> str:
    if type_ in (POINTS, PACKETS, *LIVOX):
        return "scans"
    return "poses" if type_ in (*POSE_TYPES, *TF) else "other"


def _topics(connections: Sequence[Any]) -> tuple[Topic, ...]:
    """Return the topics, each once, by name."""
    found: dict[str, Topic] = {}
    for c in connections:
        if not isinstance(c.topic, str) or not isinstance(c.msgtype, str):
            continue  # a damaged database has cells without text
        old = found.get(c.topic)
        if old is None:
            found[c.topic] = Topic(c.topic, c.msgtype, c.msgcount, _holds(c.msgtype))
        else:
            found[c.topic] = replace(old, count=(old.count or 0) + c.msgcount)
    return tuple(found[name] for name in sorted(found))


def _salvaged(path: Path) -> Iterator[Message]:
    for topic, type_, time, data, is_ros1 in salvage(bag_path(path)):
        yield Message(topic, type_, time, data, is_ros1)
