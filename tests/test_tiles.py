"""The search in tiles: to the bit the answer of one piece, in bounded memory, here or on Dask."""

from __future__ import annotations

import importlib
import math
import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import distributed
import numpy as np
import pytest
from typer.testing import CliRunner

import device_arrays
from commonmap.cli import app
from commonmap.config import ComputeConfig, Config
from commonmap.errors import InputError, MissingExtraError
from commonmap.matching import arrays, tiles
from commonmap.matching.evidence_fft import bytes_held, evidence_surface, transform_target
from commonmap.matching.lane_fft import find_length
from commonmap.matching.levels import find_level
from commonmap.matching.peaks import local_maxima
from commonmap.matching.search import Peaks, plan_search, search, search_both
from commonmap.matching.slabs import (
    Columns,
    SlabGrid,
    coarse_shape,
    coarse_window,
    coarsen,
    list_columns,
    mirror_grid,
    pack_slabs,
    scatter,
)
from commonmap.matching.tiles import (
    Sweep,
    Task,
    Tile,
    TilePlan,
    find_turned_rim,
    plan_tiles,
    search_tile,
    search_tiles,
    turn_columns,
)
from commonmap.types import no_progress

IN_ONE_PIECE = ComputeConfig(memory_gb=8.0)
NOTHING_WHOLE = ComputeConfig(memory_gb=1e-5)
IN_LITTLE = ComputeConfig(memory_gb=0.006)


def random_grid(seed: int, shape: tuple[int, int], cell: float = 0.25) -> SlabGrid:
    """Return three slabs in which things stand in clumps, a fifth of the cells unknown."""
    rng = np.random.default_rng(seed)
    coarse = rng.random((3, shape[0] // 4 + 1, shape[1] // 4 + 1)) < 0.3
    occupied = np.kron(coarse, np.ones((1, 4, 4), bool))[:, : shape[0], : shape[1]]
    known = np.broadcast_to(rng.random(shape) < 0.8, occupied.shape)
    return pack_slabs(np.array([-3.25, 7.25]), cell, occupied & known, known)


def cut(grid: SlabGrid, rows: slice, columns: slice) -> SlabGrid:
    """Return a part of a grid as a map of its own."""
    first = np.array([rows.start, columns.start])
    occupied, known = (b[rows, columns].copy() for b in (grid.occupied, grid.known))
    return SlabGrid(grid.origin + first * grid.cell, grid.cell, occupied, known, grid.n_slabs)


BASE = random_grid(1, (150, 138))
DRAFT = cut(BASE, slice(90, 130), slice(60, 96))


def same_bytes(a: Peaks, b: Peaks) -> bool:
    """Return whether two answers of the search are the same to the bit."""
    return all(
        getattr(a, name).tobytes() == getattr(b, name).tobytes()
        for name in ("pose", "score", "overlap", "centre", "per_yaw")
    )


@pytest.mark.parametrize("shape", [(7, 11), (64, 64), (400, 90)])
@pytest.mark.parametrize("memory_gb", [0.001, 0.004, 1.0])
def test_every_translation_belongs_to_one_tile(shape: tuple[int, int], memory_gb: float) -> None:
    compute = ComputeConfig(memory_gb=memory_gb)
    plan = plan_tiles(shape, 9, 3, shared=True, compute=compute, workers=1)
    seen = np.zeros((shape[0] + 8, shape[1] + 8), int)
    for tile in plan.tiles:
        seen[slice(*tile.rows), slice(*tile.columns)] += 1
    assert np.all(seen == 1)
    assert plan.n_bytes <= 1e9 * memory_gb
    if memory_gb == 1.0 and shape != (400, 90):
        assert len(plan.tiles) == 1


def test_a_budget_that_no_tile_keeps_is_told_with_one_that_does() -> None:
    def plan(memory_gb: float) -> TilePlan:
        compute = ComputeConfig(memory_gb=memory_gb)
        return plan_tiles((900, 900), 300, 8, shared=True, compute=compute, workers=2)

    with pytest.raises(InputError, match=r"compute\.memory_gb of at least 0\.\d\d for a source of"):
        plan_tiles(
            (900, 900), 300, 8, shared=True, compute=ComputeConfig(memory_gb=0.002), workers=2
        )
    with pytest.raises(InputError, match="at least") as told:
        plan_tiles(
            (900, 900), 300, 8, shared=True, compute=ComputeConfig(memory_gb=0.002), workers=2
        )
    enough = float(str(told.value).split("at least ")[1].split(" ")[0])
    assert plan_tiles(
        (900, 900), 300, 8, shared=True, compute=ComputeConfig(memory_gb=enough), workers=2
    )


def sweep_of(draft: SlabGrid, cell: float, n_yaws: int) -> Sweep:
    """Return the draft about its middle, at some yaws."""
    columns = list_columns(draft)
    xy = columns.xy - columns.xy.mean(axis=0)
    side = 2 * int(np.ceil(np.hypot(*xy.T).max() / cell)) + 2
    yaws = 2 * np.pi * np.arange(n_yaws) / n_yaws
    centred = Columns(np.ascontiguousarray(xy), columns.occupied, columns.known, columns.n_slabs)
    return Sweep(centred, cell, np.full(2, -0.5 * side * cell), side, yaws, 5.0, "numpy")


@pytest.mark.parametrize("extent", [3, 10, 1000])
@pytest.mark.parametrize("seed", [3, 4])
def test_peaks_of_tiles_are_the_peaks_of_the_whole_surface(seed: int, extent: int) -> None:
    # a target of few different columns: plateaus and equal scores, also across rims
    base = random_grid(seed, (26, 22), 0.5)
    base = SlabGrid(
        base.origin, 0.5, np.tile(base.occupied[:13], (2, 1)), base.known | np.uint32(7), 3
    )
    sweep = sweep_of(cut(base, slice(0, 6), slice(2, 9)), 0.5, 5)
    n_u, n_v = (n + sweep.side - 1 for n in base.shape)
    parts = tuple(
        Tile((u, min(u + extent, n_u)), (v, min(v + extent, n_v)))
        for u in range(0, n_u, extent)
        for v in range(0, n_v, extent)
    )
    (found,) = search_tiles(
        (find_level(base, 1, IN_ONE_PIECE),), sweep, parts, compute=IN_ONE_PIECE, workers=2,
        progress=no_progress,
    )  # fmt: skip
    spectra = transform_target(base, (sweep.side, sweep.side))
    c = sweep.columns
    for yaw, peaks in zip(sweep.yaws, found, strict=True):
        turned = scatter(
            c.xy, c.occupied, c.known, np.cos(yaw), np.sin(yaw), 0.5, sweep.low, sweep.side,
            sweep.side,
        )  # fmt: skip
        score, _ = evidence_surface(spectra, *turned, min_overlap=5.0)
        index, _ = local_maxima(score, 6, 0.0)
        index = index[index[:, 0] >= 0]
        assert len(index) >= 3
        assert peaks[:, :2].tolist() == index.tolist()
        assert peaks[:, 2].tolist() == score[index[:, 0], index[:, 1]].tolist()


@pytest.mark.parametrize("least", [1.0, 7.3, 60.0, 1e6])
@pytest.mark.parametrize("n_yaws", [3, 4, 6, 24])
@pytest.mark.parametrize("askew", [False, True])
def test_the_rim_of_all_yaws_is_that_of_the_turned_sources(
    least: float, n_yaws: int, askew: bool
) -> None:
    draft = cut(BASE, slice(0, 26), slice(2, 28))
    draft.known[np.add.outer(np.arange(26), np.arange(26)) < 20] = 0  # a corner is missing
    if askew:  # a strip at 30 degrees: its long side is a column where its short one is a row
        x, y = np.meshgrid(np.arange(26) - 12.5, np.arange(26) - 12.5, indexing="ij")
        draft.known[np.abs(y * np.cos(0.5236) - x * np.sin(0.5236)) > 4.0] = 0
    sweep = replace(sweep_of(draft, 0.5, n_yaws), min_pairs=least)
    masks = [turn_columns(sweep, yaw[None])[1][..., 0] > 0 for yaw in sweep.yaws]
    expected = arrays.find_rim(masks, (sweep.side, sweep.side), max(1, math.ceil(least)))
    if n_yaws % 4 == 0:  # what is a row at one yaw is a column at another
        assert min(expected) == max(expected)
    assert find_turned_rim(sweep) == expected
    assert (expected[0] == sweep.side) == (max(mask.sum() for mask in masks) < least)


def test_equal_peaks_of_two_tiles_keep_the_order_of_one_piece() -> None:
    peaks = np.array(
        [[0, 9, 1, 5.0], [0, 2, 8, 5.0], [0, 2, 3, 5.0], [1, 0, 0, 1.0], [0, 7, 7, 6.0]]
        + [[1, k, 0, 2.0] for k in range(7)]
    )
    first, second, third = tiles._best_of_each_yaw(peaks, 3)
    assert first.tolist() == [[7, 7, 6], [2, 3, 5], [2, 8, 5], [9, 1, 5]]
    assert second.tolist() == [[k, 0, 2] for k in range(6)]
    assert third.shape == (0, 3)


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("workers", [1, 2])
def test_the_search_in_little_memory_gives_the_same_bytes(
    mirrored: bool, workers: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = search(BASE, DRAFT, min_overlap=0.1, mirrored=mirrored, compute=IN_ONE_PIECE)
    assert len(whole.score) == 16
    little = ComputeConfig(memory_gb=0.003 if workers == 1 else 0.006)
    assert plan_search(BASE, DRAFT).cells == (0.5,)
    plan = plan_tiles((75, 69), 30, 3, shared=True, compute=little, workers=workers)
    assert len(plan.tiles) > 1
    # and no level is kept whole: tiles and climbs read windows
    monkeypatch.setattr(
        "commonmap.matching.search.find_level", lambda t, f, c: find_level(t, f, NOTHING_WHOLE)
    )
    told: list[float] = []
    found = search(
        BASE, DRAFT, min_overlap=0.1, mirrored=mirrored, compute=little, workers=workers,
        progress=lambda step, share=0.0: told.append(share),
    )  # fmt: skip
    assert same_bytes(found, whole)
    assert told == sorted(told)
    assert told[-1] == 1.0


@pytest.mark.parametrize("compute", [IN_ONE_PIECE, IN_LITTLE])
def test_both_sides_at_once_are_what_each_is_alone(compute: ComputeConfig) -> None:
    both = search_both(BASE, DRAFT, min_overlap=0.1, compute=compute)
    for mirrored, found in zip((False, True), both, strict=True):
        alone = search(BASE, DRAFT, min_overlap=0.1, mirrored=mirrored, compute=compute)
        assert same_bytes(found, alone)
    assert not same_bytes(*both)


@pytest.mark.parametrize("factor", [1, 2, 4])
def test_a_mirrored_level_is_the_level_of_the_mirrored_target(factor: int) -> None:
    for compute in (IN_ONE_PIECE, NOTHING_WHOLE):
        level = find_level(BASE, factor, compute).mirror()
        expected = coarsen(mirror_grid(BASE), factor)
        assert level.shape == expected.shape
        assert level.origin == pytest.approx(expected.origin, abs=1e-12)
        window = level.window((2, 7), (1, 9))
        assert np.array_equal(window.occupied, expected.occupied[2:7, 1:9])
        assert np.array_equal(window.known, expected.known[2:7, 1:9])
        corner = expected.origin + np.array([2, 1]) * expected.cell
        assert window.origin == pytest.approx(corner, abs=1e-12)
    # by hand: cell [0, 0] of 0.25 m at x = -1 ends at -0.75, reflected at 0.75 to 1
    grid = SlabGrid(
        np.array([-1.0, 2.0]), 0.25, *(np.arange(6, dtype=np.uint32).reshape(3, 2),) * 2, 3
    )
    mirrored = mirror_grid(grid)
    assert mirrored.origin.tolist() == [0.25, 2.0]
    assert mirrored.occupied.tolist() == [[4, 5], [2, 3], [0, 1]]


def test_climbs_read_windows_of_a_target_too_large_to_keep() -> None:
    level = find_level(BASE, 2, NOTHING_WHOLE)
    assert level.whole is None
    assert find_level(BASE, 2, IN_ONE_PIECE).whole is not None
    pose = np.array([[10.0, 20.0, 0.3], [12.0, 21.0, 0.0]])
    window, first_i, first_j = level.around(pose, 4.0)
    # the level begins at x = -3.5, y = 7: (10 - 4 + 3.5) / 0.5 = 19 and one cell more;
    # (20 - 4 - 7) / 0.5 = 18 and one more
    assert (first_i, first_j) == (18, 17)
    # to (12 + 4 + 3.5) / 0.5 = 39 and (21 + 4 - 7) / 0.5 = 36, and two more
    assert window.shape == (41 - 18, 38 - 17)
    whole = coarsen(BASE, 2)
    assert np.array_equal(window.occupied, whole.occupied[18:41, 17:38])
    outside, _, _ = level.around(np.array([[900.0, 900.0, 0.0]]), 4.0)
    assert outside.occupied.size == 0


@pytest.mark.parametrize("factor", [1, 2, 4])
def test_a_window_is_a_part_of_the_coarse_grid(factor: int) -> None:
    whole = coarsen(BASE, factor)
    assert coarse_shape(BASE, factor) == whole.shape
    window = coarse_window(BASE, factor, (5, 23), (0, whole.shape[1]))
    assert np.array_equal(window.occupied, whole.occupied[5:23])
    assert np.array_equal(window.known, whole.known[5:23])
    assert window.origin == pytest.approx(whole.origin + np.array([5 * whole.cell, 0.0]))
    beyond = coarse_window(BASE, factor, (-3, 2), (whole.shape[1] - 2, whole.shape[1] + 4))
    assert np.array_equal(beyond.known[3:, :2], whole.known[:2, -2:])
    assert not beyond.known[:3].any() and not beyond.known[:, 2:].any()


def test_a_base_in_a_file_of_bytes_gives_the_same_answer(tmp_path: Path) -> None:
    files = []
    for name in ("occupied", "known"):
        files.append(tmp_path / f"{name}.npy")
        np.save(files[-1], getattr(BASE, name).astype(np.uint8))
    occupied, known = (np.load(f, mmap_mode="c") for f in files)
    mapped = SlabGrid(BASE.origin, BASE.cell, occupied, known, 3)
    narrow = SlabGrid(
        DRAFT.origin, DRAFT.cell, DRAFT.occupied.astype(np.uint8), DRAFT.known.astype(np.uint8), 3
    )
    expected = search(BASE, DRAFT, min_overlap=0.1, compute=IN_ONE_PIECE)
    assert same_bytes(search(mapped, narrow, min_overlap=0.1, compute=IN_LITTLE), expected)


def test_counts_that_single_precision_cannot_tell_are_taken_in_double() -> None:
    side = 40
    single = transform_target(BASE, (side, side))
    double = transform_target(BASE, (side, side), n_source=10**12)
    assert (single.dtype, double.dtype) == (np.float32, np.float64)
    source = cut(BASE, slice(30, 70), slice(30, 70))
    for a, b in zip(
        *(
            evidence_surface(s, source.occupied, source.known, min_overlap=3.0)
            for s in (single, double)
        ),
        strict=True,
    ):
        assert a.tobytes() == b.tobytes()


@pytest.mark.parametrize("double", [False, True])
@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("n_targets", [1, 2])
def test_a_tile_holds_no_more_than_planned(
    n_targets: int, double: bool, shared: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "commonmap.matching.evidence_fft.rounding", lambda *a: 1.0 if double else 0.1
    )
    base = random_grid(5, (500, 480), 0.5)
    if shared:
        base = SlabGrid(base.origin, base.cell, base.occupied, base.known | np.uint32(7), 3)
    sweep = sweep_of(cut(base, slice(100, 130), slice(100, 130)), 0.5, 3)
    shape = (500 + sweep.side - 1, 480 + sweep.side - 1)
    tile = Tile((0, shape[0]), (0, shape[1]))
    plan = plan_tiles(
        base.shape, sweep.side, 3, shared=shared, compute=IN_ONE_PIECE, workers=1,
        n_targets=n_targets,
    )  # fmt: skip
    task = Task((base, mirror_grid(base))[:n_targets], tile, tile, sweep, (0, 0, 0))
    size = find_length(shape[0]), find_length(shape[1])
    planned = bytes_held(size, sweep.side, 3, shared=shared, workers=1, n_targets=n_targets)
    assert planned <= plan.n_bytes <= 1.2 * planned
    alone = bytes_held(size, sweep.side, 3, shared=shared, workers=1)
    layers = (4 if shared else 6) * (16 if double else 8) * size[0] * size[1]
    assert planned - alone >= (n_targets - 1) * layers
    search_tile(task)  # compiled
    arrays._own.__dict__.clear()
    tracemalloc.start()
    try:
        search_tile(task)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert 0.5 * planned < peak < planned


def test_the_search_on_a_device_gives_the_same_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    expected = search_both(BASE, DRAFT, min_overlap=0.1, workers=1)
    device_arrays.install(monkeypatch)
    device = ComputeConfig(arrays="cupy")
    found = search_both(BASE, DRAFT, min_overlap=0.1, workers=1, compute=device)
    for one, other in zip(found, expected, strict=True):
        assert same_bytes(one, other)


@pytest.mark.filterwarnings("default")
def test_workers_of_a_dask_scheduler_give_the_same_bytes() -> None:
    whole = search_both(BASE, DRAFT, min_overlap=0.1, compute=IN_ONE_PIECE)
    told: list[float] = []
    with distributed.LocalCluster(  # type: ignore[no-untyped-call]
        n_workers=2, threads_per_worker=1, processes=False, dashboard_address=None,
        protocol="tcp://",
    ) as cluster:  # fmt: skip
        for memory_gb in (0.0035, 1.0):  # many tiles; one tile, its yaws shared out
            compute = ComputeConfig(cluster.scheduler_address, memory_gb)
            found = search_both(
                BASE, DRAFT, min_overlap=0.1, compute=compute,
                progress=lambda step, share=0.0: told.append(share),
            )  # fmt: skip
            for one, other in zip(found, whole, strict=True):
                assert same_bytes(one, other)
            assert told[-1] == 1.0
        cluster.scale(0)
        for worker in list(cluster.workers.values()):
            cluster.sync(worker.close)
        with pytest.raises(InputError, match="has no workers"):
            search(BASE, DRAFT, min_overlap=0.1, compute=compute)


def test_a_scheduler_that_does_not_answer_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tiles, "CONNECT_SECONDS", 0.3)
    nowhere = ComputeConfig(scheduler="tcp://127.0.0.1:1")
    with pytest.raises(InputError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:1"):
        search(BASE, DRAFT, min_overlap=0.1, compute=nowhere)


def test_dask_is_an_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(name: str) -> Any:
        raise ImportError(name)

    monkeypatch.setattr(importlib, "import_module", refuse)
    with pytest.raises(MissingExtraError, match=r"commonmap\[dask\]"):
        next(tiles._on_cluster("tcp://127.0.0.1:1", iter([])))


def test_addresses_and_memory_are_checked() -> None:
    with pytest.raises(InputError, match=r"an address like tcp://host:8786; here:8786 came"):
        Config.from_dict({"compute": {"scheduler": "here:8786"}})
    with pytest.raises(InputError, match=r"compute\.memory_gb must be positive; 0 came"):
        Config.from_dict({"compute": {"memory_gb": 0}})
    said = CliRunner().invoke(app, ["match", "a.ply", "b.ply", "--scheduler", "here:8786"])
    assert isinstance(said.exception, InputError)
    assert "here:8786 came" in str(said.exception)
