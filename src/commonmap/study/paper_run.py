"""The source paper's experiment on one page: two raw logs, one common map, and the scores.

M. C. Akay, A. Aybakan, H. Temeltas, Map Matching Performance under Various Similarity Metrics for
Heterogeneous Robot Teams. Its figures are drawn from the record that `run_experiment` returns.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from commonmap.demo import BASE_LOG, DRAFT_LOG, map_file, write_log
from commonmap.errors import EmptyMapError, InputError
from commonmap.frames import difference, invert
from commonmap.io.logs import iter_scans
from commonmap.mapping.octree import Octree
from commonmap.mapping.points import points_of
from commonmap.matching.refine import lift, refine
from commonmap.matching.search import Peaks
from commonmap.matching.search_metric import search_metric
from commonmap.merging.products import CommonMap
from commonmap.odometry import PlaceableTurns, TrajectoryErrors, compare, georeference
from commonmap.pipeline import match_maps, merge_maps
from commonmap.pipeline_logs import RobotMap
from commonmap.sim.pairs import Plan, plan_missions
from commonmap.sim.recording import MARGIN, fit_truth
from commonmap.study.paper_maps import CELL, Area, HeightMaps, cut_areas, make_height_maps
from commonmap.study.readings import (
    METRICS,
    READINGS,
    Best,
    Columns,
    list_columns,
    score_pose,
    search_readings,
)
from commonmap.types import Float64s, GridMap, Leaves, Match, Progress, no_progress

SECONDS = 60.0
"""Length of the logs, at most."""

VOXEL = 0.15
"""Metres, edge of the octrees' voxels."""

TURNS = 120
"""Turns of each log that enter its octree, evenly spaced: a turn sees what its neighbours see."""

FLOOR = 0.05
"""Metres to which heights of zero are raised in the search."""

AREAS_READ = 4
"""Areas of which every reading is scored at every pose: those with the most objects."""


@dataclass(frozen=True, eq=False)
class Found:
    """The best pose of a metric. pose: x, y, yaw of the columns' centre in the prepared target.

    score: at that pose; at_truth: at the true pose; metres, radians: from the truth; rival: the
    best score of a pose elsewhere, NaN where there is none; seconds: of the search, one core's.
    """

    pose: Float64s
    score: float
    at_truth: float
    rival: float
    metres: float
    radians: float
    seconds: float

    @property
    def right(self) -> bool:
        """Whether the pose is the true one, within 1 m and 5 degrees."""
        return self.metres < 1.0 and self.radians < np.radians(5.0)


@dataclass(frozen=True, eq=False)
class AreaReadings:
    """Every reading of the formulas on one area: scores (R, 3) at the true pose, and the best."""

    area: int
    at_truth: Float64s
    best: Best
    metres: Float64s
    radians: Float64s


@dataclass(frozen=True, eq=False)
class Experiment:
    """All that the study knows of one run.

    plan: the scene and the true ways. base, draft: the maps of the drone and the ground robot, by
    LOAM. errors: of the two trajectories. map_errors: metres, of the two maps' points (RMS).
    T_target_source: the truth for the two maps. octrees: of both. maps: height maps under 1 m.
    areas: of the draft; found: per area, per metric. whole: per metric, of the whole draft.
    readings: of some areas. T_best: (4, 4) the pose by K, in the two maps' own frames, z from their
    grounds; off: metres and radians from the truth. T_merged: refined on the points in all six
    degrees of freedom; off_merged: the same of it. common: the map merged so. product: this
    software's own answer, and how far it is off, None where it refused. seconds: per step.
    """

    seed: int
    plan: Plan
    base: RobotMap
    draft: RobotMap
    errors: tuple[TrajectoryErrors, TrajectoryErrors]
    map_errors: tuple[float, float]
    T_target_source: Float64s
    octrees: tuple[Leaves, Leaves]
    maps: HeightMaps
    areas: tuple[Area, ...]
    found: tuple[dict[str, Found], ...]
    whole: dict[str, Found]
    readings: tuple[AreaReadings, ...]
    T_best: Float64s
    off: tuple[float, float]
    T_merged: Float64s
    off_merged: tuple[float, float]
    common: CommonMap
    product: Match
    product_off: tuple[float, float] | None
    seconds: dict[str, float]


def run_experiment(
    seed: int,
    *,
    seconds: float = SECONDS,
    size: float | None = None,
    areas_read: int = AREAS_READ,
    progress: Progress = no_progress,
) -> Experiment:
    """Return the paper's experiment on the scene of a seed.

    seconds: length of the two raw logs, at most. size: metres, of the scene; its own unless given.
    areas_read: areas of which every reading is scored at every pose.
    """
    if not 5.0 <= seconds <= 600.0:
        raise InputError(f"the logs must last between 5 and 600 s; {seconds:g} came")
    rng = np.random.default_rng(seed)
    spent: dict[str, float] = {}

    # 1. a scene, and what a VLP-16 on each robot records in it: raw logs
    with _timed(spent, "simulate"), tempfile.TemporaryDirectory() as folder:
        progress("simulate two robots")
        plan = plan_missions("paper", rng=rng, margin=MARGIN, size=size)
        missions, worlds = (plan.flight, plan.ground), (plan.world, plan.source_world)
        paths = (Path(folder) / "drone" / BASE_LOG, Path(folder) / "ground_robot" / DRAFT_LOG)
        for path, mission, world in zip(paths, missions, worlds, strict=True):
            path.parent.mkdir()
            write_log(path, mission, world, int(rng.integers(2**31)), seconds, progress)
        # 2. georeferencing by LOAM, which is not told the truth: a cloud of each robot
        with _timed(spent, "odometry"):
            base, draft = (map_file(path, method="loam", progress=progress) for path in paths)
        # 3. octrees of the turns, every ray of them
        with _timed(spent, "octrees"):
            octrees = [
                make_octree(path, robot, progress=progress)
                for path, robot in zip(paths, (base, draft), strict=True)
            ]
    spent["simulate"] -= spent["odometry"] + spent["octrees"]
    robots = (base, draft)
    errors = [compare(r.trajectory, m.sensor) for r, m in zip(robots, missions, strict=True)]
    truths = [
        fit_truth(r.cloud, r.trajectory, m.sensor) for r, m in zip(robots, missions, strict=True)
    ]
    T_target_source = invert(truths[0][0]) @ truths[1][0]

    # 4. of the occupied voxels height maps under 1 m
    with _timed(spent, "height maps"):
        progress("height maps under 1 m")
        points = [points_of(leaves, "map") for leaves in octrees]
        maps = make_height_maps(points[0], points[1], T_target_source)

    # 5. the three metrics at every pose: of each 10 m area of the draft, and of the whole draft
    areas = cut_areas(maps.grids[1])
    with _timed(spent, "search"):
        found = [search_area(maps, area.grid, progress=progress) for area in areas]
        whole = search_area(maps, maps.grids[1], progress=progress)

    # 6. every reading of the formulas, on the areas in which most stands
    with _timed(spent, "readings"):
        readings = [
            read_area(maps, areas[n], n, progress=progress) for n in busiest(areas, areas_read)
        ]

    # 7. the common map with the best pose by K, refined on the points
    with _timed(spent, "merge"):
        T_best = best_motion(maps, whole["k"].pose)
        refined = refine(base.cloud.xyz, draft.cloud.xyz, T_best, cell=CELL)
        T_merged = refined.T_target_source
        common = merge_maps(base.cloud, draft.cloud, T_merged, progress=progress)
    centre = draft.cloud.xyz.mean(axis=0)
    off, off_merged = (difference(T, T_target_source, centre) for T in (T_best, T_merged))

    # 8. for comparison, what this software answers by itself
    with _timed(spent, "match by evidence"):
        product = match_maps(base.cloud, draft.cloud, progress=progress)
    product_off = None
    if product.T_target_source is not None:
        product_off = difference(product.T_target_source, T_target_source, centre)
    return Experiment(
        seed, plan, base, draft, (errors[0], errors[1]), (truths[0][1], truths[1][1]),
        T_target_source, (octrees[0], octrees[1]), maps, areas, tuple(found), whole,
        tuple(readings), T_best, off, T_merged, off_merged, common, product,
        product_off, spent,
    )  # fmt: skip


def make_octree(path: Path, robot: RobotMap, *, progress: Progress = no_progress) -> Leaves:
    """Return the octree of a log's turns, in the frame of its map."""
    every = max(1, robot.n_turns // TURNS)
    turns = PlaceableTurns(robot.odometry, iter_scans(path), every=every)
    tree = Octree(VOXEL)
    for number, cloud in enumerate(georeference(turns, robot.trajectory)):
        assert cloud.origin is not None
        tree.insert(cloud.origin, cloud.xyz)
        step = f"octree of {path.parent.name}/{path.name}"
        progress(step, min(1.0, number * every / robot.n_turns))
    leaves = tree.leaves()
    if not leaves.occupied.any():
        raise EmptyMapError(f"no turn of {path.name} gives the octree an occupied voxel")
    return leaves


def search_area(
    maps: HeightMaps, grid: GridMap, *, progress: Progress = no_progress
) -> dict[str, Found]:
    """Return the best of all poses of a part of the draft by each of the paper's metrics.

    grid: on half cells. Scored over the overlap, all known cells, as `commonmap match --metric`.
    """
    columns = list_columns(grid)
    row = next(n for n, r in enumerate(READINGS) if (r.cells, r.floor) == ("all", FLOOR))
    at_truth, _ = score_pose(maps.lattice, columns, maps.true_pose(columns))
    answers = {}
    for number, name in enumerate(METRICS):
        start = time.process_time()
        peaks = search_metric(
            maps.grids[0], grid, metric=name, normalise="overlap", floor=FLOOR, min_overlap=0.5,
            workers=1, progress=progress,
        )  # fmt: skip
        seconds = time.process_time() - start
        pose = _place(peaks, columns)
        metres, radians = maps.error(columns, pose)
        answers[name] = Found(
            pose, -float(peaks.score[0]), float(at_truth[row, number]), _rival(peaks), metres,
            radians, seconds,
        )  # fmt: skip
    return answers


def read_area(
    maps: HeightMaps, area: Area, number: int, *, progress: Progress = no_progress
) -> AreaReadings:
    """Return every reading of the formulas on one area, at the true pose and at the best."""
    at_truth, _ = score_pose(maps.lattice, area.columns, maps.true_pose(area.columns))
    best = search_readings(maps.lattice, area.columns, progress=progress)
    errors = np.array(
        [[maps.error(area.columns, pose) for pose in poses] for poses in best.pose]
    )  # (R, 3, 2)
    return AreaReadings(number, at_truth, best, errors[..., 0], errors[..., 1])


def busiest(areas: tuple[Area, ...], n: int) -> list[int]:
    """Return the numbers of the n areas with the greatest share of objects, in their order."""
    order = np.argsort([-area.objects for area in areas], kind="stable")[:n]
    return sorted(int(i) for i in order)


def best_motion(maps: HeightMaps, pose: Float64s) -> Float64s:
    """Return T_target_source (4, 4) of the maps' own frames at a pose of the whole draft.

    The pose is first made exact: K falls at ever smaller steps, down to an eighth of a cell. z
    follows from the two grounds in closed form.
    """
    columns = list_columns(maps.grids[1])
    exact = climb(maps, columns, pose)
    planar = maps.T_target_source(columns, exact)
    T = lift(planar, maps.target.ground, maps.source.ground)
    return np.asarray(invert(maps.target.T_prepared_map) @ T @ maps.source.T_prepared_map)


def climb(maps: HeightMaps, columns: Columns, pose: Float64s) -> Float64s:
    """Return the pose near `pose` at which K over the overlap is lowest, to an eighth of a cell."""
    row = next(n for n, r in enumerate(READINGS) if (r.cells, r.floor) == ("all", FLOOR))

    def k_at(p: Float64s) -> float:
        return float(np.nan_to_num(score_pose(maps.lattice, columns, p)[0][row, 2], nan=np.inf))

    step = 2.0 * CELL
    best, lowest = pose, k_at(pose)
    while step > 0.12 * CELL:
        turn = step / columns.radius
        moves = [
            np.array([x, y, w]) * [step, step, turn]
            for x in (-1, 0, 1) for y in (-1, 0, 1) for w in (-1, 0, 1)
        ]  # fmt: skip
        scores = [k_at(best + move) for move in moves]
        least = int(np.argmin(scores))
        if scores[least] < lowest:
            best, lowest = best + moves[least], scores[least]
        else:
            step *= 0.5
    return best


def _place(peaks: Peaks, columns: Columns) -> Float64s:
    """Return x, y, yaw of the columns' centre at the best peak."""
    T = peaks.T_target_source(0)
    xy = T[:2, :2] @ columns.centre + T[:2, 3]
    return np.append(xy, np.arctan2(T[1, 0], T[0, 0]))


def _rival(peaks: Peaks) -> float:
    """Return the best score of a pose that is not the best one's neighbour."""
    apart = np.hypot(*(peaks.pose[:, :2] - peaks.pose[0, :2]).T) > 2.0
    turned = np.abs(np.angle(np.exp(1j * (peaks.pose[:, 2] - peaks.pose[0, 2])))) > np.radians(10)
    elsewhere = peaks.score[apart | turned]
    return -float(elsewhere.max()) if len(elsewhere) else float("nan")


@contextmanager
def _timed(spent: dict[str, float], name: str) -> Iterator[None]:
    """Keep the seconds of a step."""
    start = time.perf_counter()
    yield
    spent[name] = time.perf_counter() - start
