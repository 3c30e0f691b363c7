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
the transforms, the number of yaws at a time, or the machine.

On a GPU the same counts come from CuPy's transforms, `evidence_device.py`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from commonmap.matching import evidence_device
from commonmap.matching.arrays import NUMPY, Array, Arrays, borrow
from commonmap.matching.evidence import signed_evidence, uncertainty, weigh, xlogx_table
from commonmap.matching.lane_fft import STEP, Plan, find_length, plan_transform, transform_line
from commonmap.matching.lanes import WIDTH, clip_below_zero, load, spread, store
from commonmap.matching.peaks import add_peaks, local_maxima
from commonmap.matching.slabs import Bits, Range, SlabGrid, find_standing, is_shared, unpack
from commonmap.metrics.formulas import DOUBT
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
        return self.n_slabs + (0 if self.shared_known else slab)

    @property
    def at_once(self) -> int:
        """Yaws that are best scored at a time: on a device as many as 2^25 cells hold, up to 64."""
        if self.arrays.name == "numpy":
            return WIDTH
        return min(max((1 << 25) // (self.fft_shape[0] * self.fft_shape[1]), 1), 64)


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
    shape: tuple[int, int], side: int, n_slabs: int, *, shared: bool, workers: int
) -> float:
    """Return what the transforms of a target hold at most, its own once, of each worker the rest.

    shape: of the transforms. side: of a square source. A value of all lanes takes 64 bytes.
    """
    every = (True,) * n_slabs
    job = plan_lanes(every, every, shared, shared)
    n = shape[0] * shape[1]
    own = n * (len(job.parts) + len(job.products)) + max(shape) * (side + len(job.products) + 2)
    scores = WIDTH * (3 * 4 * shape[1] + 2 * 4 * side * side)
    target = 8.0 * n * (n_slabs + (1 if shared else n_slabs) + 2)
    held = target + workers * (64.0 * own + scores)
    return held * (1.0 if rounding(shape, n, side * side) < 0.5 else 2.0)


def evidence_surface(
    target: Spectra, occupied: Bits, known: Bits, *, min_overlap: float
) -> tuple[Float32s, Float32s]:
    """Return (score, overlap) at every translation of one turned source; see the next function."""
    score, overlap = evidence_surfaces(
        target, occupied[..., None], known[..., None], min_overlap=min_overlap
    )
    return score[0].copy(), overlap[0].copy()


def evidence_surfaces(
    target: Spectra, occupied: Bits, known: Bits, *, min_overlap: float, count: bool = True
) -> tuple[Float32s, Float32s]:
    """Return (score, overlap), (n_yaws, U, V) each, at every translation of turned sources.

    occupied, known: (sx, sy, n_yaws) slab bits of the source, at most eight yaws on the CPU. Of all
    translations, (tx + sx - 1, ty + sy - 1), the answers hold those of `target.rows` and
    `target.columns`. Translation [u, v] lays source cell [i, j] on target cell
    [i + u - (sx - 1), j + v - (sy - 1)]. Poses with fewer than `min_overlap` known pairs in the
    best known slab score -inf. overlap: known pairs, the largest over the slabs; empty unless
    `count`. The answers are borrowed (`arrays.borrow`): they last until this thread's next call.
    """
    least, table = math.ceil(min_overlap), xlogx_table(occupied.shape[0] * occupied.shape[1])
    if target.arrays.name != "numpy":
        shared = target.shared_known and is_shared(known, target.n_slabs)
        standing = find_standing(occupied, target.n_slabs)
        return evidence_device.score(target, occupied, known, shared, standing, least, table)
    products, job = _correlate(target, occupied, known)
    score = borrow(NUMPY, "evidence score", (occupied.shape[2], *target.shape), np.float32)
    overlap = borrow(NUMPY, "evidence overlap", score.shape if count else (0, 0, 0), np.float32)
    y = target.plans[1]
    _score_rows(
        products, job.counts, job.overlaps, target.columns[0], least, table, y.radices, y.roots,
        y.angles, score, overlap,
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
    if target.arrays.name != "numpy":
        score, _ = evidence_surfaces(target, occupied, known, min_overlap=min_overlap)
        return [_list_peaks(*local_maxima(one, n_peaks, 0.0, *rim)) for one in score]
    low_u, high_u, low_v, high_v = rim
    n_u, n_v = target.shape
    own = (low_u, n_u - high_u, low_v, n_v - high_v)
    least, table = math.ceil(min_overlap), xlogx_table(occupied.shape[0] * occupied.shape[1])
    products, job = _correlate(target, occupied, known)
    y = target.plans[1]
    index, value = _find_peaks(
        products, job.counts, job.overlaps, occupied.shape[2], (target.columns[0], n_v), own, least,
        n_peaks, table, y.radices, y.roots, y.angles,
    )  # fmt: skip
    return [_list_peaks(*found) for found in zip(index, value, strict=True)]


def _list_peaks(index: NDArray[np.int64], value: Float32s) -> Float64s:
    """Return u, v, score (n, 3) of the peaks that were found."""
    found = index[:, 0] >= 0
    return np.column_stack([index[found], value[found].astype(np.float64)])


def _correlate(target: Spectra, occupied: Bits, known: Bits) -> tuple[Any, Lanes]:
    """Return the products (U, n, Ny * STEP), still to go back along y, and what they hold."""
    n_yaws = occupied.shape[2]
    if n_yaws > WIDTH:
        raise ValueError(f"at most {WIDTH} yaws at a time; {n_yaws} came")
    shared = target.shared_known and is_shared(known, target.n_slabs)
    standing = find_standing(occupied, target.n_slabs)
    job = plan_lanes(standing, target.standing, shared, target.shared_known)
    n_x, n_y = target.fft_shape
    rows, lanes, products = (
        borrow(NUMPY, "evidence " + role, shape, target.dtype)
        for role, shape in (
            ("rows", (n_y, occupied.shape[0] * STEP)),
            ("lanes", (len(job.parts), n_y, n_x * STEP)),
            ("products", (target.shape[0], len(job.products), n_y * STEP)),
        )
    )
    x, y = ((plan.radices, plan.roots, plan.angles) for plan in target.plans)
    _transform_sources(occupied, known, job.parts, *x, *y, rows, lanes)
    _multiply_and_invert(lanes, target.layers, job.products, target.rows[0], *x, products)
    return products, job


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

    def known_layer(k: int) -> int:
        return n_slabs + (0 if target_shared else k)

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


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _transform_sources(  # type: ignore[no-untyped-def]
    occupied, known, parts, radices_x, roots_x, angles_x, radices_y, roots_y, angles_y, rows, out
):
    """Set out (n_lanes, Ny, Nx * STEP) to the spectra of the source's lanes.

    The source is turned round, so that a product of spectra is a cross-correlation. rows:
    (Ny, sx * STEP) room for the lines along y.
    """
    side_x, side_y, n_yaws = occupied.shape
    n_y, n_x = out.shape[1], out.shape[2] // STEP
    longest = max(n_x, n_y) * STEP
    a, b = np.empty(longest, out.dtype), np.empty(longest, out.dtype)
    forward = out.dtype.type(1)
    for lane in range(parts.shape[0]):
        for i in range(side_x):
            a[: n_y * STEP] = 0
            for part in range(2):
                source = parts[lane, part]
                if source < 0:
                    continue
                bits = occupied if source % 2 == 0 else known
                slab = source // 2
                for j in range(side_y):
                    at = (side_y - 1 - j) * STEP + part * WIDTH
                    for w in range(n_yaws):
                        a[at + w] = (bits[i, j, w] >> slab) & 1
            line = b if transform_line(a, b, n_y, radices_y, roots_y, angles_y, forward) else a
            place = (side_x - 1 - i) * STEP
            for f in range(n_y):
                for h in (0, WIDTH):
                    store(rows[f], place + h, load(line, f * STEP + h))
        for f in range(n_y):
            a[: side_x * STEP] = rows[f]
            a[side_x * STEP : n_x * STEP] = 0
            line = b if transform_line(a, b, n_x, radices_x, roots_x, angles_x, forward) else a
            out[lane, f] = line[: n_x * STEP]


@numba.njit(cache=True, nogil=True, fastmath={"contract"})  # type: ignore[misc]
def _multiply_and_invert(  # type: ignore[no-untyped-def]
    lanes, layers, products, first_row, radices_x, roots_x, angles_x, out
):
    """Set out (n_rows, n_products, Ny * STEP) to the products, back from frequencies along x."""
    n_y, n_x = lanes.shape[1], lanes.shape[2] // STEP
    a, b = np.empty(n_x * STEP, lanes.dtype), np.empty(n_x * STEP, lanes.dtype)
    half, zero, back = lanes.dtype.type(0.5), lanes.dtype.type(0), lanes.dtype.type(-1)
    for m in range(products.shape[0]):
        lane, part, other_part, first, second = products[m]
        plain = part == 0 and other_part == 1 and first == second
        for f in range(n_y):
            z, turned = lanes[lane, f], lanes[lane, (n_y - f) % n_y]
            for g in range(n_x):
                at = g * STEP
                zr, zi = load(z, at), load(z, at + WIDTH)
                tr, ti = layers[first, f, g, 0], layers[first, f, g, 1]
                if plain:
                    store(a, at, tr * zr - ti * zi)
                    store(a, at + WIDTH, tr * zi + ti * zr)
                    continue
                ur, ui = zero, zero
                if second >= 0:
                    ur, ui = layers[second, f, g, 0], layers[second, f, g, 1]
                # of Z and of conj Z(-f): what the real count takes, then what the imaginary does
                if part == 0:
                    pr, pi, qr, qi = tr, ti, tr, ti
                else:
                    pr, pi, qr, qi = ti, -tr, -ti, tr
                if other_part == 0:
                    pr, pi, qr, qi = pr - ui, pi + ur, qr - ui, qi + ur
                else:
                    pr, pi, qr, qi = pr + ur, pi + ui, qr - ur, qi - ui
                pr, pi, qr, qi = half * pr, half * pi, half * qr, half * qi
                there = (n_x - g) % n_x * STEP
                yr, yi = load(turned, there), load(turned, there + WIDTH)
                store(a, at, pr * zr - pi * zi + qr * yr + qi * yi)
                store(a, at + WIDTH, pr * zi + pi * zr + qi * yr - qr * yi)
            line = b if transform_line(a, b, n_x, radices_x, roots_x, angles_x, back) else a
            for u in range(out.shape[0]):
                row = out[u, m]
                at = (first_row + u) * STEP
                store(row, f * STEP, load(line, at))
                store(row, f * STEP + WIDTH, load(line, at + WIDTH))


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _invert_row(products, u, radices_y, roots_y, angles_y, spare, row):  # type: ignore[no-untyped-def]
    """Set row (n_products, Ny * STEP) to the counts of one row of translations, not yet rounded."""
    n_y, back = spare.shape[0] // STEP, products.dtype.type(-1)
    for m in range(row.shape[0]):
        a = products[u, m]
        row[m] = spare if transform_line(a, spare, n_y, radices_y, roots_y, angles_y, back) else a


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _count(row, place, at):  # type: ignore[no-untyped-def]
    """Return the whole number that a product's real or imaginary part holds for one lane."""
    return int(row[place >> 1, at + (place & 1) * WIDTH] + 0.5)


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _count_overlap(row, overlaps, at):  # type: ignore[no-untyped-def]
    """Return the known pairs of the best known slab."""
    most = 0
    for place in overlaps:
        most = max(most, _count(row, place, at))
    return most


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _score_at(row, counts, at, xlogx):  # type: ignore[no-untyped-def]
    """Return the score of one translation at one yaw."""
    evidence, doubt = 0.0, 0.0
    for k in range(counts.shape[0]):
        n, r = _count(row, counts[k, 0], at), _count(row, counts[k, 1], at)
        doubt += uncertainty(n, r, xlogx)
        if counts[k, 2] >= 0:
            c, n11 = _count(row, counts[k, 2], at), _count(row, counts[k, 3], at)
            n11 = min(max(n11, r + c - n, 0), r, c)
            evidence += signed_evidence(n, r, c, n11, xlogx)
    return weigh(evidence, doubt)


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _score_rows(  # type: ignore[no-untyped-def]
    products, counts, overlaps, first_column, least, xlogx, radices_y, roots_y, angles_y, score,
    overlap
):  # fmt: skip
    """Set the scores (n_yaws, n_rows, n_columns), and the overlaps if there is room for them."""
    n_y = products.shape[2]
    spare, row = np.empty(n_y, products.dtype), np.empty((products.shape[1], n_y), products.dtype)
    for u in range(score.shape[1]):
        _invert_row(products, u, radices_y, roots_y, angles_y, spare, row)
        for v in range(score.shape[2]):
            for w in range(score.shape[0]):
                at = (first_column + v) * STEP + w
                seen = _count_overlap(row, overlaps, at)
                if overlap.shape[0] > 0:
                    overlap[w, u, v] = seen
                score[w, u, v] = _score_at(row, counts, at, xlogx) if seen >= least else -np.inf


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _find_peaks(  # type: ignore[no-untyped-def]
    products, counts, overlaps, n_yaws, columns, own, least, n_peaks, xlogx, radices_y, roots_y,
    angles_y
):  # fmt: skip
    """Return (n_yaws, n_peaks, 2) indices and values of the best peaks of each yaw.

    columns: the first one and how many. own: first and behind the last row, then column, that may
    be a peak. A score is worked out only where its bound reaches the least of the peaks so far:
    what lies lower is no peak and lowers none.
    """
    n_y, n_rows, (first, n_columns) = products.shape[2], products.shape[0], columns
    spare, row = np.empty(n_y, products.dtype), np.empty((products.shape[1], n_y), products.dtype)
    index = np.full((n_yaws, n_peaks, 2), -1, np.int64)
    value = np.full((n_yaws, n_peaks), -np.inf, np.float32)
    score = np.full((n_yaws, 3, n_columns), -np.inf, np.float32)  # of the last three rows
    bound = np.empty((n_columns + 1) * WIDTH, products.dtype)
    for u in range(n_rows + 1):
        score[:, u % 3] = -np.inf
        if u < n_rows:
            _invert_row(products, u, radices_y, roots_y, angles_y, spare, row)
            _bound_scores(row, counts, first, n_columns, bound)
            for v in range(n_columns):
                for w in range(n_yaws):
                    if bound[v * WIDTH + w] < max(value[w, n_peaks - 1], 0.0):
                        continue
                    at = (first + v) * STEP + w
                    if _count_overlap(row, overlaps, at) >= least:
                        score[w, u % 3, v] = _score_at(row, counts, at, xlogx)
        if own[0] <= u - 1 < own[1]:
            for w in range(n_yaws):
                add_peaks(score[w], u - 1, own[2], own[3], 0.0, index[w], value[w])
    return index, value


@numba.njit(cache=True, nogil=True, fastmath={"contract"})  # type: ignore[misc]
def _bound_scores(row, counts, first_column, n_columns, bound):  # type: ignore[no-untyped-def]
    """Set bound (n_columns * WIDTH) to what no score of the row exceeds, by arithmetic alone.

    With d = n n11 - r c, n11 is (1 + x) times what independence expects, x = d / (r c), and so are
    the others: x = d / ((n - r) (n - c)) for n00, -d / (r (n - c)) and -d / ((n - r) c) for n10 and
    n01. As (1 + x) ln(1 + x) <= x + x^2 / 2 for x >= 0, and <= x + x^2 / 2 - x^3 / 2 from -1 to 0,

        n MI <= d^2 / 2 (n A B + (A^2 + B^2) d / n),  A = 1 / (r (n - c)),  B = 1 / ((n - r) c)

    for d > 0. And n H(p) >= 4 ln 2 n p (1 - p). What rounding may take away here is added: 1 % and
    a tenth of a nat.
    """
    number = row.dtype.type
    zero, one, tiny = number(0), number(1), number(1e-3)
    half, slack = number(0.5 * 1.01), number(0.1)
    entropy, prior = number(4.0 * np.log(2.0)), number(DOUBT)
    # added and taken away, it leaves a whole number
    magic = number(1.5 * 2.0**23) if row.itemsize == 4 else number(1.5 * 2.0**52)
    for v in range(n_columns):
        at = (first_column + v) * STEP
        evidence, doubt = spread(zero), spread(zero)
        for k in range(counts.shape[0]):
            place = counts[k, 0]
            n = -magic + (magic + load(row[place >> 1], at + (place & 1) * WIDTH))
            place = counts[k, 1]
            r = -magic + (magic + load(row[place >> 1], at + (place & 1) * WIDTH))
            share = one / (tiny + n)
            doubt = doubt + r * (n - r) * share
            if counts[k, 2] < 0:
                continue
            place = counts[k, 2]
            c = -magic + (magic + load(row[place >> 1], at + (place & 1) * WIDTH))
            place = counts[k, 3]
            both = -magic + (magic + load(row[place >> 1], at + (place & 1) * WIDTH))
            d = clip_below_zero(n * both - r * c)
            A, B = one / (tiny + r * (n - c)), one / (tiny + (n - r) * c)
            evidence = evidence + half * d * d * (n * A * B + d * share * (A * A + B * B))
        evidence = slack + evidence
        store(bound, v * WIDTH, evidence * evidence / (prior + entropy * doubt))
