"""The real pair as a case of the study: crops, records that are kept, and the table."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from commonmap.errors import InputError
from commonmap.frames import apply, from_xyz_yaw, invert
from commonmap.io import write_cloud
from commonmap.study import real_pair
from commonmap.study.metrics_scores import LABELS
from commonmap.study.real_pair import Case, crop, make_table, plan_cases, read_motion, tabulate
from commonmap.types import Cloud
from test_cli import Run, run, told, yard

__all__ = ["run"]


def made_up(case: Case, metres: float, degrees: float) -> dict[str, Any]:
    """Return a record in which every metric is so far off, the first one not at all."""
    return {
        "format": real_pair.FORMAT, "seed": 1, "labels": list(LABELS),
        "case": {"size": case.size, "low": case.low, "draw": case.draw},
        "metres": [0.0, *[metres] * (len(LABELS) - 1)],
        "degrees": [0.0, *[degrees] * (len(LABELS) - 1)],
    }  # fmt: skip


def test_every_size_is_drawn_with_low_and_all_heights() -> None:
    cases = plan_cases(3)
    assert len(cases) == 3 * 2 * 4 == len({case.name for case in cases})
    assert Case(10.0, True, 2).name == "10m-low-02" and Case(None, False, 0).name == "whole-all-00"


def test_a_crop_is_a_square_inside() -> None:
    xyz = np.random.default_rng(0).uniform(0.0, 20.0, (5000, 3))
    piece = crop(xyz, 6.0, np.random.default_rng(1))
    np.testing.assert_allclose(np.ptp(piece, axis=0)[:2], 6.0, atol=0.2)
    assert crop(xyz, None, np.random.default_rng(1)) is xyz
    with pytest.raises(InputError, match="too small for a crop of 30 m"):
        crop(xyz, 30.0, np.random.default_rng(1))


def test_success_is_counted_two_ways_and_no_answer_is_none() -> None:
    case = Case(10.0, True, 0)
    failed = {k: v for k, v in made_up(case, 0, 0).items() if k not in ("metres", "degrees")}
    records = [
        made_up(case, 0.9, 1.9), made_up(case, 0.4, 4.0), made_up(case, 0.4, 1.0),
        made_up(case, 1.1, 1.0), failed,
    ]  # fmt: skip
    rows = tabulate(records)
    first, second = rows[0], rows[1]
    assert (first.n, first.found) == (5, (0.8, 0.8))  # right in all that had an answer
    assert second.found == (0.4, 0.4)
    assert second.median_metres == pytest.approx(0.65)
    table = make_table(rows)
    assert table[0] == "| metric | 10 m, under 1 m | all |"
    assert table[3] == f"| {LABELS[0]} | 4 / 4 | 4 / 4 |"
    assert f"| {LABELS[1]} | 2 / 2 | 2 / 2 |" in table


def test_a_crop_is_placed_and_its_record_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(real_pair, "SIZES", (10.0,))
    base = yard(1)
    T = from_xyz_yaw(1.0, 2.0, 0.3, 0.4)  # the draft's file has a frame of its own
    draft = apply(invert(T), base[(np.abs(base[:, :2]) < 9.0).all(axis=1)])
    first = real_pair.study_real(base, draft, T, tmp_path, seed=3, draws=1, cell=0.5)
    assert len(first) == 2 and len(list(tmp_path.iterdir())) == 2
    whole = next(r for r in first if not r["case"]["low"])
    at = LABELS.index("evidence")
    assert whole["metres"][at] < 1.0 and whole["degrees"][at] < 5.0
    monkeypatch.setattr(real_pair, "run_case", lambda *a, **k: pytest.fail("measured again"))
    assert real_pair.study_real(base, draft, T, tmp_path, seed=3, draws=1, cell=0.5) == first
    with pytest.raises(InputError, match="another study"):
        real_pair.study_real(base, draft, T, tmp_path, seed=4, draws=1, cell=0.5)
    next(tmp_path.iterdir()).write_text("no record")
    with pytest.raises(InputError, match="no record"):
        real_pair.study_real(base, draft, T, tmp_path, seed=3, draws=1, cell=0.5)


def test_what_is_wrong_is_told(tmp_path: Path, run: Run) -> None:
    write_cloud(tmp_path / "a.ply", Cloud(yard(1)))
    a, out = tmp_path / "a.ply", tmp_path / "out"
    told(run("study", "real", tmp_path / "no.ply", a, "-o", out), "no file")
    told(run("study", "real", a, a, "-o", out, "--draws", "0"), "--draws")
    told(run("study", "real", a, a, "-o", out, "--resolution", "0"), "--resolution")
    (tmp_path / "T.txt").write_text("1 0 0 0\n0 1 0 0\n0 0 1\n")
    told(run("study", "real", a, a, "-o", out, "--truth", tmp_path / "T.txt"), "four rows")
    assert not out.exists()


def test_a_motion_is_read_row_by_row(tmp_path: Path) -> None:
    path = tmp_path / "T.txt"
    path.write_text("0 -1 0 5\n1 0 0 6\n0 0 1 7\n0 0 0 1\n")
    assert apply(read_motion(path), np.array([[1.0, 0.0, 0.0]])).tolist() == [[5.0, 7.0, 7.0]]
    path.write_text(json.dumps([[1, 0], [0, 1]]))
    with pytest.raises(InputError, match="four"):
        read_motion(path)
