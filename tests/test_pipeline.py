"""The jobs from Python, and the names of the package."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import commonmap
from commonmap import pipeline
from commonmap.config import Config
from commonmap.errors import EmptyMapError, InputError
from commonmap.types import Cloud, Match


def test_every_public_name_is_there() -> None:
    for name in commonmap.__all__:
        assert getattr(commonmap, name) is not None
    assert commonmap.match is pipeline.match_maps
    assert set(commonmap.__all__) <= set(dir(commonmap))
    with pytest.raises(AttributeError, match="no attribute 'mtach'"):
        commonmap.mtach  # noqa: B018


def test_importing_the_package_costs_nothing() -> None:
    code = "import commonmap, sys; print('numpy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


@pytest.mark.parametrize(
    "values", [np.zeros(3), np.zeros((4, 2)), [["a", "b", "c"]], [[1, 2], [3]], None]
)
def test_arrays_that_are_no_maps(values: Any) -> None:
    with pytest.raises(InputError):
        commonmap.match(values, np.zeros((10, 3)))


def test_a_map_without_points() -> None:
    with pytest.raises(EmptyMapError, match="target"):
        commonmap.match(np.zeros((0, 3)), np.zeros((10, 3)))


def test_unknown_metric_is_told_before_any_work(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipeline, "match", lambda *a, **k: pytest.fail("too late"))
    config = Config.from_dict({"search": {"metric": "klm"}})
    with pytest.raises(InputError, match="'klm' came"):
        commonmap.match(np.zeros((9, 3)), np.zeros((9, 3)), config=config)


def test_run_merges_only_what_is_accepted(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    xyz = np.column_stack([rng.uniform(-5, 5, (2000, 2)), rng.uniform(0, 0.1, 2000)])
    ready = Match(
        True, "accepted: it fits", np.eye(4), 0.9, None, None, 1.0, 1.0, 0.1, (), "evidence"
    )
    steps: list[str] = []

    def tell(step: str, share: float = 0.0) -> None:
        steps.append(step)

    monkeypatch.setattr(pipeline, "match", lambda *a, **k: ready)
    result = pipeline.run(xyz, Cloud(xyz), progress=tell)
    assert result.common is not None and len(result.common.cloud.xyz) == 4000
    assert {"match", "merge"} <= set(result.match.timings)
    assert "common octree" in steps
    refused = replace(ready, accepted=False, T_target_source=None)
    monkeypatch.setattr(pipeline, "match", lambda *a, **k: refused)
    assert pipeline.run(xyz, xyz).common is None


def test_maps_that_share_no_voxel_are_merged_with_a_warning(
    caplog: pytest.LogCaptureFixture,
) -> None:
    yard = np.random.default_rng(3).uniform(0, 8, (4000, 3)) * [1.0, 1.0, 0.1]
    near, far = np.eye(4), np.eye(4)
    far[0, 3] = 50.0
    pipeline.merge_maps(yard, yard, near)
    assert "seen by both" not in caplog.text
    pipeline.merge_maps(yard, yard, far)
    assert "no voxel of the common map was seen by both" in caplog.text
