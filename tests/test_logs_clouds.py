"""PointCloud2 in the layouts of the drivers, field by field; what is told from the geometry."""

from __future__ import annotations

import logging
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from commonmap.errors import InputError
from commonmap.io.logs.derive import rings_of, times_of
from commonmap.io.logs.livox import read_custom
from commonmap.io.logs.pointcloud2 import CloudReader, PointCloud2, PointField, columns_of
from commonmap.io.logs.record import Teller
from commonmap.sim.scanning import firing_pattern
from commonmap.sim.vlp16 import LIDARS, LidarModel
from commonmap.types import Scan
from log_files import header, ros1_store, ros2_store

STAMP = 1_700_000_000.25
XYZ = [(1.0, 2.0, 3.0), (-4.0, 5.0, 0.5)]


def reader(**options: Any) -> CloudReader:
    return CloudReader(Teller(Path("log")), **options)


def cloud(
    fields: list[tuple[str, int, int]], step: int, data: bytes, *, big: bool = False,
    stamp: float = STAMP, height: int = 1, row: int | None = None,
) -> PointCloud2:  # fmt: skip
    """Return a message of points laid out as (name, offset, datatype)."""
    width = (len(data) if row is None else row) // step
    return PointCloud2(
        stamp, "lidar", height, width, [PointField(*f) for f in fields], big, step,
        width * step if row is None else row, data,
    )  # fmt: skip


def assert_two_points(scan: Scan | None, times: list[float], rings: list[int]) -> None:
    assert scan is not None
    np.testing.assert_allclose(scan.xyz, XYZ)
    np.testing.assert_allclose(scan.time, times, rtol=0, atol=3e-7)
    assert scan.ring.tolist() == rings
    assert scan.intensity.tolist() == [10.0, 20.0]
    assert scan.stamp == scan.time.min()
    types = [a.dtype.name for a in (scan.xyz, scan.time, scan.ring, scan.intensity)]
    assert types == ["float32", "float64", "uint16", "float32"]


def test_velodyne_layout() -> None:
    # velodyne_pointcloud/point_types.h: x y z intensity ring time, packed to 22 bytes (ROS 2)
    fields = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 12, 7), ("ring", 16, 4),
              ("time", 18, 7)]  # fmt: skip
    data = struct.pack("<ffffHf", *XYZ[0], 10.0, 9, 0.0) + struct.pack(
        "<ffffHf", *XYZ[1], 20.0, 3, 0.05
    )
    assert_two_points(reader().scan(cloud(fields, 22, data)), [STAMP, STAMP + 0.05], [9, 3])


def test_velodyne_times_before_the_stamp() -> None:
    # older drivers stamp the cloud with its end: times are negative
    fields = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 16, 7), ("ring", 20, 4),
              ("time", 24, 7)]  # fmt: skip
    rows = [
        struct.pack("<fff4xfH2xf4x", *p, i, r, t)
        for p, i, r, t in zip(XYZ, (10, 20), (9, 3), (-0.1, 0.0), strict=True)
    ]
    scan = reader().scan(cloud(fields, 32, b"".join(rows)))
    assert_two_points(scan, [STAMP - 0.1, STAMP], [9, 3])


def test_ouster_layout() -> None:
    # ouster_ros/os_point.h: PCL_ADD_POINT4D, intensity, t (ns), reflectivity, ring, ambient, range
    fields = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 16, 7), ("t", 20, 6),
              ("reflectivity", 24, 4), ("ring", 26, 4), ("ambient", 28, 4),
              ("range", 32, 6)]  # fmt: skip
    rows = [
        struct.pack("<fff4xfIHHH2xI12x", *p, i, t, 7, r, 1, 5000)
        for p, i, t, r in zip(XYZ, (10, 20), (0, 99_999_744), (63, 64), strict=True)
    ]
    scan = reader().scan(cloud(fields, 48, b"".join(rows)))
    # ring 63 looks higher than 64 here, as in the sensor: numbers are turned over (128 channels)
    assert_two_points(scan, [STAMP, STAMP + 0.099999744], [64, 63])


def test_hesai_layout() -> None:
    # hesai_ros_driver: x y z pad, intensity, timestamp (f64, absolute), ring
    fields = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 16, 7), ("timestamp", 24, 8),
              ("ring", 32, 4)]  # fmt: skip
    rows = [
        struct.pack("<fff4xf4xdH14x", *p, i, t, r)
        for p, i, t, r in zip(XYZ, (10, 20), (STAMP + 0.01, STAMP + 0.06), (8, 2), strict=True)
    ]
    scan = reader().scan(cloud(fields, 48, b"".join(rows)))
    assert_two_points(scan, [STAMP + 0.01, STAMP + 0.06], [8, 2])


def test_livox_layout() -> None:
    # livox_ros_driver2, PointXYZRTLT: packed, 26 bytes; timestamp is a double of nanoseconds
    fields = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 12, 7), ("tag", 16, 2),
              ("line", 17, 2), ("timestamp", 18, 8)]  # fmt: skip
    rows = [
        struct.pack("<ffffBBd", *p, i, 16, r, 1e9 * STAMP + t)
        for p, i, t, r in zip(XYZ, (10, 20), (0.0, 5e7), (3, 0), strict=True)
    ]
    scan = reader().scan(cloud(fields, 26, b"".join(rows)))
    assert_two_points(scan, [STAMP, STAMP + 0.05], [3, 0])


def test_times_of_a_sensor_that_counts_from_its_start() -> None:
    # absolute seconds that began at 0 with the sensor: the second cloud must not be taken as
    # relative although its numbers are small
    fields = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("timestamp", 16, 8), ("ring", 24, 4)]
    readers = reader()
    for start in (0.0, 0.1, 5.0):
        rows = [
            struct.pack("<fff4xdH6x", *p, start + t, 1) for p, t in zip(XYZ, (0, 0.05), strict=True)
        ]
        scan = readers.scan(cloud(fields, 32, b"".join(rows), stamp=start))
        assert scan is not None
        np.testing.assert_allclose(scan.time, [start, start + 0.05], atol=1e-12)


@pytest.mark.parametrize(
    ("kind", "code", "values"),
    [("f", 7, (0.0, 0.1)), ("f", 7, (0.0, 100.0)), ("f", 7, (0.0, 1e5)), ("f", 7, (0.0, 1e8)),
     ("d", 8, (STAMP, STAMP + 0.1)), ("d", 8, (STAMP * 1e6, STAMP * 1e6 + 1e5)),
     ("Q", None, (0, 0))],
)  # fmt: skip
def test_unit_of_time_is_told_by_its_span(
    kind: str, code: int | None, values: tuple[float, float]
) -> None:
    if code is None:
        return
    fields = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("time", 12, code)]
    step = 12 + struct.calcsize(kind)
    data = b"".join(struct.pack("<fff" + kind, *p, t) for p, t in zip(XYZ, values, strict=True))
    scan = reader().scan(cloud(fields, step, data))
    assert scan is not None
    np.testing.assert_allclose(scan.time, [STAMP, STAMP + 0.1], atol=2e-6, rtol=0)


def test_big_endian_padding_and_rows() -> None:
    fields = [("x", 4, 7), ("y", 8, 7), ("z", 12, 7), ("intensity", 16, 2), ("ring", 17, 2),
              ("t", 18, 6)]  # fmt: skip
    rows = [
        struct.pack(">4xfffBBI2x", *p, i, r, t) + b"\xaa" * 8
        for p, i, r, t in zip(XYZ, (10, 20), (9, 3), (0, 50_000_000), strict=True)
    ]
    message = cloud(fields, 24, b"".join(rows), big=True, height=2, row=32)
    assert (message.height, message.width) == (2, 1)
    assert_two_points(reader().scan(message), [STAMP, STAMP + 0.05], [9, 3])


def test_nan_points_and_points_at_the_sensor_are_left_out() -> None:
    fields = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("ring", 12, 4), ("time", 14, 7)]
    points = [(np.nan, 1, 1), XYZ[0], (0, 0, 0), (1, np.inf, 2), XYZ[1]]
    data = b"".join(struct.pack("<fffHf", *p, i, 0.01 * i) for i, p in enumerate(points))
    scan = reader().scan(cloud(fields, 18, data))
    assert scan is not None
    np.testing.assert_allclose(scan.xyz, XYZ)
    np.testing.assert_allclose(scan.time, [STAMP + 0.01, STAMP + 0.04], atol=1e-6)
    assert reader().scan(cloud(fields, 18, data[:18])) is None
    assert reader().scan(cloud(fields, 18, b"")) is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width": 10**9}, "needs .* bytes of data; 44 came"),
        ({"point_step": 0}, "points of 0 bytes"),
        ({"fields": [PointField("x", 40, 7)]}, "does not fit a point of 22 bytes"),
        ({"fields": [PointField("x", 0, 99)]}, "unknown datatype 99"),
        ({"fields": [PointField("range", 0, 7)]}, "need x, y and z; they have range"),
    ],
)
def test_clouds_that_make_no_sense(change: dict[str, Any], message: str) -> None:
    base = cloud([("x", 0, 7), ("y", 4, 7), ("z", 8, 7)], 22, b"\0" * 44)
    with pytest.raises(InputError, match=message):
        reader().scan(base._replace(**change))


def test_columns_are_views_of_the_data() -> None:
    message = cloud([("x", 0, 7)], 4, struct.pack("<3f", 1, 2, 3))
    column = columns_of(message)["x"]
    assert column.shape == (1, 3) and not column.flags.owndata
    assert column.ravel().tolist() == [1.0, 2.0, 3.0]


def sweep(
    model: LidarModel, rng: np.random.Generator, *, share: float = 0.9
) -> tuple[NDArray[np.float32], NDArray[np.uint16], NDArray[np.float64]]:
    """Return points (N, 3), channel and time after the start of one turn, in order of firing."""
    time, direction, laser = firing_pattern(model)
    kept = rng.uniform(size=len(time)) < share
    distance = rng.uniform(2.0, 60.0, kept.sum())
    xyz = direction[kept] * distance[:, None]
    xyz[:, 2] += model.height_offset[laser[kept]]
    return xyz.astype(np.float32), model.ring[laser[kept]], time[kept]


@pytest.mark.parametrize("name", ["vlp16", "hdl32", "os1-64"])
def test_channel_and_time_from_geometry(name: str, caplog: pytest.LogCaptureFixture) -> None:
    model = LIDARS[name]
    xyz, ring, time = sweep(model, np.random.default_rng(5))
    fields = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7)]
    with caplog.at_level(logging.WARNING, logger="commonmap"):
        scan = reader().scan(cloud(fields, 12, xyz.tobytes()))
    assert scan is not None
    assert "name no channel" in caplog.text and "have no time" in caplog.text
    assert (scan.ring != ring).mean() < 0.001
    # the stagger of the lasers of an OS1 (4.2 deg) is what its azimuth cannot tell
    error = np.abs(scan.time - STAMP - time)
    error = np.minimum(error, 0.1 - error)
    assert error.max() < (0.003 if name == "os1-64" else 0.0005)


@pytest.mark.parametrize("way", [-1.0, 1.0])
def test_channel_by_channel_order_tells_way_and_start(way: float) -> None:
    # as KITTI stores its scans: channel after channel, each around once
    rng = np.random.default_rng(0)
    xyz_parts, rings, times = [], [], []
    for channel in range(63, -1, -1):
        share = np.sort(rng.uniform(0, 1, 1500))
        azimuth = 0.7 + way * 2 * np.pi * share
        elevation = np.radians(-24.0 + 26.0 * channel / 63) + rng.normal(0, 0.0005)
        r = rng.uniform(3, 60, 1500)
        xyz_parts.append(
            np.column_stack([r * np.cos(azimuth), r * np.sin(azimuth), r * np.tan(elevation)])
        )
        rings.append(np.full(1500, channel))
        times.append(share)
    xyz = np.concatenate(xyz_parts).astype(np.float32)
    ring = rings_of(xyz)
    assert ring.max() == 63
    # boundaries are known to a few points only
    assert (ring != np.concatenate(rings)).mean() < 0.002
    time = times_of(xyz, ring, 10.0, 0.1)
    error = np.abs(time - 10.0 - 0.1 * np.concatenate(times))
    assert np.quantile(error, 0.99) < 2e-4


def test_organised_clouds_take_the_row_for_the_channel(caplog: pytest.LogCaptureFixture) -> None:
    azimuth = -np.linspace(0, 2 * np.pi, 360, endpoint=False)
    elevation = np.radians([15.0, 5.0, -5.0, -15.0])  # the top row first
    xyz = np.empty((4, 360, 3), dtype=np.float32)
    xyz[..., 0] = 10 * np.cos(azimuth)
    xyz[..., 1] = 10 * np.sin(azimuth)
    xyz[..., 2] = 10 * np.tan(elevation)[:, None]
    fields = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7)]
    scan = reader().scan(cloud(fields, 12, xyz.tobytes(), height=4, row=360 * 12))
    assert scan is not None and "rows of its clouds" in caplog.text
    assert [np.unique(scan.ring[scan.xyz[:, 2] < z]).tolist() for z in (-2, 0, 2)] == [
        [0], [0, 1], [0, 1, 2],
    ]  # fmt: skip


def test_deskewed_points_have_the_stamp() -> None:
    xyz, _, _ = sweep(LIDARS["vlp16"], np.random.default_rng(5))
    fields = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7)]
    scan = reader(deskewed=True).scan(cloud(fields, 12, xyz.tobytes()))
    assert scan is not None and set(scan.time.tolist()) == {STAMP}


def test_numbers_of_channels_in_order_of_firing_are_sorted() -> None:
    model = LIDARS["vlp16"]
    xyz, ring, _ = sweep(model, np.random.default_rng(5))
    laser = np.argsort(model.ring)[ring].astype("<u2")
    rows = np.zeros(len(xyz), dtype=[("p", "<f4", 3), ("laser_id", "<u2")])
    rows["p"], rows["laser_id"] = xyz, laser
    fields = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("laser_id", 12, 4)]
    scan = reader().scan(cloud(fields, 14, rows.tobytes()))
    assert scan is not None
    np.testing.assert_array_equal(scan.ring, ring)


@pytest.mark.parametrize("ros", [1, 2])
def test_livox_custom_messages(ros: int) -> None:
    # serialised by rosbags from the published definition, read by our own layout
    store = ros1_store() if ros == 1 else ros2_store()
    kind = "livox_ros_driver2/msg/CustomMsg"
    point = store.types["livox_ros_driver2/msg/CustomPoint"]
    for frame in ("l", "livox_frame", "abcdef"):
        message = store.types[kind](
            header=header(store, round(STAMP * 1e9), frame), timebase=round(STAMP * 1e9),
            point_num=2, lidar_id=1, rsvd=np.zeros(3, np.uint8),
            points=[
                point(0, *XYZ[0], 10, 0x10, 2), point(50_000_000, *XYZ[1], 20, 0x10, 1),
            ],
        )  # fmt: skip
        if ros == 1:
            data = bytes(store.serialize_ros1(message, kind))
        else:
            data = bytes(store.serialize_cdr(message, kind))
        read = read_custom(data, is_ros1=ros == 1)
        assert read.frame == frame
        assert_two_points(reader().scan(read), [STAMP, STAMP + 0.05], [2, 1])
        with pytest.raises((InputError, struct.error)):
            read_custom(data[:-8], is_ros1=ros == 1)


def test_the_first_cloud_decides_for_the_topic() -> None:
    fields = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("ring", 12, 4), ("t", 14, 6)]
    one = reader()
    for index in range(3):
        data = b"".join(struct.pack("<fffHI", *p, 1, 1000) for p in XYZ)
        scan = one.scan(replace_stamp(cloud(fields, 18, data), STAMP + 0.1 * index))
        assert scan is not None
        np.testing.assert_allclose(scan.time, STAMP + 0.1 * index + 1e-6, atol=3e-7)


def replace_stamp(message: PointCloud2, stamp: float) -> PointCloud2:
    assert replace(message.fields[0]).name == "x"
    return message._replace(stamp=stamp)
