"""Channel and time of points that come without: told from where the points lie.

A spinning lidar sees along cones, one a channel, and around the full circle in one turn. Both are
approximations: the lasers do not start in one point, and a turn is not perfectly even.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from commonmap.types import Float32s, Float64s

MAX_RINGS = 256
BIN = np.radians(0.01)
"""Width of a bin of elevation, radians."""

SEAM_BINS = 720
SEAM_REACH = 20.0
SEAM_JUMP = 0.15
"""Metres by which the channels must break for a turn to count as deskewed."""

VALLEY = 0.6
"""A valley between two channels holds at most this share of the lower of them."""


def rings_of(xyz: Float32s) -> NDArray[np.uint16]:
    """Return the channel of each point (N,), lowest first.

    Where the points are stored channel by channel, each going around once (KITTI), the order
    tells; else the elevations are clustered.
    """
    by_order = _rings_by_order(xyz)
    return by_order if by_order is not None else _rings_by_elevation(xyz)


def times_of(xyz: Float32s, ring: NDArray[np.uint16], stamp: float, period: float) -> Float64s:
    """Return when each point was measured, (N,) seconds, of a turn that begins at `stamp`.

    The turn begins at the azimuth of the first point that is stored, and goes the way in which
    the points of a channel follow each other, clockwise seen from above where that tells nothing.
    """
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0]).astype(np.float64)
    way = _way(azimuth, ring)
    if len(azimuth) == 0:
        return np.empty(0)
    start = azimuth[0]
    _, firsts = np.unique(ring, return_index=True)
    if len(firsts) > 4:
        # the channels start together: their middle is surer than the first point
        lead = np.angle(np.exp(1j * (azimuth[firsts] - start)))
        if np.median(np.abs(lead)) < 0.2:
            start = start + float(np.median(lead))
    share = np.mod(way * (azimuth - start) / (2 * np.pi), 1.0)
    # the channels do not all begin at the same azimuth: what is stored first in a channel and
    # lies just before the start belongs to the start, what is last and just after it to the end
    order = np.argsort(ring, kind="stable")
    counts = np.bincount(ring, minlength=1)
    rank = np.empty(len(ring))
    rank[order] = np.arange(len(ring)) - np.repeat(np.cumsum(counts) - counts, counts)
    place = rank / np.maximum(counts[ring], 1)
    share[(share > 0.95) & (place < 0.1)] = 0.0
    share[(share < 0.05) & (place > 0.9)] = 1.0
    result: Float64s = stamp + share * period
    return result


def _way(azimuth: Float64s, ring: NDArray[np.uint16]) -> float:
    """Return 1 where the head turns counter-clockwise seen from above, else -1."""
    order = np.argsort(ring, kind="stable")
    step = np.angle(np.exp(1j * np.diff(azimuth[order])))
    same = np.diff(ring[order].astype(np.int64)) == 0
    small = same & (np.abs(step) < 0.1) & (step != 0.0)
    if small.sum() < 100:
        return -1.0
    share = float((step[small] > 0).mean())
    return 1.0 if share > 0.9 else -1.0


def _rings_by_order(xyz: Float32s) -> NDArray[np.uint16] | None:
    """Return the channels of points stored channel by channel, None where they are not."""
    if len(xyz) < 1000:
        return None
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0]).astype(np.float64)
    step = np.angle(np.exp(1j * np.diff(azimuth)))
    moving = step[np.abs(step) > 1e-6]
    if not len(moving) or np.median(np.abs(moving)) > np.radians(3.0):
        return None
    way = 1.0 if np.median(moving) > 0 else -1.0
    if (np.sign(moving) == way).mean() < 0.9:
        return None
    gone = np.concatenate([[0.0], np.cumsum(way * step)])
    turns = round(gone[-1] / (2 * np.pi))
    if not 4 <= turns + 1 <= MAX_RINGS:
        return None
    start = azimuth[0]
    # a channel ends where the azimuth passes the start; a little to and fro is not another turn
    phase = np.mod(way * (azimuth - start) + np.pi, 2 * np.pi)
    crossing = (
        np.flatnonzero((phase[:-1] < np.pi) & (phase[1:] >= np.pi) & (np.abs(step) < 2.0)) + 1
    )
    edges = [0]
    for i in crossing:
        if gone[i] - gone[edges[-1]] > np.pi:
            edges.append(int(i))
    ring = np.zeros(len(xyz), dtype=np.int64)
    ring[edges[1:]] = 1
    ring = np.cumsum(ring)
    n = int(ring[-1]) + 1
    flat = np.hypot(xyz[:, 0], xyz[:, 1])
    elevation = np.arctan2(xyz[:, 2], flat)
    middle = np.array([np.median(part) for part in np.split(elevation, edges[1:])])
    if not 4 <= n <= MAX_RINGS:
        return None
    rank = np.empty(n, dtype=np.uint16)
    rank[np.argsort(middle, kind="stable")] = np.arange(n)
    return rank[ring]


def _rings_by_elevation(xyz: Float32s) -> NDArray[np.uint16]:
    """Return the channels as the clusters of the elevations.

    The histogram of the elevations is smoothed as little as parts it into clear peaks.
    """
    from scipy.ndimage import gaussian_filter1d

    elevation = np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1])).astype(np.float64)
    if not len(elevation):
        return np.empty(0, dtype=np.uint16)
    low = float(elevation.min())
    index = np.floor((elevation - low) / BIN).astype(np.int64)
    counts = np.bincount(index).astype(np.float64)
    for width in (2.0, 4.0, 8.0, 16.0, 32.0, 64.0):
        smooth = gaussian_filter1d(counts, width, mode="constant")
        edges = _valleys(smooth)
        if edges is not None and 3 <= len(edges) < MAX_RINGS:
            break
    else:
        # no cones: 16 bands of equal width
        edges = np.linspace(0, len(counts), 17)[1:-1].astype(int).tolist()
    ring = np.searchsorted(np.array(edges), index, side="right")
    return np.asarray(ring, dtype=np.uint16)


def _valleys(smooth: Float64s) -> list[int] | None:
    """Return the bins that part the peaks of a histogram, None where a valley is not deep."""
    padded = np.concatenate([[0.0], smooth, [0.0]])
    peaks = np.flatnonzero((padded[1:-1] > padded[:-2]) & (padded[1:-1] >= padded[2:]))
    peaks = peaks[smooth[peaks] > 0.02 * smooth.max()]
    edges = []
    shallow = 0
    for a, b in pairwise(peaks.tolist()):
        cut = int(a + np.argmin(smooth[a : b + 1]))
        if smooth[cut] > VALLEY * min(smooth[a], smooth[b]):
            shallow += 1
        edges.append(cut)
    return edges if shallow * 20 <= len(edges) else None


@dataclass(frozen=True)
class Seam:
    """Where a turn begins and ends, in points that were moved to one moment.

    azimuth: radians. jump: metres by which all channels break there.
    """

    azimuth: float
    jump: float


def find_seam(xyz: Float32s, ring: NDArray[np.uint16]) -> Seam | None:
    """Return the seam of a turn that was deskewed while the sensor moved, None where there is none.

    As measured, a channel draws an unbroken line on the ground. Points that were moved to one
    moment break where the turn begins and ends: there the first and the last were moved apart by
    the way of the whole turn, and so in every channel, near and far, by the same length. No edge
    of a thing in the world does that.
    """
    if len(xyz) < 1000:
        return None
    flat = np.hypot(xyz[:, 0], xyz[:, 1]).astype(np.float64)
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0])
    column = np.minimum(
        ((azimuth + np.pi) / (2 * np.pi) * SEAM_BINS).astype(np.int64), SEAM_BINS - 1
    )
    n_rings = int(ring.max()) + 1
    cell = ring.astype(np.int64) * SEAM_BINS + column
    count = np.bincount(cell, minlength=n_rings * SEAM_BINS).astype(np.float64)
    total = np.bincount(cell, weights=flat, minlength=n_rings * SEAM_BINS)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = (total / count).reshape(n_rings, SEAM_BINS)
    far = [np.roll(mean, shift, axis=1) for shift in (4, 2, -1, -3)]
    # the break between the bins to the left and right, less the slope on either side
    jump = far[2] - far[1] - 0.75 * ((far[1] - far[0]) + (far[3] - far[2]))
    best: Seam | None = None
    # near the sensor, where unevenness of the ground moves the line little
    with np.errstate(invalid="ignore"):
        known = np.isfinite(jump) & (far[1] < SEAM_REACH)
    for b in np.flatnonzero(known.sum(axis=0) >= 6):
        values, reach = jump[known[:, b], b], far[1][known[:, b], b]
        middle = float(np.median(values))
        if abs(middle) < SEAM_JUMP or (best is not None and abs(middle) < abs(best.jump)):
            continue
        agree = np.abs(values - middle) < max(0.05, 0.15 * abs(middle))
        if agree.mean() >= 0.6 and reach[agree].max() > 2.0 * reach[agree].min():
            best = Seam(float(-np.pi + 2 * np.pi * b / SEAM_BINS), middle)
    return best
