"""From where a coarser grid saw a peak to its top on this one.

Evidence has many small tops. What two cells apart can be the two sides of one peak on cells twice
as wide, and a yaw a little off is made up for by a shift. So a pose first looks about itself in
steps of whole cells and climbs from the best that it saw; the few poses that matter in the end
climb from everywhere about them.

Poses are counted word by word, 64 cells at a time: both maps are bit planes, one a slab, and the
four counts of a slab are population counts of words joined, of eight slabs side by side
(`lanes.py`). A turned source serves all poses of its yaw: the lattice has half cells, and there are
four ways in which these pair up to cells.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numba
import numpy as np
from numpy.typing import NDArray

from commonmap.matching.evidence import sum_table, weigh, xlogx_table
from commonmap.matching.lanes import WIDTH, count_ones, load, spread, store
from commonmap.matching.slabs import Bits, Columns, SlabGrid, is_shared
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
    alike = is_shared(columns.known, columns.n_slabs)
    # one after the other in yaw, so that a turned source serves many
    order = np.argsort(pose[:, 2], kind="stable")
    n_blocks = workers if level.whole is not None else len(pose)
    blocks = np.array_split(order, max(1, n_blocks))
    whole = None if level.whole is None else _pack(level.whole, pad, alike)

    def climb(block: NDArray[np.int64]) -> Float64s:
        if len(block) == 0:
            return np.zeros((0, 5))
        window, first_i, first_j = level.around(pose[block], reach)
        return np.asarray(
            _climb(
                *(whole or _pack(window, pad, alike)), pad, level.origin, level.cell, first_i,
                first_j, columns.xy, columns.occupied, columns.known, columns.n_slabs, side,
                pose[block], yaw_step, least_pairs, starts, each, farthest + 1, table,
            )
        )  # fmt: skip

    rows = np.empty((len(pose), 5))
    with ThreadPoolExecutor(max_workers=workers) as pool:
        rows[order] = np.concatenate([np.zeros((0, 5)), *pool.map(climb, blocks)])
    return rows[:, :3], rows[:, 3], rows[:, 4]


def _pack(window: SlabGrid, pad: int, source_alike: bool) -> tuple[Words, Words]:
    """Return the occupied and the known planes; of the known one where both maps know alike."""
    alike = source_alike and is_shared(window.known, window.n_slabs)
    return (
        pack_planes(window.occupied, window.n_slabs, pad),
        pack_planes(window.known, 1 if alike else window.n_slabs, pad, alone=alike),
    )


def pack_planes(bits: Bits, n_slabs: int, pad: int, *, alone: bool = False) -> Words:
    """Return the slab bits (nx, ny) as words (nx, n_words, n_planes), `pad` empty ones at each end.

    Bit b of word w of a row is its cell `64 (w - pad) + b`. Planes fill up whole lanes, except one
    that is `alone`.
    """
    n_words = (bits.shape[1] + 63) // 64 + 2 * pad
    n_planes = 1 if alone else -(-n_slabs // WIDTH) * WIDTH
    out = np.zeros((bits.shape[0], n_words, n_planes), np.uint64)
    _fill_planes(np.ascontiguousarray(bits, np.uint32), n_slabs, pad, out)
    return out


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _fill_planes(bits, n_slabs, pad, out):  # type: ignore[no-untyped-def]
    for i in range(bits.shape[0]):
        for j in range(bits.shape[1]):
            _set_planes(out, i, 64 * pad + j, bits[i, j], n_slabs)


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _set_planes(planes, i, j, bits, n_slabs):  # type: ignore[no-untyped-def]
    """Set cell [i, j] of the planes of all slabs that are in the bits."""
    cell, k = np.uint64(1) << np.uint64(j & 63), 0
    while bits != 0 and k < n_slabs:
        if bits & np.uint32(1):
            planes[i, j >> 6, k] |= cell
        bits >>= np.uint32(1)
        k += 1


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _window(low, high, bit):  # type: ignore[no-untyped-def]
    """Return the 64 bits that start at a bit of the first of two words, or lanes of words."""
    shift = np.uint64(bit & 63)
    return (low >> shift) | ((high << np.uint64(1)) << (np.uint64(63) - shift))


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _count(s_occupied, s_known, t_occupied, t_known, i0, j0, pad, counts):  # type: ignore[no-untyped-def]
    """Set counts (4, n_planes) to known in both, occupied here, there, in both.

    Cell [0, 0] of the source lies on cell [i0, j0] of the target. Known planes may be one for all.
    """
    counts[:] = 0
    side, n_words, n_planes = s_occupied.shape
    n_x, n_t = t_occupied.shape[0], t_occupied.shape[1]
    first = j0 + 64 * pad
    if first < 0 or first + 64 * n_words > 64 * (n_t - 1):
        return
    shared = t_known.shape[2] == 1
    mine_o, other_o = s_occupied.reshape(-1), t_occupied.reshape(-1)
    mine_k, other_k = s_known.reshape(-1), t_known.reshape(-1)
    nothing = np.uint64(0)
    for g in range(0, n_planes, WIDTH):
        here, there, both = spread(nothing), spread(nothing), spread(nothing)
        known, n_known = spread(nothing), nothing
        for a in range(max(0, -i0), min(side, n_x - i0)):
            for w in range(n_words):
                bit = first + 64 * w
                s, t = a * n_words + w, (a + i0) * n_t + (bit >> 6)
                if shared:
                    word = mine_k[s]
                    t_word = _window(other_k[t], other_k[t + 1], bit)
                    if (word & t_word) == 0:
                        continue
                    n_known += count_ones(word & t_word)
                    s_seen, t_seen = spread(word), spread(t_word)
                else:
                    at = t * n_planes + g
                    s_seen = load(mine_k, s * n_planes + g)
                    t_seen = _window(load(other_k, at), load(other_k, at + n_planes), bit)
                    known = known + count_ones(s_seen & t_seen)
                at = t * n_planes + g
                mine = load(mine_o, s * n_planes + g)
                other = _window(load(other_o, at), load(other_o, at + n_planes), bit)
                here = here + count_ones(mine & t_seen)
                there = there + count_ones(other & s_seen)
                both = both + count_ones(mine & other)
        if shared:
            known = spread(n_known)
        store(counts[0], g, known)
        store(counts[1], g, here)
        store(counts[2], g, there)
        store(counts[3], g, both)


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _turn(  # type: ignore[no-untyped-def]
    xy, s_occupied, s_known, n_slabs, yaw, cell, x, y, half_o, half_k, out_occupied, out_known
):
    """Fill the planes of the source turned by `yaw`, for the four ways to pair up half cells.

    x, y: in cells, where the source's origin lies in a cell, 0 to 1. half_o, half_k: (2 side,
    n_words, .) room for planes of half cells. out_occupied, out_known: (4, side, n_words, .); at
    [2 a + b] cell [i, j] holds the half cells 2 i - a, 2 i - a + 1 and 2 j - b, 2 j - b + 1. Half
    cell [side, side] holds the origin of the cell that the source's origin lies in.
    """
    half_o[:] = 0
    half_k[:] = 0
    side = out_occupied.shape[1]
    cosine, sine = np.cos(yaw), np.sin(yaw)
    scale = 2.0 / cell
    n_known = 1 if half_k.shape[2] == 1 else n_slabs
    for n in range(xy.shape[0]):
        h = int(np.floor((cosine * xy[n, 0] - sine * xy[n, 1]) * scale + 2.0 * x)) + side - 1
        v = int(np.floor((sine * xy[n, 0] + cosine * xy[n, 1]) * scale + 2.0 * y)) + side - 1
        _set_planes(half_o, h, v, s_occupied[n], n_slabs)
        _set_planes(half_k, h, v, s_known[n], n_known)
    _pair_up_lanes(half_o, out_occupied)
    if half_k.shape[2] == 1:
        _pair_up_words(half_k, out_known)
    else:
        _pair_up_lanes(half_k, out_known)


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _even_bits(x):  # type: ignore[no-untyped-def]
    """Return bits 0, 2, 4 ... of a word, or of lanes of words, as the lower 32."""
    x = x & np.uint64(0x5555555555555555)
    x = (x | (x >> np.uint64(1))) & np.uint64(0x3333333333333333)
    x = (x | (x >> np.uint64(2))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    x = (x | (x >> np.uint64(4))) & np.uint64(0x00FF00FF00FF00FF)
    x = (x | (x >> np.uint64(8))) & np.uint64(0x0000FFFF0000FFFF)
    return (x | (x >> np.uint64(16))) & np.uint64(0x00000000FFFFFFFF)


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _pair_up(before, low, high):  # type: ignore[no-untyped-def]
    """Return the cells of a row, a word each, from half cells 2 j, 2 j + 1 and 2 j - 1, 2 j.

    low, high: the two words of its half cells. before: the one that comes before them.
    """
    one, last = np.uint64(1), np.uint64(63)
    straight = _even_bits(low | (low >> one)), _even_bits(high | (high >> one))
    shifted = (
        _even_bits(low | (low << one) | (before >> last)),
        _even_bits(high | (high << one) | (low >> last)),
    )
    half = np.uint64(32)
    return straight[0] | (straight[1] << half), shifted[0] | (shifted[1] << half)


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _pair_up_lanes(half, out):  # type: ignore[no-untyped-def]
    """Set out (4, side, n_words, n_planes) from planes of half cells, eight planes at a time."""
    side, n_words, n_planes = out.shape[1:]
    for a in range(2):
        for i in range(side):
            top, bottom = half[max(2 * i - a, 0)].reshape(-1), half[2 * i - a + 1].reshape(-1)
            straight, shifted = out[2 * a, i].reshape(-1), out[2 * a + 1, i].reshape(-1)
            for g in range(0, n_planes, WIDTH):
                before = spread(np.uint64(0))
                for w in range(n_words):
                    at = 2 * w * n_planes + g
                    low = load(top, at) | load(bottom, at)
                    high = load(top, at + n_planes) | load(bottom, at + n_planes)
                    one, other = _pair_up(before, low, high)
                    store(straight, w * n_planes + g, one)
                    store(shifted, w * n_planes + g, other)
                    before = high


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _pair_up_words(half, out):  # type: ignore[no-untyped-def]
    """The same of one plane."""
    for a in range(2):
        for i in range(out.shape[1]):
            top, bottom = half[max(2 * i - a, 0)], half[2 * i - a + 1]
            before = np.uint64(0)
            for w in range(out.shape[2]):
                low = top[2 * w, 0] | bottom[2 * w, 0]
                high = top[2 * w + 1, 0] | bottom[2 * w + 1, 0]
                one, other = _pair_up(before, low, high)
                out[2 * a, i, w, 0], out[2 * a + 1, i, w, 0] = one, other
                before = high


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _snap(value, step):  # type: ignore[no-untyped-def]
    """Return the multiple of a step that lies within a millionth of it, else the value."""
    nearest = np.round(value / step) * step
    return nearest if abs(value - nearest) < 1e-6 * step else value


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _climb(  # type: ignore[no-untyped-def]
    t_occupied, t_known, pad, origin, cell, first_i, first_j, xy, s_occupied, s_known, n_slabs,
    side, poses, yaw_step, least_pairs, starts, each, middle, xlogx,
):  # fmt: skip
    """Return (P, 5) x, y, yaw, score, pairs of the tops that poses (P, 3) reach.

    t_occupied, t_known: planes of a window of the target that holds all that the source reaches;
    its first cell is (first_i, first_j) of the grid at `origin`. side: cells, odd, of a square
    about the source at any yaw. Every node of the lattice is scored once; `middle` is the pose's
    own index in it.
    """
    out = np.empty((poses.shape[0], 5))
    n_words = (side + 63) // 64
    n_planes, n_known = t_occupied.shape[2], t_known.shape[2]
    half_o = np.empty((2 * side, 2 * n_words, n_planes), np.uint64)
    half_k = np.empty((2 * side, 2 * n_words, n_known), np.uint64)
    kept = np.full((KEPT_YAWS, 3), np.nan)  # yaw, and where in its cell the source's origin lies
    turned_o = np.empty((KEPT_YAWS, 4, side, n_words, n_planes), np.uint64)
    turned_k = np.empty((KEPT_YAWS, 4, side, n_words, n_known), np.uint64)
    counts = np.empty((4, n_planes), np.uint64)
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
                yaw_step, least_pairs, middle, xlogx, at, n_slabs, half_o, half_k, kept, turned_o,
                turned_k, counts, score, pairs,
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
                                s_known, place, yaw_step, least_pairs, middle, xlogx, at, n_slabs,
                                half_o, half_k, kept, turned_o, turned_k, counts, score, pairs,
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
    least_pairs, middle, xlogx, at, n_slabs, half_o, half_k, kept, turned_o, turned_k, counts,
    score, pairs,
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
            xy, s_occupied, s_known, n_slabs, yaw, cell, place[2], place[3], half_o, half_k,
            turned_o[slot], turned_k[slot],
        )  # fmt: skip
    i, j = a - middle, b - middle
    around = (turned_o.shape[2] - 1) // 2
    way = 2 * (i & 1) + (j & 1)
    _count(
        turned_o[slot, way], turned_k[slot, way], t_occupied, t_known,
        int(place[0]) + (i >> 1) - around - first_i, int(place[1]) + (j >> 1) - around - first_j,
        pad, counts,
    )  # fmt: skip
    most = int(counts[0, :n_slabs].max())
    evidence, doubt = sum_table(counts[:, :n_slabs].T, xlogx)
    node = at[0], at[1], at[2]
    score[node] = weigh(evidence, doubt) if most >= least_pairs else -np.inf
    pairs[node] = most
    return score[node]
