"""The best local maxima of a surface of scores, whole or row by row."""

from __future__ import annotations

import numba
import numpy as np


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def local_maxima(score, n_peaks, above, low_u=0, high_u=0, low_v=0, high_v=0):  # type: ignore[no-untyped-def]
    """Return indices (n_peaks, 2) and values of the highest 3x3 local maxima over `above`, else -1.

    Best first, of equals the one of the smaller u, then v. So many rows and columns at the rims are
    only neighbours of the others, and no peaks.
    """
    n_u, n_v = score.shape
    index = np.full((n_peaks, 2), -1, np.int64)
    value = np.full(n_peaks, -np.inf, score.dtype)
    three = np.full((3, n_v), -np.inf, score.dtype)
    for u in range(n_u + 1):
        for v in range(n_v):
            three[u % 3, v] = score[u, v] if u < n_u else -np.inf
        if low_u <= u - 1 < n_u - high_u:
            add_peaks(three, u - 1, low_v, n_v - high_v, above, index, value)
    return index, value


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def add_peaks(score, u, low_v, high_v, above, index, value):  # type: ignore[no-untyped-def]
    """Insert the local maxima of row u into the best peaks so far, which are sorted, best first.

    score: (3, n_v) rows u - 1, u and u + 1, each at its number modulo 3. A local maximum has no
    higher one among its eight neighbours, and no equal one before it.
    """
    n_v, n_peaks = score.shape[1], value.shape[0]
    for v in range(low_v, high_v):
        s = score[u % 3, v]
        if not s > value[n_peaks - 1] or s <= above:
            continue
        peak = True
        for a in range(u - 1, u + 2):
            for b in range(max(v - 1, 0), min(v + 2, n_v)):
                other = score[a % 3, b]
                earlier = a < u or (a == u and b < v)
                if other > s or (earlier and other == s):
                    peak = False
        if not peak:
            continue
        place = n_peaks - 1
        while place > 0 and s > value[place - 1]:
            value[place] = value[place - 1]
            index[place] = index[place - 1]
            place -= 1
        value[place] = s
        index[place, 0], index[place, 1] = u, v
