"""From where a coarser grid saw a peak to its top on this one.

Evidence has many small tops. What two cells apart can be the two sides of one peak on cells twice
as wide, and a yaw a little off is made up for by a shift. So a pose first looks about itself in
steps of whole cells and climbs from the best that it saw; the few poses that matter in the end
climb from everywhere about them.

Poses are counted word by word, 64 cells at a time: both maps are bit planes, one a slab, and the
four counts of a slab are population counts of words joined. A turned source serves all poses of its
yaw: the lattice has half cells, and there are four ways in which these pair up to cells.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numba
import numpy as np
from numba.extending import intrinsic
from numpy.typing import NDArray

from commonmap.matching.evidence import is_shared, sum_table, weigh, xlogx_table
from commonmap.matching.slabs import Bits, Columns, SlabGrid
from commonmap.matching.tiles import Level
from commonmap.types import Float64s

MOST_STEPS = 12
"""Steps that a pose climbs on one level at most."""

KEPT_YAWS = 32
"""Turned sources that are kept for the poses to come."""

Words = NDArray[np.uint64]


def starts_around(cells: int, yaws: int, *, apart: int = 1) -> NDArray[np.int64]:
    """Return (S, 3) nodes of the lattice of `climb_all`, the pose itself first.

    So many whole cells to each side along x and y, and so many whole yaws; `apart` makes every step
    in yaw that many yaws.
    """
    x, y, yaw = (np.arange(-n, n + 1) for n in (cells, cells, yaws))
    nodes = np.stack(np.meshgrid(x, y, yaw, indexing="ij"), axis=-1).reshape(-1, 3)
    nodes = nodes[np.argsort(np.abs(nodes).sum(axis=1), kind="stable")]
    return np.ascontiguousarray(nodes * np.array([2, 2, 2 * apart]), dtype=np.int64)


HERE = starts_around(0, 0)
"""Only the pose itself."""


def climb_all(
    level: Level,
    columns: Columns,
    pose: Float64s,
    *,
    yaw_step: float,
    least_pairs: float,
    starts: NDArray[np.int64],
    each: bool = False,
    workers: int = 1,
) -> tuple[Float64s, Float64s, Float64s]:
    """Return every pose (P, 3) moved to a local maximum of this level, its score and its pairs.

    The nodes of the lattice about a pose lie half a cell and `yaw_step` radians apart. It climbs
    from the best of its starts, or from each of them (the best top counts). least_pairs: known
    pairs that a pose needs; where no start has as many, the score is -inf.
    """
    table = xlogx_table(len(columns.xy) + 1)
    farthest = MOST_STEPS + int(np.abs(starts).max())
    radius = float(np.hypot(*columns.xy.T).max())
    reach = radius + (0.5 * farthest + 1.0) * level.cell
    side = 2 * int(np.ceil(radius / level.cell)) + 5
    pad = side // 64 + 2
    n_known = 1 if is_shared(columns.known, columns.n_slabs) else columns.n_slabs
    # one after the other in yaw, so that a turned source serves many
    order = np.argsort(pose[:, 2], kind="stable")
    n_blocks = workers if level.whole is not None else len(pose)
    blocks = np.array_split(order, max(1, n_blocks))
    whole = None if level.whole is None else _pack(level.whole, pad)

    def climb(block: NDArray[np.int64]) -> Float64s:
        if len(block) == 0:
            return np.zeros((0, 5))
        window, first_i, first_j = level.around(pose[block], reach)
        return np.asarray(
            _climb(
                *(whole or _pack(window, pad)), pad, level.origin, level.cell, first_i, first_j,
                columns.xy, columns.occupied, columns.known, columns.n_slabs, n_known, side,
                pose[block], yaw_step, least_pairs, starts, each, farthest + 1, table,
            )
        )  # fmt: skip

    rows = np.empty((len(pose), 5))
    with ThreadPoolExecutor(max_workers=workers) as pool:
        rows[order] = np.concatenate([np.zeros((0, 5)), *pool.map(climb, blocks)])
    return rows[:, :3], rows[:, 3], rows[:, 4]


def _pack(window: SlabGrid, pad: int) -> tuple[Words, Words]:
    """Return the occupied and the known planes of a target; one known plane where all are alike."""
    n_known = 1 if is_shared(window.known, window.n_slabs) else window.n_slabs
    return (
        pack_planes(window.occupied, window.n_slabs, pad),
        pack_planes(window.known, n_known, pad),
    )


def pack_planes(bits: Bits, n_slabs: int, pad: int) -> Words:
    """Return the slab bits (nx, ny) as words (nx, n_words, n_slabs), `pad` empty ones at each end.

    Bit b of word w of a row is its cell `64 (w - pad) + b`.
    """
    n_words = (bits.shape[1] + 63) // 64 + 2 * pad
    out = np.zeros((bits.shape[0], n_words, n_slabs), np.uint64)
    _fill_planes(np.ascontiguousarray(bits, np.uint32), pad, out)
    return out


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _fill_planes(bits, pad, out):  # type: ignore[no-untyped-def]
    one = np.uint64(1)
    for i in range(bits.shape[0]):
        for j in range(bits.shape[1]):
            if bits[i, j] == 0:
                continue
            cell = one << np.uint64(j & 63)
            for k in range(out.shape[2]):
                if (bits[i, j] >> np.uint32(k)) & np.uint32(1):
                    out[i, pad + (j >> 6), k] |= cell


def _count_ones(typing_context: Any, word: Any) -> Any:
    """Return the number of bits set in a word of 64."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.ctpop(arguments[0])

    return numba.types.uint64(numba.types.uint64), build


popcount: Any = intrinsic(_count_ones)


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _window(row, bit, k):  # type: ignore[no-untyped-def]
    """Return the 64 bits of plane k of a row of words that start at a bit."""
    shift = np.uint64(bit & 63)
    low, high = row[bit >> 6, k], row[(bit >> 6) + 1, k]
    return (low >> shift) | ((high << np.uint64(1)) << (np.uint64(63) - shift))


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _count(s_occupied, s_known, t_occupied, t_known, i0, j0, pad, counts):  # type: ignore[no-untyped-def]
    """Set counts (n_slabs, 4) to known in both, occupied here, there, in both.

    Cell [0, 0] of the source lies on cell [i0, j0] of the target. Known planes may be one for all.
    """
    counts[:] = 0
    side, n_words, n_slabs = s_occupied.shape
    n_x = t_occupied.shape[0]
    first = j0 + 64 * pad
    if first < 0 or first + 64 * n_words > 64 * (t_occupied.shape[1] - 1):
        return
    shared = s_known.shape[2] == 1 and t_known.shape[2] == 1
    n_both = np.uint64(0)
    for a in range(max(0, -i0), min(side, n_x - i0)):
        row_o, row_k = t_occupied[a + i0], t_known[a + i0]
        for w in range(n_words):
            bit = first + 64 * w
            s_seen = s_known[a, w, 0]
            t_seen = _window(row_k, bit, 0)
            if shared:
                if s_seen & t_seen == 0:
                    continue
                n_both += popcount(s_seen & t_seen)
                for k in range(n_slabs):
                    mine, other = s_occupied[a, w, k], _window(row_o, bit, k)
                    counts[k, 1] += popcount(mine & t_seen)
                    counts[k, 2] += popcount(other & s_seen)
                    counts[k, 3] += popcount(mine & other)
            else:
                for k in range(n_slabs):
                    if s_known.shape[2] > 1:
                        s_seen = s_known[a, w, k]
                    if t_known.shape[2] > 1:
                        t_seen = _window(row_k, bit, k)
                    mine, other = s_occupied[a, w, k], _window(row_o, bit, k)
                    counts[k, 0] += popcount(s_seen & t_seen)
                    counts[k, 1] += popcount(mine & t_seen)
                    counts[k, 2] += popcount(other & s_seen)
                    counts[k, 3] += popcount(mine & other)
    if shared:
        for k in range(n_slabs):
            counts[k, 0] = n_both


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _turn(xy, s_occupied, s_known, yaw, cell, x, y, half, out_occupied, out_known):  # type: ignore[no-untyped-def]
    """Fill the planes of the source turned by `yaw`, for the four ways to pair up half cells.

    x, y: in cells, where the source's origin lies in a cell, 0 to 1. half: (2 side, 2 side, 2)
    room for occupied and known. out_occupied, out_known: (4, side, n_words, .); at [2 a + b] cell
    [i, j] holds the half cells 2 i - a, 2 i - a + 1 and 2 j - b, 2 j - b + 1. Half cell [side,
    side] holds the origin of the cell that the source's origin lies in.
    """
    half[:] = 0
    side = out_occupied.shape[1]
    cosine, sine = np.cos(yaw), np.sin(yaw)
    scale = 2.0 / cell
    for n in range(xy.shape[0]):
        h = int(np.floor((cosine * xy[n, 0] - sine * xy[n, 1]) * scale + 2.0 * x)) + side - 1
        v = int(np.floor((sine * xy[n, 0] + cosine * xy[n, 1]) * scale + 2.0 * y)) + side - 1
        half[h, v, 0] |= s_occupied[n]
        half[h, v, 1] |= s_known[n]
    out_occupied[:] = 0
    out_known[:] = 0
    one = np.uint64(1)
    n_known = out_known.shape[3]
    for a in range(2):
        for i in range(side):
            g0, g1 = max(2 * i - a, 0), 2 * i - a + 1
            for b in range(2):
                occupied, known = out_occupied[2 * a + b, i], out_known[2 * a + b, i]
                for j in range(side):
                    v0, v1 = max(2 * j - b, 0), 2 * j - b + 1
                    seen = half[g0, v0, 1] | half[g0, v1, 1] | half[g1, v0, 1] | half[g1, v1, 1]
                    if seen == 0:
                        continue
                    full = half[g0, v0, 0] | half[g0, v1, 0] | half[g1, v0, 0] | half[g1, v1, 0]
                    w, place = j >> 6, one << np.uint64(j & 63)
                    if n_known == 1:
                        known[w, 0] |= place
                    else:
                        for k in range(n_known):
                            if (seen >> np.uint32(k)) & np.uint32(1):
                                known[w, k] |= place
                    k = 0
                    while full != 0:
                        if full & np.uint32(1):
                            occupied[w, k] |= place
                        full >>= np.uint32(1)
                        k += 1


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _snap(value, step):  # type: ignore[no-untyped-def]
    """Return the multiple of a step that lies within a millionth of it, else the value."""
    nearest = np.round(value / step) * step
    return nearest if abs(value - nearest) < 1e-6 * step else value


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _climb(  # type: ignore[no-untyped-def]
    t_occupied, t_known, pad, origin, cell, first_i, first_j, xy, s_occupied, s_known, n_slabs,
    n_known, side, poses, yaw_step, least_pairs, starts, each, middle, xlogx,
):  # fmt: skip
    """Return (P, 5) x, y, yaw, score, pairs of the tops that poses (P, 3) reach.

    t_occupied, t_known: planes of a window of the target that holds all that the source reaches;
    its first cell is (first_i, first_j) of the grid at `origin`. side: cells, odd, of a square
    about the source at any yaw. n_known: 1 where all slabs are known alike, else n_slabs.
    Every node of the lattice is scored once; `middle` is the pose's own index in it.
    """
    out = np.empty((poses.shape[0], 5))
    n_words = (side + 63) // 64
    half = np.empty((2 * side, 2 * side, 2), np.uint32)
    kept = np.full((KEPT_YAWS, 3), np.nan)  # yaw, and where in its cell the source's origin lies
    turned_o = np.empty((KEPT_YAWS, 4, side, n_words, n_slabs), np.uint64)
    turned_k = np.empty((KEPT_YAWS, 4, side, n_words, n_known), np.uint64)
    counts = np.empty((n_slabs, 4), np.uint64)
    size = 2 * middle + 1
    score, pairs = np.empty((size, size, size)), np.zeros((size, size, size), np.int64)
    at, way, top = np.empty(3, np.int64), np.empty(3, np.int64), np.empty(3, np.int64)
    place = np.empty(5)  # cell and place in it of the pose, in cells, and its yaw
    for p in range(poses.shape[0]):
        score[:] = np.nan
        # poses that come from a lattice lie on it to the last bit
        for k in range(2):
            place[k] = _snap((poses[p, k] - origin[k]) / cell, 1.0 / 4096.0)
            place[2 + k] = place[k] - np.floor(place[k])
            place[k] = np.floor(place[k])
        place[4] = _snap(poses[p, 2], yaw_step)
        best, first = -np.inf, 0
        for s in range(0 if each else starts.shape[0]):
            at[:] = middle + starts[s]
            value = _score(
                t_occupied, t_known, pad, cell, first_i, first_j, xy, s_occupied, s_known, place,
                yaw_step, least_pairs, middle, xlogx, at, half, kept, turned_o, turned_k, counts,
                score, pairs,
            )  # fmt: skip
            if value > best + 1e-9:
                best, first = value, s
        best = -np.inf
        top[:] = middle
        for s in range(0 if each else first, starts.shape[0] if each else first + 1):
            way[:] = middle + starts[s]
            here = -np.inf
            for _ in range(MOST_STEPS):
                a0, b0, c0 = way
                won = False
                for c in range(c0 - 1, c0 + 2):
                    for a in range(a0 - 1, a0 + 2):
                        for b in range(b0 - 1, b0 + 2):
                            at[0], at[1], at[2] = a, b, c
                            value = _score(
                                t_occupied, t_known, pad, cell, first_i, first_j, xy, s_occupied,
                                s_known, place, yaw_step, least_pairs, middle, xlogx, at, half,
                                kept, turned_o, turned_k, counts, score, pairs,
                            )  # fmt: skip
                            if value > here + 1e-9:
                                here, won = value, True
                                way[:] = at
                if not won:
                    break  # nothing about is better
            if here > best + 1e-9:
                best = here
                top[:] = way
        for k in range(2):
            out[p, k] = origin[k] + (place[k] + place[2 + k] + 0.5 * (top[k] - middle)) * cell
        out[p, 2] = _snap(place[4] + (top[2] - middle) * yaw_step, yaw_step)
        out[p, 3], out[p, 4] = best, pairs[top[0], top[1], top[2]]
    return out


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _score(  # type: ignore[no-untyped-def]
    t_occupied, t_known, pad, cell, first_i, first_j, xy, s_occupied, s_known, place, yaw_step,
    least_pairs, middle, xlogx, at, half, kept, turned_o, turned_k, counts, score, pairs,
):  # fmt: skip
    """Return the evidence of a node, looked up or counted; -inf with too few pairs.

    turned_o, turned_k: the planes of turned sources, of the yaws and places in `kept`.
    """
    a, b, c = at
    if score[a, b, c] == score[a, b, c]:
        return score[a, b, c]
    yaw = _snap(place[4] + (c - middle) * yaw_step, yaw_step)
    slot = int(np.round(yaw / yaw_step)) % KEPT_YAWS
    if kept[slot, 0] != yaw or kept[slot, 1] != place[2] or kept[slot, 2] != place[3]:
        kept[slot, 0], kept[slot, 1], kept[slot, 2] = yaw, place[2], place[3]
        _turn(
            xy, s_occupied, s_known, yaw, cell, place[2], place[3], half, turned_o[slot],
            turned_k[slot],
        )  # fmt: skip
    i, j = a - middle, b - middle
    around = (turned_o.shape[2] - 1) // 2
    way = 2 * (i & 1) + (j & 1)
    _count(
        turned_o[slot, way], turned_k[slot, way], t_occupied, t_known,
        int(place[0]) + (i >> 1) - around - first_i, int(place[1]) + (j >> 1) - around - first_j,
        pad, counts,
    )  # fmt: skip
    most = int(counts[:, 0].max())
    evidence, doubt = sum_table(counts, xlogx)
    node = at[0], at[1], at[2]
    score[node] = weigh(evidence, doubt) if most >= least_pairs else -np.inf
    pairs[node] = most
    return score[node]
