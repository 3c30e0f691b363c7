"""Maps made ready for matching: level, near their own origin, cut into layers, thinned."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from commonmap.config import Config
from commonmap.errors import EmptyMapError, InputError
from commonmap.frames import from_rotation
from commonmap.mapping.ground import Ground, choose_ground_cell, find_ground, typical_spacing
from commonmap.mapping.height_map import (
    build_height_map,
    choose_cell,
    choose_slabs,
    find_slabs,
)
from commonmap.mapping.level import MOST_POINTS as LEVEL_POINTS
from commonmap.mapping.level import Levelling, find_level, no_levelling
from commonmap.mapping.points import bounds, inside_box, move, points_of, rows_of, sample, thin
from commonmap.matching.slabs import SlabGrid
from commonmap.metrics.table import METRICS
from commonmap.types import Bools, Cloud, Float64s, GridMap, Leaves

MOST_POINTS = 1_000_000
"""Points of a map that the refinement and the verdict look at."""

LOW = 0.3
"""Metres above ground under which a point is the ground's."""

MOST_LOW = 20_000
"""Points of the ground that are laid on another ground."""


@dataclass(frozen=True, eq=False)
class Prepared:
    """A map made ready: level, near its own origin, with its ground.

    xyz: (N, 3) metres, in the prepared frame. T_prepared_map: (4, 4) takes the map's points there.
    height: (N,) metres above its ground. spacing: metres between its points, seen from above.
    """

    xyz: Float64s
    T_prepared_map: Float64s
    ground: Ground
    height: Float64s
    levelling: Levelling
    spacing: float


@dataclass(frozen=True, eq=False)
class Layers:
    """One map's layers for the search: slabs and height map on half the cell.

    build_grid: returns the height map; few searches need it.
    """

    slabs: SlabGrid
    build_grid: Callable[[], GridMap]

    @cached_property
    def grid(self) -> GridMap:
        """Return the height map, built when it is asked for first."""
        return self.build_grid()


@dataclass(frozen=True, eq=False)
class Points:
    """Points for the refinement and the verdict, one mean per small voxel.

    xyz: (M, 3) metres. height: (M,) metres above ground. standing: (M,) bool, above the lowest
    slab edge. voxel: metres.
    """

    xyz: Float64s
    height: Float64s
    standing: Bools
    voxel: float

    @cached_property
    def low(self) -> NDArray[np.int64]:
        """Return which points are the ground's, some of them if there are many."""
        return np.asarray(sample(np.flatnonzero(np.abs(self.height) < LOW), MOST_LOW))

    def where(self, wanted: Bools) -> Points:
        """Return the wanted ones, (M,) bool."""
        return Points(
            rows_of(self.xyz, wanted), self.height[wanted], self.standing[wanted], self.voxel
        )


def prepare(item: Cloud | Leaves | Float64s, name: str, config: Config) -> Prepared:
    """Return a map with its points level and near the origin, and its ground."""
    xyz = points_of(item, name)
    middle = np.round(np.median(sample(xyz, 20_000), axis=0))
    low, high = bounds(xyz)
    extent = (high - low)[:2]
    if len(xyz) < 100 or float(extent.max()) < 1.0:
        raise EmptyMapError(
            f"the {name} has {len(xyz)} finite points over {extent[0]:.2g} x "
            f"{extent[1]:.2g} m; a map needs at least 100 points over a metre"
        )
    if float(extent.max()) > 100_000:
        raise InputError(
            f"the {name} spans {extent.max() / 1000:.0f} km; a map is of one place, in metres"
        )
    if config.level.mode == "off":
        levelling = no_levelling("levelling was turned off")
    elif isinstance(item, Cloud) and item.crs is not None:
        levelling = no_levelling("a map with a coordinate reference system is level")
    else:
        levelling = find_level(sample(xyz, LEVEL_POINTS))
    T_prepared_map = levelling.T_level_map @ from_rotation(np.eye(3), -middle)
    local = move(T_prepared_map, xyz)
    spacing = typical_spacing(local)
    ground = find_ground(local, cell=choose_ground_cell(spacing))
    height = ground.height_above(local)
    return Prepared(local, T_prepared_map, ground, height, levelling, spacing)


def choose_grid(
    base: Prepared, draft: Prepared, config: Config
) -> tuple[float, Float64s, float | None]:
    """Return (cell, slab edges, max_height) in metres, from the data where not configured.

    Metrics on height maps use heights under 1 m unless told otherwise, as the source paper does.
    """
    spacing = max(base.spacing, draft.spacing)
    cell = config.grid.resolution or choose_cell(base.xyz, draft.xyz, spacing=spacing)
    max_height = config.grid.max_height
    if max_height is None and METRICS[config.search.metric].layers != "slabs":
        max_height = 1.0
    edges = choose_slabs(draft.height, cell=cell, max_height=max_height)
    return cell, edges, max_height


def build_layers(item: Prepared, cell: float, edges: Float64s, max_height: float | None) -> Layers:
    """Return the layers of a prepared map on half of `cell`."""
    half = 0.5 * cell
    origin, occupied, known = find_slabs(
        item.xyz, item.height, cell=half, slab_edges=edges, max_height=max_height
    )
    slabs = SlabGrid(origin, half, occupied, known, len(edges) - 1)
    return Layers(
        slabs,
        lambda: build_height_map(
            item.xyz, cell=half, slab_edges=edges, ground=item.ground, max_height=max_height,
            height=item.height,
        ),
    )  # fmt: skip


def choose_points(
    item: Prepared, cell: float, edges: Float64s, max_height: float | None, *,
    around: Float64s | None = None,
) -> Points:  # fmt: skip
    """Return the points of a prepared map below `max_height`, one mean per voxel.

    The voxel is a quarter cell or 0.1 m. around: (K, 3) take only what lies within three cells of
    the plan of these points, metres: a large base is not thinned as a whole.
    """
    xyz = item.xyz if max_height is None else rows_of(item.xyz, item.height < max_height)
    if around is not None:
        xyz = rows_of(xyz, _is_around(xyz, around, cell))
    voxel = min(0.25 * cell, 0.1)
    xyz = thin(sample(xyz, MOST_POINTS), voxel)
    height = item.ground.height_above(xyz)
    return Points(xyz, height, height > edges[0], voxel)


def _is_around(xyz: Float64s, around: Float64s, cell: float) -> Bools:
    low, high = bounds(around)
    return inside_box(xyz, (low - 3.0 * cell)[:2], (high + 3.0 * cell)[:2])
