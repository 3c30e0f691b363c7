"""How a metric is written as correlations: what `matching.correlate` needs to know of it.

A plan names the sums over the overlap O(p) that the metric is made of, and how they combine. A
*moment* is `sum f(a) g(b)`, one cross-correlation. The other plans name a sum that is not one
product (`kernel`, `min`, ...) together with the road that turns it into products.
`combine` works on arrays over all poses, of NumPy or CuPy alike.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Term = tuple[float, str, str]
"""factor, f, g: one product `factor * sum f(a) g(b)`; f and g are keys of `BASIS`."""


def _power(exponent: float) -> Callable[[Array], Array]:
    return lambda h: h**exponent


BASIS: dict[str, Callable[[Array], Array]] = {
    "1": lambda h: np.ones_like(h),
    "h": lambda h: h,
    "h^2": lambda h: h * h,
    "h^0.5": np.sqrt,
    "h^-1": lambda h: 1.0 / h,
    "h^2.5": _power(2.5),
    "h^-1.5": _power(-1.5),
    "ln h": np.log,
    "h ln h": lambda h: h * np.log(h),
}
"""Functions of one height that moments are made of. A cell not known contributes nothing."""


@dataclass(frozen=True, eq=False)
class Sums:
    """What is known at every pose: arrays (Sx, Sy) over the poses, or numbers where constant.

    n: cells known in both. A, B: what source and target are divided by (P = a / A, Q = b / B):
    the sums over the overlap, over each map, or 1. values: the sums the plan names, of heights.
    errors: what rounding may have added to each.
    """

    n: Array
    A: Array | float
    B: Array | float
    values: Mapping[str, Array] = field(default_factory=dict)
    errors: Mapping[str, float] = field(default_factory=dict)

    def above_rounding(self, value: Array, name: str) -> Array:
        """Return the value, or NaN where it does not stand out from the rounding of sum `name`."""
        return np.where(value > 30.0 * self.errors.get(name, 0.0), value, np.nan)

    def __getitem__(self, name: str) -> Array:
        """Return the sum of that name."""
        return self.values[name]

    @property
    def P(self) -> Array:
        """`sum P` over the overlap, from the moment "a"."""
        share: Array = self["a"] / self.A
        return share

    @property
    def Q(self) -> Array:
        """`sum Q` over the overlap, from the moment "b"."""
        share: Array = self["b"] / self.B
        return share


Combine = Callable[[Sums], Array]

A_SUM: dict[str, tuple[Term, ...]] = {"a": ((1.0, "h", "1"),)}
B_SUM: dict[str, tuple[Term, ...]] = {"b": ((1.0, "1", "h"),)}


@dataclass(frozen=True, eq=False)
class Moments:
    """A metric that is a function of moments: exact, to rounding.

    shift_free: the value stays when one constant is taken off both maps' heights; then the
        engine centres them, which keeps single precision from cancelling.
    """

    terms: Mapping[str, tuple[Term, ...]]
    combine: Combine
    shift_free: bool = False


@dataclass(frozen=True, eq=False)
class Smooth:
    """Moments a and b, and `kernel = sum P^alpha Q^beta (psi(s) + linear s)`, s = ln(Q / P).

    psi is even and smooth, a key of `matching.expansion.PSI`; its Fourier expansion makes products
    of it.
    """

    psi: str
    alpha: float
    beta: float
    combine: Combine
    linear: float = 0.0


@dataclass(frozen=True, eq=False)
class MinSum:
    """Moments a and b, and `min = sum min(P, Q)`, which quantised heights make products of.

    While P and Q are the heights to a fixed scale, level sets do it in one inverse transform; over
    the overlap, the scale changes with the pose and the classes of `ln b - ln a` are counted.
    """

    combine: Combine


@dataclass(frozen=True, eq=False)
class RatioSum:
    """`ratio = sum h(|ln(Q / P)|)`: the classes of `ln b - ln a` are counted at every pose.

    slope, bend: bounds of the first derivative of h and, away from 0, of the second.
    """

    h: Callable[[Array], Array]
    slope: float
    bend: float
    combine: Combine


@dataclass(frozen=True, eq=False)
class DifferenceSum:
    """Mean of `|d - mean d|`, d = a - b: the classes of a - b are counted at every pose."""


@dataclass(frozen=True, eq=False)
class JointHistogram:
    """A function of the joint histogram of quantised heights: the counts are exact."""

    statistic: Literal["mutual information"] = "mutual information"


Plan = Moments | Smooth | MinSum | RatioSum | DifferenceSum | JointHistogram


# Combinations -------------------------------------------------------------------------------------

KL_TERMS: dict[str, tuple[Term, ...]] = {
    **A_SUM,
    **B_SUM,
    "a ln(a/b)": ((1.0, "h ln h", "1"), (-1.0, "h", "ln h")),
}
JEFFREYS_TERMS: dict[str, tuple[Term, ...]] = {
    **KL_TERMS,
    "b ln(b/a)": ((1.0, "1", "h ln h"), (-1.0, "ln h", "h")),
}
CHI2_TERMS: dict[str, tuple[Term, ...]] = {
    **A_SUM,
    **B_SUM,
    "a2/b": ((1.0, "h^2", "h^-1"),),
    "b2/a": ((1.0, "h^-1", "h^2"),),
}
SQUARE_TERMS: dict[str, tuple[Term, ...]] = {
    **A_SUM,
    **B_SUM,
    "aa": ((1.0, "h^2", "1"),),
    "bb": ((1.0, "1", "h^2"),),
    "ab": ((1.0, "h", "h"),),
}
ROOT_TERMS: dict[str, tuple[Term, ...]] = {**A_SUM, **B_SUM, "root": ((1.0, "h^0.5", "h^0.5"),)}
POWER_TERMS: dict[str, tuple[Term, ...]] = {
    **A_SUM,
    **B_SUM,
    "root": ((1.0, "h^0.5", "h^0.5"),),
    "a5/b3": ((1.0, "h^2.5", "h^-1.5"),),
    "b5/a3": ((1.0, "h^-1.5", "h^2.5"),),
}


def divide(top: Array, bottom: Array) -> Array:
    """Return `top / bottom`, NaN where the bottom is not positive."""
    return top / np.where(bottom > 0.0, bottom, np.nan)


def root(x: Array) -> Array:
    """Return the square root of what rounding may have made slightly negative."""
    return np.sqrt(np.maximum(x, 0.0))


def kl(s: Sums) -> Array:
    """`sum P ln(P / Q) = (sum a ln(a / b) - ln(A / B) sum a) / A`."""
    score: Array = (s["a ln(a/b)"] - np.log(s.A / s.B) * s["a"]) / s.A
    return score


def jeffreys(s: Sums) -> Array:
    """KL both ways."""
    back: Array = (s["b ln(b/a)"] - np.log(s.B / s.A) * s["b"]) / s.B
    return kl(s) + back


def pearson(s: Sums) -> Array:
    """`sum (P - Q)^2 / Q = sum P^2 / Q - 2 sum P + sum Q`."""
    return s["a2/b"] * (s.B / s.A**2) - 2.0 * s.P + s.Q


def neyman(s: Sums) -> Array:
    """`sum (P - Q)^2 / P = sum Q^2 / P - 2 sum Q + sum P`."""
    return s["b2/a"] * (s.A / s.B**2) - 2.0 * s.Q + s.P


def additive_chi2(s: Sums) -> Array:
    """`sum (P - Q)^2 (P + Q) / (P Q) = sum P^2 / Q + sum Q^2 / P - sum P - sum Q`."""
    return s["a2/b"] * (s.B / s.A**2) + s["b2/a"] * (s.A / s.B**2) - s.P - s.Q


def kumar_johnson(s: Sums) -> Array:
    """`sum P^2.5 Q^-1.5 / 2 + sum Q^2.5 P^-1.5 / 2 - sum sqrt(P Q)`."""
    forth: Array = s["a5/b3"] * (s.B**1.5 / s.A**2.5)
    back: Array = s["b5/a3"] * (s.A**1.5 / s.B**2.5)
    return 0.5 * (forth + back) - fidelity(s)


def fidelity(s: Sums) -> Array:
    """`sum sqrt(P Q)`."""
    return s["root"] / np.sqrt(s.A * s.B)


def squared_chord(s: Sums) -> Array:
    """`sum (sqrt P - sqrt Q)^2 = sum P + sum Q - 2 sum sqrt(P Q)`."""
    return np.maximum(s.P + s.Q - 2.0 * fidelity(s), 0.0)


def pp(s: Sums) -> Array:
    """`sum P^2`."""
    return np.divide(s["aa"], s.A**2)


def qq(s: Sums) -> Array:
    """`sum Q^2`."""
    return np.divide(s["bb"], s.B**2)


def pq(s: Sums) -> Array:
    """`sum P Q`."""
    return np.divide(s["ab"], s.A * s.B)


def squared_euclidean(s: Sums) -> Array:
    """`sum P^2 + sum Q^2 - 2 sum P Q`."""
    return np.maximum(pp(s) + qq(s) - 2.0 * pq(s), 0.0)


def variances(s: Sums) -> tuple[Array, Array, Array]:
    """`n` times the variance of a, of b, and the covariance, over the overlap."""
    va = s["aa"] - s["a"] ** 2 / s.n
    vb = s["bb"] - s["b"] ** 2 / s.n
    return va, vb, s["ab"] - s["a"] * s["b"] / s.n


def zssd(s: Sums) -> Array:
    """Mean squared difference without the means, from the variances."""
    va, vb, cab = variances(s)
    return np.maximum(va + vb - 2.0 * cab, 0.0) / s.n


def zncc(s: Sums) -> Array:
    """Pearson's r; NaN where a side is flat to the rounding of its own sum of squares."""
    va, vb, cab = variances(s)
    va, vb = s.above_rounding(va, "aa"), s.above_rounding(vb, "bb")
    r: Array = np.clip(cab / np.sqrt(va * vb), -1.0, 1.0)
    return r


def ncc(s: Sums) -> Array:
    """`sum a b / sqrt(sum a^2 sum b^2)`; NaN where a side is nought to the rounding."""
    aa, bb = s.above_rounding(s["aa"], "aa"), s.above_rounding(s["bb"], "bb")
    r: Array = np.clip(s["ab"] / np.sqrt(aa * bb), -1.0, 1.0)
    return r
