"""The array module as an argument: one record that holds NumPy with SciPy's FFT, or CuPy.

Layers are (m, nx, ny); spectra are real transforms, (m, Nx, Ny // 2 + 1). The source is turned
round before its transform, so that a plain product of spectra is a cross-correlation.
"""

from __future__ import annotations

import importlib
import threading
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
import scipy.fft
from numpy.typing import NDArray

from commonmap.errors import InputError, MissingExtraError
from commonmap.matching.lane_fft import find_length, plan_transform, transform_columns

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
    target_shape: tuple[int, int],
    source_shape: tuple[int, int],
    min_cells: int,
    rim: tuple[int, int] = (0, 0),
) -> tuple[int, int]:
    """Return the size of the transforms, (Nx, Ny): no larger than the poses that count need.

    All shifts need `t + s - 1` per axis. Shifts at the rim, where the maps touch in so few
    rows that fewer than `min_cells` cells can lie on each other, may wrap onto each other. rim: so
    many rows and columns at each end of a source hold fewer than that.
    """
    lengths = []
    for axis in (0, 1):
        other = min(target_shape[1 - axis], source_shape[1 - axis])
        full = target_shape[axis] + source_shape[axis] - 1
        spare = max(0, (min_cells - 1) // other, rim[axis])
        need = max(full - spare, target_shape[axis], source_shape[axis])
        lengths.append(find_length(need))
    return lengths[0], lengths[1]


def find_rim(
    sources: Iterable[NDArray[np.bool_]], source_shape: tuple[int, int], min_cells: int
) -> tuple[int, int]:
    """Return how many rows and columns at each end of all sources hold too few cells for a pose.

    sources: known masks (sx, sy) or smaller, as they will be scored, of `source_shape` padded.
    """
    rims = list(source_shape)
    for known in sources:
        pad = [(0, n - m) for n, m in zip(source_shape, known.shape, strict=True)]
        padded = np.pad(known, pad)
        rims = [min(rims[axis], count_rim(padded, axis, min_cells)) for axis in (0, 1)]
    return rims[0], rims[1]


def count_rim(known: NDArray[np.bool_], axis: int, min_cells: int) -> int:
    """Return how many rows (axis 0) or columns at either end hold fewer than `min_cells` cells."""
    cells = np.count_nonzero(known, axis=1 - axis)
    ends = (np.searchsorted(np.cumsum(some), min_cells) for some in (cells, cells[::-1]))
    return int(min(ends))


_own = threading.local()


def borrow(arrays: Arrays, role: str, shape: tuple[int, ...], dtype: Any) -> Array:
    """Return an array of this thread to write into, the same one again for the same role.

    What a fresh array of many megabytes costs is not its values but its pages: a third of the time
    of a score. The array is good until this thread borrows for that role again.
    """
    if arrays.name != "numpy" or not role:
        return arrays.xp.empty(shape, dtype)
    store = _own.__dict__
    array = store.get(role)
    if array is None or array.shape != shape or array.dtype != dtype:
        array = store[role] = np.empty(shape, dtype)
    return array


def give_back(prefix: str) -> None:
    """Let go of what this thread borrowed for roles that begin so: a thread may live long."""
    for role in [role for role in _own.__dict__ if role.startswith(prefix)]:
        del _own.__dict__[role]


def transform(
    arrays: Arrays, layers: Array, shape: tuple[int, int], workers: int, role: str = ""
) -> Array:
    """Return the spectra of the layers, padded with zeros to `shape`; empty rows are skipped.

    role: of the array to borrow for them; without one they have an array of their own. workers:
    threads along the second axis, on the CPU. There the first axis takes the lengths of
    `lane_fft.find_length`.
    """
    one = np.result_type(layers.dtype, np.complex64)
    out = borrow(arrays, role, (layers.shape[0], shape[0], shape[1] // 2 + 1), one)
    for k in range(layers.shape[0]):
        if arrays.threads:
            rows = arrays.fft.rfft(layers[k], n=shape[1], axis=-1, workers=workers)
            _transform_first_axis(rows, out[k], 1)
        else:
            rows = arrays.fft.rfft(layers[k], n=shape[1], axis=-1)
            out[k] = arrays.fft.fft(rows, n=shape[0], axis=-2)
    return out


def invert(
    arrays: Arrays, spectra: Array, shape: tuple[int, int], workers: int, role: str = ""
) -> Array:
    """Return the layers (m, Nx, Ny) of the spectra, which are overwritten; the rest as above."""
    out = borrow(arrays, role, (spectra.shape[0], *shape), spectra.real.dtype)
    for k in range(spectra.shape[0]):
        if arrays.threads:
            _transform_first_axis(spectra[k], spectra[k], -1)
            out[k] = arrays.fft.irfft(
                spectra[k], n=shape[1], axis=-1, overwrite_x=True, workers=workers
            )
        else:
            columns = arrays.fft.ifft(spectra[k], axis=-2, overwrite_x=True)
            out[k] = arrays.fft.irfft(columns, n=shape[1], axis=-1, overwrite_x=True)
    return out


def _transform_first_axis(values: Array, out: Array, sign: int) -> None:
    """Set out (n, m) to the transform of complex values (n_in, m) along their first axis.

    sign: 1 forward; -1 back, divided by n.
    """
    number = out.real.dtype.type
    n, width = out.shape
    plan = plan_transform(n, number)
    transform_columns(
        values.view(number).reshape(-1), out.view(number).reshape(-1), len(values), width,
        plan, number(sign), number(1.0 if sign > 0 else 1.0 / n),
    )  # fmt: skip


@numba.njit(cache=True, nogil=True, fastmath={"contract", "nsz"})
def _multiply_add(
    U: Array, W: Array, first: Array, f: Array, w: Array, out: Array, turned: Array
) -> None:  # pragma: no cover
    """out[m] = sum U[f] W[w], turned[m] = sum conj(U[f]) W[w], where they have rows.

    U, out, turned: (., F, 2) interleaved, W: (., 2, F) planar. In blocks that stay in the cache;
    the sum at each frequency runs in the order of the pairs, whatever the block.
    """
    n = U.shape[1]
    block = 1024
    u = np.empty((U.shape[0], 2, block), U.dtype)
    s = np.empty((4, block), U.dtype)
    for start in range(0, n, block):
        size = min(block, n - start)
        for k in range(U.shape[0]):
            for i in range(size):
                u[k, 0, i] = U[k, start + i, 0]
                u[k, 1, i] = U[k, start + i, 1]
        for m in range(first.shape[0] - 1):
            s[:] = 0.0
            k = first[m]
            while k + 3 < first[m + 1]:  # four at a time: the sums stay in registers longer
                ra, ia, rb, ib = u[f[k], 0], u[f[k], 1], u[f[k + 1], 0], u[f[k + 1], 1]
                rc, ic, rd, ie = u[f[k + 2], 0], u[f[k + 2], 1], u[f[k + 3], 0], u[f[k + 3], 1]
                xa, ya = W[w[k], 0, start : start + size], W[w[k], 1, start : start + size]
                xb, yb = W[w[k + 1], 0, start : start + size], W[w[k + 1], 1, start : start + size]
                xc, yc = W[w[k + 2], 0, start : start + size], W[w[k + 2], 1, start : start + size]
                xd, yd = W[w[k + 3], 0, start : start + size], W[w[k + 3], 1, start : start + size]
                for i in range(size):
                    s[0, i] += ra[i] * xa[i] + rb[i] * xb[i] + rc[i] * xc[i] + rd[i] * xd[i]
                    s[1, i] += ia[i] * ya[i] + ib[i] * yb[i] + ic[i] * yc[i] + ie[i] * yd[i]
                for i in range(size):
                    s[2, i] += ra[i] * ya[i] + rb[i] * yb[i] + rc[i] * yc[i] + rd[i] * yd[i]
                    s[3, i] += ia[i] * xa[i] + ib[i] * xb[i] + ic[i] * xc[i] + ie[i] * xd[i]
                k += 4
            for rest in range(k, first[m + 1]):
                re, im = u[f[rest], 0], u[f[rest], 1]
                wr, wi = W[w[rest], 0, start : start + size], W[w[rest], 1, start : start + size]
                for i in range(size):
                    s[0, i] += re[i] * wr[i]
                    s[1, i] += im[i] * wi[i]
                    s[2, i] += re[i] * wi[i]
                    s[3, i] += im[i] * wr[i]
            if out.shape[0] > 0:
                for i in range(size):
                    out[m, start + i, 0] = s[0, i] - s[1, i]
                    out[m, start + i, 1] = s[2, i] + s[3, i]
            if turned.shape[0] > 0:
                for i in range(size):
                    turned[m, start + i, 0] = s[0, i] + s[1, i]
                    turned[m, start + i, 1] = s[2, i] - s[3, i]


def pack(arrays: Arrays, spectra: Array) -> Array:
    """Return spectra as `multiply_add` wants the target's: on the CPU, real and imaginary apart."""
    if arrays.name != "numpy":
        return spectra
    flat = spectra.reshape(spectra.shape[0], -1)
    return np.stack([flat.real, flat.imag], axis=1)


def multiply_add(
    arrays: Arrays,
    U: Array,
    W: Array,
    pairs: Sequence[Sequence[tuple[int, int]]],
    turns: Sequence[bool] = (False,),
) -> list[Array]:
    """Return, per turn, the spectra `sum U[f] * W[w]` of each list of pairs (f, w).

    The spectra are borrowed. W: as `pack` returns it. A half turn conjugates U, up to a shift.
    """
    shape = (len(pairs), *U.shape[1:])
    if arrays.name == "numpy":
        outs = {turn: borrow(arrays, f"products {turn}", shape, U.dtype) for turn in turns}
        none = np.empty((0, *U.shape[1:]), U.dtype)
        flat = [pair for some in pairs for pair in some]
        first = np.cumsum([0, *(len(some) for some in pairs)])
        f, w = (np.array([pair[k] for pair in flat]) for k in (0, 1))
        planes = [U, outs.get(False, none), outs.get(True, none)]
        u, out, turned = (x.view(W.dtype).reshape(x.shape[0], W.shape[-1], 2) for x in planes)
        _multiply_add(u, W, first, f, w, out, turned)
        return [outs[turn] for turn in turns]
    results = []
    for turn in turns:
        total = arrays.xp.zeros(shape, U.dtype)
        V = U.conj() if turn else U
        for m, some in enumerate(pairs):
            for source, target in some:
                total[m] += V[source] * W[target]
        results.append(total)
    return results
