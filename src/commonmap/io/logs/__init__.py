"""Logs of lidars, as recorded: captures of packets, ROS bags, folders of scans."""

from commonmap.io.logs.imu import Acceleration, read_acceleration
from commonmap.io.logs.poses import read_kitti_poses, read_poses
from commonmap.io.logs.record import Log, Topic
from commonmap.io.logs.table import LOGS, LogFormat, find_log, iter_scans, open_log

__all__ = [
    "LOGS",
    "Acceleration",
    "Log",
    "LogFormat",
    "Topic",
    "find_log",
    "iter_scans",
    "open_log",
    "read_acceleration",
    "read_kitti_poses",
    "read_poses",
]
