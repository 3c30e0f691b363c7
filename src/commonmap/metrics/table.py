"""The table of similarity metrics: what each one means, and how it is scored at every pose.

Rows say once whether more is better; nothing else in the software decides that. P and Q are the
values of source (draft map, moving) and target (base map) at the cells of the overlap:

    normalise="overlap"   P = a / sum a, Q = b / sum b, sums over the overlap of the pose
    normalise="map"       the same, sums over all known cells of each map
    normalise="off"       P = a, Q = b, metres: the source paper's formulas read literally

`best` and `worst` hold for shares that sum to one. A row with `fft=None` is offered at the
candidate poses only, and `note` says why.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from commonmap.errors import InputError
from commonmap.metrics import formulas as f
from commonmap.metrics import plans as c
from commonmap.metrics.plans import (
    DifferenceSum,
    JointHistogram,
    MinSum,
    Moments,
    Plan,
    RatioSum,
    Smooth,
    Sums,
)
from commonmap.types import Bools, Float64s, Floats

Normalise = Literal["overlap", "map", "off"]
ALL: tuple[Normalise, ...] = ("overlap", "map", "off")
HEIGHTS: tuple[Normalise, ...] = ("off",)
INF = float("inf")
LN2 = float(np.log(2.0))

CHA = "S.-H. Cha, Int. J. Math. Models Methods Appl. Sci. 1(4), 2007"
KAESLIN = "R. Kaeslin et al., Collaborative localization ... through elevation maps, 2016"
WILKS = "S. S. Wilks, Annals of Mathematical Statistics 6(4), 1935"


@dataclass(frozen=True, eq=False)
class Metric:
    """One row.

    direct: the literal evaluation on 1-D arrays of the valid cells (`formulas`).
    fft: the plan for all poses at once, or None.
    maximise: more is better. symmetric: source and target may change places.
    needs_positive: heights are raised to the floor first. normalisations: which readings apply.
    layers: "heights" (one value a cell), "classes" (quantised heights) or "slabs".
    """

    name: str
    title: str
    family: str
    formula: str
    maximise: bool
    best: float
    worst: float
    symmetric: bool
    direct: Callable[..., float]
    fft: Plan | None
    needs_positive: bool = True
    normalisations: tuple[Normalise, ...] = ALL
    layers: Literal["heights", "classes", "slabs"] = "heights"
    reference: str = CHA
    note: str = ""

    def cost(self, score: Any) -> Any:
        """Return the score turned so that less is better, whatever the metric."""
        return -score if self.maximise else score


def _metric(
    name: str,
    title: str,
    formula: str,
    direct: Callable[..., float],
    fft: Plan | None,
    worst: float,
    *,
    family: str,
    best: float = 0.0,
    maximise: bool = False,
    symmetric: bool = True,
    note: str = "",
) -> Metric:
    return Metric(
        name, title, family, formula, maximise, best, worst, symmetric, direct, fft, note=note
    )


def _kernel(s: Sums) -> Any:
    return s["kernel"]


# K: p ln(2p/(p+q)) = -p ln((1 + e^s)/2) = -p (s/2 + ln cosh(s/2))
_K = Smooth("ln cosh", 1.0, 0.0, lambda s: -s["kernel"], linear=0.5)
_TOPSOE = Smooth("topsoe", 0.5, 0.5, _kernel)
_HALF_TOPSOE = Smooth("topsoe", 0.5, 0.5, lambda s: 0.5 * s["kernel"])
_TANEJA = Smooth("cosh ln cosh", 0.5, 0.5, _kernel)


def _l1(s: Sums) -> Any:
    return np.maximum(s.P + s.Q - 2.0 * s["min"], 0.0)


def _norms(s: Sums) -> Any:
    return c.pp(s) + c.qq(s)


SHANNON, CHI2, FIDELITY = "Shannon's entropy", "squared L2", "fidelity"
INNER, L1, INTERSECTION = "inner product", "L1", "intersection"
MINKOWSKI, MIXED, VICIS, IMAGE = "Minkowski", "combinations", "vicissitude", "image registration"

_MAXIMUM = "a maximum over cells is not a sum over cells"
_AMPLIFIES = (
    "the ratio of two heights enters without bound, so quantised heights give no useful bound"
)

_ROWS = (
    # Shannon's entropy: the source paper's family
    _metric("kl", "Kullback-Leibler", "sum P ln(P/Q)", f.kl,
            Moments(c.KL_TERMS, c.kl), INF, family=SHANNON, symmetric=False),
    _metric("jeffreys", "Jeffreys", "sum (P-Q) ln(P/Q)", f.jeffreys,
            Moments(c.JEFFREYS_TERMS, c.jeffreys), INF, family=SHANNON),
    _metric("k", "K divergence", "sum P ln(2P/(P+Q))", f.k_divergence, _K, LN2,
            family=SHANNON, symmetric=False),
    _metric("topsoe", "Topsoe", "sum P ln(2P/(P+Q)) + Q ln(2Q/(P+Q))", f.topsoe, _TOPSOE,
            2 * LN2, family=SHANNON),
    _metric("jensen-shannon", "Jensen-Shannon", "Topsoe / 2", f.jensen_shannon, _HALF_TOPSOE,
            LN2, family=SHANNON),
    _metric("jensen-difference", "Jensen difference",
            "sum (P ln P + Q ln Q)/2 - (P+Q)/2 ln((P+Q)/2)", f.jensen_difference, _HALF_TOPSOE,
            LN2, family=SHANNON),
    _metric("taneja", "Taneja", "sum (P+Q)/2 ln((P+Q)/(2 sqrt(PQ)))", f.taneja, _TANEJA, INF,
            family=MIXED),
    _metric("kumar-johnson", "Kumar-Johnson", "sum (P^2-Q^2)^2 / (2 (PQ)^1.5)", f.kumar_johnson,
            Moments(c.POWER_TERMS, c.kumar_johnson), INF, family=MIXED),
    _metric("average-l1-chebyshev", "Average of L1 and L-infinity",
            "(sum |P-Q| + max |P-Q|)/2", f.average_l1_chebyshev, None, 1.5, family=MIXED,
            note=_MAXIMUM),
    # squared L2 (chi2)
    _metric("squared-euclidean", "Squared Euclidean", "sum (P-Q)^2", f.squared_euclidean,
            Moments(c.SQUARE_TERMS, c.squared_euclidean), 2.0, family=CHI2),
    _metric("pearson", "Pearson chi2", "sum (P-Q)^2/Q", f.pearson,
            Moments(c.CHI2_TERMS, c.pearson), INF, family=CHI2, symmetric=False),
    _metric("neyman", "Neyman chi2", "sum (P-Q)^2/P", f.neyman,
            Moments(c.CHI2_TERMS, c.neyman), INF, family=CHI2, symmetric=False),
    _metric("squared-chi2", "Squared chi2", "sum (P-Q)^2/(P+Q)", f.squared_chi2,
            Smooth("sech", 0.5, 0.5, lambda s: s.P + s.Q - 2.0 * s["kernel"]),
            2.0, family=CHI2),
    _metric("symmetric-chi2", "Probabilistic symmetric chi2", "2 sum (P-Q)^2/(P+Q)",
            f.symmetric_chi2,
            Smooth("sech", 0.5, 0.5, lambda s: 2.0 * (s.P + s.Q) - 4.0 * s["kernel"]),
            4.0, family=CHI2),
    _metric("divergence", "Divergence", "2 sum (P-Q)^2/(P+Q)^2", f.divergence,
            Smooth("sech^2", 0.0, 0.0, lambda s: 2.0 * (s.n - s["kernel"])),
            INF, family=CHI2),
    _metric("clark", "Clark", "sqrt(sum ((P-Q)/(P+Q))^2)", f.clark,
            Smooth("sech^2", 0.0, 0.0, lambda s: c.root(s.n - s["kernel"])),
            INF, family=CHI2),
    _metric("additive-chi2", "Additive symmetric chi2", "sum (P-Q)^2 (P+Q)/(PQ)",
            f.additive_chi2, Moments(c.CHI2_TERMS, c.additive_chi2), INF, family=CHI2),
    # fidelity
    _metric("fidelity", "Fidelity", "sum sqrt(PQ)", f.fidelity,
            Moments(c.ROOT_TERMS, c.fidelity), 0.0, family=FIDELITY, best=1.0, maximise=True),
    _metric("bhattacharyya", "Bhattacharyya", "-ln sum sqrt(PQ)", f.bhattacharyya,
            Moments(c.ROOT_TERMS, lambda s: -np.log(c.fidelity(s))), INF, family=FIDELITY),
    _metric("squared-chord", "Squared chord", "sum (sqrt P - sqrt Q)^2", f.squared_chord,
            Moments(c.ROOT_TERMS, c.squared_chord), 2.0, family=FIDELITY),
    _metric("matusita", "Matusita", "sqrt(sum (sqrt P - sqrt Q)^2)", f.matusita,
            Moments(c.ROOT_TERMS, lambda s: c.root(c.squared_chord(s))), 2.0**0.5,
            family=FIDELITY),
    _metric("hellinger", "Hellinger", "sqrt(2 sum (sqrt P - sqrt Q)^2)", f.hellinger,
            Moments(c.ROOT_TERMS, lambda s: c.root(2.0 * c.squared_chord(s))), 2.0,
            family=FIDELITY),
    # inner product
    _metric("inner-product", "Inner product", "sum PQ", f.inner_product,
            Moments(c.SQUARE_TERMS, c.pq), 0.0, family=INNER, best=1.0, maximise=True),
    _metric("harmonic-mean", "Harmonic mean", "2 sum PQ/(P+Q)", f.harmonic_mean,
            Smooth("sech", 0.5, 0.5, _kernel), 0.0, family=INNER,
            best=1.0, maximise=True),
    _metric("cosine", "Cosine", "sum PQ / sqrt(sum P^2 sum Q^2)", f.cosine,
            Moments(c.SQUARE_TERMS, lambda s: c.divide(c.pq(s), c.root(c.pp(s) * c.qq(s)))),
            0.0, family=INNER, best=1.0, maximise=True),
    _metric("kumar-hassebrook", "Kumar-Hassebrook", "sum PQ/(sum P^2 + sum Q^2 - sum PQ)",
            f.kumar_hassebrook,
            Moments(c.SQUARE_TERMS, lambda s: c.divide(c.pq(s), _norms(s) - c.pq(s))), 0.0,
            family=INNER, best=1.0, maximise=True),
    _metric("jaccard", "Jaccard", "sum (P-Q)^2/(sum P^2 + sum Q^2 - sum PQ)", f.jaccard,
            Moments(c.SQUARE_TERMS,
                    lambda s: c.divide(c.squared_euclidean(s), _norms(s) - c.pq(s))),
            1.0, family=INNER),
    _metric("dice", "Dice", "sum (P-Q)^2/(sum P^2 + sum Q^2)", f.dice,
            Moments(c.SQUARE_TERMS, lambda s: c.divide(c.squared_euclidean(s), _norms(s))),
            1.0, family=INNER),
    # Minkowski, L1, intersection
    _metric("euclidean", "Euclidean", "sqrt(sum (P-Q)^2)", f.euclidean,
            Moments(c.SQUARE_TERMS, lambda s: c.root(c.squared_euclidean(s))), 2.0**0.5,
            family=MINKOWSKI),
    _metric("city-block", "City block", "sum |P-Q|", f.city_block, MinSum(_l1), 2.0,
            family=MINKOWSKI),
    _metric("chebyshev", "Chebyshev", "max |P-Q|", f.chebyshev, None, 1.0, family=MINKOWSKI,
            note=_MAXIMUM),
    _metric("sorensen", "Sorensen", "sum |P-Q| / sum (P+Q)", f.sorensen,
            MinSum(lambda s: c.divide(_l1(s), s.P + s.Q)), 1.0, family=L1),
    _metric("soergel", "Soergel", "sum |P-Q| / sum max(P,Q)", f.soergel,
            MinSum(lambda s: c.divide(_l1(s), s.P + s.Q - s["min"])), 1.0, family=L1),
    _metric("kulczynski", "Kulczynski", "sum |P-Q| / sum min(P,Q)", f.kulczynski,
            MinSum(lambda s: c.divide(_l1(s), s["min"])), INF, family=L1),
    _metric("canberra", "Canberra", "sum |P-Q|/(P+Q)", f.canberra,
            RatioSum(lambda s: np.tanh(0.5 * s), 0.5, 0.2, lambda s: s["ratio"]), INF, family=L1),
    _metric("lorentzian", "Lorentzian", "sum ln(1 + |P-Q|)", f.lorentzian, None, INF,
            family=L1, note="no function of the ratio P/Q nor of products of P and Q"),
    _metric("intersection", "Intersection", "sum min(P,Q)", f.intersection,
            MinSum(lambda s: s["min"]), 0.0, family=INTERSECTION, best=1.0, maximise=True),
    _metric("wave-hedges", "Wave Hedges", "sum |P-Q|/max(P,Q)", f.wave_hedges,
            RatioSum(lambda s: -np.expm1(-s), 1.0, 1.0, lambda s: s["ratio"]), INF,
            family=INTERSECTION),
    _metric("motyka", "Motyka", "sum min(P,Q) / sum (P+Q)", f.motyka,
            MinSum(lambda s: c.divide(s["min"], s.P + s.Q)), 0.0, family=INTERSECTION,
            best=0.5, maximise=True),
    _metric("ruzicka", "Ruzicka", "sum min(P,Q) / sum max(P,Q)", f.ruzicka,
            MinSum(lambda s: c.divide(s["min"], s.P + s.Q - s["min"])), 0.0,
            family=INTERSECTION, best=1.0, maximise=True),
    # vicissitude
    _metric("min-symmetric-chi2", "Min-symmetric chi2", "min(Pearson, Neyman)",
            f.min_symmetric_chi2,
            Moments(c.CHI2_TERMS, lambda s: np.minimum(c.pearson(s), c.neyman(s))), INF,
            family=VICIS),
    _metric("max-symmetric-chi2", "Max-symmetric chi2", "max(Pearson, Neyman)",
            f.max_symmetric_chi2,
            Moments(c.CHI2_TERMS, lambda s: np.maximum(c.pearson(s), c.neyman(s))), INF,
            family=VICIS),
    _metric("vicis-wave-hedges", "Vicis-Wave Hedges", "sum |P-Q|/min(P,Q)",
            f.vicis_wave_hedges, None, INF, family=VICIS, note=_AMPLIFIES),
    _metric("vicis-chi2-1", "Vicis-symmetric chi2 (1)", "sum (P-Q)^2/min(P,Q)^2",
            f.vicis_chi2_min_squared, None, INF, family=VICIS, note=_AMPLIFIES),
    _metric("vicis-chi2-2", "Vicis-symmetric chi2 (2)", "sum (P-Q)^2/min(P,Q)",
            f.vicis_chi2_min, None, INF, family=VICIS, note=_AMPLIFIES),
    _metric("vicis-chi2-3", "Vicis-symmetric chi2 (3)", "sum (P-Q)^2/max(P,Q)",
            f.vicis_chi2_max, None, INF, family=VICIS, note=_AMPLIFIES),
)  # fmt: skip


def _image(
    name: str,
    title: str,
    formula: str,
    direct: Callable[..., float],
    fft: Plan,
    *,
    best: float,
    worst: float,
    maximise: bool = False,
    layers: Literal["heights", "classes"] = "heights",
) -> Metric:
    return Metric(
        name, title, IMAGE, formula, maximise, best, worst, True, direct, fft,
        needs_positive=False, normalisations=HEIGHTS, layers=layers, reference=KAESLIN,
    )  # fmt: skip


_IMAGE_ROWS = (
    _image("ssd", "Mean squared difference", "sum (a-b)^2 / n", f.ssd,
           Moments(c.SQUARE_TERMS, lambda s: c.squared_euclidean(s) / s.n, shift_free=True),
           best=0.0, worst=INF),
    _image("zssd", "Zero-mean squared difference", "sum (a-b - mean(a-b))^2 / n", f.zssd,
           Moments(c.SQUARE_TERMS, c.zssd, shift_free=True), best=0.0, worst=INF),
    _image("sad", "Mean absolute difference", "sum |a-b| / n", f.sad,
           MinSum(lambda s: _l1(s) / s.n), best=0.0, worst=INF),
    _image("zsad", "Zero-mean absolute difference", "sum |a-b - mean(a-b)| / n", f.zsad,
           DifferenceSum(), best=0.0, worst=INF),
    _image("ncc", "Normalised cross-correlation", "sum ab / sqrt(sum a^2 sum b^2)", f.ncc,
           Moments(c.SQUARE_TERMS, c.ncc), best=1.0, worst=-1.0, maximise=True),
    _image("zncc", "Zero-mean normalised cross-correlation", "Pearson's r of a and b", f.zncc,
           Moments(c.SQUARE_TERMS, c.zncc, shift_free=True), best=1.0, worst=-1.0,
           maximise=True),
    _image("mi", "Mutual information", "sum p_ij ln(p_ij / (p_i p_j))", f.mutual_information,
           JointHistogram(), best=INF, worst=0.0, maximise=True, layers="classes"),
)  # fmt: skip

_EVIDENCE = Metric(
    "evidence", "evidence (n·MI over height slabs, weighed by what it explains)",
    "likelihood ratio",
    "E |E| / (D + 200), over slabs E = sum sign(n11 n00 - n10 n01) n MI(occupied_s, occupied_t), "
    "D = sum n H(occupied_s)", True, INF, -INF,
    True, f.evidence_direct, None, needs_positive=False, normalisations=HEIGHTS, layers="slabs",
    reference=WILKS, note="scored at every pose by matching.evidence, from height slabs",
)  # fmt: skip

METRICS: dict[str, Metric] = {row.name: row for row in (*_ROWS, *_IMAGE_ROWS, _EVIDENCE)}
"""Every metric by name."""


def find_metric(name: str) -> Metric:
    """Return the row of that name, or raise `InputError` with the names there are."""
    if name not in METRICS:
        raise InputError(f"the metric must be one of {', '.join(METRICS)}; {name!r} came")
    return METRICS[name]


def check_normalise(metric: Metric, normalise: str) -> Normalise:
    """Return the reading to use: the one asked for, or "off" where the metric knows no other."""
    if normalise not in ALL:
        raise InputError(f"normalise must be one of {', '.join(ALL)}; {normalise!r} came")
    if normalise in metric.normalisations:
        return next(known for known in ALL if known == normalise)
    return metric.normalisations[0]


def raise_to_floor(metric: Metric, height: Floats, floor: float) -> Float64s:
    """Return the heights, no lower than `floor` (metres) where the metric needs positive ones."""
    lifted: Float64s = np.asarray(height, np.float64)
    if not metric.needs_positive:
        return lifted
    if not floor > 0.0:
        raise InputError(f"the floor of heights must be above 0 m; {floor} came")
    return np.maximum(lifted, floor)


def quantise(height: Floats, low: float, high: float, bins: int) -> Float64s:
    """Return the class 0 .. bins-1 of each height: `bins` equal steps from `low` to `high`."""
    step = (high - low) / bins
    return np.clip(np.floor((np.asarray(height, np.float64) - low) / step), 0, bins - 1)


def evaluate(
    metric: Metric,
    height_s: Floats,
    known_s: Bools,
    height_t: Floats,
    known_t: Bools,
    *,
    normalise: str = "overlap",
    floor: float = 0.05,
    totals: tuple[float, float] | None = None,
    height_range: tuple[float, float] = (0.0, 1.0),
    bins: int = 8,
) -> float:
    """Return the metric of two grids that lie cell on cell; NaN where no cell is known in both.

    height_s, height_t: one shape, metres; known_s, known_t: the same shape, bool.
    normalise: "overlap", "map" or "off", as the head of this module says.
    totals: for "map", the sums of the whole maps' known heights after the floor; by default the
        sums of the grids given.
    height_range, bins: for a metric of classes, how heights are quantised.
    """
    reading = check_normalise(metric, normalise)
    if metric.layers == "slabs":
        raise InputError(f"{metric.name} is a metric of height slabs, not of heights")
    both = known_s & known_t
    if not both.any():
        return float("nan")
    lifted_s = raise_to_floor(metric, np.asarray(height_s, np.float64), floor)
    lifted_t = raise_to_floor(metric, np.asarray(height_t, np.float64), floor)
    a, b = lifted_s[both], lifted_t[both]
    if metric.layers == "classes":
        low, high = height_range
        return metric.direct(quantise(a, low, high, bins), quantise(b, low, high, bins))
    if reading == "overlap":
        a, b = a / a.sum(), b / b.sum()
    elif reading == "map":
        total_s, total_t = totals or (
            float(lifted_s[known_s].sum()),
            float(lifted_t[known_t].sum()),
        )
        a, b = a / total_s, b / total_t
    return metric.direct(a, b)
