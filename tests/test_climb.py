"""Climbing: scored as pose by pose, never down, and from all starts as good as from the best."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from commonmap.config import ComputeConfig
from commonmap.matching.climb import HERE, climb_all, starts_around
from commonmap.matching.levels import find_level
from commonmap.matching.planes import pack_planes, turn_planes
from commonmap.matching.search import evidence_at
from commonmap.matching.slabs import Columns, SlabGrid, list_columns, pack_slabs
from commonmap.types import Bools, Float64s

CELL = 0.5
IN_WINDOWS = ComputeConfig(memory_gb=1e-9)


def scene(seed: int, n_slabs: int = 3) -> tuple[SlabGrid, Columns]:
    """Return a target of 40 x 36 cells with holes, and columns about their middle."""
    rng = np.random.default_rng(seed)
    full = (1 << n_slabs) - 1
    known = np.where(rng.uniform(size=(40, 36)) < 0.8, full, 0).astype(np.uint32)
    blobs = np.kron(rng.integers(0, full + 1, (10, 9)), np.ones((4, 4), int))
    occupied = (blobs & rng.integers(0, full + 1, (40, 36))).astype(np.uint32) & known
    target = SlabGrid(np.array([-3.0, 2.0]), CELL, occupied, known, n_slabs)
    i, j = np.indices((24, 20)).reshape(2, -1)
    xy = (np.column_stack([i - 11.5, j - 9.5])) * 0.5 * CELL
    # what the target holds about (7, 11), as a part of it would be seen
    at = np.floor((xy + np.array([7.0, 11.0]) - target.origin) / CELL).astype(int)
    seen, there = known[at[:, 0], at[:, 1]], occupied[at[:, 0], at[:, 1]]
    return target, Columns(xy, there, seen, n_slabs)


def evidence(target: SlabGrid, columns: Columns, pose: Float64s) -> float:
    """Return the evidence at a pose, counted pose by pose."""
    return evidence_at(target, columns, pose).score


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("each", [False, True])
def test_a_top_scores_what_its_pose_does_and_no_start_scores_more(seed: int, each: bool) -> None:
    target, columns = scene(seed)
    rng = np.random.default_rng(seed)
    poses = np.column_stack([rng.uniform(5, 9, 6), rng.uniform(9, 13, 6), rng.normal(0, 0.3, 6)])
    starts = starts_around(1, 1, apart=2)
    level = find_level(target, 1, ComputeConfig())
    tops, score, pairs = climb_all(
        level, columns, poses, yaw_step=0.05, least_pairs=1.0, starts=starts, each=each
    )
    for pose, top, told, n in zip(poses, tops, score, pairs, strict=True):
        expected = evidence_at(target, columns, top)
        assert told == pytest.approx(expected.score, rel=1e-9, abs=1e-9)
        assert n == expected.n_pairs
        about = pose + starts * np.array([0.5 * CELL, 0.5 * CELL, 0.05])
        assert told >= max(evidence(target, columns, start) for start in about) - 1e-9
        # none of the 26 nodes about a top is higher
        steps = np.array(list(itertools.product((-1, 0, 1), repeat=3)))
        nodes = top + steps * np.array([0.5 * CELL, 0.5 * CELL, 0.05])
        assert told >= max(evidence(target, columns, node) for node in nodes) - 1e-9


def test_it_takes_the_way_up_that_a_slow_climb_takes() -> None:
    target, columns = scene(5)
    level = find_level(target, 1, ComputeConfig())
    steps = np.array(list(itertools.product((-1, 0, 1), repeat=3)))
    for start in ((6.1, 11.7, 0.2), (8.0, 10.2, -0.3), (7.3, 11.1, 0.1)):
        pose = np.array(start)
        while True:
            about = pose + steps * np.array([0.5 * CELL, 0.5 * CELL, 0.04])
            scores = [evidence(target, columns, node) for node in about]
            if max(scores) <= evidence(target, columns, pose) + 1e-9:
                break
            pose = about[int(np.argmax(scores))]
        top, _, _ = climb_all(
            level, columns, np.array([start]), yaw_step=0.04, least_pairs=1.0, starts=HERE
        )
        assert top[0] == pytest.approx(pose, abs=1e-9)


def test_all_starts_together_are_as_good_as_the_best_of_them() -> None:
    target, columns = scene(6)
    level = find_level(target, 1, ComputeConfig())
    pose = np.array([[6.3, 12.0, 0.3]])
    starts = starts_around(1, 1)
    _, together, _ = climb_all(
        level, columns, pose, yaw_step=0.05, least_pairs=1.0, starts=starts, each=True
    )
    alone = [
        climb_all(level, columns, pose, yaw_step=0.05, least_pairs=1.0, starts=start[None])[1][0]
        for start in starts
    ]
    assert together[0] == pytest.approx(max(alone), rel=1e-12)
    assert together[0] > min(alone) + 1.0


@pytest.mark.parametrize("each", [False, True])
def test_windows_and_workers_change_nothing(each: bool) -> None:
    target, columns = scene(7)
    rng = np.random.default_rng(7)
    # some beyond the target
    poses = np.column_stack([rng.uniform(-8, 22, 9), rng.uniform(-4, 24, 9), rng.uniform(-3, 3, 9)])
    answers = []
    for compute, workers in ((ComputeConfig(), 1), (ComputeConfig(), 2), (IN_WINDOWS, 1)):
        level = find_level(target, 1, compute)
        assert (level.whole is None) == (compute is IN_WINDOWS)
        answers.append(
            climb_all(
                level, columns, poses, yaw_step=0.05, least_pairs=5.0,
                starts=starts_around(2, 1), each=each, workers=workers,
            )
        )  # fmt: skip
    for other in answers[1:]:
        for a, b in zip(answers[0], other, strict=True):
            assert np.array_equal(a, b)
    assert not np.isfinite(answers[0][1]).all()  # nothing known where they are


def test_too_few_pairs_score_nothing() -> None:
    target, columns = scene(8)
    level = find_level(target, 1, ComputeConfig())
    pose = np.array([[7.0, 11.0, 0.0]])
    top, score, _ = climb_all(
        level, columns, pose, yaw_step=0.05, least_pairs=1e6, starts=starts_around(1, 1)
    )
    assert score[0] == -np.inf
    assert np.array_equal(top, pose)


def test_starts_are_whole_cells_and_yaws_apart_the_pose_first() -> None:
    starts = starts_around(1, 2, apart=3)
    assert starts.shape == (45, 3)
    assert starts[0].tolist() == [0, 0, 0]
    assert sorted({tuple(s) for s in starts[:, :2].tolist()}) == list(
        itertools.product((-2, 0, 2), repeat=2)
    )
    assert sorted(set(starts[:, 2].tolist())) == [-12, -6, 0, 6, 12]
    assert HERE.tolist() == [[0, 0, 0]]


N_SLABS = 5


def random_grid(
    rng: np.random.Generator, shape: tuple[int, int], cell: float, *, shared: bool
) -> SlabGrid:
    """Return slabs with blobs, known alike in all slabs or each by itself."""
    coarse = rng.random((N_SLABS, -(-shape[0] // 4), -(-shape[1] // 4))) < 0.3
    occupied: Bools = np.kron(coarse, np.ones((1, 4, 4), bool))[:, : shape[0], : shape[1]]
    known = rng.random((1 if shared else N_SLABS, *shape)) < 0.8
    known = np.broadcast_to(known, occupied.shape)
    return pack_slabs(np.array([3.0, -7.0]), cell, occupied & known, known)


def test_planes_by_hand() -> None:
    bits = np.zeros((2, 70), np.uint32)
    bits[0, 0], bits[0, 63], bits[1, 64], bits[1, 69] = 1, 3, 2, 1
    planes = pack_planes(bits, 2, 1)
    assert planes.shape == (2, 4, 8) and not planes[..., 2:].any()
    assert planes[0, :, 0].tolist() == [0, 1 + (1 << 63), 0, 0]
    assert planes[0, :, 1].tolist() == [0, 1 << 63, 0, 0]
    assert planes[1, :, 0].tolist() == [0, 0, 1 << 5, 0]
    assert planes[1, :, 1].tolist() == [0, 0, 1, 0]


@pytest.mark.parametrize("alone", [True, False])
@pytest.mark.parametrize("side", [9, 75, 141])
def test_half_cells_pair_up_in_four_ways(side: int, alone: bool) -> None:
    rng = np.random.default_rng([side, alone])
    n_slabs, n, n_words = 3, 30 * side, -(-side // 64)
    xy = rng.uniform(-0.34 * side, 0.34 * side, (n, 2))
    occupied = rng.integers(0, 1 << n_slabs, n).astype(np.uint32)
    known = rng.integers(0, 1 << n_slabs, n).astype(np.uint32) | occupied
    x, y, yaw = 0.3, 0.8, 0.7
    rooms = [
        np.empty((rows, words, planes), np.uint64)
        for rows, words, planes in (
            (2 * side, 2 * n_words, 8),
            (2 * side, 2 * n_words, 1 if alone else 8),
        )
    ]
    found = [np.empty((4, side, n_words, room.shape[2]), np.uint64) for room in rooms]
    turn_planes(np.ascontiguousarray(xy.T), occupied, known, yaw, 1.0, x, y, *rooms, *found)
    # the slow twin: a set of half cells, then of cells
    turned = xy @ np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    half = np.floor(2.0 * turned + 2.0 * np.array([x, y])).astype(int) + side - 1
    for a in range(2):
        for b in range(2):
            cell = (half + np.array([a, b])) // 2
            for bits, planes in zip((occupied, known), found, strict=True):
                expected = np.zeros((side, 64 * n_words, planes.shape[3]), bool)
                for k in range(1 if planes.shape[3] == 1 else n_slabs):
                    here = cell[(bits >> np.uint32(k)) & 1 == 1]
                    expected[here[:, 0], here[:, 1], k] = True
                words = np.packbits(
                    expected.swapaxes(1, 2).reshape(side, -1, n_words, 64), axis=-1,
                    bitorder="little",
                ).view(np.uint64)[..., 0]  # fmt: skip
                assert np.array_equal(planes[2 * a + b], words.swapaxes(1, 2))


@pytest.mark.parametrize(
    ("base_shared", "draft_shared"), [(True, True), (False, True), (True, False)]
)
@pytest.mark.parametrize("shape", [(40, 33), (150, 90)])
def test_a_climb_ends_on_what_the_slow_twin_counts(
    shape: tuple[int, int], base_shared: bool, draft_shared: bool
) -> None:
    rng = np.random.default_rng([shape[0], base_shared, draft_shared])
    base = random_grid(rng, (170, 201), 0.5, shared=base_shared)
    columns = list_columns(random_grid(rng, shape, 0.25, shared=draft_shared))
    xy = np.ascontiguousarray(columns.xy - columns.xy.mean(axis=0))
    draft = Columns(xy, columns.occupied, columns.known, columns.n_slabs)
    # off the lattice, on it, over the rims, and beyond
    starts = np.column_stack([rng.uniform((-5, -15), (95, 100), (12, 2)), rng.uniform(-9, 9, 12)])
    starts[:6, :2] = base.origin + np.round((starts[:6, :2] - base.origin) / 0.5) * 0.5
    starts[:6, 2] = 0.03 * np.round(starts[:6, 2] / 0.03)
    starts[0, :2], starts[6, :2] = base.origin - 200.0, base.origin + 400.0
    level = find_level(base, 1, ComputeConfig())
    pose, score, pairs_found = climb_all(
        level, draft, starts, yaw_step=0.03, least_pairs=1.0, starts=HERE
    )
    for n in range(len(starts)):
        expected = evidence_at(base, draft, pose[n])
        if expected.n_pairs == 0:
            assert score[n] == -np.inf
            continue
        assert score[n] == pytest.approx(expected.score, rel=1e-9)
        assert score[n] >= evidence(base, draft, starts[n]) - 1e-6
        for k in range(3):  # nothing beside it is better
            for step in (-1.0, 1.0):
                beside = pose[n] + step * np.eye(3)[k] * np.array([0.25, 0.25, 0.03])
                walked = np.abs(pose[n] - starts[n]) / np.array([0.25, 0.25, 0.03])
                if walked.max() < 10.0:
                    assert evidence(base, draft, beside) <= score[n] + 1e-6
    assert not np.isfinite(score[[0, 6]]).any()
    for workers in (1, 2, 3):
        again = climb_all(
            level, draft, starts, yaw_step=0.03, least_pairs=1.0, starts=HERE, workers=workers
        )
        for a, b in zip((pose, score, pairs_found), again, strict=True):
            assert a.tobytes() == b.tobytes()


def test_a_turned_source_is_kept_for_its_own_place_in_a_cell() -> None:
    target, columns = scene(9)
    level = find_level(target, 1, ComputeConfig())
    yaw = 3 * 0.05
    poses = np.array([[7.0, 11.0, yaw], [7.0, 11.13, yaw], [7.09, 11.0, yaw], [7.0, 11.0, yaw]])
    together = climb_all(level, columns, poses, yaw_step=0.05, least_pairs=1.0, starts=HERE)
    for n, pose in enumerate(poses):
        alone = climb_all(level, columns, pose[None], yaw_step=0.05, least_pairs=1.0, starts=HERE)
        for a, b in zip(together, alone, strict=True):
            assert np.array_equal(a[n], b[0])
    assert len(np.unique(together[0], axis=0)) == 3
