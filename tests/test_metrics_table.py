"""The table of metrics: literal values, declared ranges, and that every row is complete."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from commonmap.errors import InputError
from commonmap.metrics import METRICS, evaluate, evidence_direct, find_metric
from commonmap.metrics.table import check_normalise, quantise

P = np.array([0.2, 0.4, 0.3, 0.1])
Q = np.array([0.3, 0.2, 0.3, 0.2])
HEIGHT_ROWS = [row for row in METRICS.values() if row.layers == "heights"]
SHARE_ROWS = [row for row in HEIGHT_ROWS if "overlap" in row.normalisations]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("kl", 0.12685113254635072),
        ("jeffreys", 0.2484906649788),
        ("k", 0.029897607907053952),
        ("topsoe", 0.0610374678139636),
        ("jensen-shannon", 0.0305187339069818),
        ("jensen-difference", 0.0305187339069818),
        ("taneja", 0.031603932337718146),
        ("city-block", 0.4),
        ("chebyshev", 0.2),
        ("intersection", 0.8),
        ("sorensen", 0.2),
        ("soergel", 1.0 / 3.0),
        ("kulczynski", 0.5),
        ("motyka", 0.4),
        ("ruzicka", 2.0 / 3.0),
        ("squared-euclidean", 0.06),
        ("pearson", 0.01 / 0.3 + 0.04 / 0.2 + 0.01 / 0.2),
        ("neyman", 0.01 / 0.2 + 0.04 / 0.4 + 0.01 / 0.1),
        ("squared-chi2", 0.01 / 0.5 + 0.04 / 0.6 + 0.01 / 0.3),
        ("divergence", 2 * (0.01 / 0.25 + 0.04 / 0.36 + 0.01 / 0.09)),
        ("additive-chi2", 0.01 * 0.5 / 0.06 + 0.04 * 0.6 / 0.08 + 0.01 * 0.3 / 0.02),
        ("inner-product", 0.25),
        ("harmonic-mean", 2 * (0.06 / 0.5 + 0.08 / 0.6 + 0.09 / 0.6 + 0.02 / 0.3)),
        ("cosine", 0.25 / (0.3 * 0.26) ** 0.5),
        ("dice", 0.06 / 0.56),
        ("jaccard", 0.06 / 0.31),
        ("kumar-hassebrook", 0.25 / 0.31),
        ("canberra", 0.1 / 0.5 + 0.2 / 0.6 + 0.1 / 0.3),
        ("wave-hedges", 0.1 / 0.3 + 0.2 / 0.4 + 0.1 / 0.2),
    ],
)
def test_literal_values(name: str, value: float) -> None:
    assert METRICS[name].direct(P, Q) == pytest.approx(value, abs=1e-12, rel=0.0)


def test_literal_values_of_heights() -> None:
    a, b = np.array([1.0, 2.0, 4.0]), np.array([2.0, 2.0, 2.0])
    assert METRICS["ssd"].direct(a, b) == pytest.approx(5.0 / 3.0, abs=1e-14)
    assert METRICS["zssd"].direct(a, b) == pytest.approx(5.0 / 3.0 - 1.0 / 9.0, abs=1e-14)
    assert METRICS["sad"].direct(a, b) == pytest.approx(1.0, abs=1e-14)
    assert METRICS["zsad"].direct(a, b) == pytest.approx((4 / 3 + 1 / 3 + 5 / 3) / 3, abs=1e-14)
    assert np.isnan(METRICS["zncc"].direct(a, b))
    assert METRICS["zncc"].direct(a, 3.0 - a) == pytest.approx(-1.0, abs=1e-14)
    assert METRICS["mi"].direct(a, a) == pytest.approx(np.log(3.0), abs=1e-14)
    assert METRICS["mi"].direct(a, b) == pytest.approx(0.0, abs=1e-14)


def test_evidence_literal_table() -> None:
    occupied_s = np.array([[1, 1, 1, 0, 0, 0, 0, 1]], bool)
    occupied_t = np.array([[1, 1, 0, 0, 0, 0, 1, 1]], bool)
    known = np.array([[1, 1, 1, 1, 1, 1, 1, 0]], bool)  # n11 2, n10 1, n01 1, n00 3
    expected = 2 * np.log(2 * 7 / 9) + 2 * np.log(1 * 7 / 12) + 3 * np.log(3 * 7 / 16)
    doubt = -(3 * np.log(3 / 7) + 4 * np.log(4 / 7))  # what the source leaves open
    value = evidence_direct(occupied_s, known, occupied_t, np.ones_like(known))
    assert value == pytest.approx(expected**2 / (200 + doubt), abs=1e-12)
    inverted = evidence_direct(occupied_s, known, ~occupied_t, np.ones_like(known))
    assert inverted == pytest.approx(-(expected**2) / (200 + doubt), abs=1e-12)
    twice = evidence_direct(
        *(np.repeat(x, 2, axis=0) for x in (occupied_s, known, occupied_t, np.ones_like(known)))
    )
    assert twice == pytest.approx((2 * expected) ** 2 / (200 + 2 * doubt), abs=1e-12)


@pytest.mark.parametrize("row", METRICS.values(), ids=lambda row: row.name)
def test_row_is_complete(row) -> None:  # type: ignore[no-untyped-def]
    assert METRICS[row.name] is row
    assert row.title and row.formula and row.family and row.reference
    assert row.best > row.worst if row.maximise else row.best < row.worst
    assert row.cost(row.best) < row.cost(row.worst)
    assert row.fft is not None or row.note


shares = st.lists(st.floats(0.05, 1.0), min_size=12, max_size=12).map(
    lambda h: np.array(h) / np.sum(h)
)


@pytest.mark.parametrize("row", SHARE_ROWS, ids=lambda row: row.name)
@given(p=shares, q=shares)
def test_range_symmetry_and_optimum(row, p, q) -> None:  # type: ignore[no-untyped-def]
    value = row.direct(p, q)
    low, high = sorted((row.best, row.worst))
    assert low - 1e-12 <= value <= high + 1e-12
    if row.name != "inner-product":  # the inner product is not at its best for equal maps
        assert row.cost(row.direct(p, p)) <= row.cost(value) + 1e-7
        assert row.direct(p, p) == pytest.approx(row.best, abs=2e-7)
    if row.symmetric:
        assert row.direct(q, p) == pytest.approx(value, abs=1e-12, rel=1e-12)


def test_asymmetric_rows_are_asymmetric() -> None:
    for row in SHARE_ROWS:
        if not row.symmetric:
            assert abs(row.direct(P, Q) - row.direct(Q, P)) > 1e-3, row.name


def test_readings() -> None:
    height_s = np.array([[0.2, 0.4], [0.3, 0.1]])
    height_t = np.array([[0.6, 0.4], [0.6, 0.4]])
    known = np.ones((2, 2), bool)
    hole = np.array([[True, True], [True, False]])
    k = METRICS["k"]
    over = evaluate(k, height_s, hole, height_t, known, normalise="overlap")
    a, b = np.array([0.2, 0.4, 0.3]) / 0.9, np.array([0.6, 0.4, 0.6]) / 1.6
    assert over == pytest.approx(np.sum(a * np.log(2 * a / (a + b))), abs=1e-15)
    a, b = np.array([0.2, 0.4, 0.3]) / 0.9, np.array([0.6, 0.4, 0.6]) / 2.0
    whole = evaluate(k, height_s, hole, height_t, known, normalise="map")
    assert whole == pytest.approx(np.sum(a * np.log(2 * a / (a + b))), abs=1e-15)
    a, b = np.array([0.25, 0.4, 0.3]), np.array([0.6, 0.4, 0.6])
    off = evaluate(k, height_s, hole, height_t, known, normalise="off", floor=0.25)
    assert off == pytest.approx(np.sum(a * np.log(2 * a / (a + b))), abs=1e-15)
    assert np.isnan(evaluate(k, height_s, ~known, height_t, known))


def test_bad_names_are_told() -> None:
    with pytest.raises(InputError, match="must be one of kl"):
        find_metric("kullback")
    with pytest.raises(InputError, match="normalise must be one of"):
        check_normalise(METRICS["k"], "all")
    assert check_normalise(METRICS["ncc"], "overlap") == "off"
    with pytest.raises(InputError, match="floor"):
        evaluate(
            METRICS["k"],
            np.ones((1, 1)),
            np.ones((1, 1), bool),
            np.ones((1, 1)),
            np.ones((1, 1), bool),
            floor=0.0,
        )


def test_quantise_literal() -> None:
    heights = np.array([-1.0, 0.0, 0.124, 0.125, 0.5, 0.999, 1.0, 2.0])
    assert quantise(heights, 0.0, 1.0, 8).tolist() == [0, 0, 0, 1, 4, 7, 7, 7]
