"""The array module as an argument: one record that holds NumPy with SciPy's FFT, or CuPy.

Layers are (m, nx, ny); spectra are real transforms, (m, Nx, Ny // 2 + 1). The source is turned
round before its transform, so that a plain product of spectra is a cross-correlation.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
import scipy.fft

from commonmap.errors import InputError, MissingExtraError

Array = Any


@dataclass(frozen=True, eq=False)
class Arrays:
    """An array module and its FFT. threads: the FFT takes a `workers` argument."""

    name: str
    xp: Any
    fft: Any
    threads: bool

    def to_host(self, array: Array) -> Array:
        """Return the array as NumPy's."""
        return array.get() if self.name == "cupy" else array


NUMPY = Arrays("numpy", np, scipy.fft, True)


def find_arrays(name: str) -> Arrays:
    """Return the array module of that name: "numpy", or "cupy" where the gpu extra is installed."""
    if name == "numpy":
        return NUMPY
    if name != "cupy":
        raise InputError(f"the array module must be numpy or cupy; {name!r} came")
    try:
        xp = importlib.import_module("cupy")
        fft = importlib.import_module("cupyx.scipy.fft")
    except ImportError as problem:
        raise MissingExtraError(
            "scores on a GPU need CuPy: pip install 'commonmap[gpu]'"
        ) from problem
    return Arrays("cupy", xp, fft, False)


def choose_shape(
    target_shape: tuple[int, int], source_shape: tuple[int, int], min_cells: int
) -> tuple[int, int]:
    """Return the size of the transforms, (Nx, Ny): no larger than the poses that count need.

    All shifts need `t + s - 1` per axis. Shifts at the rim, where the maps touch in so few
    rows that fewer than `min_cells` cells can lie on each other, may wrap onto each other.
    """
    lengths = []
    for axis in (0, 1):
        other = min(target_shape[1 - axis], source_shape[1 - axis])
        full = target_shape[axis] + source_shape[axis] - 1
        spare = max(0, (min_cells - 1) // other)
        need = max(full - spare, target_shape[axis], source_shape[axis])
        lengths.append(int(scipy.fft.next_fast_len(need, real=axis == 1)))
    return lengths[0], lengths[1]


def transform(arrays: Arrays, layers: Array, shape: tuple[int, int], workers: int) -> Array:
    """Return the spectra of the layers, padded with zeros to `shape`; empty rows are skipped."""
    options = {"workers": workers} if arrays.threads else {}
    rows = arrays.fft.rfft(layers, n=shape[1], axis=-1, **options)
    return arrays.fft.fft(rows, n=shape[0], axis=-2, **options)


def invert(arrays: Arrays, spectra: Array, shape: tuple[int, int], workers: int) -> Array:
    """Return the layers (m, Nx, Ny) of the spectra, which are overwritten."""
    options: dict[str, Any] = {"overwrite_x": True}
    if arrays.threads:
        options["workers"] = workers
    columns = arrays.fft.ifft(spectra, axis=-2, **options)
    return arrays.fft.irfft(columns, n=shape[1], axis=-1, **options)


def unroll(arrays: Arrays, layers: Array, out_shape: tuple[int, int]) -> Array:
    """Return the layers cut, or filled with zeros where they wrapped, to (m, Sx, Sy)."""
    m, nx, ny = layers.shape
    sx, sy = out_shape
    if nx >= sx and ny >= sy:
        return layers[:, :sx, :sy]
    out = arrays.xp.zeros((m, sx, sy), layers.dtype)
    out[:, : min(nx, sx), : min(ny, sy)] = layers[:, :sx, :sy]
    return out


@numba.njit(cache=True, nogil=True)
def _multiply_add(U: Array, W: Array, first: Array, f: Array, w: Array, out: Array) -> None:
    n = U.shape[1]
    block = 2048
    for start in range(0, n, block):
        stop = min(start + block, n)
        for m in range(out.shape[0]):
            for k in range(first[m], first[m + 1]):
                fk, wk = f[k], w[k]
                if k == first[m]:
                    for i in range(start, stop):
                        out[m, i] = U[fk, i] * W[wk, i]
                else:
                    for i in range(start, stop):
                        out[m, i] += U[fk, i] * W[wk, i]


def multiply_add(
    arrays: Arrays, U: Array, W: Array, pairs: Sequence[Sequence[tuple[int, int]]]
) -> Array:
    """Return, for each list of pairs (f, w), the spectrum `sum U[f] * W[w]`; (m, Nx, Ny//2+1)."""
    shape = (len(pairs), *U.shape[1:])
    if arrays.name == "numpy":
        out = np.empty(shape, U.dtype)
        flat = [pair for some in pairs for pair in some]
        first = np.cumsum([0, *(len(some) for some in pairs)])
        f, w = (np.array([pair[k] for pair in flat]) for k in (0, 1))
        size = int(np.prod(U.shape[1:]))
        _multiply_add(U.reshape(-1, size), W.reshape(-1, size), first, f, w, out.reshape(-1, size))
        return out
    out = arrays.xp.zeros(shape, U.dtype)
    for m, some in enumerate(pairs):
        for source, target in some:
            out[m] += U[source] * W[target]
    return out
