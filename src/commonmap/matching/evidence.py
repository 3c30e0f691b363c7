"""Evidence that two maps saw the same place: n * MI over height slabs, weighed by what it explains.

Per slab a cell that both maps know is occupied or not in each of them. At a pose the 2x2 table
n11, n10, n01, n00 of these pairs gives the log-likelihood ratio of "dependent" against
"independent", `G / 2 = n * MI` in nats (Wilks 1935), here negative where the association is. Its
sum over the slabs, E, grows with the overlap wherever two places are built alike: halls that lie
along each other on a whole map beat a small overlap that agrees in every wall. So E is weighed by
the share of the source's uncertainty over the overlap, H = n H(source) in nats, that it takes away
(Theil's coefficient U = MI / H, 1972), with `DOUBT` added to H: of a few cells a large share is
explained by luck. The score is `E |E| / (H + DOUBT)`, nats too.

All translations of one yaw come exactly from cross-correlations of the binary layers:

    n = known_s * known_t    n_1 = occupied_s * known_t    n_2 = known_s * occupied_t
    n11 = occupied_s * occupied_t

The transforms run on NumPy or, where the target was transformed on it, on CuPy.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from commonmap.matching.arrays import NUMPY, Array, Arrays, borrow, invert, transform
from commonmap.matching.slabs import Bits, Range, SlabGrid, unpack
from commonmap.metrics.formulas import DOUBT
from commonmap.types import Float32s, Float64s


@dataclass(frozen=True, eq=False)
class Spectra:
    """Forward transforms of one target, and the translations that they serve.

    occupied: (n_slabs, Nx, Ny // 2 + 1), known: the same, or (1, ...) where all slabs share it.
    rows, columns: the translations [u, v] that are told. standing: of each slab, whether anything
    is occupied in it.
    """

    occupied: Array
    known: Array
    source_shape: tuple[int, int]
    rows: Range
    columns: Range
    fft_shape: tuple[int, int]
    shared_known: bool
    standing: tuple[bool, ...]
    arrays: Arrays
    dtype: Any


def transform_target(
    grid: SlabGrid,
    source_shape: tuple[int, int],
    *,
    rows: Range | None = None,
    columns: Range | None = None,
    n_source: int | None = None,
    arrays: Arrays = NUMPY,
    workers: int = 1,
) -> Spectra:
    """Return the target's spectra, padded so that no translation asked for wraps round.

    rows, columns: the translations [u, v] of `evidence_surface` to tell, by default all of them.
    n_source: known cells of the source at most. The transforms are in single precision where it
    restores whole numbers, else in double.
    """
    ranges = tuple(
        (0, t + s - 1) if some is None else some
        for some, t, s in zip((rows, columns), grid.shape, source_shape, strict=True)
    )
    n_x, n_y = (
        fft.next_fast_len(max(t, s, high, t + s - 1 - low), real=axis == 1)
        for axis, ((low, high), t, s) in enumerate(
            zip(ranges, grid.shape, source_shape, strict=True)
        )
    )
    shared = is_shared(grid.known, grid.n_slabs)
    n_source = source_shape[0] * source_shape[1] if n_source is None else n_source
    single = rounding((n_x, n_y), int(np.count_nonzero(grid.known)), n_source) < 0.5
    dtype = np.float32 if single else np.float64

    def spectra(bits: Bits, n_layers: int) -> Array:
        placed = arrays.xp.asarray(bits)
        shape = (n_layers, n_x, n_y // 2 + 1)
        out = arrays.xp.empty(shape, np.result_type(dtype, np.complex64))
        for k in range(n_layers):
            layer = unpack(arrays, placed, k, dtype)[None]
            out[k] = transform(arrays, layer, (n_x, n_y), workers)[0]
        return out

    return Spectra(
        spectra(grid.occupied, grid.n_slabs),
        spectra(grid.known, 1 if shared else grid.n_slabs),
        source_shape,
        ranges[0],
        ranges[1],
        (n_x, n_y),
        shared,
        _standing(grid.occupied, grid.n_slabs),
        arrays,
        dtype,
    )


def rounding(shape: tuple[int, int], n_target: int, n_source: int) -> float:
    """Return how far counts of single precision may be off, cells.

    eps / 2 per level of the transform, on the product of the layers' norms. Below 0.5, rounding
    restores the counts; what was measured on dense layers was a seventh of this at most.
    """
    eps = float(np.finfo(np.float32).eps)
    return 0.5 * eps * float(np.log2(shape[0] * shape[1])) * float(np.sqrt(n_target * n_source))


def is_shared(known: Bits, n_slabs: int) -> bool:
    """Return whether every cell is known in all slabs or in none."""
    full = np.uint32((1 << n_slabs) - 1)
    return bool(np.all((known == 0) | (known == full)))


def _standing(occupied: Bits, n_slabs: int) -> tuple[bool, ...]:
    """Return of each slab whether anything is occupied in it."""
    any_of = int(np.bitwise_or.reduce(occupied, axis=None))
    return tuple(bool(any_of >> k & 1) for k in range(n_slabs))


def evidence_surface(
    target: Spectra, occupied: Bits, known: Bits, *, min_overlap: float, workers: int
) -> tuple[Float32s, Float32s]:
    """Return (score, overlap) at every translation of one turned source.

    occupied, known: (sx, sy) slab bits of the source. Of all translations, (tx + sx - 1,
    ty + sy - 1), the answers hold those of `target.rows` and `target.columns`. Translation [u, v]
    lays source cell [i, j] on target cell [i + u - (sx - 1), j + v - (sy - 1)]. Poses with
    fewer than `min_overlap` known pairs in the best known slab score -inf. overlap: known
    pairs, the largest over the slabs. The answers are the same to the bit for any padding, any
    number of workers and any array module: what the transforms count are whole numbers.
    """
    arrays, n_slabs = target.arrays, len(target.standing)
    shared = target.shared_known and is_shared(known, n_slabs)
    standing = _standing(occupied, n_slabs)
    # turned round, a product of spectra is a cross-correlation
    bits_occupied = arrays.xp.asarray(np.ascontiguousarray(occupied[::-1, ::-1]))
    bits_known = arrays.xp.asarray(np.ascontiguousarray(known[::-1, ::-1]))
    region = slice(*target.rows), slice(*target.columns)

    def forward(bits: Array, k: int, role: str) -> Array:
        layer = unpack(arrays, bits, k, target.dtype)[None]
        return transform(arrays, layer, target.fft_shape, workers, role)

    def correlate(a: Array, b: Array, role: str) -> Array:
        out = borrow(arrays, "evidence product", a.shape, a.dtype)
        product = arrays.xp.multiply(a, b[None], out=out)
        return invert(arrays, product, target.fft_shape, workers, role)[0][region]

    shape = tuple(high - low for low, high in (target.rows, target.columns))
    total, doubt = arrays.xp.zeros(shape, np.float64), arrays.xp.zeros(shape, np.float64)
    overlap = arrays.xp.zeros(shape, np.float32)
    table = arrays.xp.asarray(xlogx_table(int(np.count_nonzero(known)) + 1))

    def add(pairs: Array, mine: Array, other: Array, both: Array) -> None:
        if arrays.name == "numpy":
            _add_evidence(pairs, mine, other, both, table, total, doubt)
        else:
            _add_evidence_on_device(arrays.xp, pairs, mine, other, both, table, total, doubt)

    for k in range(n_slabs):
        t_known = target.known[min(k, target.known.shape[0] - 1)]
        if k == 0 or not shared:
            s_known = forward(bits_known, k, "evidence known")
            pairs = correlate(s_known, t_known, "evidence pairs")
            overlap = arrays.xp.maximum(overlap, arrays.xp.floor(pairs + 0.5))
        if not standing[k]:
            continue  # a source that never varies says nothing
        s_occupied = forward(bits_occupied, k, "evidence occupied")
        source_side = correlate(s_occupied, t_known, "evidence source side")
        if not target.standing[k]:
            nothing = arrays.xp.zeros_like(source_side)
            add(pairs, source_side, nothing, nothing)
            continue
        target_side = correlate(s_known, target.occupied[k], "evidence target side")
        both = correlate(s_occupied, target.occupied[k], "evidence both")
        add(pairs, source_side, target_side, both)
    total = total * arrays.xp.abs(total) / (doubt + DOUBT)
    score = arrays.xp.where(overlap >= math.ceil(min_overlap), total, -np.inf).astype(np.float32)
    return arrays.to_host(score), arrays.to_host(overlap.astype(np.float32))


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
def uncertainty(n, r, xlogx):  # type: ignore[no-untyped-def]
    """Return n H (nats) of a source that has r of n cells occupied."""
    return xlogx[n] - xlogx[r] - xlogx[n - r] if 0 < r < n else 0.0


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def weigh(evidence, doubt):  # type: ignore[no-untyped-def]
    """Return the score of a pose: its evidence, by the share of the doubt that it takes away."""
    return evidence * abs(evidence) / (doubt + DOUBT)


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def sum_table(table, xlogx):  # type: ignore[no-untyped-def]
    """Return (evidence, doubt), nats, of a pose's table (n_slabs, 4): n, n_1, n_2, n11."""
    evidence, doubt = 0.0, 0.0
    for k in range(table.shape[0]):
        n, r, c, n11 = int(table[k, 0]), int(table[k, 1]), int(table[k, 2]), int(table[k, 3])
        evidence += signed_evidence(n, r, c, n11, xlogx)
        doubt += uncertainty(n, r, xlogx)
    return evidence, doubt


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _add_evidence(pairs, source_side, target_side, both, xlogx, total, doubt):  # type: ignore[no-untyped-def]
    """Add evidence and uncertainty of one slab, from its four counts, not yet rounded."""
    for u in range(total.shape[0]):
        for v in range(total.shape[1]):
            n = int(pairs[u, v] + 0.5)
            r = int(source_side[u, v] + 0.5)
            c = int(target_side[u, v] + 0.5)
            n11 = max(int(both[u, v] + 0.5), r + c - n, 0)
            total[u, v] += signed_evidence(n, r, c, min(n11, r, c), xlogx)
            doubt[u, v] += uncertainty(n, r, xlogx)


def _add_evidence_on_device(
    xp: Any, pairs: Array, source_side: Array, target_side: Array, both: Array, xlogx: Array,
    total: Array, doubt: Array,
) -> None:  # fmt: skip
    """The same in whole arrays, each sum in the same order: the same bits."""
    n, r, c, n11 = ((x + 0.5).astype(np.int32) for x in (pairs, source_side, target_side, both))
    n11 = xp.minimum(xp.maximum(xp.maximum(n11, r + c - n), 0), xp.minimum(r, c))
    g = xlogx[n] - xlogx[r] - xlogx[n - r] - xlogx[c] - xlogx[n - c]
    g += xlogx[n11] + xlogx[r - n11] + xlogx[c - n11] + xlogx[n - r - c + n11]
    varies = (r > 0) & (c > 0) & (r < n) & (c < n)
    agrees = n11.astype(np.int64) * n > r.astype(np.int64) * c
    total += (2.0 * agrees - 1.0) * g * varies
    doubt += (xlogx[n] - xlogx[r] - xlogx[n - r]) * ((r > 0) & (r < n))


def _spread_table() -> NDArray[np.uint64]:
    """Return for each byte its bits, one in each byte of a word: eight counters in one addition."""
    bits = np.arange(256, dtype=np.uint64)
    lanes = [((bits >> np.uint64(k)) & np.uint64(1)) << np.uint64(8 * k) for k in range(8)]
    return np.asarray(np.bitwise_or.reduce(np.stack(lanes), axis=0))


SPREAD = _spread_table()


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def count_bits(  # type: ignore[no-untyped-def]
    occupied, known, t_occupied, t_known, i0, j0, n_bytes, spread, lanes
):
    """Set lanes (4, 8 n_bytes) to the counts, per bit, of known, mine, other, and mine and other.

    [0, 0] of the first two lies on [i0, j0] of the target. A lane of a word holds up to 255, so
    the words are emptied after so many cells at most.
    """
    lanes[:] = 0
    n_x, n_y = t_occupied.shape
    side = known.shape[0]
    words = np.zeros((4, n_bytes), np.uint64)
    first, last = max(0, -j0), min(side, n_y - j0)
    for a in range(max(0, -i0), min(side, n_x - i0)):
        for start in range(first, last, 255):
            words[:] = np.uint64(0)
            hit = False
            for b in range(start, min(start + 255, last)):
                both = known[a, b] & t_known[a + i0, b + j0]
                if both == 0:
                    continue
                hit = True
                mine, other = occupied[a, b] & both, t_occupied[a + i0, b + j0] & both
                for g in range(n_bytes):
                    shift = 8 * g
                    words[0, g] += spread[(both >> shift) & 255]
                    words[1, g] += spread[(mine >> shift) & 255]
                    words[2, g] += spread[(other >> shift) & 255]
                    words[3, g] += spread[((mine & other) >> shift) & 255]
            if not hit:
                continue
            for q in range(4):
                for g in range(n_bytes):
                    for k in range(8):
                        lane = (words[q, g] >> np.uint64(8 * k)) & np.uint64(255)
                        lanes[q, 8 * g + k] += np.int64(lane)


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def count_tables(  # type: ignore[no-untyped-def]
    t_occupied, t_known, origin, cell, xy, s_occupied, s_known, n_slabs, poses, first_i=0, first_j=0
):
    """Return the (n_poses, n_slabs, 4) tables n, n_1, n_2, n11 of columns at planar poses.

    first_i, first_j: the cell of the grid at `origin` on which t_occupied[0, 0] lies, where only a
    window of that grid is given; the window holds all that the columns reach.

    poses: (P, 3) x, y, yaw of the source in the frame of the target grid. The turned and shifted
    columns are gathered into the target's cells first, just as `scatter` does: at a shift of whole
    cells this is what the FFT counts, and elsewhere what it would count on a shifted grid.
    """
    out = np.zeros((poses.shape[0], n_slabs, 4), np.int64)
    lanes = np.zeros((4, 8 * ((n_slabs + 7) // 8)), np.int64)
    spread = SPREAD
    n_x, n_y = t_occupied.shape
    reach = 0.0
    for n in range(xy.shape[0]):
        reach = max(reach, xy[n, 0] ** 2 + xy[n, 1] ** 2)
    side = 2 * int(np.ceil(np.sqrt(reach) / cell)) + 3
    occupied = np.empty((side, side), np.uint32)
    known = np.empty((side, side), np.uint32)
    turned = np.empty((xy.shape[0], 2))
    for p in range(poses.shape[0]):
        cosine, sine = np.cos(poses[p, 2]), np.sin(poses[p, 2])
        i0 = int(np.floor((poses[p, 0] - origin[0]) / cell)) - side // 2 - first_i
        j0 = int(np.floor((poses[p, 1] - origin[1]) / cell)) - side // 2 - first_j
        occupied[:] = 0
        known[:] = 0
        dx, dy = poses[p, 0] - origin[0], poses[p, 1] - origin[1]
        if p == 0 or poses[p, 2] != poses[p - 1, 2]:
            for n in range(xy.shape[0]):
                turned[n, 0] = cosine * xy[n, 0] - sine * xy[n, 1]
                turned[n, 1] = sine * xy[n, 0] + cosine * xy[n, 1]
        for n in range(xy.shape[0]):
            i = int(np.floor((turned[n, 0] + dx) / cell)) - first_i
            j = int(np.floor((turned[n, 1] + dy) / cell)) - first_j
            if 0 <= i < n_x and 0 <= j < n_y:
                occupied[i - i0, j - j0] |= s_occupied[n]
                known[i - i0, j - j0] |= s_known[n]
        count_bits(occupied, known, t_occupied, t_known, i0, j0, (n_slabs + 7) // 8, spread, lanes)
        for k in range(n_slabs):
            for q in range(4):
                out[p, k, q] = lanes[q, k]
    return out
