"""Height maps and height slabs: what a map says per cell of the ground plan, above its own ground.

Layers of the `GridMap` that `build_height_map` returns (nx, ny unless said):

    known          bool, the column was observed below `max_height`
    ground         float, z of the ground, metres; NaN where nothing was observed near
    height         float, height above ground of the highest point below `max_height`; NaN unknown
    lowest, highest  float, z of the lowest and highest point of the column; NaN unknown
    count          int32, points in the column
    slab_occupied  bool (n_slabs, nx, ny), a point lies in the slab
    slab_known     bool (n_slabs, nx, ny), the slab was observed: occupied, or seen through
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from commonmap.errors import EmptyMapError, InputError
from commonmap.mapping.ground import Ground, find_ground, typical_spacing
from commonmap.mapping.points import sample
from commonmap.types import Float64s, GridMap

NICE_CELLS = (0.05, 0.1, 0.2, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
"""Cell sizes to choose from, metres."""


def choose_cell(
    target_xyz: Float64s, source_xyz: Float64s, *, spacing: float | None = None
) -> float:
    """Return the cell size in metres for matching two clouds, from their density and extent.

    A cell should be hit by about ten points in the sparser map, and no finer than the shape of
    the source can be trusted over its extent (an odometry drifts about 1 % of the way).
    spacing: of the sparser map's points, metres, where the caller has it already.
    """
    if spacing is None:
        spacing = max(typical_spacing(target_xyz), typical_spacing(source_xyz))
    extent = min(robust_extent(target_xyz), robust_extent(source_xyz))
    wish = max(3.0 * spacing, extent / 120.0)
    fitting = [c for c in NICE_CELLS if c >= wish * 0.999]
    return max(0.2, fitting[0]) if fitting else float(np.ceil(wish))


def robust_extent(xyz: Float64s) -> float:
    """Return the wider side in metres of the box that holds the middle 98 % of the points."""
    low, high = np.quantile(sample(xyz, 50_000)[:, :2], [0.01, 0.99], axis=0)
    return float((high - low).max())


def choose_slabs(heights: Float64s, *, cell: float, max_height: float | None = None) -> Float64s:
    """Return the edges (K+1,) in metres of the height slabs above ground.

    Under a `max_height` of up to 2 m the slabs are even, five to a map; else they double in
    thickness from 0.25 m to the height that one point in a hundred exceeds, as both the detail of
    things and the accuracy of their height do.
    """
    lowest = 0.25 if max_height is None or max_height > 1.0 else 0.2 * max_height
    if max_height is not None and max_height <= 2.0:
        return np.linspace(lowest, max_height, 5)
    few = sample(heights, 100_000)
    above = few[few > lowest]
    top = float(np.quantile(above, 0.99)) if len(above) else 1.0
    if max_height is not None:
        top = min(top, max_height)
    edges = [lowest]
    while edges[-1] < top and len(edges) < 12:
        edges.append(2.0 * edges[-1])
    if len(edges) < 3:
        edges = [lowest, 2 * lowest, 4 * lowest]
    if max_height is not None:
        edges = [e for e in edges if e < 0.75 * max_height] + [max_height]
    return np.array(edges)


def build_height_map(
    xyz: Float64s,
    *,
    cell: float,
    slab_edges: Float64s,
    ground: Ground | None = None,
    max_height: float | None = None,
    height: Float64s | None = None,
) -> GridMap:
    """Return the height map of an (N, 3) cloud that is level, with layers named above.

    cell: metres. slab_edges: (K+1,) rising heights above ground, at most 32 slabs.
    ground: by default found from the cloud. max_height: use only what is less than this above
    ground (1 m is the paper's set-up). Points more than 1 m under the ground are left out.
    height: (N,) of the points above that ground, where the caller has it already.
    Raises EmptyMapError when nothing is left.
    """
    ground = ground or find_ground(xyz)
    if height is None:
        height = ground.height_above(xyz)
    limit = np.inf if max_height is None else max_height
    origin, (n_x, n_y) = _find_columns(xyz, height, limit, cell, slab_edges)
    count, top, lowest, highest, bits = _fill_columns(
        np.ascontiguousarray(xyz), height, limit, origin, cell, n_x, n_y,
        np.asarray(slab_edges, np.float64),
    )  # fmt: skip
    known = count > 0
    slabs = np.arange(len(slab_edges) - 1, dtype=np.uint32)[:, None, None]
    occupied = ((bits >> slabs) & 1).astype(bool)
    i, j = np.meshgrid(np.arange(n_x), np.arange(n_y), indexing="ij")
    centres = origin + (np.column_stack([i.ravel(), j.ravel()]) + 0.5) * cell
    layers: dict[str, NDArray[Any]] = {
        "known": known,
        "ground": np.where(known, ground.height_at(centres).reshape(n_x, n_y), np.nan),
        "height": np.where(known, np.maximum(top, 0.0), np.nan),
        "lowest": lowest,
        "highest": highest,
        "count": count,
        "slab_occupied": occupied,
        "slab_known": np.broadcast_to(known, occupied.shape),
    }
    return GridMap(origin=origin, cell=cell, layers=layers, slab_edges=np.asarray(slab_edges))


def find_slabs(
    xyz: Float64s, height: Float64s, *, cell: float, slab_edges: Float64s,
    max_height: float | None = None,
) -> tuple[Float64s, NDArray[np.uint32], NDArray[np.uint32]]:  # fmt: skip
    """Return origin (2,), and occupied and known slabs, one bit each, (nx, ny), of a height map.

    What `build_height_map` says of slabs, and nothing else, in half of the time. height: (N,) of
    the (N, 3) points above ground; the rest as there.
    """
    limit = np.inf if max_height is None else max_height
    origin, (n_x, n_y) = _find_columns(xyz, height, limit, cell, slab_edges)
    occupied, known = _fill_slabs(
        np.ascontiguousarray(xyz), height, limit, origin, cell, n_x, n_y,
        np.asarray(slab_edges, np.float64),
    )  # fmt: skip
    return origin, occupied, known


def _find_columns(
    xyz: Float64s, height: Float64s, limit: float, cell: float, slab_edges: Float64s
) -> tuple[Float64s, tuple[int, int]]:
    """Return the grid's origin (2,) and shape over the used points, of which there must be some."""
    if not (np.isfinite(cell) and cell > 0):
        raise InputError(
            f"the cell of a height map must be a positive length in metres; {cell} came"
        )
    if len(slab_edges) < 2 or len(slab_edges) > 33 or not np.all(np.diff(slab_edges) > 0):
        raise InputError("slab_edges must be 2 to 33 rising heights in metres")
    low, high = _used_bounds(np.ascontiguousarray(xyz), height, limit)
    if not np.isfinite(low).all():
        raise EmptyMapError(
            f"no point lies between 1 m below the ground and {limit:g} m above it; nothing to match"
        )
    origin = np.floor(low / cell) * cell
    n_x, n_y = np.floor((high - origin) / cell).astype(int) + 1
    return origin, (int(n_x), int(n_y))


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _used_bounds(xyz, height, limit):  # type: ignore[no-untyped-def]
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for n in range(xyz.shape[0]):
        if -1.0 < height[n] < limit:
            for a in range(2):
                low[a] = min(low[a], xyz[n, a])
                high[a] = max(high[a], xyz[n, a])
    return low, high


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _slab_bit(height, edges):  # type: ignore[no-untyped-def]
    """Return the bit of the slab that a height lies in, zero where it lies in none."""
    if not edges[0] <= height < edges[-1]:
        return np.uint32(0)
    k = 0
    while height >= edges[k + 1]:
        k += 1
    return np.uint32(1) << np.uint32(k)


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _fill_columns(xyz, height, limit, origin, cell, n_x, n_y, edges):  # type: ignore[no-untyped-def]
    count = np.zeros((n_x, n_y), np.int32)
    top = np.full((n_x, n_y), np.nan)
    lowest = np.full((n_x, n_y), np.nan)
    highest = np.full((n_x, n_y), np.nan)
    bits = np.zeros((n_x, n_y), np.uint32)
    for n in range(xyz.shape[0]):
        if not -1.0 < height[n] < limit:
            continue
        i = min(int((xyz[n, 0] - origin[0]) / cell), n_x - 1)
        j = min(int((xyz[n, 1] - origin[1]) / cell), n_y - 1)
        count[i, j] += 1
        if not top[i, j] >= height[n]:
            top[i, j] = height[n]
        if not lowest[i, j] <= xyz[n, 2]:
            lowest[i, j] = xyz[n, 2]
        if not highest[i, j] >= xyz[n, 2]:
            highest[i, j] = xyz[n, 2]
        bits[i, j] |= _slab_bit(height[n], edges)
    return count, top, lowest, highest, bits


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _fill_slabs(xyz, height, limit, origin, cell, n_x, n_y, edges):  # type: ignore[no-untyped-def]
    """Return the occupied and the known slabs of every column, as `_fill_columns` finds them."""
    occupied, known = np.zeros((n_x, n_y), np.uint32), np.zeros((n_x, n_y), np.uint32)
    full = np.uint32((1 << (edges.shape[0] - 1)) - 1)
    for n in range(xyz.shape[0]):
        h = height[n]
        if not -1.0 < h < limit:
            continue
        i = min(int((xyz[n, 0] - origin[0]) / cell), n_x - 1)
        j = min(int((xyz[n, 1] - origin[1]) / cell), n_y - 1)
        known[i, j] = full
        occupied[i, j] |= _slab_bit(h, edges)
    return occupied, known
