"""The certified error of the expansions, tried where they were not fitted."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from commonmap.errors import InputError
from commonmap.matching.expansion import PSI, certify, expand, interpolation_error, separate


@pytest.mark.parametrize("name", PSI)
@pytest.mark.parametrize("half_width", [0.5, 4.0, 9.0])
def test_certified_error_holds_between_the_points_of_the_fit(name: str, half_width: float) -> None:
    expansion = expand(name, half_width, 1e-6)
    s = np.random.default_rng(0).uniform(-half_width, half_width, 100_000)
    seen = np.max(np.abs(expansion(s) - PSI[name].evaluate(s)))
    assert seen <= expansion.error <= 1e-6
    assert expansion.error < 3.0 * seen + 1e-7  # and it is not idle


def test_the_design_notes_figures() -> None:
    assert expand("ln cosh", 4.0, 6e-6).alpha.size <= 7
    assert expand("ln cosh", 4.0, 1.3e-7).alpha.size <= 9
    assert expand("ln cosh", 4.0, 9e-9).alpha.size <= 11


@pytest.mark.parametrize("name", PSI)
def test_curvature_bounds(name: str) -> None:
    for L in (0.5, 3.0, 8.0):
        s, h = np.linspace(-L, L, 20_001), 2.0 * L / 20_000
        second = np.diff(PSI[name].evaluate(s), 2) / h**2
        assert np.max(np.abs(second)) <= PSI[name].curvature(L) * (1.0 + 1e-4) + 1e-6


def test_a_bad_fit_is_not_certified() -> None:
    expansion = expand("sech", 4.0, 1e-6)
    spoiled = expansion.alpha.copy()
    spoiled[2] += 1e-3
    error = certify(PSI["sech"], spoiled, expansion.omega, 4.0, 1e-8)
    assert 0.99e-3 < error < 1.02e-3


def test_impossible_tolerance_is_told() -> None:
    with pytest.raises(InputError, match="cannot be expanded"):
        expand("cosh ln cosh", 60.0, 1e-9)


@settings(max_examples=8, deadline=None)
@given(
    name=st.sampled_from(sorted(PSI)),
    width=st.floats(0.5, 5.0),
    middle=st.floats(-1.0, 1.0),
    half=st.sampled_from([0.0, 0.3, 1.2]),
    linear=st.sampled_from([0.0, 0.5]),
)
def test_separated_error_holds(
    name: str, width: float, middle: float, half: float, linear: float
) -> None:
    x_range, g_range = (-0.5 * width, 0.5 * width), (middle - half, middle + half)
    expansion = expand(name, width + abs(middle) + half, 4e-7)
    separated = separate(expansion, x_range, x_range, g_range, 6e-7, linear)
    rng = np.random.default_rng(1)
    x, y = rng.uniform(*x_range, (2, 4000))
    g = rng.uniform(*g_range, 4000)
    at = np.clip((g - separated.middle) / separated.half, -1, 1) if half else 0.0 * g
    u, waves = separated.source @ separated.waves(x), separated.waves(y)
    value = np.zeros(x.size)
    T = np.cos(np.multiply.outer(np.arange(separated.mix.shape[0]), np.arccos(at)))
    f = separated.mix.T @ T
    np.testing.assert_allclose(f[:, 0], separated.functions(g[0]), atol=1e-12)
    for m, some in enumerate(separated.pairs):
        for p in some:
            value += f[m] * u[p] * (separated.target[m, p] @ waves)
    s = y - x + g
    seen = np.max(np.abs(value - PSI[name].evaluate(s) - linear * s))
    assert seen <= separated.error <= 1.1e-6


def test_interpolation_error_bounds_the_truth() -> None:
    expansion = expand("ln cosh", 4.0, 1e-7)
    for nodes in (3, 5, 8):
        theta = (np.arange(nodes) + 0.5) * np.pi / nodes
        g = np.linspace(-0.75, 0.75, 401)
        for d in np.linspace(-3.0, 3.0, 13):
            fit = np.polynomial.chebyshev.Chebyshev.fit(
                0.75 * np.cos(theta), expansion(d + 0.75 * np.cos(theta)), nodes - 1
            )
            error = np.max(np.abs(fit(g) - expansion(d + g)))
            assert error <= interpolation_error(expansion, 0.75, nodes) + 1e-14
