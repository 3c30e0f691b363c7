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

`evidence_fft.py` counts them so.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from commonmap.metrics.formulas import DOUBT
from commonmap.types import Float64s


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
