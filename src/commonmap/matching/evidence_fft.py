"""The evidence of every translation of a source, from counts by FFT, for several yaws at a time.

The four counts of `evidence.py` are cross-correlations of layers of ones and zeros. Here is how
they cost little. Two real layers of the source are the real and the imaginary part of one complex
*lane*, two counts are those of one product:

    F^-1[ X_a T_a + i X_b T_b ]  =  (a on T_a)  +  i (b on T_b)

where both layers come from one lane Z = X_a + i X_b, of which `X_a = (Z(f) + conj Z(-f)) / 2` and
`X_b = (Z(f) - conj Z(-f)) / 2i`. So a product is `Z(f) A + conj(Z(-f)) B`, with A and B from the
target's spectra alone. Eight yaws go side by side through every transform (`lane_fft.py`). Of the
counts only those of one row of translations exist at a time; they are whole numbers, so rounding
takes away what single precision adds, and the answer is the same to the bit whatever the size of
the transforms or the number of yaws at a time.

On a GPU the same counts come from CuPy's transforms, `evidence_device.py`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import zip_longest
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from commonmap.matching import evidence_device
from commonmap.matching.arrays import NUMPY, Array, Arrays, borrow, give_back
from commonmap.matching.evidence import xlogx_table
from commonmap.matching.evidence_kernels import (
    find_peaks,
    multiply_and_invert,
    score_rows,
    transform_sources,
)
from commonmap.matching.lane_fft import STEP, Plan, find_length, plan_transform
from commonmap.matching.lanes import WIDTH
from commonmap.matching.peaks import local_maxima
from commonmap.matching.slabs import Bits, Range, SlabGrid, find_standing, is_shared, unpack
from commonmap.types import Float32s, Float64s


@dataclass(frozen=True, eq=False)
class Spectra:
    """Forward transforms of one target, and the translations that they serve.

    layers: per slab what is occupied, then per slab what is known, or once where all slabs share
    it; (n, Ny, Nx, 2) real and imaginary, divided by Nx * Ny, on the CPU, (n, Nx, Ny // 2 + 1)
    on a device. rows, columns: the translations [u, v] that are told. standing: of each slab,
    whether anything is occupied in it. plans: of the transforms along x and y.
    """

    layers: Array
    source_shape: tuple[int, int]
    rows: Range
    columns: Range
    fft_shape: tuple[int, int]
    shared_known: bool
    standing: tuple[bool, ...]
    arrays: Arrays
    dtype: Any
    plans: tuple[Plan, Plan]

    @property
    def n_slabs(self) -> int:
        """Height slabs of both maps."""
        return len(self.standing)

    @property
    def shape(self) -> tuple[int, int]:
        """How many translations are told along x and y."""
        return self.rows[1] - self.rows[0], self.columns[1] - self.columns[0]

    def known_layer(self, slab: int) -> int:
        """Return which of the layers tells what is known in a slab."""
        return _known_layer(self.n_slabs, self.shared_known, slab)

    @property
    def at_once(self) -> int:
        """Yaws that are best scored at a time: on a device as many as 2^25 cells hold, up to 64."""
        if self.arrays.name == "numpy":
            return WIDTH
        return min(max((1 << 25) // (self.fft_shape[0] * self.fft_shape[1]), 1), 64)


def _known_layer(n_slabs: int, shared: bool, slab: int) -> int:
    return n_slabs + (0 if shared else slab)


def transform_target(
    grid: SlabGrid,
    source_shape: tuple[int, int],
    *,
    rows: Range | None = None,
    columns: Range | None = None,
    n_source: int | None = None,
    arrays: Arrays = NUMPY,
) -> Spectra:
    """Return the target's spectra, padded so that no translation asked for wraps round.

    rows, columns: the translations [u, v] of `evidence_surfaces` to tell, by default all of them.
    n_source: known cells of the source at most. The transforms are in single precision where it
    restores whole numbers, else in double.
    """
    ranges = tuple(
        (0, t + s - 1) if some is None else some
        for some, t, s in zip((rows, columns), grid.shape, source_shape, strict=True)
    )
    n_x, n_y = (
        find_length(max(t, s, high, t + s - 1 - low))
        for (low, high), t, s in zip(ranges, grid.shape, source_shape, strict=True)
    )
    shared = is_shared(grid.known, grid.n_slabs)
    n_source = source_shape[0] * source_shape[1] if n_source is None else n_source
    single = rounding((n_x, n_y), int(np.count_nonzero(grid.known)), n_source) < 0.5
    dtype: Any = np.float32 if single else np.float64
    bits = [(grid.occupied, k) for k in range(grid.n_slabs)]
    bits += [(grid.known, k) for k in range(1 if shared else grid.n_slabs)]
    if arrays.name != "numpy":
        layers = evidence_device.transform_layers(arrays, bits, (n_x, n_y), dtype)
    else:
        layers = np.empty((len(bits), n_y, n_x, 2), dtype)
        for k, (some, slab) in enumerate(bits):
            layer = unpack(arrays, some, slab, dtype)
            spectrum = fft.fft2(layer, s=(n_x, n_y), norm="forward").T
            layers[k, ..., 0], layers[k, ..., 1] = spectrum.real, spectrum.imag
    return Spectra(
        layers,
        source_shape,
        ranges[0],
        ranges[1],
        (n_x, n_y),
        shared,
        find_standing(grid.occupied, grid.n_slabs),
        arrays,
        dtype,
        (plan_transform(n_x, dtype), plan_transform(n_y, dtype)),
    )


def rounding(shape: tuple[int, int], n_target: int, n_source: int) -> float:
    """Return how far counts of single precision may be off, cells.

    eps / 2 per level of the transform, on the product of the norms of a lane's two layers and of
    the target's two that it meets. Below 0.5, rounding restores the counts; what was measured on
    dense layers was a tenth of this at most.
    """
    eps = float(np.finfo(np.float32).eps)
    return eps * float(np.log2(shape[0] * shape[1])) * float(np.sqrt(n_target * n_source))


def bytes_held(
    shape: tuple[int, int], side: int, n_slabs: int, *, shared: bool, workers: int,
    n_targets: int = 1,
) -> float:  # fmt: skip
    """Return what the transforms of targets hold at most, their own once, of each worker the rest.

    shape: of the transforms. side: of a square source. A value of all lanes takes 64 bytes.
    """
    every = (True,) * n_slabs
    job = plan_lanes(every, every, shared, shared)
    n = shape[0] * shape[1]
    own = n * (len(job.parts) + len(job.products)) + max(shape) * (side + len(job.products) + 2)
    scores = WIDTH * (3 * 4 * shape[1] + 2 * 4 * side * side)
    target = 8.0 * n * (n_slabs + (1 if shared else n_slabs) + 2)
    held = n_targets * target + workers * (64.0 * own + scores)
    return held * (1.0 if rounding(shape, n, side * side) < 0.5 else 2.0)


def evidence_surface(
    target: Spectra, occupied: Bits, known: Bits, *, min_overlap: float
) -> tuple[Float32s, Float32s]:
    """Return (score, overlap) at every translation of one turned source; see the next function."""
    score, overlap = evidence_surfaces(
        target, occupied[..., None], known[..., None], min_overlap=min_overlap
    )
    answer = score[0].copy(), overlap[0].copy()
    give_back("evidence")
    return answer


def evidence_surfaces(
    target: Spectra, occupied: Bits, known: Bits, *, min_overlap: float
) -> tuple[Float32s, Float32s]:
    """Return (score, overlap), (n_yaws, U, V) each, at every translation of turned sources.

    occupied, known: (sx, sy, n_yaws) slab bits of the source, at most eight yaws on the CPU. Of all
    translations, (tx + sx - 1, ty + sy - 1), the answers hold those of `target.rows` and
    `target.columns`. Translation [u, v] lays source cell [i, j] on target cell
    [i + u - (sx - 1), j + v - (sy - 1)]. Poses with fewer than `min_overlap` known pairs in the
    best known slab score -inf. overlap: known pairs, the largest over the slabs. The answers are
    borrowed (`arrays.borrow`): they last until this thread's next call.
    """
    least, table = math.ceil(min_overlap), xlogx_table(occupied.shape[0] * occupied.shape[1])
    alike, standing = is_shared(known, target.n_slabs), find_standing(occupied, target.n_slabs)
    if target.arrays.name != "numpy":
        shared = target.shared_known and alike
        return evidence_device.score(target, occupied, known, shared, standing, least, table)
    job = _plan_job(target, alike, standing)
    products = _multiply(target, job, _transform(target, job, occupied, known))
    score = borrow(NUMPY, "evidence score", (occupied.shape[2], *target.shape), np.float32)
    overlap = borrow(NUMPY, "evidence overlap", score.shape, np.float32)
    score_rows(
        products, job.counts, job.overlaps, target.columns[0], least, table, target.plans[1], score,
        overlap,
    )  # fmt: skip
    return score, overlap


def evidence_peaks(
    target: Spectra, occupied: Bits, known: Bits, rim: Sequence[int], n_peaks: int, *,
    min_overlap: float,
) -> list[Float64s]:  # fmt: skip
    """Return, of every yaw, the best translations (n, 3), at most `n_peaks`: u, v, score.

    Best first, of equals the one of the smaller u, then v. A translation must have a positive score
    and be a local maximum; rim: so many rows at the low and at the high end, then
    columns, are only neighbours of the others. u, v count from those that the target tells.
    The rest as in `evidence_surfaces`, from which they could be read off; most scores are never
    worked out here, since a bound of them is too low.
    """
    return peaks_on_each(
        (target,), occupied, known, rim, n_peaks, min_overlap=min_overlap
    )[0]  # fmt: skip


def peaks_on_each(
    targets: Sequence[Spectra], occupied: Bits, known: Bits, rim: Sequence[int], n_peaks: int, *,
    min_overlap: float,
) -> list[list[Float64s]]:  # fmt: skip
    """Return the same on each of several targets of one size; the source is transformed once."""
    answers = []
    if targets[0].arrays.name != "numpy":
        for target in targets:
            score, _ = evidence_surfaces(target, occupied, known, min_overlap=min_overlap)
            answers.append([_list_peaks(*local_maxima(one, n_peaks, 0.0, *rim)) for one in score])
        return answers
    least, table = math.ceil(min_overlap), xlogx_table(occupied.shape[0] * occupied.shape[1])
    n_slabs = targets[0].n_slabs
    alike, standing = is_shared(known, n_slabs), find_standing(occupied, n_slabs)
    low_u, high_u, low_v, high_v = rim
    turned: Turned | None = None
    for target in targets:
        n_u, n_v = target.shape
        own = (low_u, n_u - high_u, low_v, n_v - high_v)
        job = _plan_job(target, alike, standing)
        if turned is None or not turned.serves(target, job):
            turned = _transform(target, job, occupied, known)
        index, value = find_peaks(
            _multiply(target, job, turned), job.counts, job.overlaps, occupied.shape[2],
            (target.columns[0], n_v), own, least, n_peaks, table, target.plans[1],
        )  # fmt: skip
        answers.append([_list_peaks(*one) for one in zip(index, value, strict=True)])
    return answers


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _list_peaks(index: NDArray[np.int64], value: Float32s) -> Float64s:
    """Return u, v, score (n, 3) of the peaks that were found."""
    out, n = np.empty((index.shape[0], 3)), 0
    for k in range(index.shape[0]):
        if index[k, 0] >= 0:
            out[n, 0], out[n, 1], out[n, 2] = index[k, 0], index[k, 1], value[k]
            n += 1
    return out[:n]


def _plan_job(target: Spectra, alike: bool, standing: tuple[bool, ...]) -> Lanes:
    """Return which lanes of turned sources and which products the target's counts need.

    alike: whether the sources know all slabs alike. standing: which of the slabs hold anything.
    """
    return plan_lanes(standing, target.standing, target.shared_known and alike, target.shared_known)


@dataclass(frozen=True, eq=False)
class Turned:
    """The spectra of turned sources, (n_lanes, Ny, Nx * STEP), and what each lane holds."""

    lanes: Array
    parts: NDArray[np.int64]

    def serves(self, target: Spectra, job: Lanes) -> bool:
        """Return whether the target's products can be made of these."""
        n_x, n_y = target.fft_shape
        alike = self.lanes.dtype == target.dtype and self.lanes.shape[1:] == (n_y, n_x * STEP)
        return bool(alike and np.array_equal(self.parts, job.parts))


def _transform(target: Spectra, job: Lanes, occupied: Bits, known: Bits) -> Turned:
    """Return the spectra of turned sources, as the target needs them."""
    if occupied.shape[2] > WIDTH:
        raise ValueError(f"at most {WIDTH} yaws at a time; {occupied.shape[2]} came")
    n_x, n_y = target.fft_shape
    rows = borrow(NUMPY, "evidence rows", (n_y, occupied.shape[0] * STEP), target.dtype)
    lanes = borrow(NUMPY, "evidence lanes", (len(job.parts), n_y, n_x * STEP), target.dtype)
    transform_sources(occupied, known, job.parts, *target.plans, rows, lanes)
    return Turned(lanes, job.parts)


def _multiply(target: Spectra, job: Lanes, turned: Turned) -> Array:
    """Return the products (U, n, Ny * STEP), still to go back along y."""
    shape = (target.shape[0], len(job.products), target.fft_shape[1] * STEP)
    products = borrow(NUMPY, "evidence products", shape, target.dtype)
    multiply_and_invert(
        turned.lanes, target.layers, job.products, target.rows[0], target.plans[0], products
    )
    return products


@dataclass(frozen=True, eq=False)
class Lanes:
    """Which layers and counts share complex values.

    parts: (n_lanes, 2) the source's layers in the real and imaginary part of each lane: 2 k what is
    occupied in slab k, 2 k + 1 what is known, -1 nothing. products: (n, 5) of each product the
    lane, which part of it the real and the imaginary count take (0 or 1), and the target's layers
    for both, -1 none. counts: (n_standing, 4) of each slab where the source stands the places of
    n, n_1, n_2 and n11: 2 * product + part, -1 where it is zero. overlaps: the places of all n.
    """

    parts: NDArray[np.int64]
    products: NDArray[np.int64]
    counts: NDArray[np.int64]
    overlaps: NDArray[np.int64]


@lru_cache(maxsize=64)
def plan_lanes(
    standing: tuple[bool, ...], target_standing: tuple[bool, ...], shared: bool, target_shared: bool
) -> Lanes:
    """Return as few lanes and products as the counts need.

    standing, target_standing: of each slab, whether anything is occupied in it in the source and in
    the target. shared: whether both maps know all slabs alike; target_shared: whether the target
    does.
    """
    n_slabs = len(standing)
    slabs = [k for k in range(n_slabs) if standing[k]]
    seen = [0] if shared else list(range(n_slabs))
    sources = [2 * k for k in slabs] + [2 * k + 1 for k in seen]
    parts = np.full((-(-len(sources) // 2), 2), -1, np.int64)
    parts.reshape(-1)[: len(sources)] = sources
    place = {source: divmod(n, 2) for n, source in enumerate(sources)}

    known_layer = partial(_known_layer, n_slabs, target_shared)
    # every count is a layer of the source on one of the target
    wanted = [(2 * k + 1, known_layer(k)) for k in seen]
    for k in slabs:
        wanted.append((2 * k, known_layer(k)))
        if target_standing[k]:
            wanted += [(2 * (0 if shared else k) + 1, k), (2 * k, k)]
    products: list[tuple[int, int, int, int, int]] = []
    found: dict[tuple[int, int], int] = {}
    for lane in range(len(parts)):
        of_lane = [pair for pair in wanted if place[pair[0]][0] == lane]
        for first, second in zip_longest(of_lane[::2], of_lane[1::2]):
            found[first] = 2 * len(products)
            if second is not None:
                found[second] = 2 * len(products) + 1
            part = place[first[0]][1], 0 if second is None else place[second[0]][1]
            products.append((lane, *part, first[1], -1 if second is None else second[1]))
    counts = np.full((len(slabs), 4), -1, np.int64)
    for n, k in enumerate(slabs):
        known = 2 * (0 if shared else k) + 1
        four = (known, known_layer(k)), (2 * k, known_layer(k)), (known, k), (2 * k, k)
        counts[n] = [found.get(pair, -1) for pair in four]
    overlaps = [found[2 * k + 1, known_layer(k)] for k in seen]
    return Lanes(parts, np.array(products, np.int64), counts, np.array(overlaps, np.int64))
