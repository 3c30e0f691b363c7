"""Discrete Fourier transforms of eight complex sequences side by side.

Stockham's autosort algorithm in radices 4, 5, 3 and 2 (Van Loan, Computational Frameworks for the
FFT, 1992, section 1.7): each pass reads one array and writes another, in order, so there is no
bit reversal, and all that happens inside is arithmetic on `Lanes`. A complex value takes two of
them, real parts first: a sequence of n is a flat array of n * STEP numbers.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from commonmap.matching.lanes import WIDTH, load, load_pairs, store, store_pairs

STEP = 2 * WIDTH
"""Numbers of a complex value of all lanes."""

_compiled: Any = numba.njit(cache=True, nogil=True, fastmath={"contract"})


class Plan(NamedTuple):
    """How sequences of length n are transformed.

    radices: their product is n. roots: (2, m) the factors e^(-2 pi i p k / n) of each pass in the
    order of their use, real and imaginary. angles: (6,) what the radices 3 and 5 multiply by.
    """

    n: int
    radices: NDArray[np.int64]
    roots: NDArray[np.floating[Any]]
    angles: NDArray[np.floating[Any]]


def find_length(n: int) -> int:
    """Return the least length of at least n that has no prime factor over 5."""
    return int(fft.next_fast_len(n, real=True))


@lru_cache(maxsize=256)
def plan_transform(n: int, dtype: type[np.floating[Any]]) -> Plan:
    """Return the plan of a length that `find_length` returns."""
    radices, rest = [], n
    for radix in (4, 5, 3, 2):
        while rest % radix == 0:
            radices.append(radix)
            rest //= radix
    if rest != 1:
        raise ValueError(f"the length must have the prime factors 2, 3 and 5 alone; {n} came")
    turns, size = [np.zeros(0)], n
    for radix in radices:
        p, k = np.ogrid[: size // radix, 1:radix]
        turns.append((p * k / size).ravel())
        size //= radix
    angle = -2.0 * np.pi * np.concatenate(turns)
    fifth = 0.4 * np.pi
    angles = [0.5, np.sin(np.pi / 3.0), *np.cos([fifth, 2 * fifth]), *np.sin([fifth, 2 * fifth])]
    return Plan(
        n,
        np.array(radices, np.int64),
        np.stack([np.cos(angle), np.sin(angle)]).astype(dtype),
        np.array(angles, dtype),
    )


@_compiled  # type: ignore[misc]
def transform_line(a, b, plan, sign):  # type: ignore[no-untyped-def]
    """Transform plan.n complex values in `a`; return whether the answer lies in `b`, not in `a`.

    a, b: flat, n * STEP or longer; both are overwritten. sign: 1 forward, -1 back, not scaled, of
    the arrays' type.
    """
    roots, angles = plan.roots, plan.angles
    size, stride, first, swapped = plan.n, 1, 0, False
    for radix in plan.radices:
        x, y = (b, a) if swapped else (a, b)
        if radix == 4:
            _pass_4(x, y, size, stride, roots, first, sign)
        elif radix == 2:
            _pass_2(x, y, size, stride, roots, first, sign)
        elif radix == 3:
            _pass_3(x, y, size, stride, roots, first, angles, sign)
        else:
            _pass_5(x, y, size, stride, roots, first, angles, sign)
        first += (radix - 1) * (size // radix)
        size //= radix
        stride *= radix
        swapped = not swapped
    return swapped


@_compiled  # type: ignore[misc]
def transform_columns(x, y, n_in, width, plan, sign, scale):  # type: ignore[no-untyped-def]
    """Transform along the first axis of (n_in, width) complex values, zeros up to n = plan.n.

    x, y: flat, real and imaginary parts in turn, the values and the answer (n, width); they may be
    the same. scale: the answer is multiplied by it, of the arrays' type as the sign.
    """
    n = plan.n
    a, b = np.empty(n * STEP, y.dtype), np.empty(n * STEP, y.dtype)
    for start in range(0, width, WIDTH):
        rest = min(WIDTH, width - start)
        if rest < WIDTH:
            a[:] = 0
        for i in range(n_in):
            at = 2 * (i * width + start)
            if rest == WIDTH:
                real, imaginary = load_pairs(x, at)
                _store(a, i * STEP, real, imaginary)
            else:
                for w in range(rest):
                    a[i * STEP + w], a[i * STEP + WIDTH + w] = x[at + 2 * w], x[at + 2 * w + 1]
        a[n_in * STEP :] = 0
        line = b if transform_line(a, b, plan, sign) else a
        for i in range(n):
            at = 2 * (i * width + start)
            if rest == WIDTH:
                real, imaginary = _load(line, i * STEP)
                store_pairs(y, at, scale * real, scale * imaginary)
            else:
                for w in range(rest):
                    y[at + 2 * w] = scale * line[i * STEP + w]
                    y[at + 2 * w + 1] = scale * line[i * STEP + WIDTH + w]


@_compiled  # type: ignore[misc]
def _root(roots, at, sign):  # type: ignore[no-untyped-def]
    """Return the real and the imaginary part of a root, conjugated on the way back."""
    return roots[0, at], sign * roots[1, at]


@_compiled  # type: ignore[misc]
def _load(x, at):  # type: ignore[no-untyped-def]
    """Return the real and the imaginary lanes of a complex value."""
    return load(x, at), load(x, at + WIDTH)


@_compiled  # type: ignore[misc]
def _store(y, at, real, imaginary):  # type: ignore[no-untyped-def]
    store(y, at, real)
    store(y, at + WIDTH, imaginary)


@_compiled  # type: ignore[misc]
def _turn_and_store(y, at, root_r, root_i, real, imaginary):  # type: ignore[no-untyped-def]
    """Store the complex value times the root."""
    _store(y, at, root_r * real - root_i * imaginary, root_r * imaginary + root_i * real)


@_compiled  # type: ignore[misc]
def _pass_2(x, y, size, stride, roots, first, sign):  # type: ignore[no-untyped-def]
    m, apart = size // 2, stride * STEP
    for p in range(m):
        wr, wi = _root(roots, first + p, sign)
        for q in range(stride):
            i = (q + stride * p) * STEP
            j = i + m * apart
            o = (q + stride * 2 * p) * STEP
            ar, ai = _load(x, i)
            br, bi = _load(x, j)
            _store(y, o, ar + br, ai + bi)
            _turn_and_store(y, o + apart, wr, wi, ar - br, ai - bi)


@_compiled  # type: ignore[misc]
def _pass_3(x, y, size, stride, roots, first, angles, sign):  # type: ignore[no-untyped-def]
    m, apart = size // 3, stride * STEP
    half, height = angles[0], sign * angles[1]
    for p in range(m):
        t = first + 2 * p
        (w1r, w1i), (w2r, w2i) = _root(roots, t, sign), _root(roots, t + 1, sign)
        for q in range(stride):
            i = (q + stride * p) * STEP
            j = i + m * apart
            k = j + m * apart
            o = (q + stride * 3 * p) * STEP
            ar, ai = _load(x, i)
            br, bi = _load(x, j)
            cr, ci = _load(x, k)
            sr, si = br + cr, bi + ci
            dr, di = height * (bi - ci), height * (cr - br)
            er, ei = ar - half * sr, ai - half * si
            _store(y, o, ar + sr, ai + si)
            _turn_and_store(y, o + apart, w1r, w1i, er + dr, ei + di)
            _turn_and_store(y, o + 2 * apart, w2r, w2i, er - dr, ei - di)


@_compiled  # type: ignore[misc]
def _pass_4(x, y, size, stride, roots, first, sign):  # type: ignore[no-untyped-def]
    m, apart = size // 4, stride * STEP
    for p in range(m):
        t = first + 3 * p
        (w1r, w1i), (w2r, w2i) = _root(roots, t, sign), _root(roots, t + 1, sign)
        w3r, w3i = _root(roots, t + 2, sign)
        for q in range(stride):
            i = (q + stride * p) * STEP
            j = i + m * apart
            k = j + m * apart
            n = k + m * apart
            o = (q + stride * 4 * p) * STEP
            ar, ai = _load(x, i)
            br, bi = _load(x, j)
            cr, ci = _load(x, k)
            dr, di = _load(x, n)
            acr, aci, bdr, bdi = ar + cr, ai + ci, br + dr, bi + di
            er, ei, fr, fi = ar - cr, ai - ci, sign * (bi - di), sign * (dr - br)
            _store(y, o, acr + bdr, aci + bdi)
            _turn_and_store(y, o + apart, w1r, w1i, er + fr, ei + fi)
            _turn_and_store(y, o + 2 * apart, w2r, w2i, acr - bdr, aci - bdi)
            _turn_and_store(y, o + 3 * apart, w3r, w3i, er - fr, ei - fi)


@_compiled  # type: ignore[misc]
def _pass_5(x, y, size, stride, roots, first, angles, sign):  # type: ignore[no-untyped-def]
    m, apart = size // 5, stride * STEP
    c1, c2, s1, s2 = angles[2], angles[3], sign * angles[4], sign * angles[5]
    for p in range(m):
        t = first + 4 * p
        (w1r, w1i), (w2r, w2i) = _root(roots, t, sign), _root(roots, t + 1, sign)
        w3r, w3i = _root(roots, t + 2, sign)
        w4r, w4i = _root(roots, t + 3, sign)
        for q in range(stride):
            i = (q + stride * p) * STEP
            j = i + m * apart
            k = j + m * apart
            n = k + m * apart
            h = n + m * apart
            o = (q + stride * 5 * p) * STEP
            ar, ai = _load(x, i)
            br, bi = _load(x, j)
            cr, ci = _load(x, k)
            dr, di = _load(x, n)
            er, ei = _load(x, h)
            # the outer and the inner two of the four, their sums and differences
            ur, ui, vr, vi = br + er, bi + ei, br - er, bi - ei
            fr, fi, gr, gi = cr + dr, ci + di, cr - dr, ci - di
            _store(y, o, ar + ur + fr, ai + ui + fi)
            pr, pi = ar + c1 * ur + c2 * fr, ai + c1 * ui + c2 * fi
            qr, qi = s1 * vi + s2 * gi, s1 * vr + s2 * gr
            _turn_and_store(y, o + apart, w1r, w1i, pr + qr, pi - qi)
            _turn_and_store(y, o + 4 * apart, w4r, w4i, pr - qr, pi + qi)
            pr, pi = ar + c2 * ur + c1 * fr, ai + c2 * ui + c1 * fi
            qr, qi = s2 * vi - s1 * gi, s2 * vr - s1 * gr
            _turn_and_store(y, o + 2 * apart, w2r, w2i, pr + qr, pi - qi)
            _turn_and_store(y, o + 3 * apart, w3r, w3i, pr - qr, pi + qi)
