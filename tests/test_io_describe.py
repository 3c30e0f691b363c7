"""`describe`: the numbers of maps whose spacing and density are known."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from commonmap.io import describe as describe_file
from commonmap.io import write_cloud
from commonmap.io.describe import covered_density, nearest_distance
from commonmap.types import Cloud


def lattice(n: int, step: float) -> np.ndarray:
    i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    return np.stack([i * step, j * step, np.zeros_like(i)], axis=-1).reshape(-1, 3).astype(float)


def test_a_cloud(tmp_path: Path) -> None:
    path = tmp_path / "map.laz"
    xyz = lattice(40, 0.5) + np.array([470_600.0, 3_810_200.0, 5.0])
    write_cloud(path, Cloud(xyz=xyz, crs="EPSG:32612", time=np.linspace(3, 7, len(xyz))))
    what = describe_file(path)
    assert what["points"] == 1600
    assert what["format"] == "LAZ 1.4, point format 6"
    assert what["min"] == pytest.approx([470_600.0, 3_810_200.0, 5.0])
    assert what["extent"] == pytest.approx([19.5, 19.5, 0.0])
    assert what["spacing"] == pytest.approx(0.5)
    assert what["density"] == pytest.approx(4.0, rel=0.15)
    assert what["crs"] == "WGS 84 / UTM zone 12N"
    assert what["time_span"] == pytest.approx([3.0, 7.0])
    assert (what["colour"], what["intensity"], what["origin"]) == (False, False, False)
    json.dumps(what)


def test_an_octree(tmp_path: Path) -> None:
    octomap = pytest.importorskip("commonmap.io.octomap")
    from commonmap.types import Leaves

    leaves = Leaves(
        resolution=0.5,
        keys=np.array([[32768, 32768, 32768], [32772, 32768, 32768]], dtype=np.uint16),
        depth=np.array([16, 14], dtype=np.uint8),  # edges 0.5 and 2 m
        log_odds=np.array([0.85, -0.4], dtype=np.float32),
    )
    octomap.write_octree(tmp_path / "map.ot", leaves)
    what = describe_file(tmp_path / "map.ot")
    assert (what["kind"], what["format"]) == ("octree", "OctoMap .ot (full)")
    assert (what["leaves"], what["occupied"], what["free"]) == (2, 1, 1)
    assert what["resolution"] == 0.5
    assert (what["min"], what["max"]) == ([0.0, 0.0, 0.0], [4.0, 2.0, 2.0])
    json.dumps(what)


def test_a_map_too_large_to_search_whole_has_the_spacing_of_its_middle() -> None:
    assert nearest_distance(lattice(900, 0.25)) == pytest.approx(0.25)


def test_spacing_of_points_that_coincide_or_are_alone() -> None:
    assert nearest_distance(np.array([[0.0, 0, 0]] * 5 + [[3.0, 4, 0]])) == pytest.approx(5.0)
    assert math.isnan(nearest_distance(np.array([[1.0, 2, 3]])))
    assert math.isnan(nearest_distance(np.array([[1.0, 2, 3]] * 3)))


def test_density_counts_the_ground_that_is_covered() -> None:
    rng = np.random.default_rng(0)
    xyz = rng.uniform(0, 100, (40_000, 3))
    assert covered_density(xyz) == pytest.approx(4.0, rel=0.1)
    ell = xyz[(xyz[:, 0] < 20) | (xyz[:, 1] < 20)]
    assert covered_density(ell) == pytest.approx(4.0, rel=0.2)
    assert math.isnan(covered_density(np.zeros((5, 3))))
