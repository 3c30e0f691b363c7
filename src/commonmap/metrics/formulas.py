"""Every metric written out literally, on 1-D arrays of the cells that both maps know.

`p` and `q` are (n,) float64: the values of source and target at the same cells, already turned
into what the metric works on (shares that sum to one, or heights in metres). These are the slow
twins: `matching.correlate` must give the same numbers for all poses at once.

Formulas after S.-H. Cha, "Comprehensive survey on distance/similarity measures between probability
density functions", Int. J. Math. Models Methods Appl. Sci. 1(4), 2007.
A value that does not exist (zero variance, zero norm) is NaN.
"""

from __future__ import annotations

import numpy as np

from commonmap.types import Bools, Float64s


def _ratio(top: float, bottom: float) -> float:
    return float(top / bottom) if bottom > 0.0 else float("nan")


# Shannon's entropy family -----------------------------------------------------------------------


def kl(p: Float64s, q: Float64s) -> float:
    """Kullback-Leibler, `sum p ln(p / q)`; eq. 11 of the source paper."""
    return float(np.sum(p * np.log(p / q)))


def jeffreys(p: Float64s, q: Float64s) -> float:
    """Jeffreys, `sum (p - q) ln(p / q)`; eq. 12 of the source paper."""
    return float(np.sum((p - q) * np.log(p / q)))


def k_divergence(p: Float64s, q: Float64s) -> float:
    """K divergence, `sum p ln(2 p / (p + q))`; eq. 13 of the source paper."""
    return float(np.sum(p * np.log(2.0 * p / (p + q))))


def topsoe(p: Float64s, q: Float64s) -> float:
    """Topsoe, `sum p ln(2 p / (p + q)) + q ln(2 q / (p + q))`."""
    return k_divergence(p, q) + k_divergence(q, p)


def jensen_shannon(p: Float64s, q: Float64s) -> float:
    """Jensen-Shannon, half of Topsoe."""
    return 0.5 * topsoe(p, q)


def jensen_difference(p: Float64s, q: Float64s) -> float:
    """Jensen difference, `sum (p ln p + q ln q) / 2 - (p + q)/2 ln((p + q) / 2)`."""
    m = 0.5 * (p + q)
    return float(np.sum(0.5 * (p * np.log(p) + q * np.log(q)) - m * np.log(m)))


def taneja(p: Float64s, q: Float64s) -> float:
    """Taneja, `sum (p + q)/2 ln((p + q) / (2 sqrt(p q)))`."""
    return float(np.sum(0.5 * (p + q) * np.log((p + q) / (2.0 * np.sqrt(p * q)))))


def kumar_johnson(p: Float64s, q: Float64s) -> float:
    """Kumar-Johnson, `sum (p^2 - q^2)^2 / (2 (p q)^(3/2))`."""
    return float(np.sum((p**2 - q**2) ** 2 / (2.0 * (p * q) ** 1.5)))


# Squared L2, or chi-squared, family --------------------------------------------------------------


def squared_euclidean(p: Float64s, q: Float64s) -> float:
    """Squared Euclidean, `sum (p - q)^2`."""
    return float(np.sum((p - q) ** 2))


def euclidean(p: Float64s, q: Float64s) -> float:
    """Euclidean, `sqrt(sum (p - q)^2)`."""
    return float(np.sqrt(np.sum((p - q) ** 2)))


def pearson(p: Float64s, q: Float64s) -> float:
    """Pearson chi2, `sum (p - q)^2 / q`."""
    return float(np.sum((p - q) ** 2 / q))


def neyman(p: Float64s, q: Float64s) -> float:
    """Neyman chi2, `sum (p - q)^2 / p`."""
    return float(np.sum((p - q) ** 2 / p))


def squared_chi2(p: Float64s, q: Float64s) -> float:
    """Squared chi2, `sum (p - q)^2 / (p + q)`."""
    return float(np.sum((p - q) ** 2 / (p + q)))


def symmetric_chi2(p: Float64s, q: Float64s) -> float:
    """Probabilistic symmetric chi2, `2 sum (p - q)^2 / (p + q)`."""
    return 2.0 * squared_chi2(p, q)


def divergence(p: Float64s, q: Float64s) -> float:
    """Divergence, `2 sum (p - q)^2 / (p + q)^2`."""
    return float(2.0 * np.sum((p - q) ** 2 / (p + q) ** 2))


def clark(p: Float64s, q: Float64s) -> float:
    """Clark, `sqrt(sum (|p - q| / (p + q))^2)`."""
    return float(np.sqrt(np.sum((np.abs(p - q) / (p + q)) ** 2)))


def additive_chi2(p: Float64s, q: Float64s) -> float:
    """Additive symmetric chi2, `sum (p - q)^2 (p + q) / (p q)`."""
    return float(np.sum((p - q) ** 2 * (p + q) / (p * q)))


def min_symmetric_chi2(p: Float64s, q: Float64s) -> float:
    """Min-symmetric chi2, the smaller of Pearson's and Neyman's (Vicissitude family)."""
    return min(pearson(p, q), neyman(p, q))


def max_symmetric_chi2(p: Float64s, q: Float64s) -> float:
    """Max-symmetric chi2, the larger of Pearson's and Neyman's (Vicissitude family)."""
    return max(pearson(p, q), neyman(p, q))


# Fidelity family ----------------------------------------------------------------------------------


def fidelity(p: Float64s, q: Float64s) -> float:
    """Fidelity, `sum sqrt(p q)`."""
    return float(np.sum(np.sqrt(p * q)))


def bhattacharyya(p: Float64s, q: Float64s) -> float:
    """Bhattacharyya, `-ln sum sqrt(p q)`."""
    return float(-np.log(np.sum(np.sqrt(p * q))))


def squared_chord(p: Float64s, q: Float64s) -> float:
    """Squared chord, `sum (sqrt p - sqrt q)^2`."""
    return float(np.sum((np.sqrt(p) - np.sqrt(q)) ** 2))


def matusita(p: Float64s, q: Float64s) -> float:
    """Matusita, `sqrt(sum (sqrt p - sqrt q)^2)`."""
    return float(np.sqrt(squared_chord(p, q)))


def hellinger(p: Float64s, q: Float64s) -> float:
    """Hellinger, `sqrt(2 sum (sqrt p - sqrt q)^2)`."""
    return float(np.sqrt(2.0 * squared_chord(p, q)))


# Inner product family -----------------------------------------------------------------------------


def inner_product(p: Float64s, q: Float64s) -> float:
    """Inner product, `sum p q`."""
    return float(np.sum(p * q))


def harmonic_mean(p: Float64s, q: Float64s) -> float:
    """Harmonic mean, `2 sum p q / (p + q)`."""
    return float(2.0 * np.sum(p * q / (p + q)))


def cosine(p: Float64s, q: Float64s) -> float:
    """Cosine, `sum p q / sqrt(sum p^2 sum q^2)`."""
    return _ratio(np.sum(p * q), np.sqrt(np.sum(p**2) * np.sum(q**2)))


def kumar_hassebrook(p: Float64s, q: Float64s) -> float:
    """Kumar-Hassebrook, `sum p q / (sum p^2 + sum q^2 - sum p q)`."""
    return _ratio(np.sum(p * q), np.sum(p**2) + np.sum(q**2) - np.sum(p * q))


def jaccard(p: Float64s, q: Float64s) -> float:
    """Jaccard distance, `sum (p - q)^2 / (sum p^2 + sum q^2 - sum p q)`."""
    return _ratio(np.sum((p - q) ** 2), np.sum(p**2) + np.sum(q**2) - np.sum(p * q))


def dice(p: Float64s, q: Float64s) -> float:
    """Dice distance, `sum (p - q)^2 / (sum p^2 + sum q^2)`."""
    return _ratio(np.sum((p - q) ** 2), np.sum(p**2) + np.sum(q**2))


# L1 and intersection families ---------------------------------------------------------------------


def city_block(p: Float64s, q: Float64s) -> float:
    """City block, `sum |p - q|`."""
    return float(np.sum(np.abs(p - q)))


def chebyshev(p: Float64s, q: Float64s) -> float:
    """Chebyshev, `max |p - q|`."""
    return float(np.max(np.abs(p - q)))


def average_l1_chebyshev(p: Float64s, q: Float64s) -> float:
    """Mean of city block and Chebyshev."""
    return 0.5 * (city_block(p, q) + chebyshev(p, q))


def sorensen(p: Float64s, q: Float64s) -> float:
    """Sorensen, `sum |p - q| / sum (p + q)`."""
    return _ratio(np.sum(np.abs(p - q)), np.sum(p + q))


def soergel(p: Float64s, q: Float64s) -> float:
    """Soergel, `sum |p - q| / sum max(p, q)`; Tanimoto's distance is the same number."""
    return _ratio(np.sum(np.abs(p - q)), np.sum(np.maximum(p, q)))


def kulczynski(p: Float64s, q: Float64s) -> float:
    """Kulczynski d, `sum |p - q| / sum min(p, q)`."""
    return _ratio(np.sum(np.abs(p - q)), np.sum(np.minimum(p, q)))


def canberra(p: Float64s, q: Float64s) -> float:
    """Canberra, `sum |p - q| / (p + q)`."""
    return float(np.sum(np.abs(p - q) / (p + q)))


def lorentzian(p: Float64s, q: Float64s) -> float:
    """Lorentzian, `sum ln(1 + |p - q|)`."""
    return float(np.sum(np.log1p(np.abs(p - q))))


def intersection(p: Float64s, q: Float64s) -> float:
    """Intersection, `sum min(p, q)`."""
    return float(np.sum(np.minimum(p, q)))


def wave_hedges(p: Float64s, q: Float64s) -> float:
    """Wave Hedges, `sum |p - q| / max(p, q)`."""
    return float(np.sum(np.abs(p - q) / np.maximum(p, q)))


def motyka(p: Float64s, q: Float64s) -> float:
    """Motyka, `sum min(p, q) / sum (p + q)`."""
    return _ratio(np.sum(np.minimum(p, q)), np.sum(p + q))


def ruzicka(p: Float64s, q: Float64s) -> float:
    """Ruzicka, `sum min(p, q) / sum max(p, q)`."""
    return _ratio(np.sum(np.minimum(p, q)), np.sum(np.maximum(p, q)))


# Vicissitude family -------------------------------------------------------------------------------


def vicis_wave_hedges(p: Float64s, q: Float64s) -> float:
    """Vicis-Wave Hedges, `sum |p - q| / min(p, q)`."""
    return float(np.sum(np.abs(p - q) / np.minimum(p, q)))


def vicis_chi2_min_squared(p: Float64s, q: Float64s) -> float:
    """Vicis-symmetric chi2 (1), `sum (p - q)^2 / min(p, q)^2`."""
    return float(np.sum((p - q) ** 2 / np.minimum(p, q) ** 2))


def vicis_chi2_min(p: Float64s, q: Float64s) -> float:
    """Vicis-symmetric chi2 (2), `sum (p - q)^2 / min(p, q)`."""
    return float(np.sum((p - q) ** 2 / np.minimum(p, q)))


def vicis_chi2_max(p: Float64s, q: Float64s) -> float:
    """Vicis-symmetric chi2 (3), `sum (p - q)^2 / max(p, q)`."""
    return float(np.sum((p - q) ** 2 / np.maximum(p, q)))


# Image registration (Kaeslin et al. use zero-mean SAD, zero-mean SSD, NCC and MI) -----------------


def ssd(a: Float64s, b: Float64s) -> float:
    """Mean squared difference, `sum (a - b)^2 / n`, square metres."""
    return float(np.mean((a - b) ** 2))


def zssd(a: Float64s, b: Float64s) -> float:
    """Mean squared difference after each side's mean over the overlap is taken off."""
    d = a - b
    return float(np.mean((d - d.mean()) ** 2))


def sad(a: Float64s, b: Float64s) -> float:
    """Mean absolute difference, `sum |a - b| / n`, metres."""
    return float(np.mean(np.abs(a - b)))


def zsad(a: Float64s, b: Float64s) -> float:
    """Mean absolute difference after each side's mean over the overlap is taken off."""
    d = a - b
    return float(np.mean(np.abs(d - d.mean())))


def ncc(a: Float64s, b: Float64s) -> float:
    """Normalised cross-correlation, `sum a b / sqrt(sum a^2 sum b^2)`, -1 to 1."""
    return cosine(a, b)


def zncc(a: Float64s, b: Float64s) -> float:
    """Zero-mean normalised cross-correlation (Pearson's r), -1 to 1; NaN where a side is flat."""
    if np.ptp(a) == 0.0 or np.ptp(b) == 0.0:
        return float("nan")
    return cosine(a - a.mean(), b - b.mean())


def mutual_information(a: Float64s, b: Float64s) -> float:
    """Mutual information in nats of the values as they are: equal values are one class.

    Heights are quantised before they come here (`quantise`).
    """
    i = np.unique(a, return_inverse=True)[1]
    j = np.unique(b, return_inverse=True)[1]
    joint = np.zeros((i.max() + 1, j.max() + 1))
    np.add.at(joint, (i, j), 1.0 / a.size)
    rows, columns = joint.sum(axis=1), joint.sum(axis=0)
    seen = joint > 0.0
    return float(np.sum(joint[seen] * np.log(joint[seen] / np.outer(rows, columns)[seen])))


DOUBT = 200.0
"""Nats of uncertainty beside what the source shows: an overlap that shows much less explains little
however well it agrees. Twice the evidence below which no pose is accepted."""


def evidence_direct(occupied_s: Bools, known_s: Bools, occupied_t: Bools, known_t: Bools) -> float:
    """Return the weighed evidence, in nats, that two stacks of height slabs saw the same thing.

    Each argument is (n_slabs, ...) bool, all of one shape, cell on cell. Per slab the 2x2 table of
    the cells known in both gives `G/2 = n * MI` (Wilks' log-likelihood ratio), negative where
    the association `n11 n00 - n10 n01` is negative; the slabs are summed to E. It is weighed by the
    share of the source's uncertainty that it takes away: `E |E| / (n H(source) + DOUBT)`.
    """
    total, doubt = 0.0, 0.0
    for o_s, k_s, o_t, k_t in zip(occupied_s, known_s, occupied_t, known_t, strict=True):
        both = k_s & k_t
        s, t = o_s[both], o_t[both]
        n11 = float(np.count_nonzero(s & t))
        n10 = float(np.count_nonzero(s & ~t))
        n01 = float(np.count_nonzero(~s & t))
        n00 = float(np.count_nonzero(~s & ~t))
        n = n11 + n10 + n01 + n00
        half_g = 0.0
        for cell, row, column in (
            (n11, n11 + n10, n11 + n01),
            (n10, n11 + n10, n10 + n00),
            (n01, n01 + n00, n11 + n01),
            (n00, n01 + n00, n10 + n00),
        ):
            if cell > 0.0:
                half_g += cell * float(np.log(cell * n / (row * column)))
        total += half_g if n11 * n00 - n10 * n01 >= 0.0 else -half_g
        for margin in (n11 + n10, n01 + n00):
            if margin > 0.0:
                doubt -= margin * float(np.log(margin / n))
    return total * abs(total) / (doubt + DOUBT)
