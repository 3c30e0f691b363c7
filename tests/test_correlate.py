"""Scores of all translations by FFT against the literal formula at every shift."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.signal
from numpy.typing import NDArray

import device_arrays
from commonmap.errors import EmptyMapError, InputError, MissingExtraError
from commonmap.matching import arrays
from commonmap.matching.arrays import find_rim
from commonmap.matching.correlate import (
    prepare_target,
    score_half_turns,
    score_surface,
    score_surfaces,
)
from commonmap.matching.direct import direct_surface
from commonmap.metrics import METRICS, Metric

Grid = tuple[NDArray[np.float64], NDArray[np.bool_]]
FAST = [row for row in METRICS.values() if row.fft is not None]
CASES = [(row, reading) for row in FAST for reading in row.normalisations]
TOP = 1.0


def make_maps(
    seed: int, source: tuple[int, int] = (6, 8), target: tuple[int, int] = (12, 10)
) -> tuple[Grid, Grid]:
    """Random heights, a part of the target copied from the source, holes in both."""
    rng = np.random.default_rng(seed)
    height_s, height_t = rng.uniform(0.0, TOP, source), rng.uniform(0.0, TOP, target)
    height_t[3:7, 2:7] = 0.5 * height_t[3:7, 2:7] + 0.5 * height_s[1:5, 1:6]
    return (height_s, rng.random(source) < 0.8), (height_t, rng.random(target) < 0.8)


@pytest.mark.parametrize(("row", "reading"), CASES, ids=lambda x: getattr(x, "name", x))
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_every_pose_equals_the_formula(row: Metric, reading: str, dtype: type[Any]) -> None:
    (height_s, known_s), (height_t, known_t) = make_maps(3)
    prepared = prepare_target(
        row, height_t, known_t, height_s.shape,
        normalise=reading, height_range=(0.0, TOP), min_cells=4, dtype=dtype,
    )  # fmt: skip
    surface = score_surface(prepared, height_s, known_s, bound=True)
    slow = direct_surface(row, height_s, known_s, height_t, known_t, normalise=reading, min_cells=4)
    assert np.array_equal(np.isnan(surface.score), np.isnan(slow))
    seen = ~np.isnan(slow)
    assert seen.sum() > 100
    assert surface.bound is not None
    assert np.all(np.abs(surface.score - slow)[seen] <= surface.bound[seen])
    # the bound is worth something
    size = np.max(np.abs(slow[seen]))
    assert np.max(surface.bound[seen]) < (0.5 if prepared.step else 1e-3) * max(size, 1.0)
    if prepared.step and row.layers == "heights":
        # on the quantised heights nothing is left but rounding and the bend between classes
        snapped = direct_surface(
            row, prepared.snap(height_s), known_s, prepared.snap(height_t), known_t,
            normalise=reading, min_cells=4,
        )  # fmt: skip
        bend = 0.125 * prepared.step**2 * (known_s.sum() if row.family != "Minkowski" else 2)
        exact = reading == "off"
        assert np.nanmax(np.abs(surface.score - snapped)) < (2e-5 if exact else bend)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("name", ["k", "topsoe", "zncc", "mi", "city-block"])
def test_odd_shapes_and_sparse_masks(name: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    shape_s, shape_t = (tuple(int(n) for n in rng.integers(1, 14, 2)) for _ in range(2))
    (height_s, known_s), (height_t, known_t) = make_maps(seed, (9, 9), (13, 13))
    height_s, height_t = height_s[: shape_s[0], : shape_s[1]], height_t[: shape_t[0], : shape_t[1]]
    known_s, known_t = known_s[: shape_s[0], : shape_s[1]], known_t[: shape_t[0], : shape_t[1]]
    known_s[0, 0] = known_t[0, 0] = True
    prepared = prepare_target(
        name, height_t, known_t, height_s.shape, height_range=(0.0, TOP), dtype=np.float64,
        min_cells=2,
    )  # fmt: skip
    surface = score_surface(prepared, height_s, known_s, bound=True)
    slow = direct_surface(name, height_s, known_s, height_t, known_t, min_cells=2)
    both = ~np.isnan(slow) & ~np.isnan(surface.score)
    assert (both == ~np.isnan(slow)).mean() > 0.98  # zncc of two cells may be flat to rounding
    assert surface.bound is not None
    assert np.all(np.abs(surface.score - slow)[both] <= surface.bound[both])


def test_shift_convention_literal() -> None:
    height_s = np.array([[0.2, 0.9], [0.4, 0.1], [0.7, 0.3]])
    height_t = np.full((6, 7), 0.5)
    height_t[2:5, 4:6] = height_s
    known = np.ones((6, 7), bool)
    prepared = prepare_target("ssd", height_t, known, (3, 2), min_cells=6)
    surface = score_surface(prepared, height_s, np.ones((3, 2), bool))
    assert surface.score.shape == (8, 8)
    u, v = np.unravel_index(np.nanargmin(surface.score), surface.score.shape)
    assert (int(u), int(v)) == (
        4,
        5,
    )  # source [0, 0] on target [2, 4]: 2 = u - (3 - 1), 4 = v - (2 - 1)
    assert surface.shift(int(u), int(v)) == (2, 4)
    assert surface.score[u, v] == pytest.approx(0.0, abs=1e-6)
    assert surface.n_overlap[u, v] == 6
    assert np.isnan(surface.score[0, 0])
    whole = score_surface(
        prepare_target("ssd", height_t, known, (3, 2)), height_s, np.ones((3, 2), bool)
    )
    assert whole.n_overlap[0].tolist() == [1, 2, 2, 2, 2, 2, 2, 1]
    assert whole.score[0, 0] == pytest.approx((height_s[2, 1] - height_t[0, 0]) ** 2, abs=1e-6)


def test_a_known_rim_saves_transforms_and_no_pose_that_counts() -> None:
    (height_s, known_s), (height_t, known_t) = make_maps(6, (21, 19), (40, 37))
    known_s[:6], known_s[-5:], known_s[:, :4], known_s[:, -7:] = False, False, False, False
    sources = [known_s, known_s[::-1, ::-1]]
    rim = find_rim(sources, (21, 19), 40)
    for axis in (0, 1):  # by hand: the most rows whose cells are fewer than 40, at either end
        cells = np.count_nonzero(known_s, axis=1 - axis)
        ends = [max(m for m in range(len(c)) if c[:m].sum() < 40) for c in (cells, cells[::-1])]
        assert rim[axis] == min(ends) > 4
    shape = (21, 19)
    whole = prepare_target("k", height_t, known_t, shape, height_range=(0, TOP), min_cells=40)
    small = prepare_target(
        "k", height_t, known_t, shape, height_range=(0, TOP), min_cells=40, rim=rim
    )
    assert np.prod(small.frame.shape) < np.prod(whole.frame.shape)
    for one, other in zip(
        score_half_turns(whole, height_s, known_s), score_half_turns(small, height_s, known_s),
        strict=True,
    ):  # fmt: skip
        counted = one.n_overlap >= 40
        assert np.array_equal(~np.isnan(other.score), counted)
        assert np.array_equal(other.n_overlap[counted], one.n_overlap[counted])
        assert np.abs(one.score[counted] - other.score[counted]).max() < 5e-6
    slow = direct_surface("k", height_s, known_s, height_t, known_t, min_cells=40)
    assert np.nanmax(np.abs(score_surface(small, height_s, known_s).score - slow)) < 5e-6
    with pytest.raises(InputError, match="outermost rows"):
        score_surface(small, height_s, np.ones_like(known_s))


def test_counts_are_exact_and_rim_may_wrap() -> None:
    (height_s, known_s), (height_t, known_t) = make_maps(5, (17, 13), (40, 31))
    whole = prepare_target("k", height_t, known_t, (17, 13), height_range=(0, TOP), min_cells=1)
    small = prepare_target("k", height_t, known_t, (17, 13), height_range=(0, TOP), min_cells=90)
    assert np.prod(small.frame.shape) < np.prod(whole.frame.shape)
    n = score_surface(whole, height_s, known_s).n_overlap
    expected = np.rint(
        scipy.signal.fftconvolve(known_t.astype(float), known_s[::-1, ::-1].astype(float))
    )
    assert np.array_equal(n, expected)
    wrapped = score_surface(small, height_s, known_s)
    assert np.array_equal(~np.isnan(wrapped.score), n >= 90)
    assert np.array_equal(wrapped.n_overlap[n >= 90], n[n >= 90])
    slow = direct_surface("k", height_s, known_s, height_t, known_t, min_cells=90)
    assert np.nanmax(np.abs(wrapped.score - slow)) < 5e-6


@pytest.mark.parametrize("name", ["k", "kl", "zncc", "mi", "city-block", "taneja"])
def test_same_bytes_for_any_workers(name: str) -> None:
    (height_s, known_s), (height_t, known_t) = make_maps(6, (30, 25), (70, 64))
    prepared = [
        prepare_target(name, height_t, known_t, (30, 25), height_range=(0, TOP), workers=w)
        for w in (1, 2, 3)
    ]
    bytes_ = {
        score_surface(p, height_s, known_s, workers=w).score.tobytes()
        for p, w in zip(prepared, (1, 2, 3), strict=True)
    }
    assert len(bytes_) == 1
    sources = [(height_s, known_s), (height_s[::-1], known_s[::-1]), (height_s, known_s)]
    one = [s.score.tobytes() for s in score_surfaces(prepared[0], sources)]
    two = [s.score.tobytes() for s in score_surfaces(prepared[1], sources, workers=2)]
    assert one == two
    assert one[0] == one[2] != one[1]


@pytest.mark.parametrize("name", ["k", "zncc", "mi", "city-block", "kl"])
@pytest.mark.parametrize("reading", ["overlap", "map", "off"])
def test_half_turn(name: str, reading: str) -> None:
    (height_s, known_s), (height_t, known_t) = make_maps(7)
    prepared = prepare_target(
        name, height_t, known_t, height_s.shape, height_range=(0, TOP), dtype=np.float64,
        normalise=reading, min_cells=3,
    )  # fmt: skip
    straight, turned = score_half_turns(prepared, height_s, known_s, bound=True)
    for surface, flip in ((straight, 1), (turned, -1)):
        h, k = height_s[::flip, ::flip], known_s[::flip, ::flip]
        alone = score_surface(prepared, h, k)
        assert np.array_equal(alone.n_overlap, surface.n_overlap)
        assert np.array_equal(np.isnan(alone.score), np.isnan(surface.score))
        assert surface.bound is not None
        assert np.nanmax(np.abs(alone.score - surface.score) - surface.bound) <= 0.0


def test_smaller_source_keeps_the_convention() -> None:
    (height_s, known_s), (height_t, known_t) = make_maps(8)
    prepared = prepare_target(
        "kl", height_t, known_t, (9, 11), dtype=np.float64, height_range=(0, TOP)
    )
    padded = score_surface(prepared, height_s, known_s).score
    tight = prepare_target("kl", height_t, known_t, (6, 8), dtype=np.float64)
    alone = score_surface(tight, height_s, known_s).score
    inner = padded[3 : 3 + alone.shape[0], 3 : 3 + alone.shape[1]]
    np.testing.assert_allclose(inner, alone, atol=1e-11)


def test_flat_overlap_has_no_correlation() -> None:
    height_t = np.zeros((30, 30))
    height_t[20:, :] = np.random.default_rng(0).uniform(0, 1, (10, 30))
    known = np.ones((30, 30), bool)
    source = height_t[18:28, 5:15]
    prepared = prepare_target("zncc", height_t, known, (10, 10), min_cells=50)
    surface = score_surface(prepared, source, np.ones((10, 10), bool))
    assert np.isnan(surface.score[9 + 4, 9 + 4])  # flat ground under the whole source
    assert surface.score[9 + 18, 9 + 5] == pytest.approx(1.0, abs=1e-4)


def test_true_pose_wins_for_every_metric() -> None:
    rng = np.random.default_rng(11)
    height_t = np.exp(rng.normal(-1.5, 0.8, (40, 40))).clip(0.05, 1.0)
    height_s = height_t[12:28, 9:25] * rng.uniform(0.97, 1.03, (16, 16))
    known_s, known_t = np.ones((16, 16), bool), rng.random((40, 40)) < 0.95
    for row, reading in CASES:
        if reading == "map" or row.name == "inner-product":  # these favour mass, not likeness
            continue
        prepared = prepare_target(
            row, height_t, known_t, (16, 16), normalise=reading, height_range=(0.05, 1.1),
            min_cells=200,
        )  # fmt: skip
        surface = score_surface(prepared, height_s.clip(0.05, 1.1), known_s)
        cost = row.cost(surface.score)
        if row.name in ("intersection", "fidelity", "harmonic-mean") and reading == "off":
            continue
        best = np.unravel_index(np.nanargmin(cost), cost.shape)
        assert surface.shift(int(best[0]), int(best[1])) == (12, 9), (row.name, reading)


def test_bad_input_is_told() -> None:
    (height_s, known_s), (height_t, known_t) = make_maps(9)
    with pytest.raises(InputError, match="maximum over cells"):
        prepare_target("chebyshev", height_t, known_t, (6, 8))
    with pytest.raises(InputError, match=r"matching\.evidence"):
        prepare_target("evidence", height_t, known_t, (6, 8))
    with pytest.raises(InputError, match="bool mask"):
        prepare_target("k", height_t, known_t[:3], (6, 8))
    with pytest.raises(InputError, match="finite heights"):
        prepare_target("k", np.full((4, 4), np.nan), np.ones((4, 4), bool), (6, 8))
    with pytest.raises(EmptyMapError, match="target map has no known cell"):
        prepare_target("k", height_t, np.zeros_like(known_t), (6, 8))
    with pytest.raises(InputError, match="array module"):
        prepare_target("k", height_t, known_t, (6, 8), xp="torch")
    prepared = prepare_target("k", height_t, known_t, (6, 8), height_range=(0.0, TOP))
    with pytest.raises(InputError, match="height_range of both maps"):
        score_surface(prepared, height_s + 1.0, known_s)
    with pytest.raises(InputError, match="must fit into"):
        score_surface(prepared, height_t, known_t)
    with pytest.raises(EmptyMapError, match="source map has no known cell"):
        score_surface(prepared, height_s, np.zeros_like(known_s))
    far = prepare_target("k", height_t, known_t, (6, 8), height_range=(0.0, TOP), min_cells=1000)
    assert np.isnan(score_surface(far, height_s, known_s).score).all()


def test_unknown_cells_may_hold_anything() -> None:
    (height_s, known_s), (height_t, known_t) = make_maps(10)
    prepared = prepare_target("k", height_t, known_t, (6, 8), height_range=(0, TOP))
    clean = score_surface(prepared, height_s, known_s).score
    dirty_t, dirty_s = np.where(known_t, height_t, np.nan), np.where(known_s, height_s, 1e9)
    prepared = prepare_target("k", dirty_t, known_t, (6, 8), height_range=(0, TOP))
    assert np.array_equal(score_surface(prepared, dirty_s, known_s).score, clean, equal_nan=True)


def test_cupy_is_an_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(name: str) -> None:
        raise ImportError(name)

    monkeypatch.setattr("importlib.import_module", refuse)
    with pytest.raises(MissingExtraError, match=r"commonmap\[gpu\]"):
        arrays.find_arrays("cupy")


@pytest.mark.parametrize(("row", "reading"), CASES, ids=lambda x: getattr(x, "name", x))
def test_the_path_of_a_gpu(row: Metric, reading: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The code that CuPy runs, on arrays as strict as CuPy's (`device_arrays`)."""
    device_arrays.install(monkeypatch)
    (height_s, known_s), (height_t, known_t) = make_maps(12)
    surfaces = []
    for xp in ("numpy", "cupy"):
        prepared = prepare_target(
            row, height_t, known_t, (6, 8), normalise=reading, height_range=(0, TOP), min_cells=4,
            dtype=np.float64, xp=xp,
        )  # fmt: skip
        turned = score_half_turns(prepared, height_s, known_s)[1]
        surfaces.append((score_surface(prepared, height_s, known_s, bound=True), turned))
    for host, device in zip(*surfaces, strict=True):
        assert type(device.score) is np.ndarray
        assert np.isfinite(host.score).sum() > 50
        np.testing.assert_allclose(device.score, host.score, atol=1e-9)
        assert np.array_equal(device.n_overlap, host.n_overlap)
    assert surfaces[1][0].bound is not None


@pytest.mark.parametrize("name", ["k", "mi", "zncc"])
def test_shifts_that_wrap_onto_each_other_are_not_scored(name: str) -> None:
    rng = np.random.default_rng(13)
    height_s, height_t = rng.uniform(0, TOP, (10, 10)), rng.uniform(0, TOP, (40, 40))
    known_s, known_t = np.ones((10, 10), bool), np.ones((40, 40), bool)
    prepared = prepare_target(
        name, height_t, known_t, (10, 10), height_range=(0, TOP), min_cells=11, dtype=np.float64
    )
    assert prepared.frame.shape == (48, 48)  # for 49 shifts: the first and the last share a place
    n = scipy.signal.convolve(known_t.astype(int), known_s.astype(int), method="direct")
    for surface, flip in zip(score_half_turns(prepared, height_s, known_s), (1, -1), strict=True):
        slow = direct_surface(
            name, height_s[::flip, ::flip], known_s, height_t, known_t, min_cells=11
        )
        assert np.array_equal(np.isnan(surface.score), np.isnan(slow))
        assert np.array_equal(np.isnan(slow), n < 11)
        assert np.nanmax(np.abs(surface.score - slow)) < 2e-6
        assert np.array_equal(surface.n_overlap[n >= 11], n[n >= 11])
        assert not surface.n_overlap[[0, -1]].any() and not surface.n_overlap[:, [0, -1]].any()
