"""Points for the page: thinned evenly, quantised to 16 bits, as text."""

from __future__ import annotations

import base64
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from commonmap.types import Float64s

GOLDEN = 0.6180339887498949
"""Fraction whose multiples fall evenly into the unit interval, wherever one stops."""

RECORD = np.dtype([("xyz", "<i2", 3), ("height", "u1"), ("seen_by", "u1")])
"""What the viewer reads: eight bytes a point."""


@dataclass(frozen=True, eq=False)
class Box:
    """Where quantised points live: `xyz = centre + half * q / 32767`. Both (3,) metres."""

    centre: Float64s
    half: Float64s


def thin(xyz: Float64s, limit: int) -> NDArray[np.intp]:
    """Return the indices of at most about `limit` of (N, 3) points, spread evenly over space.

    Deterministic. Where points are dense fewer are kept: one a voxel, whose size is found so that
    the number comes out.
    """
    index = take_evenly(len(xyz), 4 * limit)
    if len(index) <= limit:
        return index
    points = xyz[index] - xyz[index].min(axis=0)
    low, high = 1e-3, max(float(points.max()), 1e-2)
    kept = index
    for _ in range(12):
        voxel = float(np.sqrt(low * high))
        first = _first_of_each(points, voxel)
        if len(first) > limit:
            low = voxel
        else:
            high, kept = voxel, index[first]
            if len(first) > 0.9 * limit:
                break
    return kept if len(kept) <= limit else kept[take_evenly(len(kept), limit)]


def take_evenly(n: int, limit: int) -> NDArray[np.intp]:
    """Return about `limit` of the indices 0 .. n-1, rising, without a period that could alias."""
    if n <= limit:
        return np.arange(n)
    return np.flatnonzero((np.arange(n) * GOLDEN) % 1.0 < limit / n)


def enclose(*clouds: Float64s) -> Box:
    """Return the box of what is to be seen: all but the outermost 0.1 % of points on each side."""
    quantiles = [np.quantile(xyz, [0.001, 0.999], axis=0) for xyz in clouds if len(xyz)]
    low = np.min([q[0] for q in quantiles], axis=0)
    high = np.max([q[1] for q in quantiles], axis=0)
    half = np.maximum(0.52 * (high - low), 0.5)
    return Box(centre=0.5 * (low + high), half=half)


def encode(
    xyz: Float64s, height: Float64s, seen_by: NDArray[np.uint8], box: Box, *, top: float
) -> str:
    """Return base64 of the points within the box. height: metres, 0 .. `top` becomes 0 .. 255."""
    q = (xyz - box.centre) / box.half
    inside = (np.abs(q) <= 1.0).all(axis=1)
    record = np.empty(int(inside.sum()), RECORD)
    record["xyz"] = np.round(q[inside] * 32767.0)
    record["height"] = np.round(np.clip(height[inside] / max(top, 1e-6), 0.0, 1.0) * 255.0)
    record["seen_by"] = seen_by[inside]
    return base64.b64encode(record.tobytes()).decode("ascii")


def _first_of_each(points: Float64s, voxel: float) -> NDArray[np.intp]:
    index = np.floor(points / voxel).astype(np.int64)
    size = index.max(axis=0) + 1
    code = (index[:, 0] * size[1] + index[:, 1]) * size[2] + index[:, 2]
    _, first = np.unique(code, return_index=True)
    return np.sort(first)
