"""The one sum of a plan that is not a moment, at every pose, and how exact it is."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from commonmap.matching.arrays import Array
from commonmap.matching.classes import mutual_information
from commonmap.matching.kernels import evaluate_kernel, kernel_products, ratio_range
from commonmap.metrics.plans import DifferenceSum, JointHistogram, Moments, RatioSum, Smooth
from commonmap.types import Bools, Float64s

if TYPE_CHECKING:
    from commonmap.matching.correlate import PreparedTarget

WIDEN = 0.25
"""The range of ln(A / B) over the poses is widened to plus and minus a multiple of this: few
kernels to prepare."""


@dataclass(frozen=True, eq=False)
class Poses:
    """What the moments say of all poses: arrays (Nx, Ny), shifts modulo the transforms' size.

    n: cells, 1 where not counted. n_seen: cells. counted: enough of them. turned: after half a
    turn. values: the moments. errors: what rounding may have added. total_s, total_t: sums of the
    whole maps.
    """

    n: Array
    n_seen: Array
    counted: Array
    turned: bool
    values: dict[str, Array]
    errors: dict[str, Any]
    total_s: float
    total_t: float

    def scales(self, normalise: str, values: Mapping[str, Array]) -> tuple[Any, Any]:
        """Return A and B: what source and target heights are divided by."""
        if normalise == "overlap":
            return values["a"], values["b"]
        return (self.total_s, self.total_t) if normalise == "map" else (1.0, 1.0)


@dataclass(frozen=True, eq=False)
class Special:
    """The sum `name` from A and B; error: what it may be off, besides the moments' rounding."""

    name: str
    evaluate: Callable[[Any, Any], Array]
    error: Callable[[Any, Any, Mapping[str, Array]], Any]


def find_specials(
    prepared: PreparedTarget,
    h: Float64s,
    known: Bools,
    poses: Sequence[Poses],
    turns: Sequence[bool],
    workers: int,
) -> list[Special | None]:
    """Return, per turn, the sum that the metric's plan has besides moments, or None."""
    plan = prepared.metric.fft
    if isinstance(plan, Smooth):
        return [*_kernels(prepared, plan, h, known, poses, turns, workers)]
    return [_find_special(prepared, h, known, some, workers) for some in poses]


def _find_special(
    prepared: PreparedTarget, h: Float64s, known: Bools, poses: Poses, workers: int
) -> Special | None:
    plan = prepared.metric.fft
    if plan is None or isinstance(plan, Moments):
        return None
    assert prepared.classes is not None
    if isinstance(plan, JointHistogram):
        frame = prepared.frame
        mask = frame.target_spectra(prepared.known[None].astype(np.float64), workers)[0]
        value = mutual_information(prepared.classes, h, known, mask, poses.n, workers)
        return Special("score", lambda A, B: value, lambda A, B, v: 0.0)
    if isinstance(plan, DifferenceSum):
        shift = (poses.values["a"] - poses.values["b"]) / poses.n
        value, rounding = _over_classes(prepared, h, known, np.abs, shift, poses, workers)
        value, step = value / poses.n, prepared.step
        return Special("score", lambda A, B: value, lambda A, B, v: 2.0 * step + rounding / poses.n)
    if isinstance(plan, RatioSum):
        return _ratio(prepared, plan, h, known, poses, workers)
    return _minimum(prepared, h, known, poses, workers)


def _span(ranges: Sequence[tuple[float, float]], unit: float) -> tuple[float, float]:
    """Return a range that holds all of them, widened to multiples of `unit`."""
    low, high = min(low for low, _ in ranges), max(high for _, high in ranges)
    return float(np.floor(low / unit - 1e-3) * unit), float(np.ceil(high / unit + 1e-3) * unit)


def _range(g: Any, counted: Array) -> tuple[float, float]:
    """Return the least and the largest g over the counted poses."""
    if getattr(g, "ndim", 0) == 0:
        return float(g), float(g)
    if not bool(counted.any()):
        return 0.0, 0.0
    xp_min, xp_max = np.where(counted, g, np.inf).min(), np.where(counted, g, -np.inf).max()
    return float(xp_min), float(xp_max)


def _kernels(
    prepared: PreparedTarget,
    plan: Smooth,
    h: Float64s,
    known: Bools,
    poses: Sequence[Poses],
    turns: Sequence[bool],
    workers: int,
) -> list[Special]:
    """Return, per turn, `sum P^alpha Q^beta (psi(s) + linear s)`, s = ln(Q / P), by expansion."""
    arrays, reading = prepared.frame.arrays, prepared.normalise
    span, ratios = (0.0, 0.0), [0.0 for _ in poses]
    if reading == "overlap":
        ranges = [
            ratio_range(arrays, some.values["a"], some.values["b"], some.counted) for some in poses
        ]
        largest = max(abs(g) for some in ranges for g in some)
        span = _span([(-largest, largest)], WIDEN)
    elif reading == "map":
        ratios = [float(np.log(some.total_s / some.total_t)) for some in poses]
        span = _span([(g, g) for g in ratios], WIDEN)
    with prepared.lock:
        if span not in prepared.kernels:
            prepared.kernels[span] = kernel_products(
                prepared.frame,
                plan,
                (float(np.log(prepared.height_range[0])), float(np.log(prepared.height_range[1]))),
                span,
                prepared.tolerance,
                prepared.height,
                prepared.known,
                workers,
            )
        kernel = prepared.kernels[span]
    separated = kernel.separated

    weights = None
    if reading != "overlap":  # g is one number: a single transform back
        weights = [separated.functions(g) for g in ratios]
    outputs, rounding = kernel.products.correlate(
        h, known, turns=turns, weights=weights, workers=workers
    )
    louder = np.abs(separated.mix).sum(axis=0) if weights is None else np.ones(1)
    off = float(louder @ rounding)

    def scale(A: Any, B: Any) -> Any:
        return A**plan.alpha * B**plan.beta

    def special(some: Poses, output: Array) -> Special:
        def evaluate(A: Any, B: Any) -> Array:
            if weights is not None:
                return output[0].astype(np.float64) / scale(A, B)
            return evaluate_kernel(arrays, kernel, output, A, B, some.counted)

        def error(A: Any, B: Any, values: Mapping[str, Array]) -> Any:
            # sum a^alpha b^beta is n, sum a, or at most sqrt(sum a sum b)
            mass = some.n ** (1.0 - plan.alpha - plan.beta)
            if plan.alpha:
                mass = mass * values["a"] ** plan.alpha
            if plan.beta:
                mass = mass * values["b"] ** plan.beta
            return (off + separated.error * mass) / scale(A, B)

        return Special("kernel", evaluate, error)

    return [special(some, output) for some, output in zip(poses, outputs, strict=True)]


def _over_classes(
    prepared: PreparedTarget,
    h: Float64s,
    known: Bools,
    weigh: Callable[[Float64s], Float64s],
    g: Any,
    poses: Poses,
    workers: int,
    *,
    weighted: bool = False,
) -> tuple[Array, float]:
    """Return `sum weigh(y - x + g)` over the overlap, x and y the classes' middles, and rounding.

    g: (Sx, Sy) or a number. Linear between multiples of the step, where all kinks of `weigh` are.
    weighted: times the source's height.
    """
    classes = prepared.classes
    assert classes is not None
    frame, step = prepared.frame, classes.steps.step
    U, norms = classes.source(h, known, workers, weighted=weighted)
    low, high = _span([_range(g, poses.counted)], step)
    first, last = round(low / step), round(high / step)
    total = frame.arrays.xp.zeros(poses.n.shape, np.float64)
    position = g / step
    reach = (classes.steps.count + max(abs(first), abs(last))) * step
    largest = float(np.max(np.abs(weigh(np.linspace(-reach, reach, 201)))))
    for m in range(first, last + 1):
        share = np.maximum(0.0, 1.0 - np.abs(position - m))
        if getattr(g, "ndim", 0) == 0 and share == 0.0:
            continue
        total += share * classes.difference(U, weigh, m, workers)
    return total, frame.rounding * largest * float(norms.sum() * classes.target_norm.sum())


def _ratio(
    prepared: PreparedTarget, plan: RatioSum, h: Float64s, known: Bools, poses: Poses, workers: int
) -> Special:
    """Return `sum h(|ln(Q / P)|)`."""
    A, B = poses.scales(prepared.normalise, poses.values)
    value, rounding = _over_classes(
        prepared, h, known, lambda s: plan.h(np.abs(s)), np.log(A / B), poses, workers
    )
    step = prepared.step
    moved = 2.0 * plan.slope * step + 0.125 * plan.bend * step * step
    return Special("ratio", lambda A, B: value, lambda A, B, v: moved * poses.n + rounding)


def _minimum(
    prepared: PreparedTarget, h: Float64s, known: Bools, poses: Poses, workers: int
) -> Special:
    """Return `sum min(P, Q)`."""
    step = prepared.step
    if prepared.normalise == "off":
        a, b = poses.values["a"], poses.values["b"]
        distance, rounding = _over_classes(prepared, h, known, np.abs, 0.0, poses, workers)
        value = 0.5 * (a + b - distance)
        return Special("min", lambda A, B: value, lambda A, B, v: 0.5 * (step * poses.n + rounding))
    A, B = poses.scales(prepared.normalise, poses.values)
    value, rounding = _over_classes(
        prepared, h, known, lambda s: np.minimum(1.0, np.exp(s)), np.log(A / B), poses, workers,
        weighted=True,
    )  # fmt: skip
    value = value / A
    relative = float(np.expm1(step) + 0.125 * step * step * np.exp(step))
    return Special("min", lambda A, B: value, lambda A, B, v: relative * value + rounding / A)
