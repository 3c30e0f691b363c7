"""The search: known poses recovered in both directions, against brute force, and honest limits."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from commonmap.mapping.ground import find_ground
from commonmap.mapping.height_map import build_height_map
from commonmap.matching.peaks import local_maxima
from commonmap.matching.search import (
    Peaks,
    SearchPlan,
    evidence_at,
    plan_glance,
    plan_part,
    plan_search,
    search,
    separate,
)
from commonmap.matching.search_metric import scatter_heights, search_metric
from commonmap.matching.slabs import Columns, SlabGrid, list_columns, pack_slabs
from commonmap.types import Float64s, Floats, GridMap
from matching_scenes import apart, look, make_place, moved, rigid

EDGES = np.array([0.25, 0.5, 1.0, 2.0, 4.0])


def height_map(xyz: Float64s, cell: float = 0.25) -> GridMap:
    """Return the height map of points on half the cell of the search."""
    return build_height_map(xyz, cell=cell, slab_edges=EDGES, ground=find_ground(xyz))


def slabs(xyz: Float64s, cell: float = 0.25) -> SlabGrid:
    """Return the height slabs of points on half the cell of the search."""
    grid = height_map(xyz, cell)
    return pack_slabs(grid.origin, cell, grid["slab_occupied"], grid["slab_known"])


def small_pair(seed: int) -> tuple[Float64s, Float64s, Float64s]:
    """Return (target, source, T_target_source) of a place of 22 m and a draft of 14 m in it."""
    rng = np.random.default_rng(seed)
    place = make_place(seed, 22.0, n_boxes=4, n_posts=9, relief=0.2)
    T = rigid(rng.uniform(-30, 30), rng.uniform(-30, 30), 0.0, rng.uniform(-math.pi, math.pi))
    centre = (float(rng.uniform(-3, 3)), float(rng.uniform(-3, 3)))
    target = look(place, rng, density=12.0)
    draft = look(place, rng, roofs=False, density=12.0, centre=centre, edge=14.0)
    return target, moved(np.linalg.inv(T), draft), T


def planar_error(T: Floats, T_true: Floats, xyz: Floats) -> tuple[float, float]:
    """Return (metres at the middle of the points, degrees)."""
    middle = 0.5 * (xyz[:, :2].min(axis=0) + xyz[:, :2].max(axis=0))
    metres, degrees = apart(T, T_true, np.array([[*middle, 0.0]]))
    return metres, degrees


@pytest.mark.parametrize("seed", range(24))
def test_a_known_pose_is_recovered_in_both_directions(seed: int) -> None:
    target, source, T = small_pair(seed)
    base, draft = slabs(target), slabs(source)
    forward = search(base, draft, min_overlap=0.3, workers=1)
    metres, degrees = planar_error(forward.T_target_source(), T, source)
    assert metres < 0.5
    assert degrees < 2.0
    # the other way round the small map is the target: a third of the source suffices
    backward = search(draft, base, min_overlap=0.15, workers=1)
    metres, degrees = planar_error(backward.T_target_source(), np.linalg.inv(T), target)
    assert metres < 0.9
    assert degrees < 2.5


@pytest.mark.parametrize("seed", [1, 5, 9])
def test_coarse_to_fine_finds_what_the_exhaustive_search_finds(seed: int) -> None:
    target, source, _ = small_pair(seed)
    base, draft = slabs(target), slabs(source)
    exhaustive = search(
        base, draft, min_overlap=0.3, workers=1, plan=SearchPlan((0.5,), 88, (256,))
    )
    quick = search(
        base, draft, min_overlap=0.3, workers=1, plan=SearchPlan((1.0, 0.5), 44, (256, 64))
    )
    # both climb on the same lattice
    assert quick.score[0] >= exhaustive.score[0] * (1.0 - 1e-9)
    delta = quick.pose[0] - exhaustive.pose[0]
    assert np.hypot(delta[0], delta[1]) < 0.5
    assert abs((delta[2] + math.pi) % (2 * math.pi) - math.pi) < math.radians(3.0)


@pytest.mark.parametrize("seed", [2, 6])
def test_no_pose_of_a_grid_beats_the_answer(seed: int) -> None:
    target, source, _ = small_pair(seed)
    base, draft = slabs(target, 0.5), slabs(source, 0.5)
    found = search(base, draft, min_overlap=0.3, workers=1, plan=SearchPlan((1.0,), 44, (256,)))
    columns = about(list_columns(draft), found.centre)
    grid = coarse(base)
    best = -math.inf
    for yaw in np.arange(44) * 2.0 * math.pi / 44:
        for x in np.arange(grid.origin[0], grid.origin[0] + grid.shape[0] * grid.cell, 2.0):
            for y in np.arange(grid.origin[1], grid.origin[1] + grid.shape[1] * grid.cell, 2.0):
                at = evidence_at(grid, columns, np.array([x, y, yaw]))
                if at.n_pairs >= 0.3 * len(columns.xy) / 4.0:
                    best = max(best, at.score)
    assert found.score[0] >= best


def coarse(grid: SlabGrid) -> SlabGrid:
    """Return the grid on twice its cell."""
    from commonmap.matching.slabs import coarsen

    return coarsen(grid, 2)


def about(columns: Columns, centre: Float64s) -> Columns:
    """Return the columns about a point."""
    xy = np.ascontiguousarray(columns.xy - centre)
    return Columns(xy, columns.occupied, columns.known, columns.n_slabs)


def test_the_score_of_a_peak_is_the_evidence_at_its_pose() -> None:
    target, source, _ = small_pair(3)
    base, draft = slabs(target), slabs(source)
    found = search(base, draft, min_overlap=0.3, workers=1)
    assert found.cell == 0.5
    assert np.all(np.diff(found.score) <= 0)
    columns = about(list_columns(draft), found.centre)
    for rank in range(3):
        at = evidence_at(coarse(base), columns, found.pose[rank])
        assert at.score == pytest.approx(found.score[rank], rel=1e-9)


def test_the_mirrored_search_finds_a_mirrored_map_and_not_the_true_one() -> None:
    target, source, T = small_pair(4)
    base = slabs(target)
    mirror = source * np.array([-1.0, 1.0, 1.0])
    true = search(base, slabs(source), min_overlap=0.3, workers=1)
    decoy = search(base, slabs(source), min_overlap=0.3, mirrored=True, workers=1)
    undone = search(base, slabs(mirror), min_overlap=0.3, mirrored=True, workers=1)
    assert undone.score[0] > 0.9 * true.score[0]
    assert decoy.score[0] < 0.6 * true.score[0]
    # the centre of the mirrored map comes to lie where the truth has it
    at = undone.centre * np.array([-1.0, 1.0])
    expected = moved(T, np.array([[*at, 0.0]]))[0, :2]
    assert np.hypot(*(undone.pose[0, :2] - expected)) < 0.6
    turned = undone.pose[0, 2] - math.atan2(T[1, 0], T[0, 0])
    assert abs(math.remainder(turned, 2.0 * math.pi)) < math.radians(2.0)


def test_poses_under_the_least_overlap_are_not_proposed() -> None:
    # the target ends 3 m into the draft: the true pose has about a quarter of its cells
    target, source, T = small_pair(7)
    middle = moved(T, 0.5 * (source.min(axis=0) + source.max(axis=0))[None])[0]
    cut = target[target[:, 0] < middle[0] - 3.0]
    for min_overlap in (0.1, 0.5, 0.9):
        found = search(slabs(cut), slabs(source), min_overlap=min_overlap, workers=1)
        assert (found.overlap >= min_overlap - 1e-9).all()
        assert (found.overlap <= 1.0).all()
    loose = search(slabs(cut), slabs(source), min_overlap=0.1, workers=1)
    assert planar_error(loose.T_target_source(), T, source)[0] < 0.8
    assert loose.overlap[0] < 0.5


def test_a_map_too_small_for_the_overlap_gives_no_pose_at_all() -> None:
    target, source, _ = small_pair(8)
    scrap = target[(np.abs(target[:, :2] - target[:, :2].mean(axis=0)) < 2.0).all(axis=1)]
    found = search(slabs(scrap), slabs(source), min_overlap=0.9, workers=1)
    assert len(found.score) == 0
    assert found.pose.shape == (0, 3)
    assert not np.isfinite(found.per_yaw[:, 1]).any()


def same_bytes(first: Peaks, second: Peaks) -> bool:
    """Return whether two answers agree to the last bit."""
    return all(
        getattr(first, name).tobytes() == getattr(second, name).tobytes()
        for name in ("pose", "score", "overlap", "per_yaw", "centre")
    )


def test_workers_do_not_change_a_bit() -> None:
    target, source, _ = small_pair(10)
    base, draft = slabs(target), slabs(source)
    one, two = (search(base, draft, min_overlap=0.3, workers=n) for n in (1, 2))
    assert same_bytes(one, two)
    a, b = (
        search_metric(
            height_map(target, 0.5), height_map(source, 0.5), metric="zncc", normalise="off",
            floor=0.05, min_overlap=0.3, workers=n,
        )
        for n in (1, 2)
    )  # fmt: skip
    assert same_bytes(a, b)


def test_progress_rises_to_one() -> None:
    target, source, _ = small_pair(11)
    told: list[float] = []
    search(
        slabs(target, 0.5), slabs(source, 0.5), min_overlap=0.3, workers=2,
        progress=lambda step, share=0.0: told.append(share),
    )  # fmt: skip
    assert told == sorted(told)
    assert told[-1] == 1.0


def test_the_plan_keeps_sixteen_cells_and_its_budget() -> None:
    target, source, _ = small_pair(12)
    base, draft = slabs(target), slabs(source)
    rich, poor = plan_search(base, draft, budget=1e12), plan_search(base, draft, budget=1.0)
    glance = plan_glance(base, draft)
    assert glance.cells == plan_search(base, draft, budget=1e8 / 32).cells
    assert glance.keep == (32, 8, 3, 3)[: len(glance.cells)]
    assert rich.cells == (0.5,)
    assert len(poor.cells) > 1
    assert all(a == 2.0 * b for a, b in zip(poor.cells[:-1], poor.cells[1:], strict=True))
    assert poor.cells[-1] == 0.5
    extent = np.ptp(list_columns(draft).xy, axis=0).max()
    assert extent / poor.cells[0] >= 15
    assert poor.n_yaw < rich.n_yaw
    assert len(poor.keep) == len(poor.cells)
    assert poor.n_yaw % 8 == rich.n_yaw % 8 == 0  # as many as go side by side
    # a part is searched on the cells of the whole, in as many yaws as its own rim needs
    few = draft.known.copy()
    few[draft.shape[0] // 3 :] = 0
    part = plan_part(rich, replace(draft, known=few, occupied=draft.occupied & few), keep=64)
    assert part.cells == rich.cells
    assert part.keep == (64,)
    assert part.n_yaw % 8 == 0
    assert part.n_yaw < rich.n_yaw


def test_the_pose_of_a_peak_by_hand() -> None:
    # a quarter turn about the centre (10, 0), which comes to lie on (1, 2)
    peaks = Peaks(
        np.array([[1.0, 2.0, math.pi / 2]]), np.ones(1), np.ones(1), np.array([10.0, 0.0]),
        np.zeros((1, 2)), 0.5,
    )  # fmt: skip
    T = peaks.T_target_source()
    assert moved(T, np.array([[10.0, 0.0, 5.0]]))[0] == pytest.approx([1.0, 2.0, 5.0])
    assert moved(T, np.array([[11.0, 0.0, 0.0]]))[0] == pytest.approx([1.0, 3.0, 0.0])


def test_local_maxima_by_hand() -> None:
    score = np.zeros((5, 6), np.float32)
    score[0, 0], score[1, 1], score[3, 4], score[4, 0], score[4, 1] = 3.0, 2.0, 5.0, 1.0, 1.0
    # [1, 1] has a higher neighbour; of two equal neighbours the first counts
    assert local_maxima(score, 4, 0.0)[0].tolist() == [[3, 4], [0, 0], [4, 0], [-1, -1]]
    assert local_maxima(score, 1, 0.0)[0].tolist() == [[3, 4]]
    assert (
        local_maxima(np.full((3, 3), -np.inf, np.float32), 2, -np.inf)[0].tolist() == [[-1, -1]] * 2
    )


def test_separate_keeps_the_best_of_each_neighbourhood() -> None:
    pose = np.array([[0, 0, 0.0], [0.5, 0, 0.1], [0.5, 0, 3.0], [9, 9, 0], [0, 0, 2 * math.pi]])
    score = np.array([2.0, 3.0, 1.0, -np.inf, 2.5])
    # the last is the first again, a full turn on
    assert separate(pose, score, 1.0, 0.5, 9).tolist() == [1, 2]
    assert separate(pose, score, 1.0, 0.05, 9).tolist() == [1, 4, 2]
    assert separate(pose, score, 1.0, 0.5, 1).tolist() == [1]
    assert separate(pose[:0], score[:0], 1.0, 0.5, 3).tolist() == []


@pytest.mark.parametrize(
    ("metric", "normalise"),
    [
        ("k", "overlap"),
        ("k", "off"),
        ("kl", "overlap"),
        ("zncc", "off"),
        ("ssd", "off"),
        ("mi", "off"),
    ],
)
def test_metrics_on_height_maps_recover_a_known_pose(metric: str, normalise: str) -> None:
    # heights under a metre, as the source paper uses; both robots saw the same surfaces
    rng = np.random.default_rng(21)
    place = make_place(21, 22.0, n_boxes=5, n_posts=12, relief=0.1)
    T = rigid(4.0, -7.0, 0.0, 2.1)
    target = look(place, rng, roofs=False, density=20.0)
    draft = moved(np.linalg.inv(T), look(place, rng, roofs=False, density=20.0, edge=15.0))

    def low(xyz: Float64s) -> GridMap:
        return build_height_map(
            xyz, cell=0.25, slab_edges=np.array([0.2, 0.6, 1.0]), max_height=1.0
        )

    found = search_metric(
        low(target), low(draft), metric=metric, normalise=normalise, floor=0.05, min_overlap=0.7,
        workers=1, budget=1e6,
    )  # fmt: skip
    metres, degrees = planar_error(found.T_target_source(), T, draft)
    assert metres < 1.0
    assert degrees < 5.0
    assert np.all(np.diff(found.score) <= 0)  # more is better, whatever the metric
    assert (found.overlap >= 0.69).all()


def test_the_highest_column_of_a_cell_counts() -> None:
    xy = np.array([[0.2, 0.2], [0.7, 0.3], [1.5, 0.5], [9.0, 9.0]])
    height, known = scatter_heights(
        xy, np.array([0.5, 0.2, 0.7, 1.0]), 1.0, 0.0, 1.0, np.zeros(2), 3, 2
    )
    assert known.tolist() == [[True, False], [True, False], [False, False]]
    assert height.tolist() == [[0.5, 0.0], [0.7, 0.0], [0.0, 0.0]]
