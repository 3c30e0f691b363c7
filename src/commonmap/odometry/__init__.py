"""Scans to trajectory: LOAM, and others as rows of one table."""

from commonmap.odometry.georeference import georeference
from commonmap.odometry.loam import LoamOptions
from commonmap.odometry.records import Odometry, ScanHealth
from commonmap.odometry.table import ODOMETRY, OdometryMethod, estimate

__all__ = [
    "ODOMETRY",
    "LoamOptions",
    "Odometry",
    "OdometryMethod",
    "ScanHealth",
    "estimate",
    "georeference",
]
