"""Evidence: the 2x2 table by hand, the FFT against brute force, packing, and support by areas."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from commonmap.matching import arrays
from commonmap.matching.arrays import NUMPY
from commonmap.matching.evidence import (
    count_tables,
    signed_evidence,
    sum_table,
    uncertainty,
    weigh,
    xlogx_table,
)
from commonmap.matching.evidence_fft import (
    evidence_peaks,
    evidence_surface,
    evidence_surfaces,
    peaks_on_each,
    plan_lanes,
    transform_target,
)
from commonmap.matching.evidence_kernels import bound_scores
from commonmap.matching.peaks import local_maxima
from commonmap.matching.search import evidence_at
from commonmap.matching.slabs import (
    Columns,
    SlabGrid,
    coarsen,
    list_columns,
    mirror_grid,
    pack_slabs,
    scatter,
    unpack,
)
from commonmap.matching.support import measure_support
from commonmap.metrics.formulas import evidence_direct, mutual_information
from commonmap.metrics.table import METRICS
from commonmap.types import Bools, Float64s

SIZES = [
    ((7, 11), (3, 5)),
    ((13, 5), (4, 4)),
    ((6, 6), (6, 6)),
    ((1, 9), (2, 3)),
    ((5, 8), (9, 13)),
    ((17, 19), (1, 1)),
]


def random_slabs(
    rng: np.random.Generator, n_slabs: int, shape: tuple[int, int], *, shared: bool
) -> tuple[Bools, Bools]:
    """Return (occupied, known) of (n_slabs, *shape), the known mask shared by the slabs or not."""
    known = rng.random((1 if shared else n_slabs, *shape)) < 0.7
    known = np.broadcast_to(known, (n_slabs, *shape)).copy()
    occupied = known & (rng.random((n_slabs, *shape)) < rng.uniform(0.1, 0.6, (n_slabs, 1, 1)))
    return occupied, known


def packed(occupied: Bools, known: Bools, cell: float = 1.0) -> SlabGrid:
    """Return the slabs as a grid that starts at the origin."""
    return pack_slabs(np.zeros(2), cell, occupied, known)


def shifted(layers: Bools, u: int, v: int, shape: tuple[int, int]) -> Bools:
    """Return the source's layers laid on a target of that shape, cell [0, 0] on [u, v]."""
    out = np.zeros((len(layers), *shape), bool)
    for i in range(layers.shape[1]):
        for j in range(layers.shape[2]):
            if 0 <= i + u < shape[0] and 0 <= j + v < shape[1]:
                out[:, i + u, j + v] = layers[:, i, j]
    return out


def test_a_table_worked_by_hand() -> None:
    # 10 pairs: both 3, source alone 1, target alone 1, neither 5; margins 4 and 4
    by_hand = 3 * math.log(30 / 16) + 2 * math.log(10 / 24) + 5 * math.log(50 / 36)
    assert by_hand == pytest.approx(1.77740, abs=1e-5)
    assert signed_evidence(10, 4, 4, 3, xlogx_table(11)) == pytest.approx(by_hand, abs=1e-12)
    # 0 both, 5 and 5 alone, neither 0: perfect contradiction, -10 ln 2
    assert signed_evidence(10, 5, 5, 0, xlogx_table(11)) == pytest.approx(-10 * math.log(2))
    assert signed_evidence(10, 5, 5, 5, xlogx_table(11)) == pytest.approx(10 * math.log(2))
    # independent: 2 of 4 in each row
    assert signed_evidence(8, 4, 4, 2, xlogx_table(9)) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("table", [(0, 0, 0, 0), (5, 0, 3, 0), (5, 5, 2, 2), (5, 2, 5, 2)])
def test_a_side_that_never_varies_says_nothing(table: tuple[int, int, int, int]) -> None:
    assert signed_evidence(*table, xlogx_table(6)) == 0.0


def test_evidence_is_weighed_by_what_it_explains() -> None:
    # 10 pairs, 3 both, 1 each alone, 5 neither: the source's 4 of 10 leave 6.7301 nats of doubt
    doubt = -(4 * math.log(0.4) + 6 * math.log(0.6))
    assert doubt == pytest.approx(6.73012, abs=1e-5)
    assert uncertainty(10, 4, xlogx_table(11)) == pytest.approx(doubt, abs=1e-12)
    assert uncertainty(10, 0, xlogx_table(11)) == uncertainty(10, 10, xlogx_table(11)) == 0.0
    both = np.array([[10, 4, 4, 3], [10, 4, 0, 0]])  # a slab in which the target has nothing
    evidence, total = sum_table(both, xlogx_table(11))
    assert evidence == pytest.approx(1.77740, abs=1e-5)
    assert total == pytest.approx(2 * doubt, abs=1e-12)
    assert weigh(evidence, total) == pytest.approx(1.77740**2 / (200.0 + 2 * 6.73012), abs=1e-5)
    assert weigh(-300.0, 100.0) == -300.0


def test_a_small_overlap_that_agrees_beats_a_large_one_that_half_agrees() -> None:
    # nats alone say the opposite: 0.2 nats in each of 10,000 cells against 0.6 in each of 2,000
    table = xlogx_table(10_001)
    large = np.array([[10_000, 5_000, 5_000, 4_000]])
    small = np.array([[2_000, 1_000, 1_000, 980]])
    (e_large, d_large), (e_small, d_small) = sum_table(large, table), sum_table(small, table)
    assert e_large > 1.5 * e_small
    assert weigh(e_large, d_large) < 0.75 * weigh(e_small, d_small)


def test_xlogx_is_zero_at_zero_and_at_one() -> None:
    assert xlogx_table(3) == pytest.approx([0.0, 0.0, 2 * math.log(2), 3 * math.log(3)])


@settings(max_examples=60, deadline=None, derandomize=True)
@given(*[st.integers(0, 30)] * 4)
def test_evidence_is_n_times_mutual_information(n11: int, n10: int, n01: int, n00: int) -> None:
    n = n11 + n10 + n01 + n00
    if n == 0:
        return
    s = np.repeat([1, 1, 0, 0], [n11, n10, n01, n00]).astype(float)
    t = np.repeat([1, 0, 1, 0], [n11, n10, n01, n00]).astype(float)
    expected = n * mutual_information(s, t) * np.sign(n11 * n00 - n10 * n01)
    got = signed_evidence(n, n11 + n10, n11 + n01, n11, xlogx_table(n + 1))
    assert got == pytest.approx(expected, abs=1e-9)


def test_the_row_of_the_table_is_the_oracle_used_here() -> None:
    assert METRICS["evidence"].direct is evidence_direct
    assert METRICS["evidence"].maximise


@pytest.mark.parametrize(("target_shape", "source_shape"), SIZES)
@pytest.mark.parametrize("shared", [(True, True), (False, False), (True, False), (False, True)])
def test_the_surface_equals_brute_force_at_every_shift(
    target_shape: tuple[int, int], source_shape: tuple[int, int], shared: tuple[bool, bool]
) -> None:
    rng = np.random.default_rng(sum(target_shape) * 31 + sum(source_shape))
    o_t, k_t = random_slabs(rng, 3, target_shape, shared=shared[0])
    o_s, k_s = random_slabs(rng, 3, source_shape, shared=shared[1])
    spectra = transform_target(packed(o_t, k_t), source_shape)
    source = packed(o_s, k_s)
    score, overlap = evidence_surface(spectra, source.occupied, source.known, min_overlap=1.0)
    sx, sy = source_shape
    assert score.shape == (target_shape[0] + sx - 1, target_shape[1] + sy - 1)
    for u in range(score.shape[0]):
        for v in range(score.shape[1]):
            lay_o = shifted(o_s, u - (sx - 1), v - (sy - 1), target_shape)
            lay_k = shifted(k_s, u - (sx - 1), v - (sy - 1), target_shape)
            pairs = (lay_k & k_t).sum(axis=(1, 2)).max()
            assert overlap[u, v] == pairs
            if pairs < 1:
                assert score[u, v] == -np.inf
                continue
            expected = evidence_direct(lay_o, lay_k, o_t, k_t)
            assert score[u, v] == pytest.approx(expected, abs=1e-4)


def test_the_surface_peaks_where_the_source_was_cut_out() -> None:
    # not symmetric in x and y: the source is target[5:9, 2:5]
    rng = np.random.default_rng(1)
    o_t, k_t = random_slabs(rng, 4, (16, 9), shared=True)
    k_t[:] = True
    source = packed(o_t[:, 5:12, 2:7], k_t[:, 5:12, 2:7])
    score, _ = evidence_surface(
        transform_target(packed(o_t, k_t), (7, 5)),
        source.occupied, source.known, min_overlap=20.0,
    )  # fmt: skip
    u, v = np.unravel_index(int(np.argmax(score)), score.shape)
    assert [int(u) - 6, int(v) - 4] == [5, 2]


def test_shifts_with_too_few_pairs_cannot_win() -> None:
    rng = np.random.default_rng(2)
    o_t, k_t = random_slabs(rng, 2, (8, 8), shared=True)
    o_s, k_s = random_slabs(rng, 2, (5, 5), shared=True)
    source = packed(o_s, k_s)
    spectra = transform_target(packed(o_t, k_t), (5, 5))
    score, overlap = evidence_surface(spectra, source.occupied, source.known, min_overlap=6.5)
    assert np.array_equal(np.isfinite(score), overlap >= 6.5)
    assert 0 < np.isfinite(score).sum() < score.size


def random_case(
    rng: np.random.Generator,
) -> tuple[SlabGrid, list[SlabGrid], dict[str, tuple[int, int]]]:
    """Return a target, one to eight sources of one shape, and ranges of translations or none."""
    n_slabs = int(rng.integers(1, 10))
    shape = int(rng.integers(5, 40)), int(rng.integers(5, 40))
    source_shape = int(rng.integers(3, 20)), int(rng.integers(3, 20))
    empty = int(rng.integers(0, 2 * n_slabs))
    shared = rng.random(2) < 0.6

    def slabs(size: tuple[int, int], *, alike: bool, without: int) -> SlabGrid:
        occupied, known = random_slabs(rng, n_slabs, size, shared=alike)
        if without < n_slabs:
            occupied[without] = False
        return packed(occupied, known)

    target = slabs(shape, alike=bool(shared[0]), without=empty)
    sources = [
        slabs(source_shape, alike=bool(shared[1]), without=2 * n_slabs - 1 - empty)
        for _ in range(int(rng.integers(1, 9)))
    ]
    ranges = {}
    for name, t, s in zip(("rows", "columns"), shape, source_shape, strict=True):
        low, high = sorted(rng.integers(0, t + s, 2).tolist())
        if rng.random() < 0.5 and high > low:
            ranges[name] = (low, high)
    return target, sources, ranges


@pytest.mark.parametrize("seed", range(24))
def test_yaws_side_by_side_score_as_each_by_itself(seed: int) -> None:
    rng = np.random.default_rng([seed, 77])
    target, sources, ranges = random_case(rng)
    spectra = transform_target(target, sources[0].shape, **ranges)  # type: ignore[arg-type]
    double = transform_target(target, sources[0].shape, n_source=10**13)
    assert (spectra.dtype, double.dtype) == (np.float32, np.float64)
    occupied, known = (
        np.stack([getattr(some, name) for some in sources], axis=-1)
        for name in ("occupied", "known")
    )
    least = float(rng.uniform(0, 20))
    score, overlap = evidence_surfaces(spectra, occupied, known, min_overlap=least)
    score, overlap = score.copy(), overlap.copy()
    region = slice(*spectra.rows), slice(*spectra.columns)
    for n, source in enumerate(sources):
        alone = evidence_surface(double, source.occupied, source.known, min_overlap=least)
        assert score[n].tobytes() == alone[0][region].tobytes()
        assert overlap[n].tobytes() == alone[1][region].tobytes()


@pytest.mark.parametrize("seed", range(24))
def test_peaks_are_those_of_the_surface(seed: int) -> None:
    rng = np.random.default_rng([seed, 78])
    target, sources, ranges = random_case(rng)
    spectra = transform_target(target, sources[0].shape, **ranges)  # type: ignore[arg-type]
    occupied, known = (
        np.stack([getattr(some, name) for some in sources], axis=-1)
        for name in ("occupied", "known")
    )
    rim, n_peaks, least = rng.integers(0, 2, 4).tolist(), int(rng.integers(1, 7)), rng.uniform(0, 9)
    score, _ = evidence_surfaces(spectra, occupied, known, min_overlap=least)
    score = score.copy()
    found = evidence_peaks(spectra, occupied, known, rim, n_peaks, min_overlap=least)
    assert len(found) == len(sources)
    for one, peaks in zip(score, found, strict=True):
        index, value = local_maxima(one, n_peaks, 0.0, *rim)
        told = index[:, 0] >= 0
        assert peaks[:, :2].tolist() == index[told].tolist()
        assert peaks[:, 2].tolist() == value[told].tolist()


@pytest.mark.parametrize("seed", range(12))
def test_targets_side_by_side_have_the_peaks_that_each_has_alone(seed: int) -> None:
    # known alike in all slabs and not, an empty slab, double precision: lanes are shared or not
    rng = np.random.default_rng([seed, 79])
    n_slabs, shape, side = int(rng.integers(2, 8)), (23, 19), (9, 8)
    grids = [packed(*random_slabs(rng, n_slabs, shape, shared=bool(k % 2))) for k in range(3)]
    occupied, known = random_slabs(rng, n_slabs, shape, shared=True)
    occupied[0] = False
    grids += [packed(occupied, known), mirror_grid(grids[1])]
    spectra = [transform_target(grid, side) for grid in grids]
    spectra.append(transform_target(grids[0], side, n_source=10**13))
    turned = packed(*random_slabs(rng, n_slabs, side, shared=True))
    bits = np.repeat(turned.occupied[..., None], 3, 2), np.repeat(turned.known[..., None], 3, 2)
    rim = (0, 1, 1, 0)
    found = peaks_on_each(spectra, *bits, rim, 5, min_overlap=4.0)
    for one, on_it in zip(spectra, found, strict=True):
        alone = evidence_peaks(one, *bits, rim, 5, min_overlap=4.0)
        assert [peaks.tobytes() for peaks in on_it] == [peaks.tobytes() for peaks in alone]
        assert all(len(peaks) > 0 for peaks in on_it)


def test_the_bound_holds_where_the_evidence_is_all_there_is() -> None:
    # a target that holds the source itself: n MI = n H, the bound's hardest case
    rng = np.random.default_rng(5)
    o_t, k_t = random_slabs(rng, 6, (60, 50), shared=True)
    o_t[1] = rng.random((60, 50)) < 0.001  # rare
    o_t[2] = rng.random((60, 50)) < 0.999
    target = packed(o_t & k_t, k_t)
    spectra = transform_target(target, (20, 20))
    occupied, known = target.occupied[20:40, 10:30, None], target.known[20:40, 10:30, None]
    (peaks,) = evidence_peaks(spectra, occupied, known, (0, 0, 0, 0), 6, min_overlap=9.0)
    assert peaks[0, :2].tolist() == [39, 29]
    score, _ = evidence_surface(spectra, occupied[..., 0], known[..., 0], min_overlap=9.0)
    assert peaks[0, 2] == score[39, 29] == score.max()


@pytest.mark.parametrize("n", [2, 7, 40])
def test_no_table_scores_more_than_its_bound(n: int) -> None:
    tables = np.array(
        [
            (n, r, c, both)
            for r in range(n + 1)
            for c in range(n + 1)
            for both in range(max(0, r + c - n), min(r, c) + 1)
        ]
    )
    tables = np.concatenate([tables, np.repeat(tables[-1:], -len(tables) % 8, axis=0)])
    # two slabs with the same table: the counts as `find_peaks` has them, in two complex products
    lanes = tables.T.reshape(4, -1, 8).astype(np.float32)
    row = np.stack([lanes[:2], lanes[2:]]).swapaxes(1, 2).reshape(2, -1)
    bound = np.empty(len(tables), np.float32)
    counts = np.array([[0, 1, 2, 3], [0, 1, 2, 3]])
    bound_scores(np.ascontiguousarray(row), counts, 0, len(tables) // 8, bound)
    xlogx = xlogx_table(n)
    score = np.array(
        [
            weigh(2.0 * signed_evidence(k, r, c, both, xlogx), 2.0 * uncertainty(k, r, xlogx))
            for k, r, c, both in tables.tolist()
        ]
    )
    assert np.all(score <= bound)
    if n == 40:  # and not so much more: what chance finds stays out
        weak = (score > 0.0) & (score < 0.2)
        assert np.median(bound[weak] - score[weak]) < 0.1


def test_counts_share_complex_values() -> None:
    # five slabs and what is known: three lanes; 3 * 5 + 1 counts: eight products
    five = (True,) * 5
    job = plan_lanes(five, five, True, True)
    assert job.parts.tolist() == [[0, 2], [4, 6], [8, 1]]
    assert len(job.products) == 8
    assert sorted(np.unique(job.counts).tolist()) == list(range(16))
    assert job.overlaps.tolist() == [job.counts[0, 0]]
    assert np.all(job.counts[:, 0] == job.counts[0, 0])  # known pairs: the same for all slabs
    # what stands in one map alone: its margin counts as uncertainty, and nothing else is asked
    job = plan_lanes((True, False), (False, True), True, True)
    assert job.counts.tolist() == [[job.overlaps[0], job.counts[0, 1], -1, -1]]
    # known slab by slab: four counts each
    job = plan_lanes(five, five, False, False)
    assert len(job.parts) == 5 and len(job.products) == 10
    assert sorted(job.counts.ravel().tolist()) == list(range(20))


def test_a_single_surface_leaves_nothing_borrowed() -> None:
    grid = packed(*random_slabs(np.random.default_rng(9), 2, (30, 30), shared=True))
    evidence_surfaces(
        transform_target(grid, (30, 30)), grid.occupied[..., None], grid.known[..., None],
        min_overlap=1.0,
    )  # fmt: skip
    assert any(role.startswith("evidence") for role in arrays._own.__dict__)
    evidence_surface(transform_target(grid, (30, 30)), grid.occupied, grid.known, min_overlap=1.0)
    assert not any(role.startswith("evidence") for role in arrays._own.__dict__)


def test_nine_yaws_are_too_many() -> None:
    grid = packed(*random_slabs(np.random.default_rng(6), 1, (9, 9), shared=True))
    nine = np.repeat(grid.occupied[..., None], 9, axis=2)
    with pytest.raises(ValueError, match="at most 8 yaws at a time; 9 came"):
        evidence_surfaces(transform_target(grid, (9, 9)), nine, nine, min_overlap=1.0)


def test_large_maps_keep_whole_counts() -> None:
    # single precision: the counts of a full 300 x 300 overlap still round to whole numbers
    rng = np.random.default_rng(4)
    o_t, k_t = random_slabs(rng, 1, (300, 300), shared=True)
    grid = packed(o_t, k_t)
    spectra = transform_target(grid, (300, 300))
    score, overlap = evidence_surface(spectra, grid.occupied, grid.known, min_overlap=100.0)
    assert overlap[299, 299] == k_t.sum()
    assert score[299, 299] == pytest.approx(evidence_direct(o_t, k_t, o_t, k_t), rel=1e-6)
    assert overlap[299, 300] == (k_t[0, :, 1:] & k_t[0, :, :-1]).sum()


def test_slab_k_is_bit_k_and_what_is_occupied_is_known() -> None:
    occupied = np.zeros((3, 2, 2), bool)
    known = np.zeros((3, 2, 2), bool)
    occupied[2, 0, 1] = True  # not said to be known
    known[0, 1, 0] = True
    grid = pack_slabs(np.array([5.0, 6.0]), 0.5, occupied, known)
    assert grid.occupied.tolist() == [[0, 4], [0, 0]]
    assert grid.known.tolist() == [[0, 4], [1, 0]]
    assert (grid.n_slabs, grid.cell, grid.origin.tolist()) == (3, 0.5, [5.0, 6.0])


def test_unpack_is_the_inverse_of_pack() -> None:
    rng = np.random.default_rng(5)
    occupied, known = random_slabs(rng, 32, (5, 7), shared=False)
    grid = packed(occupied, known)
    for k in range(32):
        layer = unpack(NUMPY, grid.occupied, k, np.float32)
        assert layer.dtype == np.float32
        assert np.array_equal(layer, occupied[k].astype(np.float32))
        assert np.array_equal(unpack(NUMPY, grid.known, k, np.float64), known[k].astype(float))


def test_coarse_cells_are_aligned_to_their_own_width() -> None:
    # cells of 0.5 m from x = 1.5 and y = -1.0; of 1 m: [1, 2) holds cell 0, [2, 3) cells 1 and 2
    bits = np.array([[1], [2], [4], [8]], np.uint32)
    coarse = coarsen(SlabGrid(np.array([1.5, -1.0]), 0.5, bits, bits, 4), 2)
    assert coarse.cell == 1.0
    assert coarse.origin.tolist() == [1.0, -1.0]
    assert coarse.occupied.tolist() == [[1], [6], [8]]


@settings(max_examples=40, deadline=None, derandomize=True)
@given(st.integers(0, 2**31), st.sampled_from([1, 2, 3, 4]), st.integers(-9, 9), st.integers(-9, 9))
def test_coarsen_equals_its_slow_twin(seed: int, factor: int, i0: int, j0: int) -> None:
    rng = np.random.default_rng(seed)
    shape = (int(rng.integers(1, 9)), int(rng.integers(1, 9)))
    occupied, known = random_slabs(rng, 3, shape, shared=False)
    grid = pack_slabs(np.array([i0, j0]) * 0.25, 0.25, occupied, known)
    coarse = coarsen(grid, factor)
    expected: dict[tuple[int, int], list[int]] = {}
    for i in range(shape[0]):
        for j in range(shape[1]):
            bits = expected.setdefault(((i0 + i) // factor, (j0 + j) // factor), [0, 0])
            bits[0] |= int(grid.occupied[i, j])
            bits[1] |= int(grid.known[i, j])
    a0, b0 = np.round(coarse.origin / coarse.cell).astype(int)
    assert coarse.origin == pytest.approx(np.array([a0, b0]) * coarse.cell)
    assert coarse.cell == 0.25 * factor
    for a in range(coarse.shape[0]):
        for b in range(coarse.shape[1]):
            bits = expected.pop((a0 + a, b0 + b), [0, 0])
            assert [coarse.occupied[a, b], coarse.known[a, b]] == bits
    assert not expected


def test_columns_are_the_centres_of_the_known_cells() -> None:
    occupied = np.zeros((1, 2, 3), bool)
    known = np.zeros((1, 2, 3), bool)
    known[0, 0, 2] = known[0, 1, 0] = occupied[0, 1, 0] = True
    columns = list_columns(pack_slabs(np.array([10.0, 20.0]), 2.0, occupied, known))
    assert columns.xy.tolist() == [[11.0, 25.0], [13.0, 21.0]]
    assert columns.occupied.tolist() == [0, 1]
    assert columns.known.tolist() == [1, 1]


def test_scatter_turns_x_towards_y() -> None:
    xy = np.array([[2.5, 0.5], [2.6, 0.4], [-50.0, 0.0]])
    occupied, known = scatter(
        xy, np.array([1, 4, 8], np.uint32), np.array([3, 4, 8], np.uint32),
        0.0, 1.0, 1.0, np.array([-3.0, 0.0]), 4, 4,
    )  # fmt: skip
    # a quarter turn takes (2.5, 0.5) to (-0.5, 2.5): cell [2, 2] from the corner (-3, 0)
    assert np.argwhere(known).tolist() == [[2, 2]]
    assert known[2, 2] == 7
    assert occupied[2, 2] == 5


def tables_by_hand(grid: SlabGrid, columns: Columns, pose: Float64s) -> list[list[int]]:
    """Return the n, n_1, n_2, n11 of every slab, cell by cell in Python."""
    cells: dict[tuple[int, int], list[int]] = {}
    c, s = math.cos(pose[2]), math.sin(pose[2])
    for (x, y), occupied, known in zip(
        columns.xy.tolist(), columns.occupied, columns.known, strict=True
    ):
        i = math.floor((c * x - s * y + pose[0] - grid.origin[0]) / grid.cell)
        j = math.floor((s * x + c * y + pose[1] - grid.origin[1]) / grid.cell)
        bits = cells.setdefault((i, j), [0, 0])
        bits[0] |= int(occupied)
        bits[1] |= int(known)
    table = [[0, 0, 0, 0] for _ in range(grid.n_slabs)]
    for (i, j), (occupied, known) in cells.items():
        if not (0 <= i < grid.shape[0] and 0 <= j < grid.shape[1]):
            continue
        for k in range(grid.n_slabs):
            if known >> k & 1 and int(grid.known[i, j]) >> k & 1:
                mine, other = occupied >> k & 1, int(grid.occupied[i, j]) >> k & 1
                for n, add in enumerate((1, mine, other, mine & other)):
                    table[k][n] += add
    return table


def test_count_tables_equals_its_slow_twin() -> None:
    rng = np.random.default_rng(6)
    o_t, k_t = random_slabs(rng, 3, (20, 14), shared=False)
    grid = pack_slabs(np.array([-4.0, 7.0]), 0.5, o_t, k_t)
    o_s, k_s = random_slabs(rng, 3, (18, 26), shared=False)
    columns = list_columns(pack_slabs(np.array([-2.0, -3.0]), 0.25, o_s, k_s))
    poses = np.column_stack(
        [rng.uniform(-8, 10, 40), rng.uniform(3, 18, 40), rng.uniform(-7, 7, 40)]
    )
    tables = count_tables(
        grid.occupied, grid.known, grid.origin, grid.cell, columns.xy, columns.occupied,
        columns.known, 3, poses,
    )  # fmt: skip
    for pose, table in zip(poses, tables, strict=True):
        assert table.tolist() == tables_by_hand(grid, columns, pose)
    assert tables[:, :, 0].max() > 20


def test_one_pose_by_counting_equals_the_surface() -> None:
    # at a shift of whole cells, the pose by pose count and the FFT say the same
    rng = np.random.default_rng(7)
    o_t, k_t = random_slabs(rng, 3, (15, 12), shared=True)
    grid = packed(o_t, k_t, cell=1.0)
    o_s, k_s = random_slabs(rng, 3, (12, 12), shared=True)
    columns = list_columns(pack_slabs(np.array([-3.0, -3.0]), 0.5, o_s, k_s))
    yaw, side, low = 0.8, 12, np.array([-6.0, -6.0])
    occupied, known = scatter(
        columns.xy, columns.occupied, columns.known, math.cos(yaw), math.sin(yaw), 1.0, low,
        side, side,
    )  # fmt: skip
    score, overlap = evidence_surface(
        transform_target(grid, (side, side)), occupied, known,
        min_overlap=1.0,
    )  # fmt: skip
    for u, v in [(11, 11), (14, 12), (16, 18), (20, 9)]:
        pose = np.array([u - (side - 1) - low[0], v - (side - 1) - low[1], yaw])
        standing = evidence_at(grid, columns, pose)
        assert standing.score == pytest.approx(float(score[u, v]), abs=1e-4)
        assert standing.n_pairs == overlap[u, v]


def test_support_of_a_true_pose_and_of_a_half_true_one() -> None:
    rng = np.random.default_rng(8)
    o_t = rng.random((3, 64, 64)) < 0.2
    k_t = np.ones_like(o_t)
    grid = packed(o_t, k_t)
    same = list_columns(grid)
    pose = np.zeros(3)
    true = measure_support(grid, same, pose)
    assert true.share == pytest.approx(1.0)
    assert true.effect == pytest.approx(1.0, abs=0.02)
    assert true.spread == pytest.approx(0.75, abs=0.05)
    assert true.weight.shape == true.evidence.shape == (64,)
    # the upper half of the source saw another place
    wrong = o_t.copy()
    wrong[:, :, 32:] = rng.random((3, 64, 32)) < 0.2
    half = measure_support(grid, list_columns(packed(wrong, k_t)), pose)
    assert half.share < 0.75
    upper = half.xy[:, 1] > 32.0
    assert half.evidence[~upper].min() > 0.0
    assert half.evidence[upper].sum() < 0.2 * half.evidence[~upper].sum()
    assert half.t < true.t


def test_areas_of_the_support_sum_to_the_evidence() -> None:
    rng = np.random.default_rng(9)
    o_t, k_t = random_slabs(rng, 2, (60, 60), shared=True)
    noisy = o_t ^ ((rng.random(o_t.shape) < 0.1) & k_t)
    grid = packed(o_t, k_t)
    source = list_columns(packed(noisy, k_t))
    support = measure_support(grid, source, np.zeros(3))
    # the table starts at half a pair in each of its cells, so the sums agree but for that
    assert support.evidence.sum() == pytest.approx(
        evidence_at(grid, source, np.zeros(3)).evidence, rel=0.01
    )
