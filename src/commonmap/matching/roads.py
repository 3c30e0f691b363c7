"""The roads from a metric's plan to cross-correlations: products, kernels, classes, histograms.

Every road ends in outputs `sum over pairs of (source layer) * (target layer)`, correlated: one
inverse transform an output, however many pairs. `Products` holds the target's half of them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numba
import numpy as np

from commonmap.matching import arrays as fourier
from commonmap.matching.arrays import Array, Arrays
from commonmap.matching.expansion import Separated, expand, separate
from commonmap.metrics.plans import BASIS, Smooth, Term
from commonmap.types import Bools, Float64s


@dataclass(frozen=True, eq=False)
class Frame:
    """Sizes and settings that all transforms of one prepared target share.

    shape: of the transforms. out_shape: of the surface. dtype: float32 or float64.
    """

    arrays: Arrays
    shape: tuple[int, int]
    source_shape: tuple[int, int]
    out_shape: tuple[int, int]
    dtype: type[np.floating]

    @property
    def rounding(self) -> float:
        """The error of one correlation is at most about this times the norms of its two layers.

        u log2(N), u the unit roundoff: the standard growth of a transform's rounding with its
        size N (Higham 2002, section 24.1), here of three transforms and a product.
        """
        return 0.5 * float(np.finfo(self.dtype).eps) * float(np.log2(np.prod(self.shape)))

    def source_spectra(self, layers: Float64s, workers: int) -> Array:
        """Return the spectra of the (m, sx, sy) layers of the source, turned round."""
        turned = np.ascontiguousarray(layers[:, ::-1, ::-1], dtype=self.dtype)
        return fourier.transform(self.arrays, self.arrays.xp.asarray(turned), self.shape, workers)

    def target_spectra(self, layers: Float64s, workers: int) -> Array:
        """Return the spectra of the (m, tx, ty) layers of the target."""
        placed = self.arrays.xp.asarray(layers.astype(self.dtype))
        return fourier.transform(self.arrays, placed, self.shape, workers)

    def correlate(self, spectra: Array, workers: int) -> Array:
        """Return the correlations (m, Nx, Ny) of products of spectra, which are overwritten.

        [u, v] is the shift of the surface's [u, v], modulo the size of the transforms; where the
        source's spectra were conjugated for a half turn, `rows_of` says where a shift is.
        """
        return fourier.invert(self.arrays, spectra, self.shape, workers)

    def rows_of(self, shifts: Any, axis: int, *, turned: bool) -> Any:
        """Return the places along `axis` of the surface's shifts: a half turn moves them."""
        moved = shifts - (self.source_shape[axis] - 1) if turned else shifts
        return moved % self.shape[axis]

    def place(self, seen: Array, fill: float, *, turned: bool) -> Array:
        """Return what `correlate` gave for one layer as the surface, on the host.

        Shifts of the rim that wrap onto each other are filled.
        """
        host = self.arrays.to_host(seen)
        whole = np.full(self.out_shape, fill, host.dtype)
        spans = []
        for axis in (0, 1):
            wrapped = max(0, self.out_shape[axis] - self.shape[axis])
            start, stop = wrapped, min(self.out_shape[axis], self.shape[axis])
            first = int(self.rows_of(start, axis, turned=turned))
            until = min(stop, start + self.shape[axis] - first)  # then the places start at 0 again
            spans.append(((start, until, first), (until, stop, 0)))
        for u0, u1, i in spans[0]:
            for v0, v1, j in spans[1]:
                if u1 > u0 and v1 > v0:
                    whole[u0:u1, v0:v1] = host[i : i + u1 - u0, j : j + v1 - v0]
        return whole


def norm(layers: Float64s) -> Float64s:
    """Return the Euclidean norm of each layer, (m,)."""
    return np.asarray(np.sqrt(np.sum(layers * layers, axis=(-2, -1))))


@dataclass(frozen=True, eq=False)
class Products:
    """Outputs that are sums of products of source layers and target layers.

    layers: (h, known) -> the (m, sx, sy) source layers. spectra: of the target layers.
    packed, for `multiply_add`. pairs: per output, which source layer meets which target layer.
    target_norm: of each target layer.
    """

    frame: Frame
    layers: Callable[[Float64s, Bools], Float64s]
    spectra: Array
    pairs: tuple[tuple[tuple[int, int], ...], ...]
    target_norm: Float64s

    def correlate(
        self,
        h: Float64s,
        known: Bools,
        *,
        turns: Sequence[bool] = (False,),
        weights: Sequence[Float64s] | None = None,
        workers: int = 1,
    ) -> tuple[list[Array], Float64s]:
        """Return per turn the outputs (m, ...), and what rounding may have added to each, (m,).

        turns: False for the source as it is, True for the source after half a turn.
        weights: per turn (m,), to sum the outputs to a single one before its inverse transform.
        """
        layers = self.layers(h, known)
        U = self.frame.source_spectra(layers, workers)
        outputs = fourier.multiply_add(self.frame.arrays, U, self.spectra, self.pairs, turns)
        norms = norm(layers)
        rounding = self.frame.rounding * np.array(
            [sum(norms[f] * self.target_norm[w] for f, w in some) for some in self.pairs]
        )
        if weights is not None:
            factors = [self.frame.arrays.xp.asarray(w.astype(self.frame.dtype)) for w in weights]
            outputs = [
                (spectra * factor[:, None, None]).sum(axis=0, keepdims=True)
                for spectra, factor in zip(outputs, factors, strict=True)
            ]
            rounding = np.array([np.max(np.abs(np.stack(weights)), axis=0) @ rounding])
        return [self.frame.correlate(spectra, workers) for spectra in outputs], rounding


def _evaluate(name: str, h: Float64s, known: Bools, unit: float) -> Float64s:
    """Return the function `name` of the heights, 0 where not known; logarithms count from unit."""
    safe = np.where(known, h, 1.0)
    if name == "ln h":
        value = np.log(safe / unit)
    elif name == "h ln h":
        value = safe * np.log(safe / unit)
    else:
        value = BASIS[name](safe)
    return np.where(known, value, 0.0)


def moment_products(
    frame: Frame,
    terms: Mapping[str, Sequence[Term]],
    height_t: Float64s,
    known_t: Bools,
    *,
    unit: float,
    workers: int,
) -> Products:
    """Return the products for the named moments, one output a name, in the order of the names."""
    source_names = sorted({f for some in terms.values() for _, f, _ in some})
    wanted: dict[tuple[tuple[float, str], ...], int] = {}
    pairs = []
    for some in terms.values():
        by_source: dict[str, list[tuple[float, str]]] = {}
        for factor, f, g in some:
            by_source.setdefault(f, []).append((factor, g))
        pairs.append(
            tuple(
                (source_names.index(f), wanted.setdefault(tuple(combination), len(wanted)))
                for f, combination in by_source.items()
            )
        )
    stack = np.stack(
        [
            sum(
                (factor * _evaluate(g, height_t, known_t, unit) for factor, g in combination),
                np.zeros(height_t.shape),
            )
            for combination in wanted
        ]
    )

    def layers(h: Float64s, known: Bools) -> Float64s:
        return np.stack([_evaluate(f, h, known, unit) for f in source_names])

    spectra = fourier.pack(frame.arrays, frame.target_spectra(stack, workers))
    return Products(frame, layers, spectra, tuple(pairs), norm(stack))


# Kernels ------------------------------------------------------------------------------------------


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
    return Kernel(plan, Products(frame, layers, W, tuple(pairs), np.concatenate(norms)), separated)


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


# Classes ------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Steps:
    """Heights cut into `count` equal steps of `low .. high`, of h or of ln h."""

    low: float
    high: float
    count: int
    logarithmic: bool

    @property
    def step(self) -> float:
        """The width of a step, in metres or of ln h."""
        return (self.high - self.low) / self.count

    def index(self, h: Float64s) -> Float64s:
        """Return the class of each height, 0 .. count - 1."""
        x = np.log(h) if self.logarithmic else h
        return np.clip(np.floor((x - self.low) / self.step), 0, self.count - 1)

    def snap(self, h: Float64s) -> Float64s:
        """Return each height moved to the middle of its class."""
        middle = self.low + (self.index(h) + 0.5) * self.step
        return np.exp(middle) if self.logarithmic else middle


@dataclass(frozen=True, eq=False)
class Classes:
    """The layers of each class: one where a cell is of that class, else zero."""

    frame: Frame
    steps: Steps
    spectra: Array
    target_norm: Float64s

    def source(
        self, h: Float64s, known: Bools, workers: int, *, weighted: bool = False
    ) -> tuple[Array, Float64s]:
        """Return the spectra and the norms of the source's classes, times the heights if asked."""
        layers = class_layers(self.steps, h, known)
        if weighted:
            layers = layers * np.where(known, self.steps.snap(np.where(known, h, 1.0)), 0.0)
        return self.frame.source_spectra(layers, workers), norm(layers)

    def difference(
        self,
        U: Array,
        weigh: Callable[[Float64s], Float64s],
        shift: int,
        workers: int,
    ) -> Array:
        """Return `sum_ij weigh((j - i + shift) step) U_i V_j` at every pose, (Sx, Sy)."""
        xp, count = self.frame.arrays.xp, self.steps.count
        j = np.arange(count, dtype=np.float64)
        total = xp.zeros(U.shape[1:], U.dtype)
        table = weigh((j[None, :] - j[:, None] + shift) * self.steps.step)
        factor = xp.asarray(table.astype(self.frame.dtype))
        flat = self.spectra.reshape(count, -1)
        block = 16384
        out, u = total.reshape(-1), U.reshape(count, -1)
        for start in range(0, flat.shape[1], block):
            part = slice(start, start + block)
            out[part] = (u[:, part] * (factor @ flat[:, part])).sum(axis=0)
        return self.frame.correlate(total[None], workers)[0]


def class_layers(steps: Steps, h: Float64s, known: Bools) -> Float64s:
    """Return the (count, nx, ny) layers, one where a known cell is of the class."""
    index = np.where(known, steps.index(np.where(known, h, 1.0)), -1.0)
    return np.asarray(
        index[None] == np.arange(steps.count, dtype=np.float64)[:, None, None], np.float64
    )


def class_products(
    frame: Frame, steps: Steps, height_t: Float64s, known_t: Bools, workers: int
) -> Classes:
    """Return the target's half of the class layers."""
    layers = class_layers(steps, height_t, known_t)
    return Classes(frame, steps, frame.target_spectra(layers, workers), norm(layers))


def mutual_information(
    classes: Classes, h: Float64s, known: Bools, known_t: Array, n: Array, workers: int
) -> Array:
    """Return the mutual information at every pose from the joint counts, which are whole numbers.

    known_t: the spectrum of the target's mask. Counts of the last row and column follow from
    those of the others and from the masks.
    """
    frame, count = classes.frame, classes.steps.count
    xp = frame.arrays.xp
    U, _ = classes.source(h, known, workers)
    known_s = frame.source_spectra(known[None].astype(np.float64), workers)[0]

    def counted(spectra: Array) -> Array:
        return xp.maximum(xp.rint(frame.correlate(spectra, workers)), 0.0).astype(np.float64)

    def entropy(counts: Array) -> Array:
        return counts * np.log(xp.maximum(counts, 1.0))

    columns = counted(known_s[None] * classes.spectra[:-1])
    last_column = n - columns.sum(axis=0)
    last_row = columns.copy()
    total = -entropy(columns).sum(axis=0) - entropy(last_column)
    rows = xp.zeros_like(total)
    for i in range(count - 1):
        joint = counted(U[i][None] * classes.spectra[:-1])
        row = counted((U[i] * known_t)[None])[0]
        total += entropy(joint).sum(axis=0) + entropy(row - joint.sum(axis=0)) - entropy(row)
        last_row -= joint
        rows += row
    last = n - rows
    total += entropy(last_row).sum(axis=0) + entropy(last - last_row.sum(axis=0)) - entropy(last)
    return xp.maximum(total / xp.maximum(n, 1.0) + np.log(xp.maximum(n, 1.0)), 0.0)
