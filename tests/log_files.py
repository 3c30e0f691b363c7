"""Logs written by hand for tests, byte by byte or with rosbags: what other programs record."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from commonmap.sim.logs import LAYOUTS, _cloud, _ethernet, velodyne_packets
from commonmap.types import Scan

SENDER = (192, 168, 1, 201)


def frames(
    scans: Iterable[Scan], sender: tuple[int, int, int, int] = SENDER
) -> list[tuple[int, bytes]]:
    """Return (time in ns, Ethernet frame) of the packets of scans."""
    return [
        (time, _ethernet(payload, sender))
        for scan in scans
        for time, payload in velodyne_packets(scan)
    ]


def write_classic(
    path: Path, packets: Sequence[tuple[int, bytes]], *, order: str = "<", nano: bool = False,
    link: int = 1,
) -> None:  # fmt: skip
    """Write a classic pcap of either byte order."""
    magic = 0xA1B23C4D if nano else 0xA1B2C3D4
    unit = 1 if nano else 1000
    out = [struct.pack(order + "IHHiIII", magic, 2, 4, 0, 0, 65535, link)]
    for time, frame in packets:
        seconds, rest = divmod(time, 10**9)
        out.append(struct.pack(order + "IIII", seconds, rest // unit, len(frame), len(frame)))
        out.append(frame)
    path.write_bytes(b"".join(out))


def block(order: str, kind: int, body: bytes) -> bytes:
    """Return a pcapng block."""
    body += b"\0" * (-len(body) % 4)
    n = len(body) + 12
    return struct.pack(order + "II", kind, n) + body + struct.pack(order + "I", n)


def write_ng(
    path: Path, scans: Iterable[Scan], *, order: str = "<", resolution: int = 9, offset: int = 0,
) -> None:  # fmt: skip
    """Write a pcapng with one interface; its clock ticks every 10 ** -resolution s."""
    options = struct.pack(order + "HHB3x", 9, 1, resolution)
    options += struct.pack(order + "HHq", 14, 8, offset) + struct.pack(order + "HH", 0, 0)
    out = [
        block(order, 0x0A0D0D0A, struct.pack(order + "IHHq", 0x1A2B3C4D, 1, 0, -1)),
        block(order, 5, b"statistics, to be passed over"),
        block(order, 1, struct.pack(order + "HHI", 1, 0, 65535) + options),
    ]
    for time, frame in frames(scans):
        ticks = (time - offset * 10**9) // 10 ** (9 - resolution)
        head = struct.pack(
            order + "IIIII", 0, ticks >> 32, ticks & 0xFFFFFFFF, len(frame), len(frame)
        )
        out.append(block(order, 6, head + frame))
    path.write_bytes(b"".join(out))


def ros1_store() -> Any:
    """Return the layouts of ROS 1, with those of velodyne_msgs and Livox as published."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    for name, text in DEFINITIONS.items():
        store.register(get_types_from_msg(text.replace("TIME", "time"), name))
    return store


def ros2_store() -> Any:
    """Return the layouts of ROS 2, with those of velodyne_msgs and Livox as published."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in DEFINITIONS.items():
        text = text.replace("TIME", "builtin_interfaces/Time")
        store.register(get_types_from_msg(text, name))
    return store


DEFINITIONS = {
    # github.com/ros-drivers/velodyne, velodyne_msgs/msg
    "velodyne_msgs/msg/VelodynePacket": "TIME stamp\nuint8[1206] data\n",
    "velodyne_msgs/msg/VelodyneScan": (
        "std_msgs/Header header\nvelodyne_msgs/VelodynePacket[] packets\n"
    ),
    # github.com/Livox-SDK/livox_ros_driver2, msg
    "livox_ros_driver2/msg/CustomPoint": (
        "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\n"
        "uint8 line\n"
    ),
    "livox_ros_driver2/msg/CustomMsg": (
        "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\n"
        "uint8[3] rsvd\nlivox_ros_driver2/CustomPoint[] points\n"
    ),
}


def header(store: Any, time_ns: int, frame: str = "lidar") -> Any:
    """Return a std_msgs/Header of either ROS."""
    seconds, rest = divmod(time_ns, 10**9)
    stamp = store.types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=rest)
    kind = store.types["std_msgs/msg/Header"]
    if "seq" in kind.__dataclass_fields__:
        return kind(seq=0, stamp=stamp, frame_id=frame)
    return kind(stamp=stamp, frame_id=frame)


def velodyne_scan(store: Any, scan: Scan) -> Any:
    """Return a velodyne_msgs/VelodyneScan."""
    packet = store.types["velodyne_msgs/msg/VelodynePacket"]
    stamp = store.types["builtin_interfaces/msg/Time"]
    packets = [
        packet(
            stamp=stamp(*divmod(time, 10**9)),
            data=np.frombuffer(payload, dtype=np.uint8),
        )
        for time, payload in velodyne_packets(scan)
    ]
    head = header(store, round(scan.stamp * 1e9))
    return store.types["velodyne_msgs/msg/VelodyneScan"](header=head, packets=packets)


def ros1_cloud(store: Any, scan: Scan, layout: str = "velodyne") -> Any:
    """Return a PointCloud2 of ROS 1."""
    message = _cloud(ros2_store(), scan, "lidar", LAYOUTS[layout], 16)
    fields = [
        store.types["sensor_msgs/msg/PointField"](f.name, f.offset, f.datatype, f.count)
        for f in message.fields
    ]
    return store.types["sensor_msgs/msg/PointCloud2"](
        header=header(store, round(scan.stamp * 1e9)), height=message.height, width=message.width,
        fields=fields, is_bigendian=False, point_step=message.point_step,
        row_step=message.row_step, data=message.data, is_dense=True,
    )  # fmt: skip


def write_bag1(
    path: Path, scans: Iterable[Scan], *, compression: str | None = None, packets: bool = False,
    topics: Sequence[str] = ("/velodyne",),
) -> None:  # fmt: skip
    """Write a ROS 1 bag, of clouds or of raw packets."""
    from rosbags.rosbag1 import Writer

    store = ros1_store()
    kind = "velodyne_msgs/msg/VelodyneScan" if packets else "sensor_msgs/msg/PointCloud2"
    writer = Writer(path)
    if compression is not None:
        writer.set_compression(Writer.CompressionFormat[compression])
    with writer:
        connections = [writer.add_connection(topic, kind, typestore=store) for topic in topics]
        for scan in scans:
            message = velodyne_scan(store, scan) if packets else ros1_cloud(store, scan)
            data = bytes(store.serialize_ros1(message, kind))
            for connection in connections:
                writer.write(connection, round((scan.stamp + 0.1) * 1e9), data)


def write_bag2(
    path: Path, messages: Iterable[tuple[str, str, int, Any]], *, plugin: str = "MCAP",
    zstd: bool = False,
) -> Path:  # fmt: skip
    """Write a ROS 2 bag of (topic, type, time in ns, message); return its one file."""
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    store = ros2_store()
    folder = path.parent / f"{path.stem}_bag"
    writer = Writer(folder, version=9, storage_plugin=StoragePlugin[plugin])
    if zstd:
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for topic, kind, time, message in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], time, bytes(store.serialize_cdr(message, kind)))
    return next(f for f in folder.iterdir() if f.suffix in (".mcap", ".db3"))


def clouds(scans: Iterable[Scan], topic: str = "/points") -> list[tuple[str, str, int, Any]]:
    """Return the scans as messages for `write_bag2`."""
    store = ros2_store()
    return [
        (topic, "sensor_msgs/msg/PointCloud2", round((scan.stamp + 0.1) * 1e9),
         _cloud(store, scan, "lidar", LAYOUTS["velodyne"], 16))
        for scan in scans
    ]  # fmt: skip


def write_sqlite(path: Path, scans: Iterable[Scan]) -> None:
    """Write a ROS 2 bag of the sqlite3 kind, and put its .db3 at `path`."""
    write_bag2(path, clouds(scans), plugin="SQLITE3").rename(path)


def write_mcap_zstd(path: Path, scans: Iterable[Scan]) -> None:
    """Write an mcap whose chunks are compressed."""
    write_bag2(path, clouds(scans), zstd=True).rename(path)
