"""Sums `sum P^alpha Q^beta (psi + linear)(ln(Q / P))` at every pose, by products of spectra."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numba
import numpy as np

from commonmap.matching import arrays as fourier
from commonmap.matching.arrays import Array, Arrays
from commonmap.matching.expansion import Separated, expand, separate
from commonmap.matching.roads import Frame, Products, norm
from commonmap.metrics.plans import Smooth
from commonmap.types import Bools, Float64s

AT_ONCE = 8
"""Layers of the target that are expanded together: more would take more memory and no less time."""


@dataclass(frozen=True, eq=False)
class Kernel:
    """`sum a^alpha b^beta (psi + linear)(ln b - ln a + g)`: one output a function of g."""

    plan: Smooth
    products: Products
    separated: Separated


@lru_cache(maxsize=64)
def _split(
    psi: str, linear: float, low: float, high: float, g0: float, g1: float, tolerance: float
) -> Separated:
    width = high - low
    half_width = max(width - g0, width + g1)
    expansion = expand(psi, half_width, 0.4 * tolerance)
    rest = tolerance - expansion.error
    return separate(expansion, (low, high), (low, high), (g0, g1), rest, linear)


@numba.njit(cache=True, nogil=True)
def _fill_waves(
    h: Array, known: Array, rows: Array, step: float, centre: float, power: float, out: Array
) -> None:  # pragma: no cover
    """out[r] = rows[r] . [cos(k step x), sin(k step x), x] h^power, x = ln h - centre."""
    K = (rows.shape[1] - 1) // 2
    wave = np.empty(rows.shape[1])
    for i in range(h.shape[0]):
        for j in range(h.shape[1]):
            if not known[i, j]:
                continue
            x = np.log(h[i, j]) - centre
            scale = h[i, j] ** power
            c1, s1 = np.cos(step * x), np.sin(step * x)
            c, s = scale, 0.0
            for k in range(K):
                wave[k], wave[K + k] = c, s
                c, s = c * c1 - s * s1, s * c1 + c * s1
            wave[2 * K] = scale * x
            for r in range(rows.shape[0]):
                total = 0.0
                for k in range(rows.shape[1]):
                    total += rows[r, k] * wave[k]
                out[r, i, j] = total


def kernel_products(
    frame: Frame,
    plan: Smooth,
    log_range: tuple[float, float],
    g_range: tuple[float, float],
    tolerance: float,
    height_t: Float64s,
    known_t: Bools,
    workers: int,
) -> Kernel:
    """Return the products for a kernel. log_range: of ln h over both maps."""
    centre = 0.5 * (log_range[0] + log_range[1])
    low, high = log_range[0] - centre, log_range[1] - centre
    separated = _split(plan.psi, plan.linear, low, high, g_range[0], g_range[1], tolerance)

    def expand_layers(h: Float64s, known: Bools, rows: Float64s, power: float) -> Float64s:
        out = np.zeros((rows.shape[0], *h.shape))
        _fill_waves(h, known, rows, separated.omega[1], centre, power, out)
        return out

    def layers(h: Float64s, known: Bools) -> Float64s:
        return expand_layers(h, known, separated.source, plan.alpha)

    listed = [(m, p) for m, some in enumerate(separated.pairs) for p in some]
    number = {pair: w for w, pair in enumerate(listed)}
    pairs = tuple(tuple((p, number[m, p]) for p in some) for m, some in enumerate(separated.pairs))
    rows = separated.target[tuple(np.array(listed).T)]
    norms = np.empty(len(rows))
    W: Array = None
    for start in range(0, len(rows), AT_ONCE):
        chunk = slice(start, start + AT_ONCE)
        stack = expand_layers(height_t, known_t, rows[chunk], plan.beta)
        packed = fourier.pack(frame.arrays, frame.target_spectra(stack, workers))
        if W is None:  # joined at the end they would be copied once more
            W = frame.arrays.xp.empty((len(rows), *packed.shape[1:]), packed.dtype)
        W[chunk], norms[chunk] = packed, norm(stack)
    return Kernel(plan, Products(frame, layers, W, pairs, norms, "kernel"), separated)


@numba.njit(cache=True, nogil=True)
def _evaluate_compiled(
    values: Array,
    mix: Array,
    g: Array,
    A: Array,
    B: Array,
    middle: float,
    half: float,
    alpha: float,
    beta: float,
    counted: Array,
    out: Array,
) -> None:  # pragma: no cover
    nodes, n_mixed = mix.shape
    width = A.shape[1]
    T = np.empty((nodes + 3, width), values.dtype)  # Chebyshev's polynomials; three rows to fill up
    T[nodes:] = 0.0
    padded = np.zeros((nodes + 3, n_mixed), values.dtype)
    padded[:nodes] = mix
    x, f, total = np.empty(width, T.dtype), np.empty(width, T.dtype), np.empty(width, T.dtype)
    one, two = x.dtype.type(1.0), x.dtype.type(2.0)
    origin, scale = x.dtype.type(middle), x.dtype.type(1.0 / half if half > 0.0 else 0.0)
    for i in range(A.shape[0]):
        if not counted[i].any():
            out[i] = np.nan
            continue
        for j in range(width):
            x[j] = (g[i, j] - origin) * scale
        for j in range(width):  # outside of the range nothing is counted
            x[j] = one if x[j] > one else (-one if x[j] < -one else x[j])
        T[0] = one
        if nodes > 1:
            T[1] = x
        for m in range(2, nodes):
            for j in range(width):
                T[m, j] = two * x[j] * T[m - 1, j] - T[m - 2, j]
        total[:] = 0.0
        for k in range(n_mixed):
            f[:] = 0.0
            for m in range(0, nodes, 4):  # four at a time: the sum stays in registers longer
                a, b, c, d = padded[m, k], padded[m + 1, k], padded[m + 2, k], padded[m + 3, k]
                Ta, Tb, Tc, Td = T[m], T[m + 1], T[m + 2], T[m + 3]
                for j in range(width):
                    f[j] += a * Ta[j] + b * Tb[j] + c * Tc[j] + d * Td[j]
            for j in range(width):
                total[j] += f[j] * values[k, i, j]
        for j in range(width):
            if not counted[i, j]:
                out[i, j] = np.nan
                continue
            if beta == 0.0:
                out[i, j] = total[j] / A[i, j] if alpha == 1.0 else total[j]
            else:
                out[i, j] = total[j] / (A[i, j] ** alpha * B[i, j] ** beta)


def evaluate_kernel(
    arrays: Arrays, kernel: Kernel, values: Array, A: Array, B: Array, counted: Array
) -> Array:
    """Return `sum P^alpha Q^beta (psi + linear)(s)` from the outputs, where counted; else NaN.

    Chebyshev's polynomials of g = ln(A / B) follow from each other. g is as precise as
    the transforms: single precision moves the score by 1e-7 or so, far below their rounding.
    """
    separated, plan = kernel.separated, kernel.plan
    g = np.log(np.divide(A, B, dtype=values.dtype))
    if arrays.name == "numpy":
        out = np.empty(A.shape, np.float64)
        _evaluate_compiled(
            values, separated.mix.astype(values.dtype), g, A, B, separated.middle, separated.half,
            plan.alpha, plan.beta, counted, out,
        )  # fmt: skip
        return out
    xp = arrays.xp
    position = xp.zeros(A.shape)
    if separated.half > 0.0:
        position = xp.clip((g - separated.middle) / separated.half, -1.0, 1.0)
    f = xp.tensordot(xp.asarray(separated.mix), values.astype(np.float64), axes=1)
    b1, b2 = 0.0 * position, 0.0 * position
    for m in range(f.shape[0] - 1, 0, -1):
        b1, b2 = 2.0 * position * b1 - b2 + f[m], b1
    return (position * b1 - b2 + f[0]) / (A**plan.alpha * B**plan.beta)


@numba.njit(cache=True, nogil=True)
def _ratio_range_compiled(
    A: Array, B: Array, counted: Array
) -> tuple[float, float]:  # pragma: no cover
    low, high = np.inf, 0.0
    for i in range(A.shape[0]):
        for j in range(A.shape[1]):
            if counted[i, j]:
                ratio = A[i, j] / B[i, j]
                low, high = min(low, ratio), max(high, ratio)
    return low, high


def ratio_range(arrays: Arrays, A: Array, B: Array, counted: Array) -> tuple[float, float]:
    """Return the range of ln(A / B) over the counted poses; (0, 0) where none counts."""
    if arrays.name == "numpy":
        low, high = _ratio_range_compiled(A, B, counted)
    else:
        xp, ratio = arrays.xp, A / B
        low = float(xp.where(counted, ratio, np.inf).min())
        high = float(xp.where(counted, ratio, 0.0).max())
    return (float(np.log(low)), float(np.log(high))) if high > 0.0 else (0.0, 0.0)
