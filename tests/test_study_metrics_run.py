"""The study survives the death of a worker and of its client: the same records, written once."""

from __future__ import annotations

import hashlib
import importlib
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from commonmap.cli import main
from commonmap.errors import InputError
from commonmap.study import metrics_run
from commonmap.study.metrics_design import KINDS, plan_study
from commonmap.study.metrics_records import gather, read_records
from commonmap.study.metrics_report import write_report
from commonmap.study.metrics_run import run_study
from commonmap.study.metrics_scores import LABELS

SEED = 3


def make_records(seed: int, index: int) -> list[dict[str, Any]]:
    """Return what a task would, at once: figures drawn from the seed and the index."""
    plan = plan_study(seed)[index]
    rng = np.random.default_rng([seed, index])
    M = len(LABELS)
    return [
        {
            "index": index, "kind": plan.kind, "replicate": plan.replicate, "drift": plan.drift,
            "tilt_deg": plan.tilt_deg, "change": plan.change, "area": k, "size": area.size,
            "cell": area.cell, "heights": area.heights, "overlap": area.overlap,
            "noise": area.noise, "true_overlap": 1.0, "n_poses": 9, "yaw_step_deg": 4.0,
            "xy": rng.uniform(0.0, 4.0, M).round(2).tolist(),
            "yaw_deg": rng.uniform(0.0, 9.0, M).round(1).tolist(),
            "sharpness": rng.uniform(0.0, 9.0, M).round(1).tolist(),
            "margin": [None] * M, "strict_xy": [0.5] * M, "strict_yaw_deg": [1.0] * M,
        }
        for k, area in enumerate(plan.areas)
    ]  # fmt: skip


def dying_records(seed: int, index: int) -> list[dict[str, Any]]:
    """The same, but the first worker that meets place 5 is killed."""
    marker = Path(os.environ["STUDY_MARKER"])
    if index == 5 and not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return make_records(seed, index)


def slow_records(seed: int, index: int) -> list[dict[str, Any]]:
    """The same, slowly enough to be interrupted."""
    time.sleep(0.5)
    return make_records(seed, index)


@pytest.fixture(autouse=True)
def no_times(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metrics_run, "measure_times", lambda: {"evidence": 1.0})


def _digest(folder: Path) -> dict[str, str]:
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in folder.glob("*.json")}


def _run_here(out: Path) -> None:
    """Write all records without a cluster: what the others must equal."""
    folder = metrics_run._open_folder(out, SEED)
    for plan in plan_study(SEED, quick=True):
        path = folder / f"place-{plan.index:04d}.json"
        metrics_run._write_once(path, make_records(SEED, plan.index))


@pytest.fixture
def expected(tmp_path: Path) -> Path:
    _run_here(tmp_path / "expected")
    return tmp_path / "expected"


def test_a_killed_worker_loses_nothing(
    tmp_path: Path, expected: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    marker = tmp_path / "killed"
    monkeypatch.setenv("STUDY_MARKER", str(marker))
    files = run_study(tmp_path / "out", seed=SEED, quick=True, workers=2, task=dying_records)
    assert marker.exists(), "a worker was killed"
    assert all(path.exists() for path in files) and len(files) == 12
    assert _digest(tmp_path / "out/records") == _digest(expected / "records")


def test_a_killed_client_goes_on_where_it_was(tmp_path: Path, expected: Path) -> None:
    out = tmp_path / "out"
    code = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "from pathlib import Path\n"
        "from test_study_metrics_run import slow_records\n"
        "from commonmap.study.metrics_run import run_study\n"
        "if __name__ == '__main__':\n"
        "    run_study(Path(sys.argv[2]), seed=3, quick=True, workers=1, task=slow_records)\n"
    )
    script = tmp_path / "client.py"
    script.write_text(code)
    command = [sys.executable, str(script), str(Path(__file__).parent), str(out)]
    client = subprocess.Popen(command, start_new_session=True)
    deadline = time.monotonic() + 60.0
    while len(_digest(out / "records")) < 3 and time.monotonic() < deadline:
        time.sleep(0.05)
    os.killpg(client.pid, signal.SIGKILL)
    client.wait()
    before = {p: p.stat().st_mtime_ns for p in (out / "records").glob("*.json")}
    assert 3 <= len(before) < 12, "it was killed half-way"

    run_study(out, seed=SEED, quick=True, workers=1, task=make_records)
    assert {p: p.stat().st_mtime_ns for p in before} == before, "no record is written twice"
    assert _digest(out / "records") == _digest(expected / "records")
    summary = write_report(out)
    assert summary.splitlines()[:-1] == write_report(expected).splitlines()[:-1]
    for name in ("metrics.csv", "conditions.csv", "records.jsonl.xz", "success.png"):
        assert (out / name).read_bytes() == (expected / name).read_bytes(), name


def test_the_packed_records_are_the_loose_ones(expected: Path) -> None:
    loose = read_records(expected)
    write_report(expected)
    for path in (expected / "records").glob("*.json"):
        path.unlink()
    assert read_records(expected) == loose


def test_records_of_another_seed_are_not_mixed(expected: Path) -> None:
    with pytest.raises(InputError, match="seed 3"):
        run_study(expected, seed=4, quick=True, task=make_records)


def test_no_records_is_said(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no records"):
        write_report(tmp_path)


def test_a_scheduler_that_does_not_answer_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(metrics_run, "CONNECT_SECONDS", 1)
    with pytest.raises(InputError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9"):
        run_study(tmp_path, seed=1, quick=True, scheduler="tcp://127.0.0.1:9", task=make_records)


def test_a_scheduler_given_by_its_address_does_the_same(tmp_path: Path, expected: Path) -> None:
    distributed: Any = importlib.import_module("distributed")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=2, processes=False, dashboard_address=None
    ) as cluster:
        run_study(
            tmp_path / "out", seed=SEED, quick=True, scheduler=cluster.scheduler_address,
            task=make_records,
        )  # fmt: skip
    assert _digest(tmp_path / "out/records") == _digest(expected / "records")


def test_the_command_reports_what_is_recorded(
    tmp_path: Path,
    expected: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def call(out: Path) -> int:
        monkeypatch.setattr(
            sys, "argv", ["commonmap", "study", "metrics", "-o", str(out), "--report-only"]
        )
        with pytest.raises(SystemExit) as ended:
            main()
        return int(ended.value.code or 0)

    assert call(expected) == 0
    assert "48 pairs of 12 places" in capsys.readouterr().out
    assert call(tmp_path / "none") == 2
    assert "holds no records" in capsys.readouterr().err


def test_right_is_within_two_cells_and_one_and_a_half_yaw_steps() -> None:
    record = make_records(SEED, 0)[0] | {"cell": 0.5, "yaw_step_deg": 4.0}
    n = len(LABELS) - 5
    record["xy"] = [1.0, 1.01, 1.0, 1.0, None, *[0.0] * n]
    record["yaw_deg"] = [6.0, 6.0, 6.1, 0.0, None, *[0.0] * n]
    right = gather([record]).right[0]
    assert right[:5].tolist() == [True, False, False, True, False] and right[5:].all()


def test_levels_appear_equally_often_in_each_kind_and_replicate() -> None:
    plans = plan_study(1)
    assert [p.index for p in plans] == list(range(288))
    for replicate in range(4):
        for kind in KINDS:
            own = [p for p in plans if p.kind == kind and p.replicate == replicate]
            areas = [a for p in own for a in p.areas]
            assert len(own) == 12 and len(set(areas)) == 48, "every combination once"
            assert len({(p.drift, p.tilt_deg, p.change) for p in own}) == 12
            assert set(Counter(a.overlap for a in areas).values()) == {12}
            assert set(Counter((a.size, a.cell) for a in areas).values()) == {16}
    assert plans != plan_study(2) and plans == plan_study(1)
