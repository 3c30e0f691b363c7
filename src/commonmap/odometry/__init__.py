"""Scans to trajectory: LOAM, and others as rows of one table."""

from commonmap.odometry.accumulate import Accumulator
from commonmap.odometry.errors import TrajectoryErrors, compare
from commonmap.odometry.georeference import covers, georeference
from commonmap.odometry.loam import LoamOptions
from commonmap.odometry.placeable import PlaceableTurns
from commonmap.odometry.records import Odometry, ScanHealth, Trouble
from commonmap.odometry.table import (
    ODOMETRY,
    OdometryMethod,
    describe_health,
    estimate,
    find_sound_part,
    find_troubles,
)

__all__ = [
    "ODOMETRY",
    "Accumulator",
    "LoamOptions",
    "Odometry",
    "OdometryMethod",
    "PlaceableTurns",
    "ScanHealth",
    "TrajectoryErrors",
    "Trouble",
    "compare",
    "covers",
    "describe_health",
    "estimate",
    "find_sound_part",
    "find_troubles",
    "georeference",
]
