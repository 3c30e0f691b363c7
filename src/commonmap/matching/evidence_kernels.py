"""The loops of `evidence_fft.py`: lanes forth, products back, counts to scores and peaks.

Arrays of complex values hold `STEP` numbers for each, those of eight yaws (`lane_fft.py`). Spectra
lie by frequency along y, then along x, so that the lines along x are in one piece.
"""

from __future__ import annotations

import numba
import numpy as np

from commonmap.matching.evidence import signed_evidence, uncertainty, weigh
from commonmap.matching.lane_fft import STEP, transform_line
from commonmap.matching.lanes import WIDTH, clip_below_zero, load, spread, store
from commonmap.matching.peaks import add_peaks
from commonmap.metrics.formulas import DOUBT


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def transform_sources(  # type: ignore[no-untyped-def]
    occupied, known, parts, plan_x, plan_y, rows, out
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
            line = b if transform_line(a, b, plan_y, forward) else a
            place = (side_x - 1 - i) * STEP
            for f in range(n_y):
                for h in (0, WIDTH):
                    store(rows[f], place + h, load(line, f * STEP + h))
        for f in range(n_y):
            a[: side_x * STEP] = rows[f]
            a[side_x * STEP : n_x * STEP] = 0
            line = b if transform_line(a, b, plan_x, forward) else a
            out[lane, f] = line[: n_x * STEP]


@numba.njit(cache=True, nogil=True, fastmath={"contract"})  # type: ignore[misc]
def multiply_and_invert(  # type: ignore[no-untyped-def]
    lanes, layers, products, first_row, plan_x, out
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
            line = b if transform_line(a, b, plan_x, back) else a
            for u in range(out.shape[0]):
                row = out[u, m]
                at = (first_row + u) * STEP
                store(row, f * STEP, load(line, at))
                store(row, f * STEP + WIDTH, load(line, at + WIDTH))


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _invert_row(products, u, plan_y, spare, row):  # type: ignore[no-untyped-def]
    """Set row (n_products, Ny * STEP) to the counts of one row of translations, not yet rounded."""
    back = products.dtype.type(-1)
    for m in range(row.shape[0]):
        a = products[u, m]
        row[m] = spare if transform_line(a, spare, plan_y, back) else a


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
def score_rows(  # type: ignore[no-untyped-def]
    products, counts, overlaps, first_column, least, xlogx, plan_y, score, overlap
):
    """Set the scores and the overlaps, (n_yaws, n_rows, n_columns) each."""
    n_y = products.shape[2]
    spare, row = np.empty(n_y, products.dtype), np.empty((products.shape[1], n_y), products.dtype)
    for u in range(score.shape[1]):
        _invert_row(products, u, plan_y, spare, row)
        for v in range(score.shape[2]):
            for w in range(score.shape[0]):
                at = (first_column + v) * STEP + w
                seen = _count_overlap(row, overlaps, at)
                overlap[w, u, v] = seen
                score[w, u, v] = _score_at(row, counts, at, xlogx) if seen >= least else -np.inf


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def find_peaks(  # type: ignore[no-untyped-def]
    products, counts, overlaps, n_yaws, columns, own, least, n_peaks, xlogx, plan_y
):
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
            _invert_row(products, u, plan_y, spare, row)
            bound_scores(row, counts, first, n_columns, bound)
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
def bound_scores(row, counts, first_column, n_columns, bound):  # type: ignore[no-untyped-def]
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
