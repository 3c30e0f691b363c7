"""Height slabs of a map as bits: per cell, which slabs are occupied and which are known.

Whole maps (`SlabGrid`), at coarser cells too, and the known cells alone (`Columns`), which turn
and are scattered onto another grid.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from commonmap.mapping.points import floor_int
from commonmap.matching.arrays import Array, Arrays
from commonmap.types import Bools, Float64s

Bits = NDArray[np.unsignedinteger[Any]]
Range = tuple[int, int]
"""From the first to behind the last."""


@dataclass(frozen=True, eq=False)
class SlabGrid:
    """Occupied and known height slabs per cell, one bit a slab (bit k is slab k, at most 32).

    origin: (2,) metres, the lower corner of cell [0, 0]. cell: metres.
    occupied, known: (nx, ny) uint32, or a narrower unsigned type that holds the slabs, also mapped
    from a file; an occupied slab is known.
    """

    origin: Float64s
    cell: float
    occupied: Bits
    known: Bits
    n_slabs: int

    @property
    def shape(self) -> tuple[int, int]:
        """Cells along x and y."""
        return self.occupied.shape[0], self.occupied.shape[1]


def pack_slabs(origin: Float64s, cell: float, occupied: Bools, known: Bools) -> SlabGrid:
    """Return the (n_slabs, nx, ny) bool layers packed one bit a slab."""
    n_slabs = occupied.shape[0]
    bits_occupied = np.zeros(occupied.shape[1:], np.uint32)
    bits_known = np.zeros(occupied.shape[1:], np.uint32)
    for k in range(n_slabs):
        bits_occupied |= occupied[k].astype(np.uint32) << np.uint32(k)
        bits_known |= known[k].astype(np.uint32) << np.uint32(k)
    bits_known |= bits_occupied
    return SlabGrid(np.asarray(origin, float), cell, bits_occupied, bits_known, n_slabs)


def mirror_grid(grid: SlabGrid) -> SlabGrid:
    """Return the grid reflected, x -> -x."""
    low = -(grid.origin[0] + grid.shape[0] * grid.cell)
    occupied, known = (np.ascontiguousarray(bits[::-1]) for bits in (grid.occupied, grid.known))
    return SlabGrid(np.array([low, grid.origin[1]]), grid.cell, occupied, known, grid.n_slabs)


def coarsen(grid: SlabGrid, factor: int) -> SlabGrid:
    """Return the grid with cells `factor` times as wide: occupied or known where any part was.

    The coarse cells are aligned to multiples of their own width.
    """
    if factor == 1:
        return grid
    n_x, n_y = coarse_shape(grid, factor)
    return coarse_window(grid, factor, (0, n_x), (0, n_y))


def coarse_window(grid: SlabGrid, factor: int, rows: Range, columns: Range) -> SlabGrid:
    """Return these cells of the coarse grid, uint32; what lies outside the grid is unknown.

    Only the part of `grid` below the window is read.
    """
    before = _cells_before(grid, factor)
    # rows and columns of `grid` that lie in the window
    (i0, i1), (j0, j1) = (
        (max(low * factor - skip, 0), min(high * factor - skip, n))
        for (low, high), skip, n in zip((rows, columns), before, grid.shape, strict=True)
    )
    first = (i0 + before[0] - rows[0] * factor, j0 + before[1] - columns[0] * factor)
    shape = (rows[1] - rows[0], columns[1] - columns[0])
    occupied, known = np.zeros(shape, np.uint32), np.zeros(shape, np.uint32)
    if i1 > i0 and j1 > j0:
        _join(np.asarray(grid.occupied[i0:i1, j0:j1]), factor, *first, occupied)
        _join(np.asarray(grid.known[i0:i1, j0:j1]), factor, *first, known)
    low = np.array([rows[0] * factor - before[0], columns[0] * factor - before[1]])
    origin = (_first_cell(grid) + low) * grid.cell
    return SlabGrid(origin, grid.cell * factor, occupied, known, grid.n_slabs)


def coarse_shape(grid: SlabGrid, factor: int) -> tuple[int, int]:
    """Return the cells along x and y of the whole coarse grid."""
    n_x, n_y = (
        -(-(n + skip) // factor)
        for n, skip in zip(grid.shape, _cells_before(grid, factor), strict=True)
    )
    return n_x, n_y


def coarse_origin(grid: SlabGrid, factor: int) -> Float64s:
    """Return the lower corner (2,) of the coarse grid's cell [0, 0], metres."""
    if factor == 1:
        return grid.origin
    return np.asarray((_first_cell(grid) - _cells_before(grid, factor)) * grid.cell)


def _first_cell(grid: SlabGrid) -> NDArray[np.int64]:
    """Return the index of cell [0, 0] on the plane's own cells, counted from x = y = 0."""
    return np.asarray(np.round(grid.origin / grid.cell), np.int64)


def _cells_before(grid: SlabGrid, factor: int) -> tuple[int, int]:
    """Return how many cells along x and y the first coarse cell holds before the grid begins."""
    x, y = _first_cell(grid) % factor
    return int(x), int(y)


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _join(bits, factor, first_i, first_j, out):  # type: ignore[no-untyped-def]
    """Lay the bits over coarse cells; bits[0, 0] is the fine cell (first_i, first_j) of `out`."""
    for i in range(bits.shape[0]):
        row = out[(i + first_i) // factor]
        j, k, end = 0, first_j // factor, factor - first_j % factor
        while j < bits.shape[1]:
            union = bits.dtype.type(0)
            for fine in range(j, min(end, bits.shape[1])):
                union |= bits[i, fine]
            row[k] |= union
            j, k, end = end, k + 1, end + factor


def is_shared(known: Bits, n_slabs: int) -> bool:
    """Return whether every cell is known in all slabs or in none."""
    full = known.dtype.type((1 << n_slabs) - 1)
    return bool(_is_all_or_nothing(np.ascontiguousarray(known).reshape(-1), full))


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _is_all_or_nothing(bits, full):  # type: ignore[no-untyped-def]
    between = 0
    for one in bits:
        between += one != 0 and one != full
    return between == 0


def find_standing(occupied: Bits, n_slabs: int) -> tuple[bool, ...]:
    """Return of each slab whether anything is occupied in it."""
    any_of = int(np.bitwise_or.reduce(occupied, axis=None))
    return tuple(bool(any_of >> k & 1) for k in range(n_slabs))


@dataclass(frozen=True, eq=False)
class Columns:
    """The known cells of a map as a list, to be turned and scattered onto another grid.

    xy: (N, 2) float64 metres, centres of the cells. occupied, known: (N,) uint32 slab bits.
    """

    xy: Float64s
    occupied: Bits
    known: Bits
    n_slabs: int


def list_columns(grid: SlabGrid) -> Columns:
    """Return the cells of `grid` that are known in any slab, in row order."""
    i, j = np.nonzero(grid.known)
    xy = grid.origin + (np.column_stack([i, j]) + 0.5) * grid.cell
    occupied, known = (b[i, j].astype(np.uint32) for b in (grid.occupied, grid.known))
    return Columns(xy, occupied, known, grid.n_slabs)


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def turned_cell(x, y, cosine, sine, cell, low):  # type: ignore[no-untyped-def]
    """Return the cell (i, j), on a grid with lower corner `low`, of a point that is turned."""
    i = floor_int((cosine * x - sine * y - low[0]) / cell)
    return i, floor_int((sine * x + cosine * y - low[1]) / cell)


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def scatter_turns(xy, occupied, known, cosines, sines, cell, low, n_x, n_y):  # type: ignore[no-untyped-def]
    """Return the bits (n_x, n_y, n_turns) of columns turned by some angles, as `scatter`."""
    n_turns = cosines.shape[0]
    out_occupied = np.zeros((n_x, n_y, n_turns), np.uint32)
    out_known = np.zeros((n_x, n_y, n_turns), np.uint32)
    for n in range(xy.shape[0]):
        for w in range(n_turns):
            i, j = turned_cell(xy[n, 0], xy[n, 1], cosines[w], sines[w], cell, low)
            if 0 <= i < n_x and 0 <= j < n_y:
                out_occupied[i, j, w] |= occupied[n]
                out_known[i, j, w] |= known[n]
    return out_occupied, out_known


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def scatter(xy, occupied, known, cosine, sine, cell, low, n_x, n_y):  # type: ignore[no-untyped-def]
    """Return the bits of columns turned by an angle, on a grid with lower corner `low`."""
    out_occupied, out_known = scatter_turns(
        xy, occupied, known, np.array([cosine]), np.array([sine]), cell, low, n_x, n_y
    )
    return out_occupied[:, :, 0], out_known[:, :, 0]


def unpack(arrays: Arrays, bits: Array, slab: int, dtype: Any) -> Array:
    """Return one slab of the bits as a layer of ones and zeros; bits and layer on the device."""
    one = bits.dtype.type(1)
    return ((bits >> bits.dtype.type(slab)) & one).astype(dtype)
