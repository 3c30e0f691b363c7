"""Rings and times of points from the geometry of a turn, for logs that hold neither."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from commonmap.io.logs.derive import rings_of, times_of
from commonmap.types import Scan

PERIOD = 0.1
"""Seconds a turn, where there is a single scan and nothing tells."""

ENOUGH = 500
"""A turn of so many points tells whether its log holds rings and times; a sparse one may have a
single ring by chance."""


def complete_scans(scans: Iterable[Scan], notes: list[str]) -> Iterator[Scan]:
    """Yield the scans; those of a log without rings or times get them, told once in `notes`.

    The first turn of `ENOUGH` points decides for the log.
    """
    period = PERIOD
    lacks: tuple[bool, bool] | None = None
    waiting: Scan | None = None
    for scan in scans:
        if waiting is not None:
            period = min(scan.stamp - waiting.stamp, 10 * PERIOD)
            lacks = find_lack(waiting) if lacks is None else lacks
            yield complete_scan(waiting, period, notes, lacks)
        waiting = scan
    if waiting is not None:
        lacks = find_lack(waiting) if lacks is None else lacks
        yield complete_scan(waiting, period, notes, lacks)


def find_lack(scan: Scan) -> tuple[bool, bool] | None:
    """Return whether a log lacks rings and whether it lacks times, None where a turn cannot tell.

    It lacks them where all points of a turn have the same.
    """
    if len(scan.xyz) < ENOUGH:
        return None
    return int(scan.ring.max()) == int(scan.ring.min()), float(np.ptp(scan.time)) == 0.0


def complete_scan(
    scan: Scan, period: float, notes: list[str], lacks: tuple[bool, bool] | None
) -> Scan:
    """Return the scan with rings from elevation and times from azimuth where its log lacks them.

    period: seconds a turn. lacks: rings, times; as `find_lack` found them.
    """
    if lacks is None or not any(lacks) or not len(scan.xyz):
        return scan
    ring, time = scan.ring, scan.time
    if lacks[0]:
        ring = rings_of(scan.xyz)
        note = (
            f"the log has no ring numbers: {int(ring.max()) + 1} rings were derived from the order "
            "or the elevation of the points"
        )
        _tell(notes, note, "the log has no ring")
    if lacks[1]:
        time = times_of(scan.xyz, ring, scan.stamp, period)
        note = "the log has no time per point: times were derived from the azimuth of the points"
        _tell(notes, note, "the log has no time")
    return replace(scan, time=time, ring=ring, timed=scan.timed and not lacks[1])


def _tell(notes: list[str], note: str, kind: str) -> None:
    if not any(old.startswith(kind) for old in notes):
        notes.append(note)
