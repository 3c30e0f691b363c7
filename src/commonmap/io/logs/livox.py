"""Livox CustomMsg, as livox_ros_driver and livox_ros_driver2 define it, to a cloud.

    std_msgs/Header header   uint64 timebase   uint32 point_num   uint8 lidar_id   uint8[3] rsvd
    CustomPoint[] points:    uint32 offset_time (ns)   float32 x y z   uint8 reflectivity tag line

A point is 19 bytes in ROS 1; in ROS 2 it begins at a multiple of 4, hence 20 but for the last.
"""

from __future__ import annotations

import struct

from commonmap.errors import InputError
from commonmap.io.logs.pointcloud2 import PointCloud2, PointField

POINT_BYTES = 19
FIELDS = (
    PointField("offset_time", 0, 6),
    PointField("x", 4, 7),
    PointField("y", 8, 7),
    PointField("z", 12, 7),
    PointField("reflectivity", 16, 2),
    PointField("tag", 17, 2),
    PointField("line", 18, 2),
)


def read_custom(data: bytes | memoryview, *, is_ros1: bool) -> PointCloud2:
    """Return the points of a CustomMsg as serialised by ROS 1, or by ROS 2 (CDR)."""
    data = bytes(data)
    if is_ros1:
        order, at, step = "<", 4, POINT_BYTES
    else:
        if len(data) < 4:
            raise InputError(f"a Livox CustomMsg of {len(data)} bytes came")
        order, at, step = ("<" if data[1] & 1 else ">"), 0, POINT_BYTES + 1
        data = data[4:]
    seconds, nanoseconds, n_name = struct.unpack_from(order + "III", data, at)
    at += 12 + n_name
    frame = data[at - n_name : at].rstrip(b"\0").decode("utf-8", "replace")
    at = at if is_ros1 else -(-at // 8) * 8
    n = struct.unpack_from(order + "QIB3xI", data, at)[3]
    points = data[at + 20 :]
    if n * step - (step - POINT_BYTES) > len(points):
        raise InputError(f"a Livox CustomMsg of {n} points has {len(points)} bytes of them")
    return PointCloud2(
        stamp=seconds + nanoseconds * 1e-9, frame=frame, height=1, width=n, fields=FIELDS,
        is_bigendian=order == ">", point_step=step, row_step=step * n,
        # the last point lacks the byte that parts it from a next one
        data=points[: n * step].ljust(n * step, b"\0"),
    )  # fmt: skip
