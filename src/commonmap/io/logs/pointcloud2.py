"""sensor_msgs/PointCloud2 to scans, in the field layouts of the common drivers.

| driver | ring | time | its meaning |
|---|---|---|---|
| velodyne_pointcloud | ring u16 | time f32 | seconds after (or before) header.stamp |
| ouster_ros | ring u8, u16 | t u32 | nanoseconds after header.stamp |
| hesai_ros_driver, rslidar_sdk | ring u16 | timestamp f64 | seconds, absolute |
| livox_ros_driver2 | line u8 | timestamp f64 | nanoseconds, absolute |
| livox CustomMsg as points | line u8 | offset_time u32 | nanoseconds after header.stamp |
| nebula, Autoware | channel u16 | time_stamp u32 | nanoseconds after header.stamp |

Fields may lie anywhere in a point (padding), in either byte order; clouds may be organised; points
that are NaN, or at the sensor (no return), are left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from commonmap.errors import InputError
from commonmap.io.logs.derive import rings_of, times_of
from commonmap.io.logs.record import Teller, shown
from commonmap.types import Float64s, Scan

DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""sensor_msgs/PointField: INT8 = 1 to FLOAT64 = 8."""

RING_FIELDS = ("ring", "line", "channel", "laser_id", "ring_id", "laser", "row")
TIME_FIELDS = (
    "time", "t", "timestamp", "offset_time", "time_stamp", "time_offset", "timeStamp", "point_time",
)  # fmt: skip
INTENSITY_FIELDS = ("intensity", "reflectivity", "intensities", "i")
NANOSECONDS = ("t", "offset_time", "time_stamp", "time_offset")
"""Fields that, where they are whole numbers, count nanoseconds after the stamp."""

LONGEST_TURN = 2.0
"""Seconds: what tells the unit of a time that is not an integer."""

USUAL_CHANNELS = (16, 20, 32, 40, 64, 80, 96, 128, 192, 256)
MAX_CHANNELS = 4096


@dataclass(frozen=True)
class PointField:
    """A field of a point: sensor_msgs/PointField."""

    name: str
    offset: int
    datatype: int
    count: int = 1


class PointCloud2(NamedTuple):
    """A message, whatever library read it. stamp: of the header, seconds."""

    stamp: float
    frame: str
    height: int
    width: int
    fields: Sequence[PointField]
    is_bigendian: bool
    point_step: int
    row_step: int
    data: bytes | memoryview | NDArray[np.uint8]


def columns_of(cloud: PointCloud2) -> dict[str, NDArray[Any]]:
    """Return name -> (height, width) view of the numbers of each field, in the data's memory.

    Of a field with a count above 1 the first is taken. Raises `InputError` where the sizes do not
    fit the data.
    """
    height, width, step = cloud.height, cloud.width, cloud.point_step
    data = np.frombuffer(cloud.data, dtype=np.uint8)
    if height * width == 0:
        return {item.name: np.empty((0, 0)) for item in cloud.fields}
    if height < 0 or width < 0 or step <= 0:
        raise InputError(f"a cloud of {height} x {width} points of {step} bytes came")
    # drivers leave row_step wrong where there is one row
    row = cloud.row_step if height > 1 and cloud.row_step >= width * step else width * step
    needed = (height - 1) * row + width * step
    if needed > len(data):
        raise InputError(
            f"a cloud of {height} x {width} points of {step} bytes needs {needed} bytes of data; "
            f"{len(data)} came"
        )
    columns = {}
    for item in cloud.fields:
        if item.datatype not in DATATYPES:
            raise InputError(f"field {shown(item.name)!r} has the unknown datatype {item.datatype}")
        dtype = np.dtype((">" if cloud.is_bigendian else "<") + DATATYPES[item.datatype])
        if item.offset < 0 or item.offset + dtype.itemsize > step:
            raise InputError(
                f"field {shown(item.name)!r} at byte {item.offset} does not fit a point of "
                f"{step} bytes"
            )
        columns[item.name] = np.ndarray(
            (height, width), dtype, buffer=data, offset=item.offset, strides=(row, step)
        )
    return columns


@dataclass
class CloudReader:
    """Makes scans of the clouds of one topic. What a field means is settled by the first cloud.

    deskewed: the points were moved to one moment by whoever recorded them; each gets the stamp.
    """

    teller: Teller
    deskewed: bool = False
    _unit: float | None = None
    _period: float = 0.1
    _stamp: float | None = None
    _rank: NDArray[np.uint16] | None = None
    _highest: int = 0
    _names: dict[str, str | None] = field(default_factory=dict)

    def scan(self, cloud: PointCloud2) -> Scan | None:
        """Return the scan of a message, None where it has no points."""
        columns = columns_of(cloud)
        missing = [name for name in "xyz" if name not in columns]
        if missing:
            raise InputError(
                f"{self.teller.path}: its points need x, y and z; they have "
                f"{', '.join(shown(item.name) for item in cloud.fields[:20]) or 'no fields'}"
            )
        planes = [columns[name].astype(np.float32).ravel() for name in "xyz"]
        xyz = np.stack(planes, axis=1) if len(planes[0]) else np.empty((0, 3), np.float32)
        kept = are_returns(xyz)
        xyz = xyz[kept]
        if not len(xyz):
            return None
        if self._stamp is not None and 0.01 < cloud.stamp - self._stamp < LONGEST_TURN:
            self._period = cloud.stamp - self._stamp
        self._stamp = cloud.stamp
        ring = self._ring(columns, kept, xyz)
        time = self._time(columns, kept, xyz, ring, cloud.stamp)
        good = np.isfinite(time)
        if not good.any():
            return None
        name = _first(INTENSITY_FIELDS, columns)
        intensity = (
            np.zeros(len(xyz), np.float32)
            if name is None
            else columns[name].ravel()[kept].astype(np.float32)
        )
        return Scan(
            xyz=xyz[good], time=time[good], ring=ring[good], intensity=intensity[good],
            stamp=float(time[good].min()), timed=_first(TIME_FIELDS, columns) is not None,
        )  # fmt: skip

    def _ring(
        self, columns: Mapping[str, NDArray[Any]], kept: NDArray[np.bool_], xyz: NDArray[np.float32]
    ) -> NDArray[np.uint16]:
        """Return the channel of each point, lowest first."""
        name = _first(RING_FIELDS, columns)
        height, width = columns["x"].shape
        if name is not None:
            values = columns[name].ravel()[kept]
            raw = np.clip(np.nan_to_num(values), 0, MAX_CHANNELS - 1).astype(np.int64)
        elif min(height, width) > 1 and min(height, width) <= 256:
            self.teller.tell("its points name no channel: the rows of its clouds are taken for it")
            row, column = np.divmod(np.flatnonzero(kept), width)
            raw = row if height <= width else column
        else:
            self.teller.tell("its points name no channel: it is told from their elevation")
            return rings_of(xyz)
        if self._rank is None or raw.max() > self._highest:
            # numbers beyond those seen so far: the sensor has more channels than was thought
            self._highest = max(self._highest, _round_up(int(raw.max())))
            self._rank = _ranking(raw, xyz, min(height, width))
        return np.asarray(self._rank[raw])

    def _time(
        self, columns: Mapping[str, NDArray[Any]], kept: NDArray[np.bool_],
        xyz: NDArray[np.float32], ring: NDArray[np.uint16], stamp: float,
    ) -> Float64s:  # fmt: skip
        """Return when each point was measured, seconds."""
        if self.deskewed:
            return np.full(len(xyz), stamp)
        name = _first(TIME_FIELDS, columns)
        if name is None:
            self.teller.tell("its points have no time: it is told from their azimuth")
            return times_of(xyz, ring, stamp, self._period)
        raw = columns[name].ravel()[kept]
        values = raw.astype(np.float64)
        finite = values[np.isfinite(values)]
        if not len(finite):
            return values
        if self._unit is None:
            self._unit = _unit_of(name, raw.dtype, finite)
            if np.ptp(finite) == 0.0 and len(finite) > 100:
                self.teller.tell(f"all its points have one time (field {name!r})")
        low = float(finite.min())
        if abs(low * self._unit - stamp) <= 10.0 and name.startswith("timest"):
            relative = False
        else:
            relative = abs(low * self._unit) <= 10.0
        if relative:
            return stamp + values * self._unit
        if self._unit == 1.0:
            return values
        # ns since 1970 are more digits than a float has: whole seconds first
        per_second = round(1.0 / self._unit)
        whole = np.floor(low / per_second)
        if raw.dtype.kind in "iu":
            rest = (raw.astype(np.int64) - int(whole) * per_second).astype(np.float64)
        else:
            rest = values - whole * per_second
        result: Float64s = whole + rest * self._unit
        return result


def are_returns(xyz: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return which points (N, 3) are finite and not at the sensor."""
    x, y, z = xyz.T  # column by column: a reduction over three numbers a row is slow
    there = (np.abs(x) > 1e-6) | (np.abs(y) > 1e-6) | (np.abs(z) > 1e-6)
    return np.asarray(there & np.isfinite(x) & np.isfinite(y) & np.isfinite(z))


def _round_up(top: int) -> int:
    """Return the highest number of a lidar that has a channel `top`."""
    return next((n for n in USUAL_CHANNELS if n > top), MAX_CHANNELS) - 1


def _first(names: Sequence[str], columns: Mapping[str, Any]) -> str | None:
    return next((name for name in names if name in columns), None)


def _unit_of(name: str, dtype: np.dtype[Any], values: Float64s) -> float:
    """Return the seconds in one unit of a time field, by its definition or by how far it spans."""
    if dtype.kind in "iu" and name in NANOSECONDS:
        return 1e-9
    span = float(np.ptp(values))
    if abs(float(values.min())) > 1e8:
        # absolute: seconds since 1970 are 1.7e9, milliseconds 1.7e12, and so on
        exponent = int(np.clip(round((np.log10(abs(float(values.min()))) - 9.2) / 3), 0, 3))
        return float(10.0 ** (-3 * exponent))
    for exponent in (0, 3, 6):
        if span <= LONGEST_TURN * 10.0**exponent:
            return float(10.0**-exponent)
    return 1e-9


def _ranking(
    raw: NDArray[np.int64], xyz: NDArray[np.float32], n_organised: int
) -> NDArray[np.uint16]:
    """Return, for each number that a driver gives a channel, its place from the lowest up.

    Many drivers count from the top (Ouster, Hesai), some in the order of firing. Numbers that the
    first scan does not hold keep their place where the order is plain, else they come last.
    """
    table = np.arange(MAX_CHANNELS, dtype=np.uint16)
    distance = np.linalg.norm(xyz.astype(np.float64), axis=1)
    elevation = np.arcsin(np.clip(xyz[:, 2] / np.maximum(distance, 1e-9), -1.0, 1.0))
    ids = np.unique(raw)
    if len(ids) < 2:
        return table
    order = np.argsort(raw, kind="stable")
    parts = np.split(elevation[order], np.searchsorted(raw[order], ids[1:]))
    middle = np.array([np.median(part) for part in parts])
    spread = float(
        np.median([np.median(np.abs(p - m)) for p, m in zip(parts, middle, strict=True)])
    )
    if spread > 0.5 * np.ptp(middle) / len(ids) * 4.0:
        return table  # lines of a lidar that does not sweep along cones: no order in elevation
    rising = np.diff(middle) > 0
    if rising.mean() >= 0.9:
        return table
    top = int(ids[-1]) + 1
    if rising.mean() <= 0.1:
        n = max(n_organised, top)
        if n not in USUAL_CHANNELS:
            # the first scan does not hold the last channels: the lowest, or those in the sky
            n = min(1 << (n - 1).bit_length(), MAX_CHANNELS)
        table[:n] = np.arange(n)[::-1]
        return table
    unseen = np.setdiff1d(np.arange(top), ids)
    table[np.concatenate([ids[np.argsort(middle, kind="stable")], unseen])] = np.arange(top)
    return table
