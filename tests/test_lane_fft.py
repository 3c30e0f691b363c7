"""Lanes against NumPy, one by one; transforms of eight sequences against NumPy's of each."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import pytest

from commonmap.matching.lane_fft import (
    STEP,
    find_length,
    plan_transform,
    transform_columns,
    transform_line,
)
from commonmap.matching.lanes import (
    WIDTH,
    clip_below_zero,
    count_ones,
    load,
    load_pairs,
    spread,
    store,
    store_pairs,
)

FLOATS: list[Any] = [np.float32, np.float64]


@numba.njit  # type: ignore[misc]
def _floats(a, b, one, out):  # type: ignore[no-untyped-def]
    x, y = load(a, 3), load(b, 0)
    store(out[0], 1, x + y)
    store(out[1], 1, x - y)
    store(out[2], 1, x * y)
    store(out[3], 1, x / y)
    store(out[4], 1, one - x)
    store(out[5], 1, x - one)
    store(out[6], 1, clip_below_zero(x) + spread(one))


@numba.njit  # type: ignore[misc]
def _words(a, b, out):  # type: ignore[no-untyped-def]
    x, y, by = load(a, 3), load(b, 0), np.uint64(5)
    store(out[0], 1, x & y)
    store(out[1], 1, x | y)
    store(out[2], 1, x << by)
    store(out[3], 1, x >> by)
    store(out[4], 1, by & x)
    store(out[5], 1, count_ones(x) + count_ones(y))


@pytest.mark.parametrize("dtype", FLOATS)
def test_arithmetic_on_lanes_is_that_of_numpy(dtype: Any) -> None:
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=14).astype(dtype), rng.uniform(1, 2, 9).astype(dtype)
    out, one = np.full((7, 10), 9.0, dtype), dtype(0.7)
    _floats(a, b, one, out)
    x, y = a[3:11], b[:8]
    expected = [x + y, x - y, x * y, x / y, one - x, x - one, np.maximum(x, 0) + one]
    assert np.array_equal(out[:, 1:9], np.stack(expected).astype(dtype))
    assert np.all(out[:, [0, 9]] == 9.0)  # eight are written, and no other


def test_words_on_lanes_are_those_of_numpy() -> None:
    rng = np.random.default_rng(2)
    a, b = (rng.integers(0, 2**64, 14, dtype=np.uint64) for _ in range(2))
    a[4], b[1] = 2**64 - 1, 0
    out, by = np.zeros((6, 10), np.uint64), np.uint64(5)
    _words(a, b, out)
    x, y = a[3:11], b[:8]
    ones = np.array([bin(int(i)).count("1") + bin(int(j)).count("1") for i, j in zip(x, y,
                    strict=True)])  # fmt: skip
    expected = [x & y, x | y, x << by, x >> by, x & by, ones.astype(np.uint64)]
    assert np.array_equal(out[:, 1:9], np.stack(expected))


def test_words_have_no_division() -> None:
    @numba.njit  # type: ignore[misc]
    def divide(a):  # type: ignore[no-untyped-def]
        store(a, 0, load(a, 0) / load(a, 0))

    with pytest.raises(numba.TypingError):
        divide(np.ones(8, np.uint64))


@pytest.mark.parametrize("dtype", FLOATS)
@pytest.mark.parametrize(
    "n", [1, 2, 3, 4, 5, 6, 8, 9, 10, 15, 16, 24, 25, 27, 60, 64, 75, 100, 125, 243, 250, 480, 625]
)
def test_eight_sequences_transform_as_each_by_itself(n: int, dtype: Any) -> None:
    rng = np.random.default_rng(n)
    z = rng.normal(size=(n, WIDTH)) + 1j * rng.normal(size=(n, WIDTH))
    plan = plan_transform(n, dtype)
    assert int(np.prod(plan.radices)) == n
    for sign, expected in ((1, np.fft.fft(z, axis=0)), (-1, np.fft.ifft(z, axis=0) * n)):
        a = np.stack([z.real, z.imag], axis=1).astype(dtype).ravel()
        b = np.empty_like(a)
        swapped = transform_line(a, b, plan, dtype(sign))
        assert swapped == (len(plan.radices) % 2 == 1)
        found = (b if swapped else a).reshape(n, 2, WIDTH)
        assert a.size == n * STEP
        off = np.abs(found[:, 0] + 1j * found[:, 1] - expected).max() / np.abs(expected).max()
        assert off < 4.0 * np.finfo(dtype).eps


@numba.njit  # type: ignore[misc]
def _pairs(a, out):  # type: ignore[no-untyped-def]
    even, odd = load_pairs(a, 3)
    store(out, 1, even)
    store(out, 9, odd)
    store_pairs(out, 18, odd, even)


@pytest.mark.parametrize("dtype", FLOATS)
def test_pairs_come_apart_and_together(dtype: Any) -> None:
    a, out = np.arange(20, dtype=dtype), np.full(35, -1.0, dtype)
    _pairs(a, out)
    assert out[1:9].tolist() == [3, 5, 7, 9, 11, 13, 15, 17]
    assert out[9:17].tolist() == [4, 6, 8, 10, 12, 14, 16, 18]
    assert out[18:34].tolist() == [4, 3, 6, 5, 8, 7, 10, 9, 12, 11, 14, 13, 16, 15, 18, 17]
    assert out[[0, 17, 34]].tolist() == [-1, -1, -1]


@pytest.mark.parametrize("dtype", FLOATS)
@pytest.mark.parametrize("width", [1, 7, 8, 21])
@pytest.mark.parametrize("n_in", [1, 20, 24])
def test_columns_transform_as_numpy_has_it(n_in: int, width: int, dtype: Any) -> None:
    rng = np.random.default_rng([n_in, width])
    z = rng.normal(size=(n_in, width)) + 1j * rng.normal(size=(n_in, width))
    z = z.astype(np.result_type(dtype, np.complex64))
    plan = plan_transform(24, dtype)
    out = np.full((24, width), np.nan, z.dtype)
    for sign, scale, expected in (
        (1, 1.0, np.fft.fft(z, n=24, axis=0)),
        (-1, 1 / 24, np.fft.ifft(z, n=24, axis=0)),
    ):
        transform_columns(
            z.view(dtype).ravel(), out.view(dtype).reshape(-1), n_in, width, plan,
            dtype(sign), dtype(scale),
        )  # fmt: skip
        assert np.abs(out - expected).max() < 8.0 * np.finfo(dtype).eps * np.abs(expected).max()


def test_lengths_have_small_factors_alone() -> None:
    assert [find_length(n) for n in (1, 7, 11, 13, 61, 97)] == [1, 8, 12, 15, 64, 100]
    with pytest.raises(ValueError, match="2, 3 and 5 alone; 14 came"):
        plan_transform(14, np.float32)
