"""Each job as one page, read from top to bottom: match, merge, run.

No file is opened here: maps come in, answers go out.
"""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from commonmap.config import Config
from commonmap.errors import InputError
from commonmap.frames import apply, check_points, check_T
from commonmap.mapping.points import points_of
from commonmap.matching.areas import match_areas
from commonmap.matching.match import match
from commonmap.merging.free_space import free_height_layer
from commonmap.merging.products import (
    SOURCE,
    TARGET,
    CommonMap,
    Map,
    choose_octree_origin,
    choose_resolution,
    merge_clouds,
    merge_heights,
    merge_octrees,
    navigation_map,
)
from commonmap.metrics.table import find_metric
from commonmap.types import Cloud, DriftField, Leaves, Match, Progress, no_progress

log = logging.getLogger("commonmap")


@dataclass(frozen=True, eq=False)
class Result:
    """What `run` returns. common: the merged map, or None where the match was refused."""

    match: Match
    common: CommonMap | None


def match_maps(
    target: Map | ArrayLike,
    source: Map | ArrayLike,
    *,
    config: Config | None = None,
    progress: Progress = no_progress,
) -> Match:
    """Return where the source lies in the target's frame, or why that cannot be said.

    target, source: a `Cloud`, the `Leaves` of an octree, or an (N, 3) array of metres, z up.
    """
    config = config or Config()
    find_metric(config.search.metric)
    start = time.perf_counter()
    target, source = as_map(target), as_map(source)
    found = match(target, source, config=config, progress=progress)
    timings = {**found.timings, "match": time.perf_counter() - start}
    areas = None
    if config.areas.size is not None and (found.accepted or found.rivals):
        start = time.perf_counter()
        areas = match_areas(target, source, found, config=config, progress=progress)
        timings["areas"] = time.perf_counter() - start
    return replace(found, areas=areas, timings=timings)


def merge_maps(
    target: Map | ArrayLike,
    source: Map | ArrayLike,
    T_target_source: ArrayLike,
    *,
    config: Config | None = None,
    progress: Progress = no_progress,
) -> CommonMap:
    """Return the common map of two maps whose relative pose is known, in the target's frame."""
    config = config or Config()
    target, source = as_map(target), as_map(source)
    T = check_T(T_target_source, "T_target_source")

    # 1. points of both in the target's frame: (N, 3) and (M, 3)
    progress("points of both maps")
    xyz_target = points_of(target, "target")
    xyz_source = apply(T, points_of(source, "source"))

    # 2. the size of a voxel, and the origin of the octree where coordinates are large: (3,)
    resolution = choose_resolution(target, source, config)
    octree_origin = choose_octree_origin(np.concatenate([xyz_target, xyz_source]), resolution)

    # 3. octree: occupied, free and unknown kept apart, and who saw what
    progress("common octree")
    tree = merge_octrees(
        target, source, T, resolution=resolution, octree_origin=octree_origin,
        mode=config.merge.mode,
    )  # fmt: skip

    # 4. cloud with provenance: (N + M, 3)
    progress("common cloud")
    cloud = merge_clouds(target, source, T, voxel=resolution)

    # 5. height map of the plan: layers (nx, ny)
    progress("common height map")
    heights = merge_heights(xyz_target, xyz_source, cell=resolution, config=config.merge)
    free = free_height_layer(heights, tree.leaves, octree_origin)
    heights = replace(heights, layers={**heights.layers, "free_height": free})

    # 6. where a robot may drive: (nx, ny) of free, occupied, unknown
    progress("navigation map")
    navigation = navigation_map(
        heights, leaves=tree.leaves, octree_origin=octree_origin, config=config.merge
    )
    seen_by = tree.provenance.astype(np.uint8)
    if not np.any(seen_by == TARGET | SOURCE):
        log.warning(
            "no voxel of the common map was seen by both: is the pose of the draft's frame in the "
            "base's, and were the maps not moved since?"
        )
    return CommonMap(cloud, tree.leaves, seen_by, tree.conflict, octree_origin, heights, navigation)


def run(
    target: Map | ArrayLike,
    source: Map | ArrayLike,
    *,
    config: Config | None = None,
    progress: Progress = no_progress,
) -> Result:
    """Return the match of two maps and, where it is accepted, the common map.

    Where the draft's areas support a correction of its drift, the corrected draft is merged.
    """
    # 1. the pose, and whether to believe it
    found = match_maps(target, source, config=config, progress=progress)
    if not found.accepted or found.T_target_source is None:
        return Result(found, None)

    # 2. the common map in the target's frame
    start = time.perf_counter()
    drift = found.areas.drift if found.areas is not None else None
    draft = correct(as_map(source), drift)
    common = merge_maps(target, draft, found.T_target_source, config=config, progress=progress)
    seconds = time.perf_counter() - start
    return Result(replace(found, timings={**found.timings, "merge": seconds}), common)


def correct(draft: Map, drift: DriftField | None) -> Map:
    """Return a draft's cloud with its drift taken off, ray origins too.

    Where there is no drift, or the draft is an octree, whose voxels cannot be bent, as it came.
    """
    if drift is None or isinstance(draft, Leaves):
        return draft
    origin = draft.origin
    if origin is not None:
        origin = drift.apply(origin).astype(np.float32)
    return replace(draft, xyz=drift.apply(draft.xyz), origin=origin)


def as_map(map_: Map | ArrayLike) -> Map:
    """Return a cloud or an octree as it is, an (N, 3) array as a cloud."""
    if isinstance(map_, Cloud | Leaves):
        return map_
    try:
        values: Any = np.asarray(map_)
    except ValueError:  # rows of unequal length
        raise InputError(
            "a map must be an (N, 3) array of x, y, z; rows differ in length"
        ) from None
    if values.dtype == object:
        raise InputError("a map is a Cloud, Leaves or an (N, 3) array of x, y, z in metres")
    return Cloud(xyz=check_points(values, "a map"))
