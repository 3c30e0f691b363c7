"""From an octree to the columns of a 2D grid: what stands there, and what was seen to be free.

A grid of heights is made from points elsewhere; an octree knows more: free space, and the unknown
under a canopy. All layers come straight from the leaves, coarse ones included, without expanding.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from commonmap.errors import InputError
from commonmap.types import KEY_ORIGIN, Float32s, Float64s, GridMap, Leaves


def octree_columns(
    leaves: Leaves,
    origin: ArrayLike,
    cell: float,
    shape: tuple[int, int],
    *,
    ground: ArrayLike | None = None,
    slab_edges: ArrayLike | None = None,
    known_share: float = 0.5,
) -> GridMap:
    """Return layers over the columns of a grid, from the leaves of an octree in the same frame.

    origin: (2,) metres, lower corner of cell [0, 0]; cell: metres; shape: cells along x and y.

    Layers (nx, ny) float32, metres, NaN where there is none: `lowest`, the lower face of the lowest
    occupied leaf; `highest`, the upper face of the highest; `lowest_free` and `highest_free`, the
    same of free leaves.

    With ground (nx, ny), metres, NaN where unknown, and slab_edges (S + 1,), rising, metres above
    that ground, further layers (S, nx, ny): `occupied` bool, an occupied leaf lies in the slab of
    the column; `free_share` and `known_share` float32, the share of its volume that is free, and
    that is free or occupied; `free` bool, not occupied and at least `known_share` of it free.

    An occupied voxel counts in the cell and the slab that hold its centre, and in those whose
    centre it covers: grid and voxels need not line up, and none is lost or counted where it hardly
    reaches. A coarse leaf counts as its voxels would.
    """
    corner = np.asarray(origin, dtype=np.float64)
    nx, ny = int(shape[0]), int(shape[1])
    if corner.shape != (2,) or not np.isfinite(corner).all():
        raise InputError(f"origin must be x and y of a grid corner in metres; {origin!r} came")
    if not (np.isfinite(cell) and cell > 0) or nx < 1 or ny < 1:
        raise InputError(f"a grid needs cells above 0 m and a shape above 0; {cell}, {shape} came")
    if (ground is None) != (slab_edges is None):
        raise InputError("ground and slab_edges belong together; only one of them came")
    low, high = _boxes(leaves)
    spans = np.full((4, nx, ny), np.nan, np.float32)
    half = 0.5 * leaves.resolution
    _spans(low, high, half, leaves.occupied, corner, float(cell), spans)
    names = ("lowest", "highest", "lowest_free", "highest_free")
    layers: dict[str, NDArray[np.generic]] = dict(zip(names, spans, strict=True))
    if ground is None or slab_edges is None:
        return GridMap(corner, float(cell), layers)
    base, edges = np.asarray(ground, dtype=np.float64), np.asarray(slab_edges, dtype=np.float64)
    if base.shape != (nx, ny):
        raise InputError(f"ground must have the shape {(nx, ny)} of the grid; {base.shape} came")
    if edges.ndim != 1 or len(edges) < 2 or not (np.diff(edges) > 0).all():
        raise InputError(f"slab_edges must be two or more rising heights; {edges.tolist()} came")
    n_slabs = len(edges) - 1
    occupied = np.zeros((n_slabs, nx, ny), np.bool_)
    volume = np.zeros((2, n_slabs, nx, ny), np.float32)
    _slabs(low, high, half, leaves.occupied, corner, float(cell), base, edges, occupied, volume)
    volume /= np.float32(cell) ** 2 * np.diff(edges).astype(np.float32)[:, None, None]
    layers["occupied"] = occupied
    layers["free_share"] = volume[0]
    layers["known_share"] = volume[0] + volume[1]
    layers["free"] = ~occupied & (volume[0] >= known_share - 1e-6)
    return GridMap(corner, float(cell), layers, slab_edges=edges)


def free_heights(columns: GridMap) -> Float32s:
    """Return up to which height above ground (nx, ny) columns were seen free, NaN for not at all.

    columns: of `octree_columns` with slabs. Free slabs are followed upwards without a gap from the
    lowest one; where something stands in that one, which may be the ground, from the next. What
    lies above is occupied or was not seen: under a canopy this is the height of the crown.
    """
    if columns.slab_edges is None:
        raise InputError("free heights need slabs; these columns were made without slab_edges")
    free, occupied = columns["free"], columns["occupied"]
    height = np.full(free.shape[1:], np.nan, np.float32)
    open_below = np.ones(free.shape[1:], np.bool_)
    for slab, top in enumerate(columns.slab_edges[1:]):
        open_here = open_below & free[slab]
        height[open_here] = top
        open_below = open_here | (occupied[slab] if slab == 0 else False)
    return height


def octree_grid(leaves: Leaves, cell: float) -> tuple[Float64s, tuple[int, int]]:
    """Return origin (2,) and shape of the grid on multiples of `cell` that holds all leaves."""
    low, high = _boxes(leaves)
    if len(low) == 0:
        raise InputError("an octree without leaves has no extent")
    first = np.floor(low[:, :2].min(axis=0) / cell + 1e-6)
    last = np.ceil(high[:, :2].max(axis=0) / cell - 1e-6)
    nx, ny = np.maximum(last - first, 1).astype(int)
    return first * cell, (int(nx), int(ny))


def _boxes(leaves: Leaves) -> tuple[Float64s, Float64s]:
    """Return the lower and the upper corners (N, 3) of leaves, metres."""
    low = (leaves.keys.astype(np.float64) - KEY_ORIGIN) * leaves.resolution
    return low, low + leaves.sizes()[:, None]


@numba.njit(cache=True, inline="always")  # type: ignore[misc]
def _cells_of(low, high, half, origin, cell, n):  # type: ignore[no-untyped-def]
    """Return first and last + 1 cell that hold the centre of a voxel of the leaf, or whose own
    centre the leaf covers. half: half of the edge of a voxel."""
    first = np.int64(np.ceil((low - origin) / cell - 0.5 - 1e-6))
    last = np.int64(np.ceil((high - origin) / cell - 0.5 - 1e-6))
    first = min(first, np.int64(np.floor((low + half - origin) / cell + 1e-6)))
    last = max(last, np.int64(np.floor((high - half - origin) / cell + 1e-6)) + 1)
    return max(first, 0), min(last, n)


@numba.njit(cache=True, inline="always")  # type: ignore[misc]
def _in_slab(bottom, top, half, start, end):  # type: ignore[no-untyped-def]
    """Tell whether a slab holds the centre of a voxel of the leaf or has its own in the leaf."""
    step = max(np.ceil((start - bottom - half) / (2.0 * half) - 1e-6), 0.0)
    centre = bottom + half + 2.0 * half * step
    if centre < top and centre < end - 1e-6 * half:
        return True
    middle = 0.5 * (start + end)
    return bottom <= middle and middle < top


@numba.njit(cache=True, inline="always")  # type: ignore[misc]
def _cells_met(low, high, origin, cell, n):  # type: ignore[no-untyped-def]
    """Return first and last + 1 cell that a leaf overlaps."""
    first = np.int64(np.floor((low - origin) / cell + 1e-6))
    last = np.int64(np.ceil((high - origin) / cell - 1e-6))
    return max(first, 0), min(last, n)


@numba.njit(cache=True)  # type: ignore[misc]
def _spans(low, high, half, occupied, origin, cell, spans):  # type: ignore[no-untyped-def]
    nx, ny = spans.shape[1], spans.shape[2]
    for n in range(low.shape[0]):
        i0, i1 = _cells_of(low[n, 0], high[n, 0], half, origin[0], cell, nx)
        j0, j1 = _cells_of(low[n, 1], high[n, 1], half, origin[1], cell, ny)
        layer = 0 if occupied[n] else 2
        for i in range(i0, i1):
            for j in range(j0, j1):
                if not spans[layer, i, j] <= low[n, 2]:
                    spans[layer, i, j] = low[n, 2]
                if not spans[layer + 1, i, j] >= high[n, 2]:
                    spans[layer + 1, i, j] = high[n, 2]


@numba.njit(cache=True, inline="always")  # type: ignore[misc]
def _overlap(low, high, start, end):  # type: ignore[no-untyped-def]
    return max(min(high, end) - max(low, start), 0.0)


@numba.njit(cache=True)  # type: ignore[misc]
def _slabs(  # type: ignore[no-untyped-def]
    low, high, half, occupied, origin, cell, ground, edges, any_occupied, volume
):
    nx, ny = ground.shape
    n_slabs = edges.shape[0] - 1
    for n in range(low.shape[0]):
        i0, i1 = _cells_met(low[n, 0], high[n, 0], origin[0], cell, nx)
        j0, j1 = _cells_met(low[n, 1], high[n, 1], origin[1], cell, ny)
        ci0, ci1 = _cells_of(low[n, 0], high[n, 0], half, origin[0], cell, nx)
        cj0, cj1 = _cells_of(low[n, 1], high[n, 1], half, origin[1], cell, ny)
        layer = 1 if occupied[n] else 0
        for i in range(i0, i1):
            x0 = origin[0] + i * cell
            dx = _overlap(low[n, 0], high[n, 0], x0, x0 + cell)
            for j in range(j0, j1):
                if ground[i, j] != ground[i, j]:
                    continue
                y0 = origin[1] + j * cell
                area = dx * _overlap(low[n, 1], high[n, 1], y0, y0 + cell)
                counts = occupied[n] and ci0 <= i < ci1 and cj0 <= j < cj1
                bottom, top = low[n, 2] - ground[i, j], high[n, 2] - ground[i, j]
                s = np.searchsorted(edges, bottom, side="right") - 1
                for slab in range(max(s, 0), n_slabs):
                    if edges[slab] >= top:
                        break
                    volume[layer, slab, i, j] += area * _overlap(
                        bottom, top, edges[slab], edges[slab + 1]
                    )
                    if counts and _in_slab(bottom, top, half, edges[slab], edges[slab + 1]):
                        any_occupied[slab, i, j] = True
