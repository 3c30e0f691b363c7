"""From a metric's plan to cross-correlations: sums of products of layers of the two maps.

Every road ends in outputs `sum over pairs of (source layer) * (target layer)`, correlated: one
inverse transform an output, however many pairs. `Products` holds the target's half of them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from commonmap.matching import arrays as fourier
from commonmap.matching.arrays import Array, Arrays
from commonmap.metrics.plans import BASIS, Term
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

    def source_spectra(self, layers: Float64s, workers: int, role: str = "") -> Array:
        """Return the spectra of the (m, sx, sy) layers of the source, turned round."""
        turned = np.ascontiguousarray(layers[:, ::-1, ::-1], dtype=self.dtype)
        placed = self.arrays.xp.asarray(turned)
        return fourier.transform(self.arrays, placed, self.shape, workers, role)

    def target_spectra(self, layers: Float64s, workers: int) -> Array:
        """Return the spectra of the (m, tx, ty) layers of the target."""
        placed = self.arrays.xp.asarray(layers.astype(self.dtype))
        return fourier.transform(self.arrays, placed, self.shape, workers)

    def correlate(self, spectra: Array, workers: int, role: str = "") -> Array:
        """Return the correlations (m, Nx, Ny) of products of spectra, which are overwritten.

        [u, v] is the shift of the surface's [u, v], modulo the size of the transforms; where the
        source's spectra were conjugated for a half turn, `rows_of` says where a shift is.
        """
        return fourier.invert(self.arrays, spectra, self.shape, workers, role)

    def rows_of(self, shifts: Any, axis: int, *, turned: bool) -> Any:
        """Return the places along `axis` of the surface's shifts: a half turn moves them."""
        moved = shifts - (self.source_shape[axis] - 1) if turned else shifts
        return moved % self.shape[axis]

    def place(self, seen: Array, fill: float, *, turned: bool) -> Array:
        """Return what `correlate` gave for one layer as the surface, on the host.

        Shifts beyond the size of the transforms are filled.
        """
        host = self.arrays.to_host(seen)
        whole = np.full(self.out_shape, fill, host.dtype)
        spans = []
        for axis in (0, 1):
            stop = min(self.out_shape[axis], self.shape[axis])
            first = int(self.rows_of(0, axis, turned=turned))
            until = min(stop, self.shape[axis] - first)  # from here the places start at 0 again
            spans.append(((0, until, first), (until, stop, 0)))
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
    target_norm: of each target layer. role: under which the outputs are borrowed.
    """

    frame: Frame
    layers: Callable[[Float64s, Bools], Float64s]
    spectra: Array
    pairs: tuple[tuple[tuple[int, int], ...], ...]
    target_norm: Float64s
    role: str

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

        The outputs are borrowed: good until the next call for the same role in this thread.
        turns: False for the source as it is, True for the source after half a turn.
        weights: per turn (m,), to sum the outputs to a single one before its inverse transform.
        """
        layers = self.layers(h, known)
        U = self.frame.source_spectra(layers, workers, "source")
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
        surfaces = [
            self.frame.correlate(spectra, workers, f"{self.role} {turn}")
            for spectra, turn in zip(outputs, turns, strict=True)
        ]
        return surfaces, rounding


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
    return Products(frame, layers, spectra, tuple(pairs), norm(stack), "moments")
