"""The whole way on simulated robots: raw logs, odometry, levelling, match, merge, and the truth.

The logs are written as files, in the formats of sensors, and read back as a user's would be.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from commonmap.config import Config
from commonmap.frames import difference, invert
from commonmap.io.logs import iter_scans
from commonmap.odometry import TrajectoryErrors, compare
from commonmap.pipeline import Result, run
from commonmap.pipeline_logs import RobotMap, map_log
from commonmap.sim.missions import Mission
from commonmap.sim.pairs import plan_missions
from commonmap.sim.recording import MARGIN, fit_truth, record, write_logs
from commonmap.sim.vlp16 import VLP16
from commonmap.sim.world import World
from commonmap.types import Float64s, Progress, Scan, no_progress

SECONDS = 60.0
"""Length of the demo's logs, at most."""

BASE_LOG, DRAFT_LOG = "log.pcap", "log.mcap"


@dataclass(frozen=True, eq=False)
class Demo:
    """A simulated job and how far its answer is from the truth.

    base, draft: the maps of the two robots. T_target_source: the truth, (4, 4): with odometry that
    drifts, the best rigid motion over the points of both maps. errors: of the two trajectories.
    map_errors: metres, RMS distance of the points of each map from their true places after the best
    rigid motion. metres: distance between answer and truth in the middle of the draft; radians:
    angle between them. Both None where the match was refused.
    """

    base: RobotMap
    draft: RobotMap
    T_target_source: Float64s
    errors: tuple[TrajectoryErrors, TrajectoryErrors]
    map_errors: tuple[float, float]
    result: Result
    metres: float | None
    radians: float | None


def run_demo(
    folder: Path,
    *,
    rng: np.random.Generator,
    scene: str = "paper",
    seconds: float = SECONDS,
    method: str = "loam",
    config: Config | None = None,
    progress: Progress = no_progress,
) -> Demo:
    """Return what the job makes of two simulated robots' raw logs, and its error.

    folder: where the logs are written, `drone/log.pcap` and `ground_robot/log.mcap`.
    scene: a name of `commonmap.sim.worlds.WORLDS`. method: a row of `ODOMETRY`.
    """
    # 1. a drone over a place and a ground robot in it, and what their lidars record
    progress("simulate two robots")
    plan = plan_missions(scene, rng=rng, margin=MARGIN)
    paths = (folder / "drone" / BASE_LOG, folder / "ground_robot" / DRAFT_LOG)
    missions = (plan.flight, plan.ground)
    for path, mission, world in zip(paths, missions, (plan.world, plan.source_world), strict=True):
        path.parent.mkdir()
        write_log(path, mission, world, int(rng.integers(2**31)), seconds, progress)

    # 2. from raw logs to the common map; the job is not told the truth
    base, draft = (map_file(path, method=method, progress=progress) for path in paths)
    result = run(base.cloud, draft.cloud, config=config, progress=progress)

    # 3. how far from the truth: the ways, the maps, the answer in the middle of the draft
    errors = [compare(r.trajectory, m.sensor) for r, m in zip((base, draft), missions, strict=True)]
    truths = [
        fit_truth(r.cloud, r.trajectory, m.sensor)
        for r, m in zip((base, draft), missions, strict=True)
    ]
    T_target_source = invert(truths[0][0]) @ truths[1][0]
    metres = radians = None
    if result.match.T_target_source is not None:
        centre = draft.cloud.xyz.mean(axis=0)
        metres, radians = difference(result.match.T_target_source, T_target_source, centre)
    return Demo(
        base, draft, T_target_source, (errors[0], errors[1]), (truths[0][1], truths[1][1]),
        result, metres, radians,
    )  # fmt: skip


def write_log(
    path: Path, mission: Mission, world: World, seed: int, seconds: float, progress: Progress
) -> None:
    """Write what a VLP-16 records on a mission as the raw log that the path's suffix names."""

    def turns() -> Iterator[Scan]:
        rng, step = np.random.default_rng(seed), f"record {path.parent.name}"
        return record(mission, world, VLP16, rng=rng, seconds=seconds, step=step, progress=progress)

    kind = path.suffix.removeprefix(".")
    write_logs(path.parent, turns, mission.sensor, VLP16, [kind], seconds=seconds)


def map_file(path: Path, *, method: str, progress: Progress) -> RobotMap:
    """Return the level map of a log."""
    read = 0.0

    def hear(step: str, share: float = 0.0) -> None:
        nonlocal read
        read = share

    return map_log(
        lambda: iter_scans(path, progress=hear), method=method, share=lambda: read,
        name=f"{path.parent.name}/{path.name}", progress=progress,
    )  # fmt: skip
