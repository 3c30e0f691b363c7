"""The paper's experiment: its scores by literal numbers, its figures, and what may go wrong."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from commonmap.errors import InputError
from commonmap.matching import correlate
from commonmap.matching.search_metric import scatter_heights
from commonmap.study import claims, paper, readings
from commonmap.study.paper_tables import ENTRIES, verdict
from commonmap.study.readings import (
    FLOORS,
    LEAST,
    METRICS,
    READINGS,
    Columns,
    Lattice,
    score_pose,
    search_readings,
)
from commonmap.types import Bools, Float64s
from test_cli import Run, run, told

__all__ = ["run"]

P = np.array([0.2, 0.4, 0.3, 0.1])
Q = np.array([0.3, 0.2, 0.3, 0.2])
KL, JEFFREYS, K = 0.12685113254635072, 0.2484906649788, 0.029897607907053952
"""Of P and Q, natural logarithm."""


def row_of(cells: str, floor: float | None, normalise: str) -> int:
    return READINGS.index(readings.Reading(cells, floor, normalise))


def laid_out(a: Float64s, b: Float64s) -> tuple[Lattice, Columns]:
    """Return heights b as a lattice and heights a as columns; NaN is not known."""
    n_x, n_y = a.shape
    i, j = np.nonzero(np.isfinite(a))
    xy = np.column_stack([i, j]) + 0.5
    centre = np.array([n_x / 2, n_y / 2])
    target = Lattice(np.nan_to_num(b), np.isfinite(b), np.zeros(2), 1.0)
    return target, Columns(xy - centre, a[i, j], centre)


# Scores


def test_scores_are_the_literal_numbers() -> None:
    # heights of 2 P and 2 Q: none lower than an object
    target, source = laid_out((2 * P).reshape(2, 2), (2 * Q).reshape(2, 2))
    scores, n = score_pose(target, source, np.array([1.0, 1.0, 0.0]))
    assert n == 4
    for cells, floor in readings.VARIANTS:
        for normalise, factor in (("overlap", 1.0), ("map", 1.0), ("off", 2.0)):
            got = scores[row_of(cells, floor, normalise)]
            np.testing.assert_allclose(got[:2], factor * np.array([KL, JEFFREYS]), rtol=1e-12)
            assert got[2] == pytest.approx(factor * K, abs=1e-6 * factor)


def literal(a: Float64s, b: Float64s, reading: readings.Reading) -> Float64s:
    """Return KL, Jeffreys and K of a reading, from their formulas."""
    in_a, in_b = a >= LEAST, b >= LEAST
    both = np.isfinite(a) & np.isfinite(b)
    chosen = both & {
        "all": np.ones_like(both), "either": in_a | in_b, "draft": in_a, "both": in_a & in_b
    }[reading.cells]  # fmt: skip
    floor = reading.floor or 1.0
    p, q = np.where(in_a, a, floor)[chosen], np.where(in_b, b, floor)[chosen]
    if reading.normalise == "overlap":
        p, q = p / p.sum(), q / q.sum()
    elif reading.normalise == "map":
        floored = reading.cells in ("all", "either")
        for values, heights, mine in ((p, a, in_a), (q, b, in_b)):
            total = heights[mine].sum()
            if floored:
                total += floor * np.count_nonzero(np.isfinite(heights) & ~mine)
            values /= total
    return np.array(
        [(p * np.log(p / q)).sum(), ((p - q) * np.log(p / q)).sum(),
         (p * np.log(2 * p / (p + q))).sum()]
    )  # fmt: skip


def heights(rng: np.random.Generator, shape: tuple[int, int]) -> Float64s:
    """Return a third objects, most of the rest bare, some not known."""
    kind = rng.random(shape)
    h = np.where(kind < 0.35, rng.uniform(LEAST, 1.0, shape), rng.uniform(0.0, 0.9 * LEAST, shape))
    return np.where(kind > 0.9, np.nan, h)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_every_reading_is_its_formula(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = heights(rng, (9, 7)), heights(rng, (9, 7))
    target, source = laid_out(a, np.where(np.isfinite(b) & (b < LEAST), 0.0, b))
    scores, n = score_pose(target, source, np.array([4.5, 3.5, 0.0]))
    assert n == np.count_nonzero(np.isfinite(a) & np.isfinite(b))
    for reading, got in zip(READINGS, scores, strict=True):
        np.testing.assert_allclose(got, literal(a, b, reading), atol=3e-5, rtol=1e-5)


def test_the_search_agrees_with_the_search_by_fft() -> None:
    rng = np.random.default_rng(4)
    b = heights(rng, (24, 21))
    b = np.where(np.isfinite(b) & (b < LEAST), 0.0, b)
    a = b[6:15, 5:13] + rng.normal(0.0, 0.03, (9, 8)) * (b[6:15, 5:13] > 0.3)
    target, source = laid_out(np.clip(a, 0.0, 1.0), b)
    best = search_readings(target, source, workers=1)
    side = 2 * math.ceil(float(np.hypot(*source.xy.T).max())) + 2
    for normalise in ("overlap", "map", "off"):
        for number, name in enumerate(METRICS):
            lowest = np.inf
            for yaw in 2 * np.pi * np.arange(count(source)) / count(source):
                h, known = scatter_heights(
                    source.xy, source.height, np.cos(yaw), np.sin(yaw), 1.0,
                    np.full(2, -0.5 * side), side, side,
                )  # fmt: skip
                h = np.where(h >= LEAST, h, 0.0)
                lowest = min(lowest, fft_lowest(name, normalise, target, h, known))
            row = row_of("all", FLOORS[0], normalise)
            assert best.score[row, number] == pytest.approx(lowest, abs=2e-4)
    exact = best.pose[row_of("all", FLOORS[0], "overlap"), METRICS.index("k")]
    np.testing.assert_allclose(exact, [6 + 4.5, 5 + 4.0, 0.0], atol=0.51)


def count(source: Columns) -> int:
    return max(16, math.ceil(2.0 * np.pi * source.radius))


def fft_lowest(name: str, normalise: str, target: Lattice, h: Float64s, known: Bools) -> float:
    prepared = correlate.prepare_target(
        name, target.height, target.known, (h.shape[0], h.shape[1]), normalise=normalise,
        floor=FLOORS[0], height_range=(0.0, 1.0), dtype=np.float64,
        min_cells=max(4, int(readings.LEAST_OVERLAP * np.count_nonzero(known))),
    )  # fmt: skip
    return float(np.nanmin(correlate.score_surface(prepared, h, known).score))


# The claim


def test_the_claim_is_about_ratios() -> None:
    assert claims.claim_holds(1.1, 1.9, 1.0)
    assert not claims.claim_holds(KL, JEFFREYS, K)  # what small differences give: 4.2 and 8.3
    assert not claims.claim_holds(0.9, 1.9, 1.0)  # KL lower than K: then K is not the best
    assert not claims.claim_holds(1.1, 2.5, 1.0)
    assert not claims.claim_holds(1.5, 1.9, 1.0)
    assert not claims.claim_holds(-1.1, -1.9, -1.0)
    assert claims.claim_holds([1.1, KL], [1.9, JEFFREYS], [1.0, K]).tolist() == [True, False]


def made_up(seed: int, scores: tuple[float, float, float]) -> dict[str, Any]:
    """Return a record of one area in which every reading gives the same scores."""
    rows = [list(scores)] * len(READINGS)
    area = {
        "area": 0, "objects": 0.1, "at_truth": rows, "best": [[KL, JEFFREYS, K]] * len(READINGS),
        "metres": [[0.2, 0.3, 5.0]] * len(READINGS), "radians": [[0.01] * 3] * len(READINGS),
    }  # fmt: skip
    return {"format": claims.FORMAT, "seed": seed, "areas": [area]}


def test_a_table_is_made_of_raw_records() -> None:
    records = [
        made_up(1, (1.1, 1.9, 1.0)),
        made_up(2, (1.2, 2.0, 1.0)),
        made_up(3, (4.0, 8.0, 1.0)),
    ]
    rows = claims.tabulate(records)
    assert [row.reading for row in rows] == list(READINGS)
    first = rows[0]
    assert first.n == 3
    assert first.kl_k == pytest.approx((1.2, KL / K))
    assert first.jeffreys_k == pytest.approx((2.0, JEFFREYS / K))
    assert first.holds_truth == pytest.approx(2 / 3) and first.holds_best == 0.0
    assert first.right.tolist() == [1.0, 1.0, 0.0]
    assert "true or at the best" in verdict(rows)
    assert verdict(claims.tabulate(records[2:])).startswith("No reading reproduces")
    none = made_up(4, (1.0, 2.0, 1.0))
    none["areas"][0]["at_truth"] = [[None, None, None]] * len(READINGS)
    assert math.isnan(claims.tabulate([none])[0].kl_k[0])


def test_scenes_measured_before_are_not_measured_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    measured: list[int] = []

    def measure(seed: int, **options: Any) -> dict[str, Any]:
        measured.append(seed)
        return made_up(seed, (float(seed), 2.0, 1.0))

    monkeypatch.setattr(claims, "measure_scene", measure)
    path = tmp_path / "claims.jsonl"
    first = claims.measure_scenes([101, 102, 103], path)
    whole = path.read_text()
    path.write_text(whole[:-40])  # ended while it wrote the last line
    assert claims.measure_scenes([101, 102, 103, 104], path)[:3] == first
    assert measured == [101, 102, 103, 103, 104]
    assert list(claims.read_records(path)) == [101, 102, 103, 104]
    path.write_text("something else\n" + whole)
    with pytest.raises(InputError, match="line 1"):
        claims.measure_scenes([101], path)


# The whole run, on a small scene


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("study") / "paper"
    paper.study_paper(out, seed=3, seconds=6.0, size=30.0, areas_read=1)
    return out


def test_every_figure_and_table_is_written(folder: Path) -> None:
    names = {path.name for path in folder.iterdir()}
    assert names == set(ENTRIES) - {"claims.jsonl"}
    page = (folder / "paper.md").read_text()
    for name in names:
        data = (folder / name).read_bytes()
        if name.endswith(".png"):
            assert data.startswith(b"\x89PNG") and 5_000 < len(data) < 200_000, name
            assert f"]({name})" in page
    assert b"Similarity metrics" in (folder / "figure1_diagram.svg").read_bytes()


def test_the_numbers_are_those_of_the_run(folder: Path) -> None:
    values = json.loads((folder / "study.json").read_text(), parse_constant=pytest.fail)
    assert values["seed"] == 3 and values["set_up"]["max_height"] == 1.0
    for name in METRICS:
        assert values["whole"][name]["score"] > 0.0
        assert values["whole"][name]["score_at_truth"] > 0.0
    assert values["odometry"]["ugv"]["ape_rms"] < 0.3
    assert len(values["readings"]) == 1 and len(values["readings"][0]["best"]) == len(READINGS)
    assert len(values["claim"]["rows"]) == len(READINGS)
    table = (folder / "readings.csv").read_text().splitlines()
    assert len(table) == 1 + len(READINGS)
    n_areas = len(values["areas"])
    assert len((folder / "scores.csv").read_text().splitlines()) == 1 + 3 * (1 + n_areas)
    times = json.loads((folder / "times.json").read_text())
    assert set(times["search_whole"]) == set(METRICS)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_files(folder: Path, tmp_path: Path) -> None:
    again = tmp_path / "again"
    paper.study_paper(again, seed=3, seconds=6.0, size=30.0, areas_read=1)
    for path in sorted(folder.iterdir()):
        if path.name != "times.json":
            assert (again / path.name).read_bytes() == path.read_bytes(), path.name


def test_what_is_wrong_is_told_before_anything_is_run(tmp_path: Path, run: Run) -> None:
    out = tmp_path / "out"
    told(run("study", "paper", "-o", out, "--seconds", "2"), "between 5 and 600")
    told(run("study", "paper", "-o", out, "--scenes", "-1"), "--scenes")
    told(run("study", "paper", "-o", out, "--seed", "-1"), "seed")
    told(run("study", "paper", "-o", tmp_path / "no" / "out"), "no folder")
    told(run("study", "paper"), "-o")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "diary.txt").write_text("dear diary")
    told(run("study", "paper", "-o", tmp_path / "mine"), "diary.txt")
    (tmp_path / "no.jsonl").write_text("{}\n{}\n")
    told(run("study", "paper", "-o", out, "--records", tmp_path / "no.jsonl"), "line 1")
    assert not out.exists()


def test_a_run_that_fails_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*args: object, **options: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(paper, "run_experiment", fail)
    with pytest.raises(KeyboardInterrupt):
        paper.study_paper(tmp_path / "out", seed=1)
    assert list(tmp_path.iterdir()) == []
