"""Bit planes of height slabs: 64 cells a word, eight slabs side by side, and what they count.

A turned source serves all poses of its yaw on a lattice of half cells: there are four ways in which
these pair up to cells.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from commonmap.mapping.points import floor_int
from commonmap.matching.lanes import WIDTH, count_ones, load, spread, store
from commonmap.matching.slabs import Bits

Words = NDArray[np.uint64]


def pack_planes(bits: Bits, n_slabs: int, pad: int, *, alone: bool = False) -> Words:
    """Return the slab bits (nx, ny) as words (nx, n_words, n_planes), `pad` empty ones at each end.

    Bit b of word w of a row is its cell `64 (w - pad) + b`. Planes fill up whole lanes, except one
    that is `alone`.
    """
    n_words = (bits.shape[1] + 63) // 64 + 2 * pad
    n_planes = 1 if alone else -(-n_slabs // WIDTH) * WIDTH
    out = np.zeros((bits.shape[0], n_words, n_planes), np.uint64)
    _fill_planes(np.ascontiguousarray(bits, np.uint32), pad, out)
    return out


def _mask_table() -> Words:
    """Return for each byte eight words, all ones where its bit is set, one after the other."""
    bits = np.arange(256)[:, None] >> np.arange(WIDTH) & 1
    return np.where(bits == 1, np.uint64(0xFFFFFFFFFFFFFFFF), np.uint64(0)).ravel()


MASKS = _mask_table()


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _fill_planes(bits, pad, out):  # type: ignore[no-untyped-def]
    n_words, n_planes, words, masks = out.shape[1], out.shape[2], out.reshape(-1), MASKS
    for i in range(bits.shape[0]):
        for j in range(bits.shape[1]):
            word = i * n_words + pad + (j >> 6)
            bit = np.uint64(1) << np.uint64(j & 63)
            if n_planes > 1:
                _set_lanes(words, word * n_planes, bit, bits[i, j], masks)
            elif bits[i, j] & np.uint32(1):
                words[word] |= bit


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _set_lanes(words, at, bit, bits, masks):  # type: ignore[no-untyped-def]
    """Set a bit of the words that begin at `at`, one a plane, of all slabs that are in `bits`."""
    while bits != 0:
        which = np.int64(bits & np.uint32(255)) * WIDTH
        store(words, at, load(words, at) | (load(masks, which) & bit))
        bits >>= np.uint32(8)
        at += WIDTH


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _window(low, high, bit):  # type: ignore[no-untyped-def]
    """Return the 64 bits that start at a bit of the first of two words, or lanes of words."""
    shift = np.uint64(bit & 63)
    return (low >> shift) | ((high << np.uint64(1)) << (np.uint64(63) - shift))


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def count_planes(s_occupied, s_known, t_occupied, t_known, i0, j0, pad, counts):  # type: ignore[no-untyped-def]
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
                    if word == 0:
                        continue
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
def turn_planes(  # type: ignore[no-untyped-def]
    xy, s_occupied, s_known, yaw, cell, x, y, half_o, half_k, out_occupied, out_known
):
    """Fill the planes of the source turned by `yaw`, for the four ways to pair up half cells.

    xy: (2, N) metres, about the source's origin. x, y: in cells, where that lies in a cell, 0 to 1.
    half_o, half_k: (2 side, n_words, .) room for planes of half cells. out_occupied, out_known:
    (4, side, n_words, .); at [2 a + b] cell [i, j] holds the half cells 2 i - a, 2 i - a + 1 and
    2 j - b, 2 j - b + 1. Half cell [side, side] holds the origin of the cell that the source's
    origin lies in.
    """
    half_o[:] = 0
    half_k[:] = 0
    side, n_words = out_occupied.shape[1], half_o.shape[1]
    cosine, sine = np.cos(yaw), np.sin(yaw)
    scale = 2.0 / cell
    xs, ys = xy[0], xy[1]
    h, v = np.empty(xs.shape[0], np.int32), np.empty(xs.shape[0], np.int32)
    for n in range(xs.shape[0]):
        h[n] = floor_int((cosine * xs[n] - sine * ys[n]) * scale + 2.0 * x)
        v[n] = floor_int((sine * xs[n] + cosine * ys[n]) * scale + 2.0 * y)
    masks, words_o, words_k = MASKS, half_o.reshape(-1), half_k.reshape(-1)
    n_planes, n_known = half_o.shape[2], half_k.shape[2]
    for n in range(xs.shape[0]):
        j = v[n] + side - 1
        word, bit = (h[n] + side - 1) * n_words + (j >> 6), np.uint64(1) << np.uint64(j & 63)
        _set_lanes(words_o, word * n_planes, bit, s_occupied[n], masks)
        if n_known > 1:
            _set_lanes(words_k, word * n_known, bit, s_known[n], masks)
        elif s_known[n] & np.uint32(1):
            words_k[word] |= bit
    _pair_up_lanes(half_o, out_occupied)
    if n_known == 1:
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
