"""The sums over an overlap that are not products of layers, cell by cell, for listed poses.

Single precision within a row of cells, double over the rows: relative errors of about 1e-6.
Loops are written so that they compile to vector instructions.
"""

from __future__ import annotations

import numba
import numpy as np

RATIO_SUMS = (
    "p ln(p+q)", "q ln(p+q)", "min", "largest", "lorentzian", "canberra", "wave-hedges",
    "vicis-wave-hedges", "vicis-chi2-1", "vicis-chi2-2", "vicis-chi2-3", "sech", "ratio^2",
    "sad", "zsad",
)  # fmt: skip
"""What `ratio_sums` gives, in this order, of shares p, q over the cells known in both.

"largest" is max |p - q|; "sech" is `sum 2 p q / (p + q)`; "ratio^2" is `sum ((p-q)/(p+q))^2`;
"sad" and "zsad" are of the raw heights, the latter after the mean difference is taken off."""

LANES = 16
"""Stretches of a row that are summed are a multiple of so many cells."""


@numba.njit(inline="always", fastmath=True, error_model="numpy")  # type: ignore[misc]
def _ln(x):  # type: ignore[no-untyped-def]
    """Return ln x of a positive normal float32 to its last bits or so.

    The mantissa is brought to 0.707 .. 1.414; there ln m = 2 artanh((m - 1) / (m + 1)), a series.
    """
    bits = np.float32(x).view(np.uint32)
    exponent = np.int32(np.uint32(np.uint32(bits - np.uint32(0x3F3504F3)) >> np.uint32(23)))
    exponent = np.int32(np.int32(exponent ^ np.int32(256)) - np.int32(256))
    mantissa = np.uint32(bits - np.uint32(np.uint32(exponent) << np.uint32(23))).view(np.float32)
    t = (mantissa - np.float32(1.0)) / (mantissa + np.float32(1.0))
    z = t * t
    series = np.float32(0.28571429) + z * (np.float32(0.22222222) + z * np.float32(0.18181818))
    series = np.float32(0.66666667) + z * (np.float32(0.4) + z * series)
    return np.float32(exponent) * np.float32(0.69314718) + t * (np.float32(2.0) + z * series)


@numba.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")  # type: ignore[misc]
def ratio_sums(a, raw_a, w_a, spans, b, raw_b, w_b, u, v, A, B, mean, top):  # type: ignore[no-untyped-def]
    """Return (P, 15) `RATIO_SUMS` at the poses u, v (P,).

    a, raw_a, w_a: (sx, sy') float32 floored and raw heights and ones where known; spans (sx, 2)
    the stretch of each row to sum. b, raw_b, w_b: of the target, padded so that source cell
    [0, 0] lies on [u, v]. A, B: (P,) what heights are divided by. mean: (P,) of the raw
    differences a - b. top: the largest share |p - q| can be, about.
    """
    zero, one, two = np.float32(0.0), np.float32(1.0), np.float32(2.0)
    out = np.zeros((u.shape[0], 15))
    calm = np.float32(1.0 / np.sqrt(1.0 + top))  # keeps a row's product of 1 + |p - q| in range
    for k in range(u.shape[0]):
        inv_a, inv_b, shift = np.float32(1.0 / A[k]), np.float32(1.0 / B[k]), np.float32(mean[k])
        s = np.zeros(15)
        for i in range(a.shape[0]):
            first, last = spans[i, 0], spans[i, 1]
            if last <= first:
                continue
            at, to = u[k] + i, v[k]
            # views of rows: their indices are never negative, which lets the loop be vectorised
            row_a, row_ra, row_wa = a[i, first:last], raw_a[i, first:last], w_a[i, first:last]
            row_b = b[at, to + first : to + last]
            row_rb, row_wb = raw_b[at, to + first : to + last], w_b[at, to + first : to + last]
            pl, ql, least, most, sad, zsad = zero, zero, zero, np.int32(0), zero, zero
            canberra, hedges, vicis, v1, v2, v3 = zero, zero, zero, zero, zero, zero
            sech, squares = zero, zero
            product = one
            for j in range(last - first):
                w = row_wa[j] * row_wb[j]
                p = row_a[j] * inv_a * w + (one - w)
                q = row_b[j] * inv_b * w + (one - w)
                both = p + q
                d = np.abs(p - q)
                low = np.minimum(p, q)
                high = both - low
                share = d / both
                logarithm = _ln(both) * w
                pl += p * logarithm
                ql += q * logarithm
                least += low * w
                bits = np.float32(d).view(np.int32)  # as whole numbers: a maximum that vectorises
                most = bits if bits > most else most
                product *= (one + d) * calm
                canberra += share
                hedges += d / high
                over = d / low
                vicis += over
                v1 += over * over
                v2 += d * over
                v3 += d * d / high
                sech += two * low * high / both * w
                squares += share * share
                difference = (row_ra[j] - row_rb[j]) * w
                sad += np.abs(difference)
                zsad += np.abs(difference - shift * w)
            s[0] += pl
            s[1] += ql
            s[2] += least
            s[3] = max(s[3], np.float64(np.int32(most).view(np.float32)))
            s[4] += np.log(np.float64(product)) - (last - first) * np.log(np.float64(calm))
            s[5] += canberra
            s[6] += hedges
            s[7] += vicis
            s[8] += v1
            s[9] += v2
            s[10] += v3
            s[11] += sech
            s[12] += squares
            s[13] += sad
            s[14] += zsad
        out[k] = s
    return out


@numba.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")  # type: ignore[misc]
def log_sums(a, w_a, spans, b, w_b, u, v, A, B):  # type: ignore[no-untyped-def]
    """Return (P, 2) `sum p ln(p + q)` and `sum q ln(p + q)`, the first two of `ratio_sums`."""
    out = np.zeros((u.shape[0], 2))
    one = np.float32(1.0)
    for k in range(u.shape[0]):
        inv_a, inv_b = np.float32(1.0 / A[k]), np.float32(1.0 / B[k])
        for i in range(a.shape[0]):
            pl, ql = np.float32(0.0), np.float32(0.0)
            first, last = spans[i, 0], spans[i, 1]
            row_a, row_wa = a[i, first:last], w_a[i, first:last]
            row_b = b[u[k] + i, v[k] + first : v[k] + last]
            row_wb = w_b[u[k] + i, v[k] + first : v[k] + last]
            for j in range(last - first):
                w = row_wa[j] * row_wb[j]
                p = row_a[j] * inv_a * w
                q = row_b[j] * inv_b * w
                logarithm = _ln(p + q + (one - w))
                pl += p * logarithm
                ql += q * logarithm
            out[k, 0] += pl
            out[k, 1] += ql
    return out


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def class_information(a, spans, b, u, v, bins, x_ln_x):  # type: ignore[no-untyped-def]
    """Return (P,) the mutual information (nats) of the classes at the poses u, v.

    a, b: uint8 classes 0 .. bins - 1 of source and target, `bins` where not known; padded as for
    `ratio_sums`. x_ln_x: (n,) of the whole numbers, up to all cells.
    """
    out = np.zeros(u.shape[0])
    wide = bins + 1
    odd, even = np.zeros(wide * wide, np.int64), np.zeros(wide * wide, np.int64)
    for k in range(u.shape[0]):
        odd[:] = 0
        even[:] = 0
        for i in range(a.shape[0]):
            first, last = spans[i, 0], spans[i, 1]
            row_a, row_b = a[i, first:last], b[u[k] + i, v[k] + first : v[k] + last]
            for j in range(0, last - first, 2):
                even[row_a[j] * wide + row_b[j]] += 1
                odd[row_a[j + 1] * wide + row_b[j + 1]] += 1
        n, total = 0, 0.0
        for p in range(bins):
            row, column = 0, 0
            for q in range(bins):
                count = even[p * wide + q] + odd[p * wide + q]
                row += count
                column += even[q * wide + p] + odd[q * wide + p]
                total += x_ln_x[count]
            total -= x_ln_x[row] + x_ln_x[column]
            n += row
        if n > 0:
            out[k] = max(0.0, (total + x_ln_x[n]) / n)
    return out


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def best_peaks(gain, u, v, shape, n_peaks):  # type: ignore[no-untyped-def]
    """Return (M, n_peaks, 4) rows u, v, gain, pose of the highest 3x3 local maxima of each metric.

    gain: (M, P) at the poses u, v (P,), more is better; elsewhere nothing was scored. u and v of
    the answer are moved to the top of a parabola through the neighbours; pose is the index of the
    peak in `gain`, -1 where there are fewer peaks.
    """
    out = np.full((gain.shape[0], n_peaks, 4), -np.inf)
    field = np.full((shape[0] + 2, shape[1] + 2), -np.inf)
    for m in range(gain.shape[0]):
        for k in range(u.shape[0]):
            g = gain[m, k]
            field[u[k] + 1, v[k] + 1] = g if np.isfinite(g) else -np.inf
        rows = out[m]
        for k in range(u.shape[0]):
            i, j = u[k] + 1, v[k] + 1
            s = field[i, j]
            if not s > rows[n_peaks - 1, 2]:
                continue
            peak = True
            for di in range(-1, 2):
                for dj in range(-1, 2):
                    other = field[i + di, j + dj]
                    earlier = di < 0 or (di == 0 and dj < 0)
                    if other > s or (earlier and other == s):
                        peak = False
            if not peak:
                continue
            place = n_peaks - 1
            while place > 0 and s > rows[place - 1, 2]:
                rows[place] = rows[place - 1]
                place -= 1
            rows[place, 2] = s
            rows[place, 3] = k
            rows[place, 0] = u[k] + vertex(field[i - 1, j], s, field[i + 1, j])
            rows[place, 1] = v[k] + vertex(field[i, j - 1], s, field[i, j + 1])
        for n in range(n_peaks):
            if rows[n, 2] == -np.inf:
                rows[n, 3] = -1.0
    return out


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def vertex(before, at, after):  # type: ignore[no-untyped-def]
    """Return where a parabola through three neighbours has its top, -0.5 to 0.5 steps."""
    bend = before - 2.0 * at + after
    if not (np.isfinite(bend) and bend < 0.0):
        return 0.0
    return min(0.5, max(-0.5, 0.5 * (before - after) / bend))
