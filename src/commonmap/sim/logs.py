"""Simulated scans as the logs that sensors write: VLP-16 pcap, ROS 2 bag (mcap), KITTI folder.

`commonmap.io.logs` reads them back: the folder exactly, a bag with PointCloud2 exactly up to how
the driver's layout tells time (`LAYOUTS`), a pcap to the packet's quantisation: 2 mm in range, 0.01
deg in azimuth, 1 microsecond in time.
"""

from __future__ import annotations

import itertools
import shutil
import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from commonmap.errors import InputError
from commonmap.io.atomic import writing, writing_folder
from commonmap.io.scans import write_scans
from commonmap.io.source import PathLike
from commonmap.io.velodyne import DUAL, HOUR_US, LAST, PACKET_BYTES, STRONGEST, pack_packets
from commonmap.sim.vlp16 import VLP16, LidarModel
from commonmap.types import Scan, Trajectory

SEQUENCES = 24
"""Firing sequences of 16 lasers in a packet (two a block)."""

AZIMUTH_TOLERANCE = np.radians(0.3)
RANGE_UNIT = 0.002
MAX_COUNTS = 65535

DATA_PORT = 2368
SENSOR_ADDRESS = (192, 168, 1, 201)

RETURN_MODES = {"strongest": STRONGEST, "last": LAST, "dual": DUAL}


@dataclass(frozen=True)
class Layout:
    """How a driver lays out a point. fields: (name, offset, datatype of PointField, NumPy type).
    time: the field of the time, and its seconds per unit; None where it has none. absolute:
    whether the time counts from the header's stamp or is on the clock itself. top_first: whether
    channel 0 is the highest."""

    fields: tuple[tuple[str, int, int, str], ...]
    point_step: int
    time: tuple[str, float] | None
    absolute: bool = False
    top_first: bool = False


_XYZ = (("x", 0, 7, "<f4"), ("y", 4, 7, "<f4"), ("z", 8, 7, "<f4"))

LAYOUTS: dict[str, Layout] = {
    "velodyne": Layout(
        (*_XYZ, ("intensity", 12, 7, "<f4"), ("ring", 16, 4, "<u2"), ("time", 18, 7, "<f4")),
        22, ("time", 1.0),
    ),
    "ouster": Layout(
        (*_XYZ, ("intensity", 16, 7, "<f4"), ("t", 20, 6, "<u4"), ("reflectivity", 24, 4, "<u2"),
         ("ring", 26, 4, "<u2"), ("ambient", 28, 4, "<u2"), ("range", 32, 6, "<u4")),
        48, ("t", 1e-9), top_first=True,
    ),
    "hesai": Layout(
        (*_XYZ, ("intensity", 16, 7, "<f4"), ("timestamp", 24, 8, "<f8"), ("ring", 32, 4, "<u2")),
        48, ("timestamp", 1.0), absolute=True,
    ),
    "livox": Layout(
        (*_XYZ, ("intensity", 12, 7, "<f4"), ("tag", 16, 2, "u1"), ("line", 17, 2, "u1"),
         ("timestamp", 18, 8, "<f8")),
        26, ("timestamp", 1e-9), absolute=True,
    ),
    "xyz": Layout(_XYZ, 16, None),
}  # fmt: skip
"""Layouts of velodyne_pointcloud 2, ouster_ros (PCL padding), the first driver of Hesai (PCL),
livox_ros_driver2, and points without anything."""


def write_kitti(path: PathLike, scans: Iterable[Scan]) -> int:
    """Write a KITTI folder with time and ring of each point; return how many scans."""
    return write_scans(path, scans)


def write_pcap(
    path: PathLike, scans: Iterable[Scan], *, lidar: LidarModel = VLP16,
    returns: str = "strongest", address: tuple[int, int, int, int] = SENSOR_ADDRESS,
) -> int:  # fmt: skip
    """Write what a VLP-16 would have sent as a pcap with nanoseconds; return how many packets.

    scans: turns of a VLP-16, the sensor frame of the simulator (the head looks along +x at the
    stamp and turns clockwise seen from above). lidar: rate of turning. returns: "strongest",
    "last" or "dual" (both returns of every firing, here the same). Each point goes to the firing of
    its channel at its time; firings without a point are told as no return, as the sensor does.

    A turn begins with a packet of its own, for the simulator starts turns at even times; the rest
    of a turn's last packet holds no returns.
    """
    if returns not in RETURN_MODES:
        raise InputError(f"returns must be one of {', '.join(RETURN_MODES)}; {returns!r} came")
    n = 0
    with writing(path) as part, open(part, "wb") as file:
        file.write(struct.pack("<IHHiIII", 0xA1B23C4D, 2, 4, 0, 0, 65535, 1))
        for index, scan in enumerate(scans):
            for time_ns, payload in velodyne_packets(
                scan, lidar=lidar, returns=returns, index=index
            ):
                frame = _ethernet(payload, address)
                file.write(struct.pack("<IIII", *divmod(time_ns, 10**9), len(frame), len(frame)))
                file.write(frame)
                n += 1
        if n == 0:
            raise InputError(f"{path} is not written: there are no scans")
    return n


def velodyne_packets(
    scan: Scan, *, lidar: LidarModel = VLP16, returns: str = "strongest", index: int = 0
) -> Iterator[tuple[int, bytes]]:
    """Yield (time of reception in ns, 1206 bytes) of the packets of one turn of a VLP-16."""
    if lidar.n_channels != 16:
        raise InputError(f"packets of the VLP-16 are written; a lidar of {lidar.n_channels} came")
    sequence, laser = _firings(scan, lidar, index)
    n_sequences = max(int(sequence.max(initial=-1)) + 1, lidar.sequences_per_turn)
    n_packets = -(-n_sequences // SEQUENCES)
    local = scan.xyz.astype(np.float64)
    local[:, 2] -= lidar.height_offset[laser]
    counts = np.round(np.linalg.norm(local, axis=1) / RANGE_UNIT)
    if (counts > MAX_COUNTS).any() or (counts < 1).any():
        raise InputError(f"scan {index} has points beyond {MAX_COUNTS * RANGE_UNIT:g} m, or at 0")
    distance = np.zeros((n_packets * SEQUENCES, 16), dtype=np.uint16)
    reflectivity = np.zeros((n_packets * SEQUENCES, 16), dtype=np.uint8)
    distance[sequence, laser] = counts
    reflectivity[sequence, laser] = np.clip(np.round(scan.intensity), 0, 255)

    # azimuth of the first firing of each block; decoders interpolate between them
    block = np.arange(n_packets * SEQUENCES // 2) * 2
    turned = block * lidar.sequence_period * lidar.rate
    azimuth = np.mod(np.round(turned * 36000.0), 36000).astype(np.uint16)
    first_us = np.round(
        (scan.stamp + np.arange(n_packets) * SEQUENCES * lidar.sequence_period) * 1e6
    ).astype(np.int64)
    # a packet leaves when its last laser has fired
    half_ns = round(SEQUENCES // 2 * lidar.sequence_period * 1e9)
    sent_ns = first_us * 1000 + 2 * half_ns
    blocks = azimuth.reshape(-1, 12)
    ranges, strengths = distance.reshape(-1, 12, 32), reflectivity.reshape(-1, 12, 32)
    if returns == "dual":
        blocks, ranges, strengths = _doubled(blocks), _doubled(ranges), _doubled(strengths)
        # the second half of a packet's firings begins later
        first_us = np.stack([first_us, first_us + round(half_ns * 1e-3)], axis=1).ravel()
        sent_ns = np.stack([sent_ns - half_ns, sent_ns], axis=1).ravel()
    packets = pack_packets(
        blocks, ranges, strengths, np.mod(first_us, HOUR_US), mode=RETURN_MODES[returns]
    )
    for time_ns, packet in zip(sent_ns.tolist(), packets, strict=True):
        yield time_ns, packet.tobytes()


def write_mcap(
    path: PathLike, scans: Iterable[Scan], *, topic: str = "/points", frame: str = "lidar",
    layout: str = "velodyne", poses: Trajectory | None = None, pose_topic: str = "/odom",
    world: str = "map", n_channels: int = 16,
) -> int:  # fmt: skip
    """Write a ROS 2 bag (mcap); return how many scans.

    path: a `.mcap` file, else the folder of a bag (with its metadata.yaml). layout: of the points,
    a name of `LAYOUTS`. poses: true poses, written as nav_msgs/Odometry of `frame` in `world`.
    n_channels: of the sensor, for drivers that count from the top.
    """
    from rosbags.rosbag2 import StoragePlugin, Writer

    if layout not in LAYOUTS:
        raise InputError(f"layout must be one of {', '.join(LAYOUTS)}; {layout!r} came")
    path = Path(path)
    single = path.suffix.lower() == ".mcap"
    name = path.stem if single else path.name
    with _place(path, single, name) as bag:
        if bag.exists():
            bag.rmdir()
        with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            n = _write_messages(
                writer, scans, topic, frame, LAYOUTS[layout], poses, pose_topic, world, n_channels
            )
        if n == 0:
            raise InputError(f"{path} is not written: there are no scans")
    return n


def _place(path: Path, single: bool, name: str) -> Any:
    """Return a context that yields the folder of a bag to write, and puts it in its place."""
    import contextlib

    @contextlib.contextmanager
    def file() -> Iterator[Path]:
        with writing(path) as part:
            folder = part.with_suffix("")
            try:
                yield folder
                next(folder.glob("*.mcap")).rename(part)
            finally:
                shutil.rmtree(folder, ignore_errors=True)

    @contextlib.contextmanager
    def folder() -> Iterator[Path]:
        with writing_folder(path, replaces=("metadata.yaml", f"{name}.mcap")) as part:
            inner = part / name
            yield inner
            for item in inner.iterdir():
                item.rename(part / item.name)
            inner.rmdir()

    return file() if single else folder()


def _write_messages(
    writer: Any, scans: Iterable[Scan], topic: str, frame: str, layout: Layout,
    poses: Trajectory | None, pose_topic: str, world: str, n_channels: int,
) -> int:  # fmt: skip
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    kind = "sensor_msgs/msg/PointCloud2"
    connection = writer.add_connection(topic, kind, typestore=store)
    pending: Iterator[tuple[int, bytes]] = iter(())
    if poses is not None:
        odometry = writer.add_connection(pose_topic, "nav_msgs/msg/Odometry", typestore=store)
        pending = _odometry(store, poses, world, frame)
    following = next(pending, None)
    n = 0
    for scan in scans:
        end_ns = round((scan.stamp + 0.1) * 1e9)
        while following is not None and following[0] <= end_ns:
            writer.write(odometry, *following)
            following = next(pending, None)
        message = _cloud(store, scan, frame, layout, n_channels)
        writer.write(connection, end_ns, bytes(store.serialize_cdr(message, kind)))
        n += 1
    for item in itertools.chain([following] if following is not None else [], pending):
        writer.write(odometry, *item)
    return n


def point_bytes(scan: Scan, layout: Layout, n_channels: int) -> bytes:
    """Return the points of a scan as a driver lays them out."""
    names, offsets, types = zip(*((n, o, t) for n, o, _, t in layout.fields), strict=True)
    dtype = np.dtype(
        {"names": names, "offsets": offsets, "formats": types, "itemsize": layout.point_step}
    )
    points = np.zeros(len(scan.xyz), dtype=dtype)
    for axis, name in enumerate("xyz"):
        points[name] = scan.xyz[:, axis]
    if "intensity" in names:
        points["intensity"] = scan.intensity
    for name in ("ring", "line"):
        if name in names:
            points[name] = n_channels - 1 - scan.ring if layout.top_first else scan.ring
    if layout.time is not None:
        field, unit = layout.time
        value = scan.time if layout.absolute else scan.time - scan.stamp
        points[field] = np.round(value / unit) if unit != 1.0 else value
    return points.tobytes()


def _cloud(store: Any, scan: Scan, frame: str, layout: Layout, n_channels: int) -> Any:
    """Return a PointCloud2 message."""
    types = store.types
    field = types["sensor_msgs/msg/PointField"]
    return types["sensor_msgs/msg/PointCloud2"](
        header=_header(types, round(scan.stamp * 1e9), frame), height=1, width=len(scan.xyz),
        fields=[field(name=n, offset=o, datatype=d, count=1) for n, o, d, _ in layout.fields],
        is_bigendian=False, point_step=layout.point_step,
        row_step=layout.point_step * len(scan.xyz),
        data=np.frombuffer(point_bytes(scan, layout, n_channels), np.uint8), is_dense=True,
    )  # fmt: skip


def _odometry(store: Any, poses: Trajectory, world: str, frame: str) -> Iterator[tuple[int, bytes]]:
    """Yield (time in ns, bytes) of the poses as nav_msgs/Odometry."""
    from commonmap.frames import quaternion

    types = store.types
    vector, point = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Point"]
    still = types["geometry_msgs/msg/TwistWithCovariance"](
        twist=types["geometry_msgs/msg/Twist"](
            linear=vector(x=0.0, y=0.0, z=0.0), angular=vector(x=0.0, y=0.0, z=0.0)
        ),
        covariance=np.zeros(36),
    )
    for time, T in zip(poses.time.tolist(), poses.T_map_sensor, strict=True):
        x, y, z, w = quaternion(T).tolist()
        pose = types["geometry_msgs/msg/Pose"](
            position=point(x=float(T[0, 3]), y=float(T[1, 3]), z=float(T[2, 3])),
            orientation=types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w),
        )
        message = types["nav_msgs/msg/Odometry"](
            header=_header(types, round(time * 1e9), world), child_frame_id=frame,
            pose=types["geometry_msgs/msg/PoseWithCovariance"](
                pose=pose, covariance=np.zeros(36)
            ),
            twist=still,
        )  # fmt: skip
        yield round(time * 1e9), bytes(store.serialize_cdr(message, "nav_msgs/msg/Odometry"))


def _header(types: Any, time_ns: int, frame: str) -> Any:
    seconds, nanoseconds = divmod(time_ns, 10**9)
    stamp = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
    return types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)


def _firings(
    scan: Scan, lidar: LidarModel, index: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the firing sequence and the laser of each point, or raise where it fits none."""
    laser_of_ring = np.argsort(lidar.ring)
    if len(scan.ring) and scan.ring.max() >= lidar.n_channels:
        raise InputError(f"scan {index} has a channel {scan.ring.max()}; the VLP-16 has 16")
    laser = laser_of_ring[scan.ring].astype(np.int64)
    after = scan.time - scan.stamp - lidar.fire_time[laser]
    sequence = np.round(after / lidar.sequence_period).astype(np.int64)
    if (sequence < 0).any() or (sequence >= 2 * lidar.sequences_per_turn).any():
        raise InputError(f"scan {index} has points outside its turn: no turn of {lidar.name}")
    fired = sequence * lidar.sequence_period + lidar.fire_time[laser]
    expected = -2 * np.pi * lidar.rate * fired
    measured = np.arctan2(scan.xyz[:, 1], scan.xyz[:, 0])
    off = np.abs(np.angle(np.exp(1j * (measured - expected))))
    if len(off) and np.median(off) > AZIMUTH_TOLERANCE:
        raise InputError(
            f"scan {index}: its points lie {np.degrees(np.median(off)):.2f} deg from where a "
            f"VLP-16 at {lidar.rate:g} turns/s looks at their time"
        )
    return sequence, laser


def _doubled(blocks: NDArray[Any]) -> NDArray[Any]:
    """Return (2 P, 12, ...) of (P, 12, ...): each half of a packet's blocks, every block twice.

    So are dual returns sent: last return, then strongest return, of the same two firings.
    """
    halves = blocks.reshape(-1, 6, *blocks.shape[2:])
    return np.repeat(halves, 2, axis=1)


def _ethernet(payload: bytes, address: tuple[int, int, int, int]) -> bytes:
    """Return a payload of 1206 bytes as broadcast in an Ethernet frame (IPv4, UDP)."""
    assert len(payload) == PACKET_BYTES
    udp = struct.pack(">HHHH", DATA_PORT, DATA_PORT, 8 + len(payload), 0)
    head = struct.pack(
        ">BBHHHBBH4s4s", 0x45, 0, 20 + len(udp) + len(payload), 0, 0x4000, 0xFF, 17, 0,
        bytes(address), b"\xff" * 4,
    )  # fmt: skip
    total = sum(struct.unpack(">10H", head))
    total = (total & 0xFFFF) + (total >> 16)
    checksum = ~((total & 0xFFFF) + (total >> 16)) & 0xFFFF
    head = head[:10] + struct.pack(">H", checksum) + head[12:]
    frame = b"\xff" * 6 + b"\x60\x76\x88" + bytes(address[1:]) + b"\x08\x00"
    return frame + head + udp + payload
