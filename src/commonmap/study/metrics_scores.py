"""Every metric of the table at every pose of one yaw, from one shared set of sums.

Sums of products of layers (`plans.Moments`) are cross-correlations, each computed once for all
metrics that need it, in double precision; sums of minima, ratios and logarithms are
taken cell by cell (`metrics_kernels`), exactly, also for the metrics that have no FFT form and
those that `matching.correlate` quantises; mutual information and evidence are whole-number counts.
What a metric makes of its sums is its own row of the table.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from commonmap.matching.arrays import NUMPY
from commonmap.matching.evidence import xlogx_table
from commonmap.matching.evidence_fft import Spectra, evidence_surface, transform_target
from commonmap.matching.lane_fft import find_length
from commonmap.matching.roads import Frame, Products, moment_products
from commonmap.matching.slabs import Bits, SlabGrid
from commonmap.metrics.plans import MinSum, Moments, Smooth, Sums, Term
from commonmap.metrics.table import METRICS, quantise
from commonmap.study.metrics_kernels import (
    LANES,
    RATIO_SUMS,
    class_information,
    log_sums,
    ratio_sums,
)
from commonmap.types import Bools, Float32s, Float64s

OTHER_READINGS = ("kl", "jeffreys", "k")
"""The source paper's metrics, which are also scored with the normalisations "map" and "off"."""

COLUMNS: tuple[tuple[str, str], ...] = (
    *((name, "overlap" if "overlap" in row.normalisations else "off")
      for name, row in METRICS.items()),
    *((name, reading) for reading in ("map", "off") for name in OTHER_READINGS),
)  # fmt: skip
"""What is scored: (metric, reading of its formula)."""

LABELS = tuple(
    name if k < len(METRICS) else f"{name} ({reading})" for k, (name, reading) in enumerate(COLUMNS)
)
"""A name for each of `COLUMNS`."""

BINS = 8
"""Classes of heights for mutual information, as `matching.correlate` takes."""


@dataclass(frozen=True, eq=False)
class Target:
    """The target with all that does not depend on the source.

    b, raw_b, w_b: padded float32 layers, as `metrics_kernels` takes them. top: metres, the
    largest height of both maps.
    """

    shape: tuple[int, int]
    source_shape: tuple[int, int]
    floor: float
    min_cells: int
    total: float
    offset: float
    unit: float
    top: float
    floored: Products
    raw: Products
    kinds: np.ndarray[tuple[int, int], np.dtype[np.uint8]]
    slabs: Spectra
    b: Float32s
    raw_b: Float32s
    w_b: Float32s

    @property
    def surface_shape(self) -> tuple[int, int]:
        """Translations along x and y."""
        return self.floored.frame.out_shape


@dataclass(frozen=True, eq=False)
class Scores:
    """u, v: (P,) shifts with enough overlap, as `correlate.Surface` counts them.

    n: (P,) cells known in both. value: (len(COLUMNS), P), NaN where a metric has none.
    """

    u: np.ndarray[tuple[int], np.dtype[np.int64]]
    v: np.ndarray[tuple[int], np.dtype[np.int64]]
    n: Float64s
    value: Float64s

    @property
    def gain(self) -> Float64s:
        """The values turned so that more is better, (len(COLUMNS), P)."""
        return np.stack(
            [-METRICS[name].cost(row) for (name, _), row in zip(COLUMNS, self.value, strict=True)]
        )


def _terms() -> tuple[dict[str, tuple[Term, ...]], dict[str, tuple[Term, ...]]]:
    """Return the moments that any metric needs: of floored heights, and of raw ones."""
    floored: dict[str, tuple[Term, ...]] = {
        "n": ((1.0, "1", "1"),),
        "a ln a": ((1.0, "h ln h", "1"),),
        "b ln b": ((1.0, "1", "h ln h"),),
    }
    raw: dict[str, tuple[Term, ...]] = {}
    for row in METRICS.values():
        if isinstance(row.fft, Moments):
            (floored if row.needs_positive else raw).update(row.fft.terms)
    return floored, raw


FLOORED, RAW = _terms()


def prepare(
    height_t: Float64s,
    known_t: Bools,
    slabs_t: SlabGrid,
    source_shape: tuple[int, int],
    *,
    top: float,
    min_cells: int,
    floor: float = 0.05,
) -> Target:
    """Return the target ready for sources of `source_shape`.

    height_t, known_t: (tx, ty) metres above ground, bool. slabs_t: the same cells as slabs.
    top: metres, no height of either map is larger. Poses with fewer than `min_cells` cells known
    in both are not scored.
    """
    (tx, ty), (sx, sy) = height_t.shape, source_shape
    size = find_length(tx + sx - 1), find_length(ty + sy - 1)
    frame = Frame(NUMPY, size, source_shape, (tx + sx - 1, ty + sy - 1), np.float64)
    raw = np.where(known_t, height_t, 0.0)
    lifted = np.where(known_t, np.maximum(raw, floor), 0.0)
    offset = float(raw[known_t].mean())
    unit = float(np.sqrt(floor * max(top, floor)))
    centred = np.where(known_t, raw - offset, 0.0)
    one, two = (
        moment_products(frame, terms, layer, known_t, unit=unit, workers=1)
        for terms, layer in ((FLOORED, lifted), (RAW, centred))
    )
    margin = ((sx - 1, sx - 1), (sy - 1, sy - 1 + 2 * LANES))
    layers = [np.pad(x, margin).astype(np.float32) for x in (lifted, raw, known_t)]
    return Target(
        (tx, ty), source_shape, floor, min_cells, float(lifted.sum()), offset, unit, top,
        one, replace(two, role="raw moments"),
        np.pad(_classes(raw, known_t, top), margin, constant_values=BINS),
        transform_target(slabs_t, source_shape), *layers,
    )  # fmt: skip


def _classes(
    height: Float64s, known: Bools, top: float
) -> np.ndarray[tuple[int, int], np.dtype[np.uint8]]:
    """Return the class of each cell's height, `BINS` where not known."""
    return np.where(known, quantise(height, 0.0, max(top, 1e-6), BINS), BINS).astype(np.uint8)


def _spans(known: Bools) -> np.ndarray[tuple[int, int], np.dtype[np.int64]]:
    """Return per row the first known cell and an end, a multiple of `LANES` cells on."""
    any_known = known.any(axis=1)
    first = np.where(any_known, np.argmax(known, axis=1), 0)
    last = np.where(any_known, known.shape[1] - np.argmax(known[:, ::-1], axis=1), 0)
    return np.column_stack([first, first + -(-(last - first) // LANES) * LANES])


def score_all(target: Target, height: Float64s, known: Bools, occupied: Bits, seen: Bits) -> Scores:
    """Return all metrics at all translations of one turned source.

    height, known: (sx, sy) metres above ground, bool. occupied, seen: its slab bits, cell by cell.
    """
    (tx, ty), (sx, sy) = target.shape, target.source_shape
    raw = np.where(known, height, 0.0)
    lifted = np.where(known, np.maximum(raw, target.floor), 0.0)
    centred = np.where(known, raw - target.offset, 0.0)
    (outputs,), _ = target.floored.correlate(lifted, known)
    counts = np.rint(outputs[0, : tx + sx - 1, : ty + sy - 1])
    u, v = np.nonzero(counts >= target.min_cells)
    n = counts[u, v]
    floored = {name: outputs[k, u, v] for k, name in enumerate(FLOORED)}
    for side in ("a", "b"):  # the logarithms of the layers count from the unit
        floored[f"{side} ln {side}"] += np.log(target.unit) * floored[side]
    (outputs,), rounding = target.raw.correlate(centred, known)
    moved = {name: outputs[k, u, v] for k, name in enumerate(RAW)}
    errors = {name: float(rounding[k]) for k, name in enumerate(RAW)}
    o = target.offset
    plain = {
        "a": moved["a"] + n * o,
        "b": moved["b"] + n * o,
        "aa": moved["aa"] + 2.0 * o * moved["a"] + n * o * o,
        "bb": moved["bb"] + 2.0 * o * moved["b"] + n * o * o,
        "ab": moved["ab"] + o * (moved["a"] + moved["b"]) + n * o * o,
    }

    pad = ((0, 0), (0, 2 * LANES))
    a, raw_a, w_a = (np.pad(x, pad).astype(np.float32) for x in (lifted, raw, known))
    spans = _spans(known)
    A, B = floored["a"], floored["b"]
    mean = (plain["a"] - plain["b"]) / np.maximum(n, 1.0)
    top = target.top / max(float(min(A.min(initial=np.inf), B.min(initial=np.inf))), 1e-6)
    table = ratio_sums(
        a, raw_a, w_a, spans, target.b, target.raw_b, target.w_b, u, v, A, B, mean, top
    )
    ratios = dict(zip(RATIO_SUMS, table.T, strict=True))

    readings = {"overlap": (A, B)}
    logs = {"overlap": ratios["p ln(p+q)"]}
    for reading, scales in (("map", (float(lifted.sum()), target.total)), ("off", (1.0, 1.0))):
        wide = tuple(np.full(n.shape, s) for s in scales)
        readings[reading] = wide[0], wide[1]
        logs[reading] = log_sums(a, w_a, spans, target.b, target.w_b, u, v, *wide)[:, 0]

    kinds = np.pad(_classes(raw, known, target.top), pad, constant_values=BINS)
    information = class_information(kinds, spans, target.kinds, u, v, BINS, xlogx_table(kinds.size))
    evidence = evidence_surface(target.slabs, occupied, seen, min_overlap=1.0)[0][u, v]

    value = np.empty((len(COLUMNS), len(n)))
    with np.errstate(all="ignore"):
        for k, (name, reading) in enumerate(COLUMNS):
            row = METRICS[name]
            scale = readings[reading]
            if name == "mi":
                value[k] = information
            elif name == "evidence":
                value[k] = evidence
            elif isinstance(row.fft, Moments):
                shown = moved if row.fft.shift_free else plain
                sums = floored if row.needs_positive else shown
                value[k] = row.fft.combine(Sums(n, *scale, sums, errors))
            else:
                value[k] = SPECIAL[name](
                    Sums(n, *scale, {**floored, **ratios, "log": logs[reading]})
                )
    return Scores(u, v, n, value)


# What the sums of `metrics_kernels` mean to the metrics that are not made of moments -------------

LN2 = float(np.log(2.0))


def _p_ln_p(s: Sums) -> Float64s:
    """`sum P ln P`, from the moment `sum a ln a`."""
    return np.asarray((s["a ln a"] - np.log(s.A) * s["a"]) / s.A)


def _q_ln_q(s: Sums) -> Float64s:
    """`sum Q ln Q`."""
    return np.asarray((s["b ln b"] - np.log(s.B) * s["b"]) / s.B)


def _k(s: Sums) -> Float64s:
    """K = sum P (ln 2 P - ln(P + Q))."""
    return np.asarray(_p_ln_p(s) + LN2 * s.P - s["log"])


def _topsoe(s: Sums) -> Float64s:
    """K both ways."""
    return np.asarray(_k(s) + _q_ln_q(s) + LN2 * s.Q - s["q ln(p+q)"])


def _taneja(s: Sums) -> Float64s:
    """`sum (P+Q)/2 (ln(P+Q) - ln 2 - (ln P + ln Q)/2)`."""
    p_ln_q = (s["a ln a"] - s["a ln(a/b)"] - np.log(s.B) * s["a"]) / s.A
    q_ln_p = (s["b ln b"] - s["b ln(b/a)"] - np.log(s.A) * s["b"]) / s.B
    mixed = 0.25 * (_p_ln_p(s) + p_ln_q + q_ln_p + _q_ln_q(s))
    logs = s["log"] + s["q ln(p+q)"]
    return np.asarray(0.5 * logs - 0.5 * LN2 * (s.P + s.Q) - mixed)


def _with(kernel: Callable[[Sums], Float64s], plan: Smooth) -> Callable[[Sums], Float64s]:
    """Return the combination of a Smooth plan, given its kernel by name instead of expansion."""
    return lambda s: np.asarray(
        plan.combine(Sums(s.n, s.A, s.B, {**s.values, "kernel": kernel(s)}, s.errors))
    )


KERNELS: dict[str, Callable[[Sums], Float64s]] = {
    "ln cosh": lambda s: -_k(s),
    "topsoe": _topsoe,
    "cosh ln cosh": _taneja,
    "sech": lambda s: np.asarray(s["sech"]),
    "sech^2": lambda s: np.asarray(s.n - s["ratio^2"]),
}
"""The sums that `matching.expansion` makes products of, by the psi of the plan."""


def _special() -> dict[str, Callable[[Sums], Float64s]]:
    """Return the function of the sums for each metric that is not made of moments."""
    found: dict[str, Callable[[Sums], Float64s]] = {
        **{name: partial(_named, name) for name in RATIO_SUMS if name in METRICS},
        "chebyshev": lambda s: np.asarray(s["largest"]),
        "average-l1-chebyshev": lambda s: np.asarray(
            0.5 * (s.P + s.Q - 2.0 * s["min"] + s["largest"])
        ),
        "sad": lambda s: np.asarray(s["sad"] / s.n),
        "zsad": lambda s: np.asarray(s["zsad"] / s.n),
    }  # fmt: skip
    for name, row in METRICS.items():
        if isinstance(row.fft, Smooth):
            found[name] = _with(KERNELS[row.fft.psi], row.fft)
        elif isinstance(row.fft, MinSum) and name not in found:
            found[name] = row.fft.combine
    return found


def _named(name: str, s: Sums) -> Float64s:
    return np.asarray(s[name])


SPECIAL = _special()
