"""Rings and times of points from the geometry of a turn, for logs that hold neither."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from commonmap.types import Float32s, Float64s, Scan

PERIOD = 0.1
"""Seconds a turn, where there is a single scan and nothing tells."""
BINS = 4096


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
        ring, ordered = derive_rings(scan.xyz)
        how = "the order of the points" if ordered else "their elevation"
        note = f"the log has no ring numbers: {int(ring.max()) + 1} rings were derived from {how}"
        _tell(notes, note, "the log has no ring")
    if lacks[1]:
        time = derive_times(scan.xyz, ring, scan.stamp, period)
        note = "the log has no time per point: times were derived from the azimuth of the points"
        _tell(notes, note, "the log has no time")
    return Scan(scan.xyz, time, ring, scan.intensity, scan.stamp)


def _tell(notes: list[str], note: str, kind: str) -> None:
    if not any(old.startswith(kind) for old in notes):
        notes.append(note)


def derive_rings(xyz: Float32s) -> tuple[NDArray[np.uint16], bool]:
    """Return the ring of each point (N,), lowest first, and whether the order of points told it.

    Where the points come ring after ring, the azimuth jumps back once a ring; else the elevations
    are cut at the gaps of their histogram.
    """
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0]).astype(np.float64)
    elevation = np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1])).astype(np.float64)
    by_order = _rings_by_order(azimuth, elevation)
    if by_order is not None:
        return by_order, True
    return _rings_by_elevation(elevation), False


def _rings_by_order(azimuth: Float64s, elevation: Float64s) -> NDArray[np.uint16] | None:
    """Return rings where points come ring after ring, else None."""
    step = np.diff(azimuth)
    step = (step + np.pi) % (2 * np.pi) - np.pi
    if np.mean(np.abs(step) < np.radians(3.0)) < 0.95:
        return None
    sense = 1.0 if np.median(step) >= 0 else -1.0
    # the angle gone round falls back where a ring ends; where a ring begins is not known
    for start in (azimuth[0], 0.0, np.pi):
        along = (sense * (azimuth - start)) % (2 * np.pi)
        ring = np.zeros(len(azimuth), np.int64)
        ring[1:] = np.cumsum(np.diff(along) < -np.pi)
        n = int(ring[-1]) + 1
        if not 4 <= n <= 256:
            continue
        middle = np.array([np.median(elevation[ring == k]) for k in range(n)])
        fall = np.diff(middle)
        if max(np.mean(fall > 0), np.mean(fall < 0)) < 0.95:
            continue
        rank = np.empty(n, np.int64)
        rank[np.argsort(middle, kind="stable")] = np.arange(n)
        numbered: NDArray[np.uint16] = rank[ring].astype(np.uint16)
        return numbered
    return None


def _rings_by_elevation(elevation: Float64s) -> NDArray[np.uint16]:
    """Return rings by clusters of elevation."""
    low, high = np.quantile(elevation, [0.001, 0.999])
    edges = np.linspace(low, high, BINS + 1)
    count, _ = np.histogram(elevation, edges)
    wide = np.convolve(count, np.ones(5) / 5, mode="same")
    full = wide > 0.15 * np.median(np.sort(wide)[-BINS // 4 :])
    starts = np.flatnonzero(full & ~np.concatenate([[False], full[:-1]]))
    stops = np.flatnonzero(full & ~np.concatenate([full[1:], [False]])) + 1
    middle = (edges[starts] + edges[stops]) / 2
    if not 4 <= len(middle) <= 256:  # no clusters: equal slices, as many as a common sensor has
        slices = (elevation - low) / max(float(high - low), 1e-9) * 64
        return np.array(np.clip(slices, 0, 63), dtype=np.uint16)
    between = (middle[1:] + middle[:-1]) / 2
    ring = np.searchsorted(between, elevation)
    return np.array(ring, dtype=np.uint16)


def derive_times(xyz: Float32s, ring: NDArray[np.uint16], stamp: float, period: float) -> Float64s:
    """Return the time of each point (N,) from its azimuth, for a head that turns evenly.

    The turn begins behind the sensor (at -x) unless the points' own order begins elsewhere, and
    goes clockwise seen from above unless the order of points on the rings says otherwise.
    """
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0]).astype(np.float64)
    same = np.diff(ring.astype(np.int64)) == 0
    step = np.diff(azimuth)
    step = ((step + np.pi) % (2 * np.pi) - np.pi)[same]
    sense = 1.0 if len(step) and np.median(step) > 0 else -1.0
    along = (sense * (azimuth - azimuth[0])) % (2 * np.pi)
    return np.asarray(stamp + period * along / (2 * np.pi))
