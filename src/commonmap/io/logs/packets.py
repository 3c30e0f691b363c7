"""Captures of the packets of a Velodyne, as scans."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

from commonmap.errors import InputError
from commonmap.io.logs.pcap import Datagram, iter_datagrams, stream_name
from commonmap.io.logs.record import Log, Options, Topic, choose_topic
from commonmap.io.velodyne import MODEL_BYTES, PACKET_BYTES, TurnReader
from commonmap.types import Progress, Scan, no_progress

LOOKED_AT = 4000
"""Packets at the start of a capture that tell which sensors it holds."""

OUSTER_PORTS = (7502, 7503)
HESAI_MAGIC = b"\xee\xff"


def open_capture(path: Path, options: Options) -> Log:
    """Return which sensors the first packets of a capture come from."""
    found: Counter[tuple[bytes, int]] = Counter()
    kinds: dict[tuple[bytes, int], set[int]] = {}
    others: Counter[tuple[int, int]] = Counter()
    first: Datagram | None = None
    for datagram in islice(iter_datagrams(path, keep_partial=True), LOOKED_AT):
        key = datagram.source, datagram.port
        if len(datagram.payload) != PACKET_BYTES:
            others[datagram.port, len(datagram.payload)] += 1
            continue
        first = first or datagram
        found[key] += 1
        kinds.setdefault(key, set()).add(datagram.payload[-1])
    if first is None:
        raise InputError(f"{path} holds no packets of a Velodyne ({_others(others)})")
    topics = tuple(
        Topic(stream_name(*key), _model(kinds[key], options), None, "scans")
        for key in sorted(found)
    )
    chosen = choose_topic(path, topics, options.topic)
    return Log(
        path=path, kind="pcap", topics=topics, topic=None if chosen is None else chosen.name
    )  # fmt: skip


def survey_capture(record: Log, topic: str) -> tuple[int, tuple[float, float]]:
    """Return how many turns a sensor of a capture makes, about, and when: reads it all."""
    turned, before, first, last = 0, None, 0.0, 0.0
    for datagram in iter_datagrams(record.path, keep_partial=True):
        if len(datagram.payload) != PACKET_BYTES or datagram.stream != topic:
            continue
        azimuth = int.from_bytes(datagram.payload[2:4], "little")
        step = 0 if before is None else (azimuth - before) % 36000
        turned += step if step < 18000 else 0
        before, last = azimuth, datagram.time
        first = first or last
    return round(turned / 36000), (first, last)


def iter_capture(record: Log, options: Options, progress: Progress = no_progress) -> Iterator[Scan]:
    """Yield the turns of one sensor of a capture."""
    path, topic = record.path, record.topic
    size = path.stat().st_size
    turns = TurnReader(path, options.model)
    key: tuple[bytes, int] | None = None
    n = 0
    for datagram in iter_datagrams(path, keep_partial=options.keep_partial):
        if len(datagram.payload) != PACKET_BYTES:
            continue
        if key is None and datagram.stream == topic:
            key = datagram.source, datagram.port
        if (datagram.source, datagram.port) != key:
            continue
        scan = turns.push(datagram.time, datagram.payload)
        if scan is not None:
            n += 1
            progress(f"reading {path.name}", datagram.end / size)
            yield scan
    scan = turns.finish()
    if scan is not None:
        n += 1
        yield scan
    if n == 0:
        raise InputError(
            f"{path} holds no whole turn of the lidar {topic} ({turns.n_packets} packets, "
            f"{turns.n_damaged} of them damaged)"
        )


def _model(bytes_: set[int], options: Options) -> str:
    if options.model is not None:
        return options.model.upper()
    names = sorted({MODEL_BYTES.get(byte, "unknown model").upper() for byte in bytes_})
    return f"Velodyne {names[0]}" if len(names) == 1 else "Velodyne"


def _others(others: Counter[tuple[int, int]]) -> str:
    """Say what a capture holds instead."""
    if not others:
        return "no UDP packets at all"
    (port, size), n = others.most_common(1)[0]
    text = f"{n} UDP packets of {size} bytes to port {port} came, {PACKET_BYTES} bytes are expected"
    if port in OUSTER_PORTS:
        return text + "; this looks like an Ouster, whose captures are not read"
    return text
