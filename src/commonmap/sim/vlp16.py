"""Spinning lidars as records: which channel looks where, and when it fires.

The VLP-16 follows the user manual (63-9243, Rev. D): table 9-1 (elevation and vertical correction
by laser ID, in firing order) and section 9.4 (one laser every 2.304 us, 16 lasers and a recharge
of 18.43 us make a firing sequence of 55.296 us). The others give other densities; their tables
are those of the makers' data sheets.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from commonmap.errors import InputError
from commonmap.types import Float64s


@dataclass(frozen=True, eq=False)
class LidarModel:
    """A lidar that turns about its z axis. All arrays are (C,), in the order of firing.

    elevation: radians above the sensor's x-y plane.
    azimuth_offset: radians, added to the azimuth of the head (counter-clockwise).
    height_offset: metres, height of the laser's origin above that of the sensor.
    fire_time: seconds after the start of the firing sequence.
    sequence_period: seconds from one firing sequence to the next.
    rate: turns per second.
    min_range, max_range: metres.
    range_sigma: metres, standard deviation of one range.
    range_step: metres, the unit in which ranges are told.
    drop_out: chance that a return is lost for no reason.
    sensitive_range: metres at which a surface that sends back 0.1 of the light and faces the
        sensor is missed half of the time.
    """

    name: str
    elevation: Float64s
    azimuth_offset: Float64s
    height_offset: Float64s
    fire_time: Float64s
    sequence_period: float
    rate: float = 10.0
    min_range: float = 0.5
    max_range: float = 100.0
    range_sigma: float = 0.02
    range_step: float = 0.002
    drop_out: float = 0.005
    sensitive_range: float = 60.0

    def __post_init__(self) -> None:
        if not 1.0 <= self.rate <= 30.0:
            raise InputError(f"rate of a lidar must lie in 1 to 30 turns/s; {self.rate:g} came")
        if not self.range_sigma >= 0.0:
            raise InputError(f"range_sigma must not be negative; {self.range_sigma:g} came")

    @property
    def n_channels(self) -> int:
        """Number of lasers."""
        return len(self.elevation)

    @property
    def ring(self) -> NDArray[np.uint16]:
        """(C,) number of the channel of each firing, lowest elevation first."""
        ring = np.empty(self.n_channels, dtype=np.uint16)
        ring[np.argsort(self.elevation, kind="stable")] = np.arange(self.n_channels)
        return ring

    @property
    def sequences_per_turn(self) -> int:
        """Number of firing sequences that start within one turn."""
        return int(np.floor(1.0 / (self.rate * self.sequence_period) + 1e-9))


def _vlp16() -> LidarModel:
    elevation_deg = [-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15]
    correction_mm = [11.2, -0.7, 9.7, -2.2, 8.1, -3.7, 6.6, -5.1, 5.1, -6.6, 3.7, -8.1, 2.2, -9.7,
                     0.7, -11.2]  # fmt: skip
    return LidarModel(
        name="vlp16",
        elevation=np.radians(np.array(elevation_deg, dtype=np.float64)),
        azimuth_offset=np.zeros(16),
        height_offset=np.array(correction_mm) * 1e-3,
        fire_time=np.arange(16, dtype=np.float64) * 2.304e-6,
        sequence_period=55.296e-6,
    )


def _hdl32() -> LidarModel:
    """HDL-32E: 32 lasers from -30.67 to +10.67 deg, low and high halves in turn, 1.152 us each."""
    step = 4.0 / 3.0
    low = -(92.0 / 3.0) + step * np.arange(16)
    elevation_deg = np.column_stack([low, low + 16 * step]).ravel()
    return LidarModel(
        name="hdl32",
        elevation=np.radians(elevation_deg),
        azimuth_offset=np.zeros(32),
        height_offset=np.zeros(32),
        fire_time=np.arange(32, dtype=np.float64) * 1.152e-6,
        sequence_period=46.080e-6,
    )


def _os1(name: str, n: int) -> LidarModel:
    """OS1 kind: n channels over 45 deg that fire together, 1024 columns a turn, staggered."""
    stagger_deg = np.tile([4.2, 1.4, -1.4, -4.2], n // 4)
    return LidarModel(
        name=name,
        elevation=np.radians(np.linspace(22.5, -22.5, n)),
        azimuth_offset=np.radians(stagger_deg),
        height_offset=np.zeros(n),
        fire_time=np.zeros(n),
        sequence_period=1.0 / (10.0 * 1024),
        range_step=0.001,
    )


VLP16 = _vlp16()

LIDARS: dict[str, LidarModel] = {
    "vlp16": VLP16,
    "hdl32": _hdl32(),
    "os1-64": _os1("os1-64", 64),
    "os1-128": _os1("os1-128", 128),
}


def find_lidar(lidar: str | LidarModel) -> LidarModel:
    """Return the model of that name, or the model itself."""
    if isinstance(lidar, LidarModel):
        return lidar
    if lidar not in LIDARS:
        raise InputError(f"lidar must be one of {', '.join(LIDARS)}; '{lidar}' came")
    return LIDARS[lidar]
