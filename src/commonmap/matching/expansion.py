"""Functions of a ratio of heights as sums of products, with a certified error.

An f-divergence is `sum P^alpha Q^beta psi(s)`, `s = ln(Q / P) = y - x + g` with x = ln a, y = ln b
and g = ln(A / B), which changes with the pose. To score all poses by FFT, psi(y - x + g) must
become a short sum of products of a function of x, one of y and one of g. Three steps, each
with a proved bound (derivations: docs/metrics-math.md):

1. `expand`: psi is even and smooth, so on |s| <= L it is a Fourier extension
   `sum_k alpha_k cos(w_k s)`, w_k = k pi / T, T > L, by least squares (Huybrechs 2010).
2. `separate`: in g, Chebyshev interpolation, and of its polynomials the few mixtures that matter.
3. `separate`: over x and y, the shortest sum of products, by a singular value decomposition.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numba
import numpy as np

from commonmap.errors import InputError
from commonmap.types import Float64s


@dataclass(frozen=True, eq=False)
class Psi:
    """An even smooth function and a bound on its second derivative over |s| <= L."""

    evaluate: Callable[[Float64s], Float64s]
    curvature: Callable[[float], float]


def _ln_cosh(s: Float64s) -> Float64s:
    half = 0.5 * np.abs(s)
    return np.asarray(half + np.log1p(np.exp(-2.0 * half)) - np.log(2.0))


PSI: dict[str, Psi] = {
    # ln cosh(s/2); its second derivative is sech^2(s/2) / 4
    "ln cosh": Psi(_ln_cosh, lambda L: 0.25),
    # cosh(s/2) ln cosh(s/2); second derivative (cosh ln cosh + 2 sinh tanh + sech) / 4, at s/2
    "cosh ln cosh": Psi(
        lambda s: np.cosh(0.5 * s) * _ln_cosh(s),
        lambda L: float(np.cosh(0.5 * L) * (0.125 * L + 0.5) + 0.25),
    ),
    # Topsoe's s sinh(s/2) - 2 cosh(s/2) ln cosh(s/2); the first part's second derivative is
    # cosh(s/2) + s/4 sinh(s/2)
    "topsoe": Psi(
        lambda s: s * np.sinh(0.5 * s) - 2.0 * np.cosh(0.5 * s) * _ln_cosh(s),
        lambda L: float(np.cosh(0.5 * L) * (0.5 * L + 2.0) + 0.5),
    ),
    # sech(s/2); second derivative (sech - 2 sech^3) / 4
    "sech": Psi(lambda s: 1.0 / np.cosh(0.5 * s), lambda L: 0.25),
    # sech^2(s/2); second derivative sech^2 - 1.5 sech^4
    "sech^2": Psi(lambda s: 1.0 / np.cosh(0.5 * s) ** 2, lambda L: 0.5),
}
"""The even functions that the Smooth plans of the metric table need."""

MAX_TERMS = 80
MAX_NODES = 64
_PERIODS = (1.2, 1.35, 1.5, 1.65, 1.8, 2.0)


@dataclass(frozen=True, eq=False)
class Expansion:
    """`psi(s) = sum_k alpha[k] cos(omega[k] s)` on |s| <= half_width, to `error` at most."""

    alpha: Float64s
    omega: Float64s
    half_width: float
    error: float

    def __call__(self, s: Float64s) -> Float64s:
        """Evaluate the sum."""
        return np.asarray(np.cos(np.multiply.outer(s, self.omega)) @ self.alpha)


def certify(psi: Psi, alpha: Float64s, omega: Float64s, L: float, slack: float) -> float:
    """Return an upper bound of |psi - sum| over |s| <= L.

    On a grid of step h, a function with second derivative at most M exceeds the larger of its
    neighbours by at most `h^2 M / 8`; h is chosen so that this is `slack`.
    """
    M = psi.curvature(L) + float(np.abs(alpha) @ omega**2)
    n = int(np.ceil(L / np.sqrt(8.0 * slack / M))) + 1
    h = L / n
    worst = 0.0
    for start in range(0, n + 1, 65536):
        s = h * np.arange(start, min(start + 65536, n + 1), dtype=np.float64)
        difference = psi.evaluate(s)
        for factor, w in zip(alpha, omega, strict=True):
            difference = difference - factor * np.cos(w * s)
        worst = max(worst, float(np.max(np.abs(difference))))
    return worst + h * h * M / 8.0


@lru_cache(maxsize=256)
def expand(name: str, half_width: float, tolerance: float) -> Expansion:
    """Return the shortest expansion of `PSI[name]` on |s| <= half_width within the tolerance.

    Raises `InputError` when no `MAX_TERMS` terms reach it.
    """
    psi, L = PSI[name], float(half_width)
    s = L * np.sin(np.linspace(0.0, 0.5 * np.pi, 1001))
    value = psi.evaluate(s)
    closest = 1e-13 * float(np.max(np.abs(value)))  # rounding of the fit
    counts = range(2, MAX_TERMS + 1) if closest < tolerance else range(0)
    for terms in counts:
        for period in _PERIODS:
            omega = np.arange(terms, dtype=np.float64) * (np.pi / (period * L))
            basis = np.cos(np.multiply.outer(s, omega))
            alpha: Float64s = np.asarray(np.linalg.lstsq(basis, value, rcond=1e-14)[0], np.float64)
            seen = float(np.max(np.abs(basis @ alpha - value)))
            if seen < 0.95 * tolerance:
                error = certify(psi, alpha, omega, L, 0.04 * tolerance)
                if error <= tolerance:
                    return Expansion(alpha, omega, L, error)
    raise InputError(
        f"heights that differ by a factor of up to {np.exp(min(L, 300.0)):.3g} cannot be expanded "
        f"to {tolerance:.3g} in {MAX_TERMS} terms; raise the floor or the tolerance"
    )


@dataclass(frozen=True, eq=False)
class Separated:
    """`(psi + linear)(y - x + g) = sum_l f_l(g) sum_p u_p(x) v_lp(y)`.

    `f_l(g) = sum_m mix[m, l] T_m(g')`, T_m Chebyshev's polynomials, `g' = (g - middle) / half` in
    [-1, 1]; `u_p(x) = source[p] . waves(x)`, `v_lp(y) = target[l, p] . waves(y)`,
    `waves(x) = [cos(omega x), sin(omega x), x]`.
    pairs: per l, the p that matter; the others are dropped, and counted in the error.
    error: a bound for x, y, g in their ranges.
    """

    omega: Float64s
    source: Float64s
    target: Float64s
    mix: Float64s
    middle: float
    half: float
    error: float
    pairs: tuple[tuple[int, ...], ...]

    def waves(self, x: Float64s) -> Float64s:
        """Return (2 K + 1, ...) cosines, then sines, of omega times x, then x."""
        return _waves(self.omega, x)

    def functions(self, g: float) -> Float64s:
        """Return f_l(g), one number each l."""
        at = np.clip((g - self.middle) / self.half, -1.0, 1.0) if self.half > 0.0 else 0.0
        T = np.cos(np.arange(self.mix.shape[0]) * np.arccos(at))
        return np.asarray(T @ self.mix, np.float64)


def _waves(omega: Float64s, x: Float64s) -> Float64s:
    turn = np.empty((omega.size, *x.shape), np.complex128)  # powers: omega[k] = k omega[1]
    turn[0], turn[1:] = 1.0, np.exp(1j * omega[1] * x)
    np.cumprod(turn, axis=0, out=turn)
    return np.concatenate([turn.real, turn.imag, x[None]])


def interpolation_error(expansion: Expansion, half: float, nodes: int) -> float:
    """Return a bound of Chebyshev interpolation in g of the cosines, over a width of 2 * half.

    Interpolation at J Chebyshev nodes of a function whose J-th derivative is at most D errs by
    at most `D half^J / (2^(J-1) J!)`; the J-th derivative of `alpha cos(w s)` is `alpha w^J`.
    """
    log_factorial = float(np.sum(np.log(np.arange(1, nodes + 1))))
    log_scale = -(nodes - 1) * np.log(2.0) - log_factorial
    turns = expansion.omega[1:] * half
    powers = np.exp(nodes * np.log(np.maximum(turns, 1e-300)) + log_scale)
    return float(np.abs(expansion.alpha[1:]) @ powers)


ORDERS = 8
"""Derivatives that the bounds below look at before they stop at the sum of the coefficients."""


def _derivative(omega: Float64s, grid: Float64s, d: int) -> Float64s:
    """Return the d-th derivatives of the waves on a grid, (2 K + 1, N)."""
    angle = np.multiply.outer(omega, grid) + 0.5 * np.pi * d
    scale = (omega**d)[:, None]
    straight = grid if d == 0 else np.full_like(grid, float(d == 1))
    return np.concatenate([scale * np.cos(angle), scale * np.sin(angle), straight[None]])


def _largest(omega: Float64s, grid: Float64s, d: int) -> Float64s:
    """Return bounds of the d-th derivatives of the waves over the grid's range, (2 K + 1,)."""
    straight = float(np.max(np.abs(grid))) if d == 0 else float(d == 1)
    return np.concatenate([omega**d, omega**d, [straight]])


def _bound_rows(rows: Float64s, omega: Float64s, grid: Float64s) -> Float64s:
    """Bound `|rows . waves|` over the range that the grid spans, one number a row.

    A function exceeds its grid values by at most half a step times its slope, and so on.
    """
    half_step = 0.5 * (grid[1] - grid[0])
    bound: Float64s = np.abs(rows) @ _largest(omega, grid, ORDERS)
    for d in range(ORDERS - 1, -1, -1):
        seen = np.einsum("rk,kn->rn", rows, _derivative(omega, grid, d))
        bound = np.max(np.abs(seen), axis=1) + half_step * bound
    return bound


@numba.njit(cache=True, nogil=True)
def _largest_product(on_x: Float64s, rows: Float64s) -> float:  # pragma: no cover
    """Return max |on_x^T rows|, (K, N) and (K, M), without the array: and without BLAS, whose
    threads get in the way of the search's own."""
    largest = 0.0
    line = np.empty(rows.shape[1])
    for i in range(on_x.shape[1]):
        line[:] = 0.0
        for k in range(rows.shape[0]):
            factor = on_x[k, i]
            for j in range(rows.shape[1]):
                line[j] += factor * rows[k, j]
        for j in range(rows.shape[1]):
            largest = max(largest, abs(line[j]))
    return largest


def _bound_residual(residual: Float64s, omega: Float64s, x: Float64s, z: Float64s) -> float:
    """Bound `|waves(x) . residual . waves(z)|` over the ranges of both grids, in the same way."""
    half_x, half_z = 0.5 * (x[1] - x[0]), 0.5 * (z[1] - z[0])
    on_x = [_derivative(omega, x, d) for d in range(ORDERS)]
    on_z = [_derivative(omega, z, d) for d in range(ORDERS)]
    over_z = [np.einsum("kl,ln->kn", residual, waves) for waves in on_z]
    size = np.abs(residual)
    bound = {
        i: float(_largest(omega, x, i) @ size @ _largest(omega, z, ORDERS - i))
        for i in range(ORDERS + 1)
    }
    for order in range(ORDERS - 1, -1, -1):
        seen = [float(_largest_product(on_x[i], over_z[order - i])) for i in range(order + 1)]
        bound = {i: seen[i] + half_x * bound[i + 1] + half_z * bound[i] for i in range(order + 1)}
    return bound[0]


def _over_g(
    expansion: Expansion, linear: float, middle: float, half: float, nodes: int
) -> Float64s:
    """Return the Chebyshev coefficients in g of `(psi + linear)(d + g)`, in the waves of d."""
    alpha, omega = expansion.alpha, expansion.omega
    theta = (np.arange(nodes) + 0.5) * (np.pi / nodes)
    g = middle + half * np.cos(theta)
    angle = np.multiply.outer(g, omega)
    straight = np.full((nodes, 1), linear)
    at_nodes = np.concatenate([alpha * np.cos(angle), -alpha * np.sin(angle), straight], axis=1)
    at_nodes[:, 0] += linear * g
    to_chebyshev = np.cos(np.multiply.outer(np.arange(nodes), theta)) * (2.0 / nodes)
    to_chebyshev[0] *= 0.5
    rows: Float64s = np.einsum("mj,jk->mk", to_chebyshev, at_nodes)
    return rows


def _over_x_and_y(row: Float64s, K: int) -> Float64s:
    """Return the matrix E with `row . waves(y - x) = waves(x) . E . waves(y)`."""
    E = np.zeros((2 * K + 1, 2 * K + 1))
    k = np.arange(K)
    E[k, k] = E[K + k, K + k] = row[:K]
    E[k, K + k], E[K + k, k] = row[K : 2 * K], -row[K : 2 * K]
    E[0, -1] += row[-1]
    E[-1, 0] -= row[-1]
    return E


BETWEEN, UNMIXED, CUT, LITTLE = 0.05, 0.6, 0.27, 0.08
"""Shares of the tolerance for the interpolation in g, for its mixtures, for the singular values and
for the products that are dropped. A mixture less saves a transform back of every surface."""


@lru_cache(maxsize=64)
def separate(
    expansion: Expansion,
    x_range: tuple[float, float],
    y_range: tuple[float, float],
    g_range: tuple[float, float],
    tolerance: float,
    linear: float = 0.0,
) -> Separated:
    """Return the expansion plus `linear * s` as products, adding at most `tolerance`.

    x_range, y_range: of ln a and ln b. g_range: of ln(A / B); one number twice where it is
    constant. `|y - x + g| <= expansion.half_width` must hold over the ranges.
    """
    omega, K = expansion.omega, expansion.omega.size
    middle, half = 0.5 * (g_range[0] + g_range[1]), 0.5 * (g_range[1] - g_range[0])
    nodes = 2 if half > 0.0 and linear else 1
    while half > 0.0 and interpolation_error(expansion, half, nodes) > BETWEEN * tolerance:
        nodes += 1
        if nodes > MAX_NODES:
            raise InputError(
                f"the maps' mean heights differ by a factor that spans {np.exp(2.0 * half):.3g} "
                "over the poses, too much to interpolate; raise the floor or the smallest overlap"
            )
    between = interpolation_error(expansion, half, nodes) if half > 0.0 else 0.0

    # in g: the few mixtures of Chebyshev polynomials that matter
    d = np.linspace(y_range[0] - x_range[1], y_range[1] - x_range[0], 1001)
    rows = _over_g(expansion, linear, middle, half, nodes)
    left = np.linalg.svd(np.einsum("mk,kn->mn", rows, _waves(omega, d[::4])))[0]
    for n_mixed in range(1, nodes + 1):
        mix = left[:, :n_mixed]
        aside = rows - np.einsum("ml,nl,nk->mk", mix, mix, rows)
        unmixed = float(_bound_rows(aside, omega, d).sum()) if n_mixed < nodes else 0.0
        if unmixed <= UNMIXED * tolerance:
            break
    louder = np.abs(mix).sum(axis=0)  # a bound of each mixture over g, as |T_m| <= 1

    # over x and y: singular vectors are the shortest sum of products
    x, y = (np.linspace(a, b, 101 + 2 * int(25.0 * (b - a))) for a, b in (x_range, y_range))
    few_x, few_y = _waves(omega, x[::2]), _waves(omega, y[::2])
    exact = [_over_x_and_y(row, K) for row in np.einsum("ml,mk->lk", mix, rows)]
    over_y = np.concatenate([E @ few_y for E in exact], axis=1)
    left, size, right = np.linalg.svd(np.einsum("kn,km->nm", few_x, over_y), full_matrices=False)
    cut = CUT * tolerance
    for rank in range(1, 2 * K + 2):
        source = np.einsum("km,rm->rk", over_y, right[:rank] / size[:rank, None])
        onto = np.einsum("nr,kn->rk", left[:, :rank], few_x)
        target = np.stack([np.einsum("rk,kl->rl", onto, E) for E in exact])
        residual = [
            E - np.einsum("rk,rl->kl", source, v) for E, v in zip(exact, target, strict=True)
        ]
        tried = [_largest_product(few_x, np.einsum("kl,ln->kn", R, few_y)) for R in residual]
        if float(louder @ np.array(tried)) > cut:
            continue
        lost = float(louder @ np.array([_bound_residual(R, omega, x, y) for R in residual]))
        if lost <= cut:
            break
    else:
        source, target, lost, rank = np.eye(2 * K + 1), np.stack(exact), 0.0, 2 * K + 1

    # products that contribute next to nothing
    flat = target.reshape(-1, target.shape[-1])
    reach = _bound_rows(flat, omega, y).reshape(-1, rank) * _bound_rows(source, omega, x)
    reach = reach * louder[:, None]
    order = np.argsort(reach, axis=None, kind="stable")
    n_dropped = int(np.searchsorted(np.cumsum(reach.ravel()[order]), LITTLE * tolerance))
    matter = np.ones(reach.size, np.bool_)
    matter[order[:n_dropped]] = False
    little = float(reach.ravel()[order[:n_dropped]].sum())
    pairs = tuple(tuple(int(p) for p in np.flatnonzero(row)) for row in matter.reshape(reach.shape))
    error = expansion.error + between + unmixed + lost + little
    return Separated(omega, source, target, mix, middle, half, error, pairs)
