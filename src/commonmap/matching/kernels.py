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
    return separate(expansion, (low, high), (low, high), (g0, g1), 0.6 * tolerance, linear)


@numba.njit(cache=True, nogil=True)
def _fill_waves(
    h: Array, known: Array, rows: Array, step: float, centre: float, power: float, out: Array
) -> None:  # pragma: no cover
    """out[r] = rows[r] . [cos(k step x), sin(k step x), x] h^power, x = ln h - centre."""
    K = (rows.shape[1] - 1) // 2
    for i in range(h.shape[0]):
        for j in range(h.shape[1]):
            if not known[i, j]:
                continue
            x = np.log(h[i, j]) - centre
            scale = h[i, j] ** power
            c1, s1 = np.cos(step * x), np.sin(step * x)
            c, s = 1.0, 0.0
            for r in range(rows.shape[0]):
                out[r, i, j] = rows[r, 2 * K] * x
            for k in range(K):
                for r in range(rows.shape[0]):
                    out[r, i, j] += rows[r, k] * c + rows[r, K + k] * s
                c, s = c * c1 - s * s1, s * c1 + c * s1
            for r in range(rows.shape[0]):
                out[r, i, j] *= scale


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

    spectra, norms = [], []
    pairs: list[tuple[tuple[int, int], ...]] = []
    for m, some in enumerate(separated.pairs):
        first = sum(len(earlier) for earlier in pairs)
        pairs.append(tuple((p, first + k) for k, p in enumerate(some)))
        if not some:
            continue
        stack = expand_layers(height_t, known_t, separated.target[m, list(some)], plan.beta)
        spectra.append(fourier.pack(frame.arrays, frame.target_spectra(stack, workers)))
        norms.append(norm(stack))
    W = frame.arrays.xp.concatenate(spectra)
    return Kernel(
        plan, Products(frame, layers, W, tuple(pairs), np.concatenate(norms), "kernel"), separated
    )


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
    f, x = np.empty((nodes, width), values.dtype), np.zeros(width, values.dtype)
    b1, b2 = np.empty(width, values.dtype), np.empty(width, values.dtype)
    two = x.dtype.type(2.0)
    for i in range(A.shape[0]):
        if not counted[i].any():
            out[i] = np.nan
            continue
        if half > 0.0:
            for j in range(width):
                x[j] = min(1.0, max(-1.0, (g[i, j] - middle) / half))
        f[:] = 0.0
        for k in range(n_mixed):
            for m in range(nodes):
                factor = mix[m, k]
                for j in range(width):
                    f[m, j] += factor * values[k, i, j]
        b1[:] = 0.0
        b2[:] = 0.0
        for m in range(nodes - 1, 0, -1):
            for j in range(width):
                b = two * x[j] * b1[j] - b2[j] + f[m, j]
                b2[j] = b1[j]
                b1[j] = b
        for j in range(width):
            if not counted[i, j]:
                out[i, j] = np.nan
                continue
            total = x[j] * b1[j] - b2[j] + f[0, j]
            if beta == 0.0:
                out[i, j] = total / A[i, j] if alpha == 1.0 else total
            else:
                out[i, j] = total / (A[i, j] ** alpha * B[i, j] ** beta)


def evaluate_kernel(
    arrays: Arrays, kernel: Kernel, values: Array, A: Array, B: Array, counted: Array
) -> Array:
    """Return `sum P^alpha Q^beta (psi + linear)(s)` from the outputs, where counted; else NaN.

    Chebyshev's polynomials of g = ln(A / B) are summed by Clenshaw's recurrence. g is as precise as
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
