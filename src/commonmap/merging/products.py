"""What a match is for: the common cloud, the common height map and the map for navigation.

Everything is in the frame of the target (the base map). Who saw what is kept throughout, as a bit
mask: 1 the target's robot, 2 the source's robot, 3 both.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from commonmap.config import Config, MergeConfig
from commonmap.errors import InputError
from commonmap.frames import apply, from_rotation
from commonmap.mapping.ground import Ground, find_ground, typical_spacing
from commonmap.mapping.height_map import NICE_CELLS
from commonmap.mapping.octree import Octree, octree_from_points
from commonmap.mapping.points import points_of
from commonmap.merging.octrees import MergedOctree, merge, resample
from commonmap.types import KEY_ORIGIN, Bools, Cloud, Float64s, GridMap, Leaves

TARGET, SOURCE = 1, 2
"""Bits of `seen_by`."""

COLOURS = {TARGET: (58, 148, 222), SOURCE: (242, 152, 36), TARGET | SOURCE: (51, 190, 135)}
"""Colour of a point by the robots that saw its place: base, draft, both."""

FREE, OCCUPIED, UNKNOWN = 0, 100, -1
"""Values of a navigation map, as in the messages of ROS (nav_msgs/OccupancyGrid)."""

TURN = 0.1
"""Seconds of a cloud with times that count as one scan when its rays are inserted: a lidar turn."""

MAX_CELLS = 1 << 27
"""Cells of a plan that are believed to be meant; more is a resolution given by mistake."""

Map = Cloud | Leaves


@dataclass(frozen=True, eq=False)
class CommonMap:
    """The products of a merge, in the frame of the target.

    cloud: all points of both maps in the target's frame, with `seen_by` and a colour for it.
    leaves: the common octree. Its coordinates are `p_octree = p_target - octree_origin`.
    leaves_seen_by: (M,) uint8, who saw each leaf. leaves_conflict: (M,) bool, one robot saw it
        occupied and the other free.
    octree_origin: (3,) metres; zero unless the target's coordinates do not fit an octree's keys
        (a map in UTM), then whole hundreds of metres.
    heights: GridMap with the layers ground, highest, height (and highest_target, height_target,
        highest_source, height_source), float32 with NaN for unknown; ground_seen bool; seen_by
        uint8; conflict bool, one robot saw an obstacle where the other saw bare ground; free_height
        float32, up to which height above ground a column was seen free without a gap.
    navigation: GridMap of the same cells with the layer occupancy, int8: 0 free, 100 occupied,
        -1 unknown.
    """

    cloud: Cloud
    leaves: Leaves
    leaves_seen_by: NDArray[np.uint8]
    leaves_conflict: Bools
    octree_origin: Float64s
    heights: GridMap
    navigation: GridMap


def merge_clouds(target: Map, source: Map, T_target_source: Float64s, *, voxel: float) -> Cloud:
    """Return the points of both maps in the target's frame with the provenance of each.

    voxel: metres; a point counts as seen by both where the other robot has a point in the same
    voxel of this edge, on multiples of it. The order is kept: first the target's points, then the
    source's.
    """
    xyz_target = points_of(target, "target")
    xyz_source = apply(T_target_source, points_of(source, "source"))
    xyz = np.concatenate([xyz_target, xyz_source])
    seen_by = np.repeat(np.array([TARGET, SOURCE], np.uint8), [len(xyz_target), len(xyz_source)])
    index = np.floor(xyz / voxel).astype(np.int64)
    index -= index.min(axis=0)
    size = index.max(axis=0) + 1
    if float(size[0]) * float(size[1]) * float(size[2]) > 2.0**62:
        raise InputError(f"voxels of {voxel:g} m are too small for the extent of these maps")
    code = (index[:, 0] * size[1] + index[:, 1]) * size[2] + index[:, 2]
    both = np.intersect1d(code[seen_by == TARGET], code[seen_by == SOURCE])
    seen_by[np.isin(code, both)] = TARGET | SOURCE
    palette = np.zeros((4, 3), np.uint8)
    for mask, colour in COLOURS.items():
        palette[mask] = colour
    crs = target.crs if isinstance(target, Cloud) else None
    return Cloud(xyz=xyz, crs=crs, colour=palette[seen_by], seen_by=seen_by)


def merge_heights(
    xyz_target: Float64s, xyz_source: Float64s, *, cell: float, config: MergeConfig
) -> GridMap:
    """Return the common height map of two (N, 3) clouds in one frame; layers as in `CommonMap`.

    cell: metres. The ground is found once, from both clouds together: what one robot could not
    see under a canopy the other gives. A conflict is a cell where one robot has points between
    `step_height` and `robot_height` above the ground and the other saw the ground in this cell
    and nothing above `step_height` in it or its eight neighbours.
    """
    xyz = np.concatenate([xyz_target, xyz_source])
    ground = find_ground(xyz)
    origin = np.floor(xyz[:, :2].min(axis=0) / cell) * cell
    shape = _shape_of(xyz, origin, cell)
    index, above = _place(xyz, ground, origin, cell, shape)
    is_target = np.arange(len(xyz)) < len(xyz_target)
    # A height map tells the surface: points more than a metre under the ground are blunders
    valid = above > -1.0
    layers: dict[str, NDArray[Any]] = {"ground": np.empty(0)}
    seen_by = np.zeros(shape, np.uint8)
    ground_seen, obstacle, bare = [], [], []
    for name, bit, mine in (("target", TARGET, is_target), ("source", SOURCE, ~is_target)):
        used = mine & valid
        known = _any(index[used], shape)
        layers[f"highest_{name}"] = _highest(index[used], xyz[used, 2], shape)
        layers[f"height_{name}"] = _highest(index[used], np.maximum(above[used], 0.0), shape)
        low = used & (above < config.step_height)
        tall = used & (above >= config.step_height)
        ground_seen.append(_any(index[low], shape))
        obstacle.append(_any(index[tall & (above < config.robot_height)], shape))
        around = ndimage.binary_dilation(_any(index[tall], shape), np.ones((3, 3), bool))
        bare.append(ground_seen[-1] & ~around)
        seen_by[known] |= bit
    layers["ground"] = _ground_layer(ground, origin, cell, shape, seen_by > 0)
    layers["highest"] = np.fmax(layers["highest_target"], layers["highest_source"])
    layers["height"] = np.fmax(layers["height_target"], layers["height_source"])
    layers["ground_seen"] = ground_seen[0] | ground_seen[1]
    layers["obstacle"] = obstacle[0] | obstacle[1]
    layers["seen_by"] = seen_by
    layers["conflict"] = (obstacle[0] & bare[1]) | (obstacle[1] & bare[0])
    return GridMap(origin=origin, cell=cell, layers=layers)


def navigation_map(
    heights: GridMap,
    *,
    leaves: Leaves | None = None,
    octree_origin: Float64s | None = None,
    config: MergeConfig,
) -> GridMap:
    """Return the map for driving: layer occupancy, int8, 0 free, 100 occupied, -1 unknown.

    Occupied: either robot has points between `step_height` and `robot_height` above the local
    ground. Free: the ground was seen there, or the octree knows free space in that band, and
    nothing is in the way. Everything else is unknown, also what merely looks like a gap.
    """
    free = heights["ground_seen"].copy()
    if leaves is not None:
        origin = np.zeros(3) if octree_origin is None else octree_origin
        free |= _free_columns(heights, leaves, origin, config)
    occupancy = np.full(heights.shape, UNKNOWN, np.int8)
    occupancy[free] = FREE
    occupancy[heights["obstacle"]] = OCCUPIED
    return GridMap(origin=heights.origin, cell=heights.cell, layers={"occupancy": occupancy})


def choose_resolution(target: Map, source: Map, config: Config) -> float:
    """Return the edge in metres of a voxel of the common octree.

    In this order: `merge.resolution`; that of an octree among the inputs, the target's first;
    `grid.resolution`; a round size of 0.2 m or more, at least twice as wide as the points of the
    sparser cloud are apart, seen from above.
    """
    if config.merge.resolution is not None:
        return config.merge.resolution
    for map_ in (target, source):
        if isinstance(map_, Leaves):
            return map_.resolution
    if config.grid.resolution is not None:
        return config.grid.resolution
    spacing = max(
        typical_spacing(points_of(target, "target")), typical_spacing(points_of(source, "source"))
    )
    fitting = [cell for cell in NICE_CELLS if cell >= max(0.2, 2.0 * spacing)]
    return fitting[0] if fitting else float(np.ceil(2.0 * spacing))


def merge_octrees(
    target: Map, source: Map, T_target_source: Float64s, *, resolution: float,
    octree_origin: Float64s, mode: str = "add",
) -> MergedOctree:  # fmt: skip
    """Return the common octree of two maps, in the target's frame less `octree_origin`.

    A cloud with ray origins gives free space along its rays; one without gives occupied voxels
    alone. A cloud of the source is moved point by point, an octree is resampled by volume.
    """
    T_octree_target = from_rotation(np.eye(3), -octree_origin)
    T_octree_source = T_octree_target @ T_target_source
    sources = []
    if isinstance(source, Leaves):
        sources.append((source, T_octree_source))
    else:
        sources.append((_leaves_of(source, T_octree_source, resolution), np.eye(4)))
    if isinstance(target, Leaves):
        base = resample(target, T_octree_target, resolution)
    else:
        base = _leaves_of(target, T_octree_target, resolution)
    return merge(base, sources, mode=mode, resolution=resolution)


def choose_octree_origin(xyz: Float64s, resolution: float) -> Float64s:
    """Return what to take from coordinates (N, 3) so that they fit an octree's keys, (3,) metres.

    Zero for an axis whose coordinates fit; else whole hundreds of metres near the middle.
    Raises InputError when the extent itself is more than an octree of this resolution can hold.
    """
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    reach = (KEY_ORIGIN - 2) * resolution
    shift = np.where(
        np.maximum(np.abs(low), np.abs(high)) < reach, 0.0, np.round((low + high) / 200.0) * 100.0
    )
    if ((low - shift < -reach) | (high - shift > reach)).any():
        raise InputError(
            f"an octree with voxels of {resolution:g} m spans at most {2 * reach:.0f} m; "
            f"this one would span {float((high - low).max()):.0f} m: give a coarser --resolution"
        )
    return np.asarray(shift, dtype=np.float64)


def _leaves_of(cloud: Cloud, T_octree_cloud: Float64s, resolution: float) -> Leaves:
    """Return the octree of a cloud moved into the octree's frame, turn by turn where it can."""
    finite = np.isfinite(cloud.xyz).all(axis=1)
    xyz = apply(T_octree_cloud, cloud.xyz[finite])
    if cloud.origin is None:
        return octree_from_points(xyz, resolution)
    start = apply(T_octree_cloud, cloud.origin[finite])
    tree = Octree(resolution)
    if cloud.time is None:
        tree.insert(start, xyz)
        return tree.leaves()
    order = np.argsort(cloud.time[finite], kind="stable")
    turn = np.floor((cloud.time[finite][order] - cloud.time[finite][order[0]]) / TURN)
    for part in np.split(order, np.flatnonzero(np.diff(turn)) + 1):
        tree.insert(start[part], xyz[part])
    return tree.leaves()


def _shape_of(xyz: Float64s, origin: Float64s, cell: float) -> tuple[int, int]:
    n_x, n_y = np.floor((xyz[:, :2].max(axis=0) - origin) / cell).astype(np.int64) + 1
    if int(n_x) * int(n_y) > MAX_CELLS:
        raise InputError(
            f"cells of {cell:g} m would make a height map of {n_x} x {n_y} cells; "
            "give a coarser --resolution"
        )
    return int(n_x), int(n_y)


def _place(
    xyz: Float64s, ground: Ground, origin: Float64s, cell: float, shape: tuple[int, int]
) -> tuple[NDArray[np.int64], Float64s]:
    """Return the flat cell index (N,) and the height above ground (N,) of points."""
    ij = np.floor((xyz[:, :2] - origin) / cell).astype(np.int64)
    ij = np.minimum(ij, np.array(shape) - 1)
    return ij[:, 0] * shape[1] + ij[:, 1], ground.height_above(xyz)


def _any(index: NDArray[np.int64], shape: tuple[int, int]) -> Bools:
    hit = np.zeros(shape[0] * shape[1], bool)
    hit[index] = True
    return hit.reshape(shape)


def _highest(
    index: NDArray[np.int64], value: Float64s, shape: tuple[int, int]
) -> NDArray[np.float32]:
    """Return the greatest value per cell, float32, NaN where there is none."""
    highest = np.full(shape[0] * shape[1], -np.inf)
    np.maximum.at(highest, index, value)
    highest[np.isneginf(highest)] = np.nan
    return highest.reshape(shape).astype(np.float32)


def _ground_layer(
    ground: Ground, origin: Float64s, cell: float, shape: tuple[int, int], known: Bools
) -> NDArray[np.float32]:
    layer = np.full(shape, np.nan, np.float32)
    layer[known] = ground.height_at(origin + (np.argwhere(known) + 0.5) * cell)
    return layer


def _free_columns(
    heights: GridMap, leaves: Leaves, octree_origin: Float64s, config: MergeConfig
) -> Bools:
    """Return (nx, ny) bool: free space of the octree reaches the band that a robot drives in."""
    n_x, n_y = heights.shape
    ground = heights["ground"].astype(np.float64)
    if not np.isfinite(ground).any():
        return np.zeros((n_x, n_y), bool)
    # Beyond what points tell, the ground is that of the nearest known cell
    rows, cols = ndimage.distance_transform_edt(
        np.isnan(ground), return_distances=False, return_indices=True
    )
    ground = ground[rows, cols]
    free = np.zeros((n_x, n_y), bool)
    is_free = ~leaves.occupied
    centres, sizes = leaves.centres()[is_free] + octree_origin, leaves.sizes()[is_free]
    for size in np.unique(sizes):
        centre = centres[sizes == size]
        # A cell is covered where its centre lies in the leaf
        low = np.ceil((centre[:, :2] - 0.5 * size - heights.origin) / heights.cell - 0.5)
        high = np.ceil((centre[:, :2] + 0.5 * size - heights.origin) / heights.cell - 0.5)
        steps = int(np.ceil(size / heights.cell)) + 1
        low, high = low.astype(np.int64), high.astype(np.int64)
        for di in range(min(steps, n_x)):
            for dj in range(min(steps, n_y)):
                i, j = low[:, 0] + di, low[:, 1] + dj
                inside = (i < high[:, 0]) & (j < high[:, 1])
                inside &= (i >= 0) & (i < n_x) & (j >= 0) & (j < n_y)
                i, j, z = i[inside], j[inside], centre[inside, 2]
                reach = ground[i, j]
                in_band = (z + 0.5 * size > reach + config.step_height) & (
                    z - 0.5 * size < reach + config.robot_height
                )
                free[i[in_band], j[in_band]] = True
    return free
