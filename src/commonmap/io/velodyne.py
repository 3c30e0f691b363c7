"""Velodyne data packets: their bytes, and the scans that a stream of them holds.

A data packet is 1206 bytes, little endian (VLP-16 user manual, 63-9243 Rev. D, section 9.3):

    12 x uint16 flag 0xEEFF, uint16 azimuth in 0.01 deg, 32 x (uint16 distance, uint8 reflectivity)
    uint32 microseconds since the full hour, when the first laser of the packet fired
    uint8 return mode | uint8 model

Distances count in 2 mm (VLP-16); 0 is no return. velodyne-decoder turns packets into points: it
keeps the azimuth in steps of 0.01 deg, and adds the vertical corrections of the VLP-16 (manual,
table 9-1, up to 11.2 mm).
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from commonmap.errors import InputError
from commonmap.io.source import log, reason
from commonmap.types import Scan

PACKET_BYTES = 1206
BLOCKS, CHANNELS = 12, 32
FLAG = 0xEEFF
FLAGS = frozenset((0xEEFF, 0xDDFF, 0xCCFF, 0xBBFF))
"""Flags of a block: the banks of lasers of the larger models begin with others than the first."""

STRONGEST, LAST, DUAL = 0x37, 0x38, 0x39
"""Return modes."""

PACKET = np.dtype(
    [
        (
            "block",
            [
                ("flag", "<u2"),
                ("azimuth", "<u2"),
                ("channel", [("distance", "<u2"), ("reflectivity", "u1")], CHANNELS),
            ],
            BLOCKS,
        ),
        ("stamp", "<u4"),
        ("mode", "u1"),
        ("model", "u1"),
    ]
)
"""A data packet as NumPy sees it, 1206 bytes without padding."""

MODELS: dict[str, str] = {
    "vlp-16": "VLP16",
    "puck-hi-res": "PuckHiRes",
    "hdl-32e": "HDL32E",
    "vlp-32a": "VLP32A",
    "vlp-32b": "VLP32B",
    "vlp-32c": "VLP32C",
    "vls-128": "VLS128",
    "hdl-64e-s1": "HDL64E_S1",
    "hdl-64e-s2": "HDL64E_S2",
    "hdl-64e-s3": "HDL64E_S3",
}
"""Name of a model here -> its name in velodyne-decoder."""

MODEL_BYTES: dict[int, str] = {
    0x21: "hdl-32e",
    0x22: "vlp-16",
    0x24: "puck-hi-res",
    0x23: "vlp-32a",
    0x28: "vlp-32c",
    0xA1: "vls-128",
}
"""Last byte of a packet -> the model that sent it."""

EXAMPLE_CALIBRATIONS = {
    "hdl-64e-s1": "HDL-64E_S1-utexas.yml",
    "hdl-64e-s2": "HDL-64E_S2.1-sztaki.yml",
    "hdl-64e-s3": "HDL-64E_S3-VeloView.yml",
}
"""Models whose units are calibrated one by one -> the file of one unit in velodyne-decoder."""

HOUR_US = 3_600_000_000
WHOLE_TURN = 0.9
"""Share of a turn below which the first and the last turn of a log are left out."""

MAX_TURN = 2.0
"""Seconds a turn can last (the slowest setting is 5 turns a second)."""

_WORDS = struct.Struct("<" + "HH96x" * BLOCKS + "IBB")


def pack_packets(
    azimuth: NDArray[Any], distance: NDArray[Any], reflectivity: NDArray[Any],
    stamp_us: NDArray[Any], *, mode: int = STRONGEST, model: int = 0x22,
) -> NDArray[np.uint8]:  # fmt: skip
    """Return data packets as bytes, (P, 1206) uint8.

    azimuth: (P, 12) hundredths of a degree, 0 to 35999. distance: (P, 12, 32), in the model's
    unit (2 mm), 0 for no return. reflectivity: (P, 12, 32) 0 to 255. stamp_us: (P,) microseconds
    since the full hour.
    """
    packets = np.zeros(len(azimuth), dtype=PACKET)
    packets["block"]["flag"] = FLAG
    packets["block"]["azimuth"] = azimuth
    packets["block"]["channel"]["distance"] = distance
    packets["block"]["channel"]["reflectivity"] = reflectivity
    packets["stamp"] = stamp_us
    packets["mode"] = mode
    packets["model"] = model
    return packets.view(np.uint8).reshape(len(packets), PACKET_BYTES)


def check_model(model: str | None) -> str | None:
    """Return the name of a model as in `MODELS`, or raise with the names there are."""
    if model is None:
        return None
    name = model.lower().replace("_", "-").replace(" ", "-")
    name = {"vlp16": "vlp-16", "hdl32": "hdl-32e", "hdl-32": "hdl-32e", "vls128": "vls-128",
            "vlp-32": "vlp-32c", "alpha-prime": "vls-128"}.get(name, name)  # fmt: skip
    if name not in MODELS:
        raise InputError(f"model must be one of {', '.join(MODELS)}; {model!r} came")
    return name


@dataclass(frozen=True)
class _Heard:
    """A packet in its place. time: seconds, device clock without jumps. turn: turns of the head
    since the start, at its first firing. turn_end: at its last."""

    time: float
    turn: float
    turn_end: float
    data: bytes


@dataclass
class TurnReader:
    """Makes scans of packets: one turn of the head each, cut where it looks along +x.

    model: name as in `MODELS`; None takes what the packets say. `push` packets as they come, then
    `finish`; either returns the turns that are complete. The time of a point is that of its
    firing on the sensor's clock; the full hour, which the sensor does not tell, is that of the
    host's clock. A sensor without GPS, whose clock is not that of the host, is set to the time of
    the host at its first packet.
    """

    path: Path
    model: str | None = None
    n_packets: int = 0
    n_damaged: int = 0
    n_lost: int = 0
    _turn: list[_Heard] = field(default_factory=list)
    _rates: deque[float] = field(default_factory=lambda: deque(maxlen=63))
    _gaps: deque[float] = field(default_factory=lambda: deque(maxlen=63))
    _last: _Heard | None = None
    _offset: float = 0.0
    _host: float = 0.0
    _device: float = 0.0
    _first: bool = True
    _decoder: Any = None
    _byte: int = 0

    def push(self, host: float, data: bytes) -> Scan | None:
        """Take a packet that the host received at `host` seconds; return a turn it completes."""
        words = _WORDS.unpack(data)
        azimuths = words[1 : 2 * BLOCKS : 2]
        self.n_packets += 1
        if not FLAGS.issuperset(words[0 : 2 * BLOCKS : 2]) or max(azimuths) >= 36000:
            self.n_damaged += 1
            return None
        if not self._same_model(words[-1]) or words[-3] >= HOUR_US:
            self.n_damaged += 1
            return None
        time = self._clock(host, words[-3])
        heard = self._place(time, azimuths, data)
        done = self._emit() if self._turn and int(heard.turn) != int(self._turn_number()) else None
        if self._last is not None and int(heard.turn) > int(self._last.turn):
            self._turn = [h for h in self._turn if int(h.turn_end) >= int(heard.turn)]
        self._turn.append(heard)
        self._last = heard
        if self._turn[-1].time - self._turn[0].time > MAX_TURN:
            raise InputError(
                f"{self.path}: the head of the lidar does not turn (azimuth {azimuths[0] / 100:g} "
                f"deg for {MAX_TURN:g} s)"
            )
        return done

    def finish(self) -> Scan | None:
        """Return the last turn, if it is whole; say what was lost."""
        done = None
        if self._turn:
            # to where in its turn the log goes
            covered = self._turn[-1].turn_end - int(self._turn_number())
            done = self._emit() if covered >= WHOLE_TURN else None
        if self.n_damaged:
            log.warning("%s: %d of %d packets are damaged and left out", self.path,
                        self.n_damaged, self.n_packets)  # fmt: skip
        if self.n_lost:
            share = self.n_lost / (self.n_lost + self.n_packets)
            log.warning("%s: about %d packets (%.1f %%) are missing", self.path, self.n_lost,
                        100 * share)  # fmt: skip
        return done

    def _turn_number(self) -> float:
        return self._turn[-1].turn

    def _same_model(self, byte: int) -> bool:
        """Return whether a packet is of the model being read; the first one decides."""
        if self._decoder is None:
            self._decoder = self._make_decoder(byte)
            self._byte = byte
        # the last byte of an HDL-64E packet is a letter of its status text
        return byte == self._byte or str(self.model).startswith("hdl-64e")

    def _make_decoder(self, byte: int) -> Any:
        import velodyne_decoder as vd

        model = check_model(self.model) or MODEL_BYTES.get(byte)
        if model is None:
            raise InputError(
                f"{self.path}: the packets do not say of which model they are (byte 0x{byte:02x}); "
                f"give model (--model), one of {', '.join(MODELS)}"
            )
        self.model = model
        try:
            calibration = None
            if model in EXAMPLE_CALIBRATIONS:
                calibration = vd.get_bundled_calibration(EXAMPLE_CALIBRATIONS[model])
                log.warning(
                    "%s: read with the calibration of another %s (each has its own)",
                    self.path, model.upper(),
                )  # fmt: skip
            config = vd.Config(
                model=getattr(vd.Model, MODELS[model]), calibration=calibration, min_range=0.01,
                max_range=1000.0, timestamp_first_packet=True,
            )  # fmt: skip
            return vd.ScanDecoder(config)
        except (RuntimeError, ValueError) as error:
            raise InputError(f"{self.path}: {model} cannot be read: {reason(error)}") from error

    def _clock(self, host: float, stamp_us: int) -> float:
        """Return the time of a packet on the sensor's clock, seconds, over the full hours."""
        if self._last is None:
            self._device = _nearest_hour(stamp_us, host)
            self._offset = 0.0 if abs(self._device - host) < 1.0 else host - self._device
        else:
            step = (stamp_us * 1e-6 - self._device + 1800.0) % 3600.0 - 1800.0
            if abs(step - (host - self._host)) > 1.0 and host > 0.0:
                # the clock was set (GPS came), or the host slept over a full hour
                jump = (host - self._host) - step
                if abs(jump - 3600.0 * round(jump / 3600.0)) < 1.0:
                    step += 3600.0 * round(jump / 3600.0)
                else:
                    log.warning("%s: the clock of the lidar jumps by %.3f s", self.path, -jump)
                    self._offset += jump
            self._device += step
        self._host = host
        return self._device

    def _place(self, time: float, azimuths: tuple[int, ...], data: bytes) -> _Heard:
        """Return the packet with the turns of the head so far."""
        start = azimuths[0] / 36000.0
        width = ((azimuths[-1] - azimuths[0]) % 36000) / 36000.0
        width *= BLOCKS / (BLOCKS - 1)
        turn = start
        if self._last is not None:
            step = time - self._last.time
            gap = _middle(self._gaps) if self._gaps else step
            lost = step > 1.5 * gap if gap > 0 else False
            rate = _middle(self._rates) if lost and self._rates else None
            if rate is None:
                rate = self._rates[-1] if self._rates else 10.0
            expected = self._last.turn + step * rate
            turn = start + round(expected - start)
            if lost and len(self._gaps) > 8:
                self.n_lost += min(max(round(step / gap) - 1, 0), 10_000_000)
            elif 0 < step < 0.05:
                self._gaps.append(step)
                if 0.5 < (turn - self._last.turn) / step < 40.0:
                    self._rates.append((turn - self._last.turn) / step)
        return _Heard(time, turn, turn + min(width, 0.5), data)

    def _emit(self) -> Scan | None:
        """Return the turn that was heard; None where the log begins within it, or it is empty."""
        import velodyne_decoder as vd

        number = int(self._turn_number())
        packets = sorted(self._turn, key=lambda heard: heard.time)
        whole = packets[0].turn - number <= 1.0 - WHOLE_TURN
        if self._first and not whole:
            self._first = False
            return None
        self._first = False
        try:
            _, points = self._decoder.decode(
                [vd.VelodynePacket(heard.time, heard.data) for heard in packets]
            )
        except (RuntimeError, ValueError) as error:
            raise InputError(f"{self.path}: a packet cannot be read: {reason(error)}") from error
        table = np.asarray(points, dtype=np.float32).reshape(-1, 8)
        time = packets[0].time + table[:, 4].astype(np.float64)
        # the turn of each point: whole turns from the packet's time, the rest from its azimuth
        turns = np.interp(time, [h.time for h in packets], [h.turn for h in packets])
        azimuth = np.arctan2(-table[:, 1], table[:, 0]).astype(np.float64) / (2 * np.pi)
        mine = np.round(turns - azimuth % 1.0) == number
        mine &= np.isfinite(table[:, :3]).all(axis=1)
        table, time = table[mine], time[mine] + self._offset
        if not len(table):
            return None
        ring = table[:, 6].astype(np.uint16)
        xyz = np.ascontiguousarray(table[:, :3])
        return Scan(
            xyz=xyz, time=time, ring=ring, intensity=np.ascontiguousarray(table[:, 3]),
            stamp=float(time.min()),
        )  # fmt: skip


def _middle(values: Collection[float]) -> float:
    """Return the median of a few numbers, the upper of two (a thirtieth of the time of NumPy's)."""
    return sorted(values)[len(values) // 2]


def _nearest_hour(stamp_us: int, host: float) -> float:
    """Return the time of a stamp within the hour, in the hour that is nearest to `host`."""
    seconds = stamp_us * 1e-6
    return seconds + 3600.0 * round((host - seconds) / 3600.0)
