"""Messages and packets as real drivers lay them out, against the drivers' published definitions.

The layouts are literal: names, datatypes, offsets and the size of a point as the named file of the
driver says (structures of PCL are aligned to 16 bytes, `PCL_ADD_POINT4D` is x, y, z and 4 bytes).
"""

from __future__ import annotations

import base64
import os
import struct
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from commonmap.io.logs import find_log, iter_scans
from commonmap.io.logs.pointcloud2 import CloudReader, PointCloud2, PointField
from commonmap.io.logs.record import Teller
from log_files import DEFINITIONS, write_classic

RECORDINGS = Path(
    os.environ.get("COMMONMAP_RECORDINGS", Path(__file__).parents[2] / "shared/data/recordings")
)
"""Where recordings of other people's test suites may lie: those of velodyne_decoder (vlp16.pcap,
vlp16.bag, at its releases) and of nebula (.db3 of VelodyneScan, in its repository)."""

U1, U2, U4, F4, F8 = 2, 4, 6, 7, 8  # sensor_msgs/PointField
STAMP = 1_700_000_000.25
HIGH, LOW = (1.0, 2.0, 3.0), (-4.0, 5.0, 0.5)


@dataclass(frozen=True)
class Driver:
    """fields: (name, offset, datatype). point: layout for `struct`. values: of a point, from its
    x y z, intensity, channel (top: counted from the top) and seconds after the stamp."""

    fields: tuple[tuple[str, int, int], ...]
    point: str
    step: int
    values: str
    source: str
    top: bool = False
    timed: bool = True


XYZ = (("x", 0, F4), ("y", 4, F4), ("z", 8, F4))

DRIVERS = {
    "velodyne_pointcloud XYZIRT": Driver(
        (*XYZ, ("intensity", 12, F4), ("ring", 16, U2), ("time", 18, F4)), "<ffffHf", 22,
        "x y z i ring after",
        "github.com/ros-drivers/velodyne, pointcloudXYZIRT.cc: fields one after the other, as "
        "sensor_msgs addPointField lays them",
    ),
    "velodyne_pointcloud XYZIR": Driver(
        (*XYZ, ("intensity", 12, F4), ("ring", 16, U2)), "<ffffH", 18, "x y z i ring",
        "the same, pointcloudXYZIR.cc", timed=False,
    ),
    "velodyne by PCL": Driver(
        (*XYZ, ("intensity", 16, F4), ("ring", 20, U2), ("time", 24, F4)), "<fff4xfH2xf4x", 32,
        "x y z i ring after", "PCL_ADD_POINT4D PCL_ADD_INTENSITY uint16 ring float time",
    ),
    "ouster-ros Point": Driver(
        (*XYZ, ("intensity", 16, F4), ("t", 20, U4), ("reflectivity", 24, U2), ("ring", 26, U2),
         ("ambient", 28, U2), ("range", 32, U4)),
        "<fff4xfIHHH2xI12x", 48, "x y z i ns 7 ring 1 5000",
        "github.com/ouster-lidar/ouster-ros, os_point.h", top=True,
    ),
    "ouster-ros Point, ring of a byte": Driver(
        (*XYZ, ("intensity", 16, F4), ("t", 20, U4), ("reflectivity", 24, U2), ("ring", 26, U1),
         ("ambient", 28, U2), ("range", 32, U4)),
        "<fff4xfIHBxH2xI12x", 48, "x y z i ns 7 ring 1 5000",
        "the same, before ring grew to two bytes", top=True,
    ),
    "ouster-ros PointXYZIRC": Driver(
        (*XYZ, ("intensity", 12, U1), ("return_type", 13, U1), ("channel", 14, U2)), "<fffBBH", 16,
        "x y z i 1 ring", "the same, common_point_types.h", top=True, timed=False,
    ),
    "hesai_ros_driver 2": Driver(
        (*XYZ, ("intensity", 12, F4), ("ring", 16, U2), ("timestamp", 18, F8)), "<ffffHd", 26,
        "x y z i ring absolute",
        "github.com/HesaiTechnology/HesaiLidar_ROS_2.0, source_driver_ros2.hpp", top=True,
    ),
    "hesai PandarPointXYZIRT by PCL": Driver(
        (*XYZ, ("intensity", 16, F4), ("timestamp", 24, F8), ("ring", 32, U2)),
        "<fff4xf4xdH14x", 48, "x y z i absolute ring",
        "HesaiLidar_General_ROS, point_types.h", top=True,
    ),
    "rslidar_sdk XYZIRT": Driver(
        (*XYZ, ("intensity", 16, F4), ("ring", 20, U2), ("timestamp", 24, F8)), "<fff4xfH2xd", 32,
        "x y z i ring absolute",
        "github.com/RoboSense-LiDAR/rslidar_sdk, source_pointcloud_ros.hpp (pcl::toROSMsg of "
        "PointXYZIRT)",
    ),
    "rslidar_sdk XYZIRT, intensity of a byte": Driver(
        (*XYZ, ("intensity", 16, U1), ("ring", 18, U2), ("timestamp", 24, F8)), "<fff4xBxH4xd", 32,
        "x y z i ring absolute", "the same, as first published",
    ),
    "livox_ros_driver2 PointXYZRTLT": Driver(
        (*XYZ, ("intensity", 12, F4), ("tag", 16, U1), ("line", 17, U1), ("timestamp", 18, F8)),
        "<ffffBBd", 26, "x y z i 16 ring absolute_ns",
        "github.com/Livox-SDK/livox_ros_driver2, comm.h (#pragma pack(1)) and lddc.cpp",
    ),
    "livox_ros_driver PointXYZRTL": Driver(
        (*XYZ, ("intensity", 12, F4), ("tag", 16, U1), ("line", 17, U1)), "<ffffBB", 18,
        "x y z i 16 ring", "the same, before points had a time", timed=False,
    ),
    "nebula PointXYZIRCAEDT": Driver(
        (*XYZ, ("intensity", 12, U1), ("return_type", 13, U1), ("channel", 14, U2),
         ("azimuth", 16, F4), ("elevation", 20, F4), ("distance", 24, F4), ("time_stamp", 28, U4)),
        "<fffBBHfffI", 32, "x y z i 1 ring 0.5 0.1 3 ns",
        "github.com/tier4/nebula, point_types.hpp", top=True,
    ),
    "nebula PointXYZIRADT": Driver(
        (*XYZ, ("intensity", 16, F4), ("ring", 20, U2), ("azimuth", 24, F4), ("distance", 28, F4),
         ("return_type", 32, U1), ("time_stamp", 40, F8)),
        "<fff4xfH2xffB7xd", 48, "x y z i ring 0.5 3 1 absolute", "the same",
    ),
}  # fmt: skip


def message(driver: Driver, points: list[tuple[tuple[float, float, float], int, int, float]],
            n_channels: int) -> PointCloud2:  # fmt: skip
    """Return a message of points (xyz, intensity, channel from the lowest, seconds)."""
    rows = []
    for xyz, intensity, ring, after in points:
        number = n_channels - 1 - ring if driver.top else ring
        known = {
            "x": xyz[0], "y": xyz[1], "z": xyz[2], "i": intensity, "ring": number, "after": after,
            "ns": round(after * 1e9), "absolute": STAMP + after,
            "absolute_ns": 1e9 * STAMP + 1e9 * after,
        }  # fmt: skip
        values = [known.get(word) for word in driver.values.split()]
        plain = [
            value if value is not None else (float(word) if "." in word else int(word))
            for word, value in zip(driver.values.split(), values, strict=True)
        ]
        rows.append(struct.pack(driver.point, *plain))
    data = b"".join(rows)
    return PointCloud2(
        STAMP, "lidar", 1, len(points), [PointField(*f) for f in driver.fields], False,
        driver.step, len(data), data,
    )  # fmt: skip


@pytest.mark.parametrize("name", DRIVERS)
def test_layouts_of_drivers(name: str, caplog: pytest.LogCaptureFixture) -> None:
    driver = DRIVERS[name]
    assert struct.calcsize(driver.point) == driver.step
    reader = CloudReader(Teller(Path("log")))
    n = 64
    points = [(HIGH, 10, 40, 0.0), (LOW, 20, 12, 0.05), (HIGH, 30, 40, 0.1)]
    scan = reader.scan(message(driver, points, n))
    assert scan is not None
    np.testing.assert_array_equal(scan.xyz, np.array([HIGH, LOW, HIGH], np.float32))
    np.testing.assert_array_equal(scan.intensity, [10.0, 20.0, 30.0])
    assert scan.ring.tolist() == [40, 12, 40]
    if driver.timed:
        np.testing.assert_allclose(scan.time, STAMP + np.array([0.0, 0.05, 0.1]), atol=3e-7)
        assert not caplog.records
    else:
        assert (np.abs(scan.time - STAMP) <= 0.1).all()
        assert "no time" in caplog.text


def test_messages_of_packets_are_those_of_velodyne_msgs() -> None:
    # github.com/ros-drivers/velodyne, velodyne_msgs/msg: VelodyneScan.msg and VelodynePacket.msg
    from commonmap.io.logs.rosbag import VELODYNE_DEFINITIONS

    for name in ("velodyne_msgs/msg/VelodynePacket", "velodyne_msgs/msg/VelodyneScan"):
        ours = VELODYNE_DEFINITIONS[name].format(time="TIME").split()
        assert ours == DEFINITIONS[name].split()


HDL32 = (
    "/+4QV84ECekJBAoFCN4JCUIFC9cJCnwFBtUJCdEFCNYJCCYGBssJDmsGCbALG8MGCK0LDi8HCK0LFKsHBLILH0IIA7sL"
    "FOgIA7sLCtoJB8ILEg8KAMcLE+MJBPgJBOMJB/sJDv/uMVfPBAnaCQQJBQfQCQlCBQnHCQp8BQbDCQfQBQbECQooBga5"
    "CQ9pBgi/CSLDBgi5CSMwBwi/CRasBwTGCSY8CAPLCRjzCAPHCQjWCQjPCQ4AAAHSCQ3RCQTjCQTRCQftCQn/7lNXzwQI"
    "wgkECQUIwAkJRgUJuQkJfAUGtAkJ1wUFswkMMwYDAAABbAYIsAkLwAYHrAkVMAcIrgkPsgcDtwkTQAgDtgkL4wgDswkE"
    "kgkDwAkIiQkFxgkHVQkE1wkEUgkF3AkD/+51V80ECUsJBAgFB0sJB0QFCToJBXwFBkAJBtUFBUMJAyEGBkwJBGoGCZ4J"
    "D8QGCKEJEy8HCJwJEKUHA6cJEj4IA6QJC+0IA6MJBIMJBLEJCHwJBbgJCFAJBMQJBEwJB9QJA//ullfNBAlHCQQLBQg+"
    "CQdFBQk5CQZ7BQY0CQbaBQU3CQYmBgQ9CQRtBgiMCR/CBgiGCQ4uBwiKCQqkBwOQCRU/CAORCQvsCAOTCQNzCQWXCQdw"
    "CQWhCQdCCQSzCQRMCQfBCQT/7rhX0AQJNQkECAUHNwkIRQUJMwkGfAUGKwkH2AUEMQkFKQYGLgkEbQYJdgkPxgYHfAkP"
    "KAcJdwkOqAcDgQkZOwgDgwkP7wgDgwkJZAkFkAkLVwkFlQkLLgkDewkLKAkFsgkG/+7aV80ECR8JBAgFBxsJB0MFCRAJ"
    "BXcFBhMJBtoFBBUJBCgGBBsJBGsGCHUJIsQGCD8JFisHCHAJDqMHA3YJGT0IA3gJD+0IA3YJB1UJBX0JDEkJBoMJDCsJ"
    "BUUJDisJB5oJDv/u+1fQBAkjCQQGBQgcCQhFBQkXCQd4BQYPCQfYBQQTCQchBgYRCQRtBghiCQ3CBgg0CR4pBwhcCQek"
    "BwNXCRc4CANVCRDnCANUCQpGCQVoCRExCQVtCRQPCQM4CQ0OCQSSCRD/7h1YyAQJBgkECgUHAAkGRQUI9QgFegUG+AgG"
    "1QUE+ggEKQYGAgkEbAYJUwkLxAYIIgkiJgcHSgkIqAcDSgkmPggDRQkm6AgDQwkPOwkEVgkfHgkGWAk8BwkEMgkMAwkF"
    "fQkL/+4/WMwECQMJBAwFB/EIBkMFCfMIB3cFBusIB9MFBO0IBiYGA/MIBGwGCEUJDMQGBxQJIisHBzkJCJ0HAjwJIT4I"
    "AzcJJOQIAzgJDiMJAz8JIB8JB0kJO/4IBCQJCQQJBnEJCP/uYVjKBAnwCAQJBQfvCAhCBQnrCAZ7BQbkCAfMBQTqCAYn"
    "BgPnCARsBgg1CQ/CBggcCVQlBwMrCQmdBwIrCSY4CAMtCSTnCAMpCQ8fCQQ2CSf8CAQyCTDlCAQdCQfkCARjCQb/7oNY"
    "zQQI1wgECAUI1ggFRQUJzggFeAUGzwgGyQUE0AgEIgYA2QgEbQYJJwkZwwYIJQloLQcDHgkJnQcCHQkbOQgDHwkk6AgD"
    "HAkOEwkEJQkj/AgGLQk04QgFHAkH4QgGVwkHx28fLTch"
)
"""A packet that a real HDL-32E sent: HDL32E_PACKET1 of the npm package @foxglove/velodyne-cloud
1.0.1 (MIT and MPL 2.0, Foxglove Technologies Inc.), which uses it in its tests."""


def test_a_packet_of_a_real_sensor_against_another_decoder(tmp_path: Path) -> None:
    packet = base64.b64decode(HDL32)
    assert len(packet) == 1206
    # several turns of it, as it went on: 20 Hz, a packet each 4.04 degrees and 553 us
    frames = []
    for k in range(-150, 250):
        data = bytearray(packet)
        for at in range(2, 1200, 100):
            azimuth = int.from_bytes(packet[at : at + 2], "little")
            data[at : at + 2] = ((azimuth + 404 * k) % 36000).to_bytes(2, "little")
        data[1200:1204] = (757_034_951 + 553 * k).to_bytes(4, "little")
        udp = struct.pack(">HHHH", 443, 2368, 8 + 1206, 0) + bytes(data)
        ip = bytes([0x45, 0]) + struct.pack(">HHHBBH", 20 + len(udp), 0, 0, 64, 17, 0)
        ip += bytes([192, 168, 1, 201, 255, 255, 255, 255])
        host = 1_599_998_400_000_000_000 + 757_034_951_000 + 553_000 * k
        frames.append((host, b"\xff" * 12 + b"\x08\x00" + ip + udp))
    path = tmp_path / "hdl32.pcap"
    write_classic(path, frames)
    scans = list(iter_scans(path))
    assert [len(np.unique(scan.ring)) for scan in scans] == [32] * len(scans)
    xyz = np.concatenate([scan.xyz for scan in scans])
    time = np.concatenate([scan.time for scan in scans])
    # what the tests of that package say of the first return of the packet
    first = np.array([-1.5504857301712036, 1.4397920370101929, -1.254827857017517])
    own = np.flatnonzero(np.abs(time - 1_599_999_157.034951) < 553e-6)
    nearest = own[int(np.linalg.norm(xyz[own, :2] - first[:2], axis=1).argmin())]
    np.testing.assert_allclose(xyz[nearest, :2], first[:2], atol=1e-5)
    # velodyne-decoder puts each laser at its own height in the housing, the other all into one
    np.testing.assert_allclose(xyz[nearest, 2], first[2], atol=0.02)
    ring = np.concatenate([scan.ring for scan in scans])
    intensity = np.concatenate([scan.intensity for scan in scans])
    assert (ring[nearest], intensity[nearest]) == (0, 9.0)
    # 382 of its 384 firings have a return between 0.4 and 100 m
    assert all(abs(len(scan.xyz) / 382 - 36000 / 404) < 1.5 for scan in scans)


@pytest.mark.skipif(not RECORDINGS.is_dir(), reason=f"no recordings at {RECORDINGS}")
def test_recordings_of_real_drivers_open() -> None:
    paths = sorted(p for p in RECORDINGS.rglob("*") if find_log(p) is not None and p.is_file())
    assert paths, f"{RECORDINGS} holds no log"
    for path in paths:
        scans = list(islice(iter_scans(path), 5))
        assert scans, path
        for scan in scans:
            assert len(scan.xyz) > 1000 and len(np.unique(scan.ring)) >= 16, path
            assert 0.02 < np.ptp(scan.time) < 0.5, path
