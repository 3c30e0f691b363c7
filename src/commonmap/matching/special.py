"""The one sum of a plan that is not a moment, at every pose, and how exact it is."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from commonmap.matching import roads
from commonmap.matching.arrays import Array
from commonmap.metrics.plans import DifferenceSum, JointHistogram, Moments, RatioSum, Smooth
from commonmap.types import Bools, Float64s

if TYPE_CHECKING:
    from commonmap.matching.correlate import PreparedTarget

WIDEN = 0.25
"""The range of ln(A / B) over the poses is widened to multiples of this: few kernels to prepare."""


@dataclass(frozen=True, eq=False)
class Poses:
    """What the moments say of all poses: arrays (Sx, Sy).

    n: cells, 1 where not counted. values: the moments, errors: what rounding may have added.
    total_s, total_t: sums of the whole maps.
    """

    n: Array
    counted: Array
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


def find_special(
    prepared: PreparedTarget, h: Float64s, known: Bools, poses: Poses, workers: int
) -> Special | None:
    """Return the sum that the metric's plan has besides moments, or None."""
    plan = prepared.metric.fft
    if plan is None or isinstance(plan, Moments):
        return None
    if isinstance(plan, Smooth):
        return _kernel(prepared, plan, h, known, poses, workers)
    assert prepared.classes is not None
    if isinstance(plan, JointHistogram):
        frame = prepared.frame
        mask = frame.target_spectra(prepared.known[None].astype(np.float64), workers)[0]
        value = roads.mutual_information(prepared.classes, h, known, mask, poses.n, workers)
        return Special("score", lambda A, B: value, lambda A, B, v: 0.0)
    if isinstance(plan, DifferenceSum):
        shift = (poses.values["a"] - poses.values["b"]) / poses.n
        value, rounding = _over_classes(prepared, h, known, np.abs, shift, poses, workers)
        value, step = value / poses.n, prepared.step
        return Special("score", lambda A, B: value, lambda A, B, v: 2.0 * step + rounding / poses.n)
    if isinstance(plan, RatioSum):
        return _ratio(prepared, plan, h, known, poses, workers)
    return _minimum(prepared, h, known, poses, workers)


def _span(g: Any, counted: Array, unit: float) -> tuple[float, float]:
    """Return the range of g over the counted poses, widened to multiples of `unit`."""
    over = g[counted] if getattr(g, "ndim", 0) else g
    low, high = float(np.min(over)), float(np.max(over))
    return float(np.floor(low / unit - 1e-3) * unit), float(np.ceil(high / unit + 1e-3) * unit)


def _kernel(
    prepared: PreparedTarget, plan: Smooth, h: Float64s, known: Bools, poses: Poses, workers: int
) -> Special:
    """Return `sum P^alpha Q^beta psi(ln(Q / P))` by the expansion."""
    A, B = poses.scales(prepared.normalise, poses.values)
    constant = prepared.normalise != "overlap"
    span = (0.0, 0.0) if prepared.normalise == "off" else _span(np.log(A / B), poses.counted, WIDEN)
    with prepared.lock:
        if span not in prepared.kernels:
            prepared.kernels[span] = roads.kernel_products(
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

    def position(A: Any, B: Any) -> Any:
        if separated.half == 0.0:
            return 0.0 * A
        return np.clip((np.log(A / B) - separated.middle) / separated.half, -1.0, 1.0)

    weights = None
    if constant:
        nodes = separated.target.shape[0]
        weights = np.cos(np.arange(nodes) * np.arccos(position(A, B)))
    outputs, rounding = kernel.products.correlate(h, known, weights=weights, workers=workers)
    off = float(rounding.sum())

    def scale(A: Any, B: Any) -> Any:
        return A**plan.alpha * B**plan.beta

    def evaluate(A: Any, B: Any) -> Array:
        if constant:
            return outputs[0].astype(np.float64) / scale(A, B)
        return roads.chebyshev_sum(prepared.frame.arrays, outputs, position(A, B)) / scale(A, B)

    def error(A: Any, B: Any, values: Mapping[str, Array]) -> Any:
        # sum a^alpha b^beta is n, sum a, or at most sqrt(sum a sum b)
        mass = poses.n ** (1.0 - plan.alpha - plan.beta)
        if plan.alpha:
            mass = mass * values["a"] ** plan.alpha
        if plan.beta:
            mass = mass * values["b"] ** plan.beta
        return (off + separated.error * mass) / scale(A, B)

    return Special("kernel", evaluate, error)


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
    low, high = _span(g, poses.counted, step)
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
