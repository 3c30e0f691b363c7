"""The benchmark against peers: its measures, its coarse search, its scores and its tables."""

from __future__ import annotations

import importlib
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from commonmap.metrics import formulas
from commonmap.types import Float64s

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"


@pytest.fixture
def load(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Return a function that imports a module of the folder of benchmarks."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    yield importlib.import_module


def record(peer: str, case: str, label: str, *, accepted: bool, metres: float | None) -> Any:
    """Return a record as a run leaves it, of a pair in a city."""
    made = {
        "peer": peer, "case": case, "family": "city", "label": label, "accepted": accepted,
        "commit": "abc", "settings": "none", "accepts": "", "cpu_s": 1.0, "peak_mb": 10.0,
    }  # fmt: skip
    return made | ({} if metres is None else {"metres": metres, "degrees": 0.4})


@pytest.mark.parametrize(
    ("measure", "oracle"),
    [
        ("zsad", formulas.zsad),
        ("zssd", formulas.zssd),
        ("ncc", lambda a, b: -formulas.zncc(a, b)),
        ("mi", lambda a, b: -formulas.mutual_information(a, b)),
        ("k", lambda a, b: formulas.k_divergence(a / a.sum(), b / b.sum())),
    ],
)
def test_a_measure_is_the_formula(load: Any, measure: str, oracle: Any) -> None:
    grids = load("peers_grids")
    rng = np.random.default_rng(3)
    a, b = rng.integers(1, 16, (2, 400)).astype(np.float64)
    found = grids.cost_of(grids.MEASURES.index(measure), a, b)
    assert found == pytest.approx(oracle(a, b), abs=1e-12)


def test_k_divergence_of_the_reference_values(load: Any) -> None:
    p, q = np.array([0.2, 0.4, 0.3, 0.1]), np.array([0.3, 0.2, 0.3, 0.2])
    assert load("peers_grids").k_divergence(p, q) == pytest.approx(0.029897607907053952, abs=1e-15)


def blocks(rng: np.random.Generator) -> Float64s:
    """Return (N, 3) points of towers of many heights on a square of 24 m."""
    xy = rng.uniform(0.0, 24.0, (40_000, 2))
    towers = np.zeros((24, 24))
    towers[rng.integers(0, 24, 40), rng.integers(0, 24, 40)] = rng.uniform(0.5, 4.0, 40)
    return np.column_stack([xy, towers[tuple(xy.astype(int).T)]])


@pytest.mark.parametrize("measure", ["zsad", "mi"])
def test_the_coarse_grid_holds_the_pose(load: Any, measure: str) -> None:
    yaw = math.radians(48.0)
    T = np.eye(4)
    T[:2, :2] = [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]
    T[:3, 3] = [7.0, -3.0, 1.5]
    base = blocks(np.random.default_rng(5))
    draft = (base[(base[:, 0] < 16.0)] - T[:3, 3]) @ T[:3, :3]
    found, figures = load("peers_grids").search(base, draft, measure=measure)
    middle = np.append(draft.mean(axis=0), 1.0)
    assert figures["found"]
    assert np.linalg.norm((found @ middle - T @ middle)[:2]) < figures["cell_m"]
    assert math.atan2(found[1, 0], found[0, 0]) == pytest.approx(yaw, abs=1e-9)


def test_errors_are_taken_at_the_middle_of_the_draft(load: Any) -> None:
    peers, pairs = load("peers"), load("peers_pairs")
    truth = [[0, -1, 0, 5], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    case = pairs.Case("1", "city", "match", "", "", truth, [100.0, 0.0, 0.0], {})
    # Turned back by 90 deg about the origin: (100, 0) comes to (105, 3) instead of (5, 100)
    found = [[1, 0, 0, 5], [0, 1, 0, 3], [0, 0, 1, 0], [0, 0, 0, 1]]
    judged = peers.judge(case, {"T": found, "T_raw": truth})
    assert judged["metres"] == pytest.approx(math.hypot(100.0, 97.0))
    assert judged["degrees"] == pytest.approx(90.0)
    assert judged["metres_raw"] == judged["degrees_raw"] == 0.0


def test_what_counts_as_wrong(load: Any) -> None:
    peers = load("peers")
    answers = [
        record("akay-k", "1", "match", accepted=True, metres=0.9),
        record("akay-k", "2", "match", accepted=True, metres=1.1),
        record("akay-k", "3", "match", accepted=False, metres=9.0),
        record("akay-k", "4", "other", accepted=True, metres=None),
        record("akay-k", "5", "other", accepted=False, metres=None),
    ]
    assert [peers.is_wrong(answer) for answer in answers] == [False, True, False, True, False]
    row = peers.overall_table(peers.newest(answers))[-1]
    assert row.split(" | ")[1:7] == ["1 of 3", "0 of 3", "0 of 3", "1", "1", "1 of 2"]


def test_the_last_record_counts_and_our_revisions_do_not_mix(load: Any) -> None:
    peers = load("peers")
    older = record("commonmap", "1", "match", accepted=True, metres=0.1) | {"commit": "old"}
    newer = record("commonmap", "2", "match", accepted=True, metres=0.2)
    again = record("akay-k", "1", "match", accepted=True, metres=7.0)
    kept = peers.newest(
        [record("akay-k", "1", "match", accepted=True, metres=8.0), older, newer, again]
    )
    assert kept == {"commonmap": [newer], "akay-k": [again]}


def test_a_page_is_filled_between_its_marks_only(load: Any) -> None:
    peers = load("peers")
    rows = peers.newest([record("akay-k", "1", "match", accepted=True, metres=0.1)])
    page = "before\n<!-- peers:families -->\nold\n<!-- /peers:families -->\nafter\n"
    filled = peers.fill_page(page, rows)
    assert filled.startswith("before\n<!-- peers:families -->\n| | paper | city |")
    assert filled.endswith("|\n<!-- /peers:families -->\nafter\n")
    assert "old" not in filled
    assert peers.fill_page(filled, rows) == filled


def test_a_peer_that_is_not_installed_says_so(load: Any) -> None:
    methods = load("peers_methods")
    absent = methods.Peer("x", lambda a, b: None, ("no_such_library",), "")
    assert methods.missing(absent).startswith("no_such_library is not installed")
    present = methods.Peer("x", lambda a, b: None, ("numpy",), "")
    assert methods.missing(present) == ""
