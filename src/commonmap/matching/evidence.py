"""Evidence that two maps saw the same place: signed n * MI summed over height slabs.

Per slab a cell that both maps know is occupied or not in each of them. At a pose the 2x2 table
n11, n10, n01, n00 of these pairs gives the log-likelihood ratio of "dependent" against
"independent", `G / 2 = n * MI` in nats (Wilks 1935), here negative where the association is. All
translations of one yaw come exactly from cross-correlations of the binary layers:

    n = known_s * known_t    n_1 = occupied_s * known_t    n_2 = known_s * occupied_t
    n11 = occupied_s * occupied_t
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from commonmap.types import Bools, Float32s, Float64s

Bits = NDArray[np.uint32]


@dataclass(frozen=True, eq=False)
class SlabGrid:
    """Occupied and known height slabs per cell, one bit a slab (bit k is slab k, at most 32).

    origin: (2,) metres, the lower corner of cell [0, 0]. cell: metres.
    occupied, known: (nx, ny) uint32; an occupied slab is known.
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
    weight = (np.uint32(1) << np.arange(n_slabs, dtype=np.uint32))[:, None, None]
    bits_known = np.bitwise_or.reduce(np.where(known | occupied, weight, np.uint32(0)), axis=0)
    bits_occupied = np.bitwise_or.reduce(np.where(occupied, weight, np.uint32(0)), axis=0)
    return SlabGrid(np.asarray(origin, float), cell, bits_occupied, bits_known, n_slabs)


def coarsen(grid: SlabGrid, factor: int) -> SlabGrid:
    """Return the grid with cells `factor` times as wide: occupied or known where any part was.

    The coarse cells are aligned to multiples of their own width.
    """
    if factor == 1:
        return grid
    start = np.round(grid.origin / grid.cell).astype(np.int64)
    before = start % factor
    pad = [(int(b), int(-(b + n) % factor)) for b, n in zip(before, grid.shape, strict=True)]

    def reduce(bits: Bits) -> Bits:
        full = np.pad(bits, pad)
        blocks = full.reshape(full.shape[0] // factor, factor, full.shape[1] // factor, factor)
        return np.asarray(np.bitwise_or.reduce(np.bitwise_or.reduce(blocks, axis=3), axis=1))

    origin = (start - before).astype(np.float64) * grid.cell
    return SlabGrid(
        origin, grid.cell * factor, reduce(grid.occupied), reduce(grid.known), grid.n_slabs
    )


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
    return Columns(xy, grid.occupied[i, j], grid.known[i, j], grid.n_slabs)


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def scatter(xy, occupied, known, cosine, sine, cell, low, n_x, n_y):  # type: ignore[no-untyped-def]
    """Return the bits of columns turned by an angle, on a grid with lower corner `low`."""
    out_occupied = np.zeros((n_x, n_y), np.uint32)
    out_known = np.zeros((n_x, n_y), np.uint32)
    for n in range(xy.shape[0]):
        i = int(np.floor((cosine * xy[n, 0] - sine * xy[n, 1] - low[0]) / cell))
        j = int(np.floor((sine * xy[n, 0] + cosine * xy[n, 1] - low[1]) / cell))
        if 0 <= i < n_x and 0 <= j < n_y:
            out_occupied[i, j] |= occupied[n]
            out_known[i, j] |= known[n]
    return out_occupied, out_known


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def unpack(bits, slabs, height, width):  # type: ignore[no-untyped-def]
    """Return (len(slabs), height, width) float32 layers of the bits, zero-padded."""
    out = np.zeros((slabs.shape[0], height, width), np.float32)
    for k in range(slabs.shape[0]):
        for i in range(bits.shape[0]):
            for j in range(bits.shape[1]):
                if (bits[i, j] >> slabs[k]) & 1:
                    out[k, i, j] = 1.0
    return out


@dataclass(frozen=True, eq=False)
class Spectra:
    """Forward transforms of one target: occupied and known layers, and the padded size."""

    occupied: NDArray[Any]
    known: NDArray[Any]
    shape: tuple[int, int]
    fft_shape: tuple[int, int]
    shared_known: bool


def transform_target(grid: SlabGrid, source_shape: tuple[int, int], *, workers: int) -> Spectra:
    """Return the target's spectra, padded so that no shift of such a source wraps round."""
    size = [
        fft.next_fast_len(t + s - 1, real=True)
        for t, s in zip(grid.shape, source_shape, strict=True)
    ]
    slabs = np.arange(grid.n_slabs, dtype=np.uint32)
    shared = _is_shared(grid.known, grid.n_slabs)
    occupied = unpack(grid.occupied, slabs, *size)
    known = unpack(grid.known, slabs[:1] if shared else slabs, *size)
    return Spectra(
        fft.rfft2(occupied, workers=workers),
        fft.rfft2(known, workers=workers),
        grid.shape,
        (size[0], size[1]),
        shared,
    )


def _is_shared(known: Bits, n_slabs: int) -> bool:
    full = np.uint32((1 << n_slabs) - 1)
    return bool(np.all((known == 0) | (known == full)))


def evidence_surface(
    target: Spectra, occupied: Bits, known: Bits, *, min_overlap: float, workers: int
) -> tuple[Float32s, Float32s]:
    """Return (evidence, overlap) at every translation of one turned source.

    occupied, known: (sx, sy) slab bits of the source. Element [u, v] of the answers, of shape
    (tx + sx - 1, ty + sy - 1), belongs to source cell [i, j] on target cell
    [i + u - (sx - 1), j + v - (sy - 1)]. Poses with fewer than `min_overlap` known pairs in the
    best known slab score -inf. overlap: known pairs, the largest over the slabs.
    """
    n_slabs = target.occupied.shape[0]
    slabs = np.arange(n_slabs, dtype=np.uint32)
    shared = target.shared_known and _is_shared(known, n_slabs)
    size = target.fft_shape
    s_occupied = fft.rfft2(unpack(occupied, slabs, *size), workers=workers)
    s_known = fft.rfft2(unpack(known, slabs[:1] if shared else slabs, *size), workers=workers)
    t_known = target.known if not shared else target.known[:1]
    np.conjugate(s_occupied, out=s_occupied)
    np.conjugate(s_known, out=s_known)

    def correlate(a: NDArray[Any], b: NDArray[Any]) -> Float32s:
        return np.asarray(fft.irfft2(a * b, s=size, workers=workers), dtype=np.float32)

    pairs = correlate(s_known, t_known)
    source_side = correlate(s_occupied, t_known)
    target_side = correlate(s_known, target.occupied)
    both = correlate(s_occupied, target.occupied)
    n_u, n_v = (t + s - 1 for t, s in zip(target.shape, occupied.shape, strict=True))
    score, overlap = _evidence_from_counts(
        pairs, source_side, target_side, both, occupied.shape[0], occupied.shape[1],
        n_u, n_v, float(min_overlap), xlogx_table(int(np.count_nonzero(known)) + 1),
    )  # fmt: skip
    return score, overlap


def xlogx_table(n_max: int) -> Float64s:
    """Return n ln n for n = 0 .. n_max; the counts of a table are whole numbers, so it is exact."""
    n = np.arange(n_max + 1, dtype=np.float64)
    n[1:] *= np.log(n[1:])
    return n


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def signed_evidence(n, r, c, n11, xlogx):  # type: ignore[no-untyped-def]
    """Return signed n * MI (nats) of a 2x2 table: n pairs, r and c its two margins, n11 both."""
    if r <= 0 or c <= 0 or r >= n or c >= n:
        return 0.0
    n10, n01 = r - n11, c - n11
    n00 = n - r - n01
    g = xlogx[n] - xlogx[r] - xlogx[n - r] - xlogx[c] - xlogx[n - c]
    g += xlogx[n11] + xlogx[n10] + xlogx[n01] + xlogx[n00]
    return g if n11 * n > r * c else -g


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _evidence_from_counts(  # type: ignore[no-untyped-def]
    pairs, source_side, target_side, both, sx, sy, n_u, n_v, min_overlap, xlogx
):
    """Sum the evidence over slabs; index [u, v] is shift u - (sx - 1), v - (sy - 1), wrapped."""
    height, width = both.shape[1], both.shape[2]
    score = np.full((n_u, n_v), -np.inf, np.float32)
    overlap = np.zeros((n_u, n_v), np.float32)
    for u in range(n_u):
        i = (u - (sx - 1)) % height
        for v in range(n_v):
            j = (v - (sy - 1)) % width
            best = 0
            for k in range(pairs.shape[0]):
                best = max(best, int(pairs[k, i, j] + 0.5))
            overlap[u, v] = best
            if best < min_overlap:
                continue
            total = 0.0
            for k in range(both.shape[0]):
                n = int(pairs[k if pairs.shape[0] > 1 else 0, i, j] + 0.5)
                r = int(source_side[k, i, j] + 0.5)
                c = int(target_side[k, i, j] + 0.5)
                n11 = max(int(both[k, i, j] + 0.5), r + c - n, 0)
                total += signed_evidence(n, r, c, min(n11, r, c), xlogx)
            score[u, v] = total
    return score, overlap


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def count_tables(t_occupied, t_known, origin, cell, xy, s_occupied, s_known, n_slabs, poses):  # type: ignore[no-untyped-def]
    """Return the (n_poses, n_slabs, 4) tables n, n_1, n_2, n11 of columns at planar poses.

    poses: (P, 3) x, y, yaw of the source in the frame of the target grid. The turned and shifted
    columns are gathered into the target's cells first, just as `scatter` does: at a shift of whole
    cells this is what the FFT counts, and elsewhere what it would count on a shifted grid.
    """
    out = np.zeros((poses.shape[0], n_slabs, 4), np.int64)
    n_x, n_y = t_occupied.shape
    reach = 0.0
    for n in range(xy.shape[0]):
        reach = max(reach, xy[n, 0] ** 2 + xy[n, 1] ** 2)
    side = 2 * int(np.ceil(np.sqrt(reach) / cell)) + 3
    occupied = np.empty((side, side), np.uint32)
    known = np.empty((side, side), np.uint32)
    for p in range(poses.shape[0]):
        cosine, sine = np.cos(poses[p, 2]), np.sin(poses[p, 2])
        i0 = int(np.floor((poses[p, 0] - origin[0]) / cell)) - side // 2
        j0 = int(np.floor((poses[p, 1] - origin[1]) / cell)) - side // 2
        occupied[:] = 0
        known[:] = 0
        dx, dy = poses[p, 0] - origin[0], poses[p, 1] - origin[1]
        for n in range(xy.shape[0]):
            i = int(np.floor((cosine * xy[n, 0] - sine * xy[n, 1] + dx) / cell))
            j = int(np.floor((sine * xy[n, 0] + cosine * xy[n, 1] + dy) / cell))
            if 0 <= i < n_x and 0 <= j < n_y:
                occupied[i - i0, j - j0] |= s_occupied[n]
                known[i - i0, j - j0] |= s_known[n]
        for a in range(max(0, -i0), min(side, n_x - i0)):
            for b in range(max(0, -j0), min(side, n_y - j0)):
                both = known[a, b] & t_known[a + i0, b + j0]
                if both == 0:
                    continue
                mine, other = occupied[a, b] & both, t_occupied[a + i0, b + j0] & both
                for k in range(n_slabs):
                    if (both >> k) & 1:
                        m, o = (mine >> k) & 1, (other >> k) & 1
                        out[p, k, 0] += 1
                        out[p, k, 1] += m
                        out[p, k, 2] += o
                        out[p, k, 3] += m & o
    return out
