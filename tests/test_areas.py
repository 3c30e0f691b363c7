"""The draft by areas: drift that was put in comes out, and none is found where there is none."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from commonmap import pipeline
from commonmap.cli_results import match_to_dict, read_drift, write_json
from commonmap.config import Config
from commonmap.errors import InputError
from commonmap.matching.areas import match_areas
from commonmap.matching.drift import (
    Pieces,
    Prior,
    Readings,
    _signed_ranks,
    displace,
    find_drift,
    find_surface,
    fit_prior,
    smooth,
)
from commonmap.report.areas import areas_text, drift_figure, enlargement
from commonmap.report.page import build_page
from commonmap.types import Area, Areas, Cloud, DriftField, Float64s, Match
from matching_scenes import look, make_place, moved, rigid

SIZE = 10.0
TRUTH = rigid(40.0, -25.0, 3.0, 0.7)
CONFIG = Config().with_values(areas={"size": SIZE}, grid={"resolution": 0.5})


def bend(xyz: Float64s) -> Float64s:
    """Return the points as a drifting robot has them: up to a metre off at the rim."""
    u, v = xyz[:, 0] / 24.0, xyz[:, 1] / 24.0
    return xyz + np.column_stack([0.9 * u * u, 0.8 * u * v, 0.4 * v])


def make_pair(*, drift: bool) -> tuple[Float64s, Float64s, Float64s]:
    """Return target, source and where each source point truly is in the target's frame."""
    place = make_place(3, 48.0, n_boxes=14, n_posts=20)
    target = look(place, np.random.default_rng(1), density=30.0)
    true = look(place, np.random.default_rng(2), density=15.0, edge=44.0)
    known = bend(true) if drift else true
    return target, moved(np.linalg.inv(TRUTH), known), true


def rigid_fit(source: Float64s, true: Float64s) -> Match:
    """Return a match that holds the best rigid pose of a source, as a search would."""
    a, b = true.mean(axis=0), source.mean(axis=0)
    U, _, Vt = np.linalg.svd((true - a).T @ (source - b))
    T = np.eye(4)
    T[:3, :3] = U @ Vt
    T[:3, 3] = a - T[:3, :3] @ b
    return Match(True, "accepted", T, 0.99, None, None, 1.0, 500.0, 100.0, (), "evidence")


def errors(T: Float64s | None, source: Float64s, true: Float64s) -> Float64s:
    """Return the distance (N,) of each point from where it truly is."""
    assert T is not None
    return np.asarray(np.linalg.norm(moved(T, source) - true, axis=1))


@pytest.fixture(scope="module")
def bent() -> tuple[Match, Areas, Float64s, Float64s]:
    """Return (match, areas, source, truth) of a draft bent by drift."""
    target, source, true = make_pair(drift=True)
    found = rigid_fit(source, true)
    return found, match_areas(target, source, found, config=CONFIG), source, true


def test_drift_is_taken_off(bent: tuple[Match, Areas, Float64s, Float64s]) -> None:
    found, areas, source, true = bent
    assert areas.drift is not None, areas.reason
    before = errors(found.T_target_source, source, true)
    after = errors(found.T_target_source, areas.drift.apply(source), true)
    assert np.median(before) > 0.15
    assert np.median(after) < 0.09
    assert np.quantile(after, 0.99) < 0.6 * np.quantile(before, 0.99)
    assert areas.gain > 0.01 and areas.gain_z > 3.0


def test_areas_are_listed_with_their_own_poses(
    bent: tuple[Match, Areas, Float64s, Float64s],
) -> None:
    found, areas, _, _ = bent
    assert found.T_target_source is not None
    assert len(areas.items) == len({tuple(np.round(a.centre, 6)) for a in areas.items}) > 15
    searched = [area for area in areas.items if area.T_target_source is not None]
    assert len(searched) > 10
    assert areas.agreeing == np.mean([area.agrees for area in searched])
    assert areas.agreeing > 0.5
    for area in searched:
        assert area.T_target_source is not None
        own = np.linalg.inv(found.T_target_source) @ np.append(area.centre, 1.0)
        apart = np.linalg.norm((area.T_target_source @ own)[:3] - area.centre)
        # another pose is one 3 m or 10 degrees off; at a rim area's middle up to 1 m more
        assert not area.agrees or apart < 4.5


def test_drift_of_an_area_points_to_the_base(
    bent: tuple[Match, Areas, Float64s, Float64s],
) -> None:
    found, areas, source, true = bent
    assert found.T_target_source is not None
    shown = moved(found.T_target_source, source)
    off = []
    for area in areas.items:
        near = np.hypot(*(shown[:, :2] - area.centre[:2]).T) < 1.5
        if area.drift is not None and area.weight > 0.5 and near.any():
            off.append(np.linalg.norm(area.drift - (true - shown)[near].mean(axis=0)))
    assert len(off) > 10
    assert np.median(off) < 0.09


def test_a_straight_draft_is_left_alone() -> None:
    target, _, true = make_pair(drift=False)
    base = find_surface(target)
    own = find_surface(true)
    cells = np.floor(own.xyz[:, :2] / SIZE).astype(int)
    _, area = np.unique(cells[:, 0] * 100 + cells[:, 1], return_inverse=True)
    count = np.bincount(area)
    centre = np.column_stack([np.bincount(area, own.xyz[:, a]) / count for a in range(3)])
    found = find_drift(base, Pieces(own, area, centre), size=SIZE, reach=1.5)
    assert found is not None
    assert not found.supported
    assert np.abs(found.motion[:, :3]).max() < 0.03


def test_readings_without_a_pattern_give_little_drift() -> None:
    kept = []
    for seed in (7, 8, 9):
        centre = np.column_stack([np.indices((7, 7)).reshape(2, -1).T * 10.0, np.zeros(49)])
        alone = np.random.default_rng(seed).normal(0.0, 0.1, (49, 4)) * [1.0, 1.0, 1.0, 0.25]
        readings = Readings(alone, np.tile(np.eye(4) * 1e4, (49, 1, 1)), np.ones(49, bool))
        motion, _ = smooth(readings, centre, centre, fit_prior(readings, centre, 10.0))
        kept.append(motion[:, :3].std() / alone[:, :3].std())
    assert np.mean(kept) < 0.3


def test_a_pattern_in_the_readings_is_kept() -> None:
    centre = np.column_stack([np.indices((7, 7)).reshape(2, -1).T * 10.0, np.zeros(49)])
    pattern = np.zeros((49, 4))
    pattern[:, 0] = 0.01 * centre[:, 0]  # up to 0.6 m
    noise = np.random.default_rng(7).normal(0.0, 0.01, (49, 4))
    readings = Readings(pattern + noise, np.tile(np.eye(4) * 1e4, (49, 1, 1)), np.ones(49, bool))
    motion, _ = smooth(readings, centre, centre, fit_prior(readings, centre, 10.0))
    assert np.abs(motion[:, 0] - pattern[:, 0]).max() < 0.03


def test_an_area_that_contradicts_its_neighbours_counts_less() -> None:
    centre = np.column_stack([np.indices((6, 6)).reshape(2, -1).T * 10.0, np.zeros(36)])
    reading = np.tile([0.2, 0.0, 0.0, 0.0], (36, 1))
    reading += 0.01 * np.cos(np.arange(144)).reshape(36, 4)
    reading[14] = [-2.0, 1.5, 0.0, 0.0]
    readings = Readings(reading, np.tile(np.eye(4) * 1e4, (36, 1, 1)), np.ones(36, bool))
    prior = Prior(reach=30.0, level=0.2, climb=0.1, own=0.02, noise=1.0)
    motion, weight = smooth(readings, centre, centre, prior)
    assert weight[14] < 0.02
    assert np.median(weight) > 0.8
    assert abs(motion[14, 0] - 0.2) < 0.05


def test_an_area_on_a_wall_says_nothing_along_it() -> None:
    rng = np.random.default_rng(4)
    wall = np.column_stack([rng.uniform(0, 80, 9000), np.zeros(9000), rng.uniform(0, 4, 9000)])
    base = find_surface(wall + rng.normal(0, 0.01, (9000, 3)))
    own = find_surface(moved(rigid(0.0, -0.2, 0.0, 0.0), wall[::2]))
    area = np.floor(own.xyz[:, 0].clip(0, 79.9) / 8.0).astype(int)
    centre = np.column_stack([(np.arange(10) + 0.5) * 8, np.zeros(10), np.full(10, 2.0)])
    found = find_drift(base, Pieces(own, area, centre), size=8.0, reach=0.4)
    assert found is not None
    assert np.abs(found.motion[:, 1] - 0.2).max() < 0.05
    information = found.readings.information
    assert (information[:, 0, 0] < 0.05 * information[:, 1, 1]).all()


def test_field_by_hand() -> None:
    motion = np.zeros((2, 2, 4))
    motion[0, :, 0] = 1.0  # x by 1 m at the nodes of x = 5
    motion[1, 1] = [0.0, 0.0, 0.0, 0.1]  # a turn about (15, 25)
    field = DriftField(np.eye(4), np.array([5.0, 15.0]), 10.0, motion)
    points = np.array([[5.0, 15.0, 2.0], [10.0, 15.0, 2.0], [15.0, 25.0, 2.0], [15.0, 20.0, 2.0]])
    moved_by = [[1, 0, 0], [0.5, 0, 0], [0, 0, 0], [0.5 * 0.1 * 5.0, 0, 0]]
    np.testing.assert_allclose(field.apply(points), points + moved_by, atol=1e-12)
    # Beyond the rim the rim holds
    np.testing.assert_allclose(field.apply(np.array([[-90.0, 15.0, 2.0]])), [[-89.0, 15.0, 2.0]])
    # In a frame turned by 90 degrees, x of the grid is y of the source
    turned = DriftField(rigid(0, 0, 0, -math.pi / 2), field.corner, 10.0, motion)
    np.testing.assert_allclose(turned.apply(np.array([[-15.0, 5.0, 2.0]])), [[-15.0, 6.0, 2.0]])


def test_displace_turns_from_x_to_y() -> None:
    got = displace(np.array([[0.0, 0.0, 0.5, 0.1]]), np.array([[2.0, 0.0, 7.0]]))
    np.testing.assert_allclose(got, [[0.0, 0.2, 0.5]])


def test_signed_ranks_by_hand() -> None:
    # ranks 1, 2, 3; all for it: 6 / sqrt(3 * 4 * 7 / 6) = 6 / sqrt(14)
    assert _signed_ranks(np.array([0.1, 0.2, 0.3])) == pytest.approx(6.0 / math.sqrt(14.0))
    assert _signed_ranks(np.array([0.1, 0.2, -0.3])) == pytest.approx(0.0)


def test_areas_too_small_for_the_cells_are_refused() -> None:
    target, source, true = make_pair(drift=False)
    config = CONFIG.with_values(areas={"size": 0.5})
    with pytest.raises(InputError, match=r"areas\.size must be at least 4 cells"):
        match_areas(target, source, rigid_fit(source, true), config=config)


def test_match_json_gives_the_drift_back(
    bent: tuple[Match, Areas, Float64s, Float64s], tmp_path: Path
) -> None:
    found, areas, source, _ = bent
    assert areas.drift is not None
    values = match_to_dict(
        replace(found, areas=areas), config=CONFIG, names=("a", "b"), n_points=(1, 2)
    )
    path = tmp_path / "match.json"
    write_json(path, values)
    read = read_drift(path)
    assert read is not None
    np.testing.assert_array_equal(read.apply(source[:50]), areas.drift.apply(source[:50]))
    assert len(values["areas"]["items"]) == len(areas.items)
    values["areas"]["drift"]["motion"] = [[1, 2], [3, 4]]
    write_json(path, values)
    with pytest.raises(InputError, match="motions"):
        read_drift(path)
    values["areas"] = None
    write_json(path, values)
    assert read_drift(path) is None


def test_the_corrected_draft_is_what_is_merged(monkeypatch: pytest.MonkeyPatch) -> None:
    target, source, true = make_pair(drift=True)
    motion = np.tile([0.0, 0.0, 5.0, 0.0], (2, 2, 1))
    field = DriftField(np.eye(4), np.zeros(2), 10.0, motion)
    areas = Areas(SIZE, (), float("nan"), field, "corrected", 0.1, 0.05, 9.0)
    found = rigid_fit(source, true)
    monkeypatch.setattr(pipeline, "match", lambda *a, **k: found)
    monkeypatch.setattr(pipeline, "match_areas", lambda *a, **k: areas)
    config = CONFIG.with_values(merge={"resolution": 1.0})
    raised = pipeline.run(target, source, config=config).common
    as_is = pipeline.run(target, source, config=Config().with_values(merge={"resolution": 1.0}))
    assert raised is not None and as_is.common is not None
    assert raised.cloud.xyz[:, 2].max() == pytest.approx(
        as_is.common.cloud.xyz[:, 2].max() + 5, abs=1
    )
    origin = np.zeros((4, 3), np.float32)
    cloud = pipeline.correct(Cloud(np.zeros((4, 3)), origin=origin), field)
    assert isinstance(cloud, Cloud) and cloud.origin is not None
    np.testing.assert_allclose(cloud.origin[:, 2], 5.0)


def make_areas() -> Areas:
    """Return three areas: one would move by 0.2 m along x, one has another pose, one no drift."""
    here = Area(
        np.array([5.0, 5.0, 0.0]), np.eye(4), True, 0.95, "accepted: x", 300.0, True,
        np.array([0.2, 0.0, 0.0]), 0.9,
    )  # fmt: skip
    there = Area(
        np.array([15.0, 5.0, 0.0]), rigid(50, 0, 0, 0), True, 0.93, "<b>", 200.0, False, None, 0.0
    )
    also = replace(here, centre=np.array([25.0, 5.0, 0.0]), drift=None)
    return Areas(10.0, (here, there, also), 2 / 3, None, "no correction: too few", 0.1, 0.0, 0.0)


def test_report_draws_the_drift() -> None:
    areas = make_areas()
    assert enlargement(areas) == 50.0  # 0.2 m drawn as 10 m
    assert "2 find the pose of the whole" in areas_text(areas)
    picture = drift_figure(areas)
    assert picture.count('<path class="mark"') == 1
    assert picture.count(">elsewhere<") == 1
    target, source, true = make_pair(drift=False)
    found = replace(rigid_fit(source, true), areas=areas)
    page = build_page(Cloud(target), Cloud(source), found, CONFIG, None, ("a", "b"), (), None)
    assert "The draft by areas" in page
    plain = replace(found, areas=None)
    page = build_page(Cloud(target), Cloud(source), plain, CONFIG, None, ("a", "b"), (), None)
    assert "The draft by areas" not in page


def test_same_bytes_for_any_number_of_threads(tmp_path: Path) -> None:
    code = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "import numpy as np\n"
        "from commonmap.matching.drift import *\n"
        "c = np.column_stack([np.indices((8, 8)).reshape(2, -1).T * 10.0, np.zeros(64)])\n"
        "rng = np.random.default_rng(0)\n"
        "m = np.column_stack([np.sin(c[:, 0] / 30), np.cos(c[:, 1] / 20), c[:, 2], c[:, 2]])\n"
        "m = 0.3 * m + rng.normal(0, 0.02, (64, 4))\n"
        "r = Readings(m, np.tile(np.eye(4) * 1e4, (64, 1, 1)), np.ones(64, bool))\n"
        "p = fit_prior(r, c, 10.0)\n"
        "print(p, smooth(r, c, c, p)[0].tobytes().hex())\n"
    )
    said = [
        subprocess.run(
            [sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, check=True,
            env={**os.environ, "OPENBLAS_NUM_THREADS": n, "OMP_NUM_THREADS": n},
        ).stdout
        for n in ("1", "2")
    ]  # fmt: skip
    assert said[0] == said[1]
    assert "reach=" in said[0]
