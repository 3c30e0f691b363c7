"""What an IMU in a bag felt, turned into the axes of the lidar: it tells which way is up."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from commonmap.io.logs.poses import edges_of, frame_of_scans, still_motion
from commonmap.io.logs.record import Options, shown
from commonmap.io.logs.rosbag import decode, is_bag_folder, iter_messages, open_rosbag
from commonmap.io.source import PathLike, log, parsing
from commonmap.types import Float64s

IMU = "sensor_msgs/msg/Imu"

GRAVITY = 9.81
"""m/s^2."""

IN_G = 2.0
"""A median below this cannot be m/s^2: some drivers (Livox) tell multiples of gravity."""


@dataclass(frozen=True, eq=False)
class Acceleration:
    """time: (M,) seconds, rising. felt: (M, 3) m/s^2, axes of the lidar: what an accelerometer
    tells, which at rest is gravity's opposite (up, 9.81)."""

    time: Float64s
    felt: Float64s


def read_acceleration(
    path: PathLike, *, sensor: str | None = None, topic: str | None = None,
    keep_partial: bool = False,
) -> Acceleration | None:  # fmt: skip
    """Return what the IMU of a bag felt; None where there is none that can be used.

    sensor: frame of the lidar, else that of the bag's scans (topic: of those that are read). The
    way from the IMU's axes to the lidar's is taken from /tf_static; one of another frame that
    nothing joins is left out, with a warning. Of several, the first that is joined is taken.
    keep_partial: of a bag that is truncated or damaged, take what can be read.
    """
    path = Path(path)
    if not is_bag_folder(path) and path.suffix.lower() not in (".bag", ".mcap", ".db3"):
        return None
    record = open_rosbag(path, Options(topic, keep_partial=keep_partial))
    topics = [found for found in record.topics if found.type == IMU and found.count != 0]
    if not topics:
        return None
    sensor = sensor or frame_of_scans(path, record.topics, record.topic, keep_partial=keep_partial)
    edges = edges_of(path, record.topics, only_static=True, keep_partial=keep_partial)
    for found in topics:
        time, felt, frame = _read(path, found.name, keep_partial)
        if len(time) < 2:
            continue
        R = np.eye(3)
        if sensor is not None and frame.lstrip("/") != sensor.lstrip("/"):
            T_sensor_imu = still_motion(edges, sensor, frame)
            if T_sensor_imu is None:
                log.warning(
                    "%s: the IMU of %s is not used: no /tf_static joins %s and %s",
                    path, shown(found.name), shown(frame), shown(sensor),
                )  # fmt: skip
                continue
            R = T_sensor_imu[:3, :3]
        unit = GRAVITY if np.median(np.linalg.norm(felt, axis=1)) < IN_G else 1.0
        return Acceleration(time, unit * felt @ R.T)
    return None


def _read(path: Path, topic: str, keep_partial: bool) -> tuple[Float64s, Float64s, str]:
    """Return times (M,), rising, accelerations (M, 3) that are finite, and their frame."""
    times: list[float] = []
    felt: list[tuple[float, float, float]] = []
    frame = ""
    for message in iter_messages(path, [topic], keep_partial=keep_partial):
        with parsing(path, f"Imu of {shown(topic)}"):
            decoded = decode(message)
            a = decoded.linear_acceleration
            row = (float(a.x), float(a.y), float(a.z))
            stamp = decoded.header.stamp
            time = float(stamp.sec) + float(stamp.nanosec) * 1e-9
            frame = str(decoded.header.frame_id)
        if np.isfinite(row).all() and (not times or time > times[-1]):
            times.append(time)
            felt.append(row)
    return np.array(times), np.array(felt).reshape(-1, 3), frame
