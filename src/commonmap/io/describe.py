"""What is in a file, in plain values: the answer of `commonmap info FILE`."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from commonmap.io.formats import find_reader
from commonmap.io.logs import find_log, iter_scans, open_log
from commonmap.io.logs.packets import survey_capture
from commonmap.io.source import PathLike
from commonmap.types import Cloud, Float64s, Leaves

SAMPLE = 20_000
"""Points whose nearest neighbour is looked up."""

STRIP = 500_000
"""Points among which neighbours are looked for; more are cut to a strip of the map."""

SPACINGS_PER_CELL = 4.0
"""Edge of the cells that measure the covered area, in mean point spacings."""


def describe(path: PathLike) -> dict[str, Any]:
    """Return what a map file, or a log of a lidar, holds.

    Keys of every kind: path, kind ("cloud", "octree", "scans"), format, bytes. Of a cloud: points,
    min and max (x, y, z, metres), extent, spacing (median distance to the nearest neighbour,
    metres), density (points per square metre of the area they cover), crs (name or None), colour,
    intensity, origin (bool), time_span (seconds, or None). Of an octree: leaves, occupied, free,
    resolution, min, max, extent. Of scans: scans (None where the log does not say), points_first,
    rings (channels seen by the first scan), time_span (or None); of a bag or a capture also topics,
    topic (the one with the scans, None where there are several) and poses (topics with poses).
    """
    path = Path(path)
    if path.is_dir() or find_log(path) is not None:
        return {"path": str(path), **_of_log(path)}
    reader = find_reader(path)
    map_ = reader.load(path)
    common = {
        "path": str(path),
        "kind": reader.holds,
        "format": reader.version(path),
        "bytes": path.stat().st_size,
    }
    return common | (_of_cloud(map_) if isinstance(map_, Cloud) else _of_octree(map_))


def nearest_distance(xyz: Float64s) -> float:
    """Return the median distance of a point to its nearest other point, metres; NaN for one point.

    Of a large map, points in a strip across its middle stand for all. Points that lie on one
    another count once.
    """
    from scipy.spatial import cKDTree

    points = np.asarray(xyz, dtype=np.float64)
    if len(points) > STRIP:
        axis = int(np.argmax(np.ptp(points[:, :2], axis=0)))
        middle = len(points) // 2
        order = np.argpartition(points[:, axis], (middle - STRIP // 2, middle + STRIP // 2 - 1))
        points = points[np.sort(order[middle - STRIP // 2 : middle + STRIP // 2])]
    points = np.unique(points, axis=0)
    if len(points) < 2:
        return math.nan
    sample = points[:: max(1, len(points) // SAMPLE)]
    tree = cKDTree(points, balanced_tree=False, compact_nodes=False)
    distance, _ = tree.query(sample, k=2)
    return float(np.median(distance[:, 1]))


def covered_density(xyz: Float64s) -> float:
    """Return points per square metre of the ground area they cover; NaN where that is zero.

    The area is that of the occupied cells of a grid whose cells hold 16 points on average.
    """
    low, high = xyz[:, :2].min(axis=0), xyz[:, :2].max(axis=0)
    area = float(np.prod(high - low))
    if not area > 0:
        return math.nan
    cell = SPACINGS_PER_CELL * math.sqrt(area / len(xyz))
    index = np.floor((xyz[:, :2] - low) / cell).astype(np.int64)
    flat = index[:, 0] * (int(index[:, 1].max()) + 1) + index[:, 1]
    return len(xyz) / (len(np.unique(flat)) * cell * cell)


def _of_cloud(cloud: Cloud) -> dict[str, Any]:
    low, high = cloud.xyz.min(axis=0), cloud.xyz.max(axis=0)
    return {
        "points": len(cloud.xyz),
        "min": low.tolist(),
        "max": high.tolist(),
        "extent": (high - low).tolist(),
        "spacing": _or_none(nearest_distance(cloud.xyz)),
        "density": _or_none(covered_density(cloud.xyz)),
        "crs": None if cloud.crs is None else _crs_name(cloud.crs),
        "colour": cloud.colour is not None,
        "intensity": cloud.intensity is not None,
        "origin": cloud.origin is not None,
        "time_span": None
        if cloud.time is None
        else [float(cloud.time.min()), float(cloud.time.max())],
    }


def _of_octree(leaves: Leaves) -> dict[str, Any]:
    half = 0.5 * leaves.sizes()[:, None]
    centres = leaves.centres()
    low = (centres - half).min(axis=0, initial=math.inf)
    high = (centres + half).max(axis=0, initial=-math.inf)
    if not len(centres):
        low = high = np.zeros(3)
    n_occupied = int(leaves.occupied.sum())
    return {
        "leaves": len(leaves.keys),
        "occupied": n_occupied,
        "free": len(leaves.keys) - n_occupied,
        "resolution": leaves.resolution,
        "min": low.tolist(),
        "max": high.tolist(),
        "extent": (high - low).tolist(),
    }


def _of_log(path: Path) -> dict[str, Any]:
    # what a damaged log still holds; that it is damaged is a warning
    record = open_log(path, keep_partial=True)
    if record.kind == "pcap" and record.topic is not None:
        n_scans, span = survey_capture(record, record.topic)
        record = replace(record, n_scans=n_scans, time_span=span)
    chosen = record.topic is not None or not record.topics
    first = next(iter_scans(path, keep_partial=True)) if chosen else None
    files = [file for file in path.rglob("*") if file.is_file()] if path.is_dir() else [path]
    return (
        {
            "kind": "scans",
            "format": record.kind,
            "bytes": sum(file.stat().st_size for file in files),
            "scans": record.n_scans,
            "points_first": None if first is None else len(first.xyz),
            "rings": None if first is None else len(np.unique(first.ring)),
            "time_span": None if record.time_span is None else list(record.time_span),
        }
        | (
            {}
            if not record.topics
            else {
                "topics": [f"{topic.name} ({topic.type})" for topic in record.topics],
                "topic": record.topic,
            }
        )
        | ({"poses": list(record.poses)} if record.topics or record.poses else {})
    )


def _crs_name(crs: str) -> str:
    from pyproj import CRS

    return str(CRS.from_user_input(crs).name)


def _or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None
