"""From turns to a level map: recovery on simulated robots, trouble, known poses."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from commonmap import pipeline, pipeline_logs
from commonmap.demo import run_demo
from commonmap.errors import InputError
from commonmap.frames import angle, from_xyz_yaw, invert
from commonmap.io.logs.poses import interpolate
from commonmap.odometry import Odometry, ScanHealth, compare, estimate, find_sound_part
from commonmap.pipeline_logs import describe_robot, map_log
from commonmap.sim.missions import Area, Mission, drive, fly
from commonmap.sim.recording import fit_truth, record
from commonmap.sim.vlp16 import VLP16
from commonmap.sim.worlds import build_world
from commonmap.types import Cloud, Match, Scan, Trajectory


@cache
def recorded(robot: str, seconds: float) -> tuple[tuple[Scan, ...], Mission]:
    """Return the first turns of a robot in the paper's place, and its mission."""
    rng = np.random.default_rng(8)
    world = build_world("paper", rng)
    area = Area(0.0, 0.0, 40.0, 40.0)
    mission = drive(world, area, rng) if robot == "ugv" else fly(world, area, rng, speed=6.0)
    return tuple(record(mission, world, VLP16, rng=rng, seconds=seconds)), mission


@pytest.mark.parametrize(("robot", "seconds"), [("ugv", 8.0), ("uav", 8.0)])
def test_a_log_becomes_a_level_map_from_the_start(robot: str, seconds: float) -> None:
    scans, mission = recorded(robot, seconds)
    told: list[tuple[str, float]] = []
    read = 0

    def turns() -> Iterator[Scan]:
        nonlocal read
        for read, scan in enumerate(scans, 1):  # noqa: B007
            yield scan

    def tell(step: str, share: float = 0.0) -> None:
        told.append((step, share))

    made = map_log(turns, max_points=200_000, share=lambda: read / len(scans), progress=tell)
    T_world_map, off = fit_truth(made.cloud, made.trajectory, mission.sensor)
    assert math.degrees(math.acos(min(1.0, T_world_map[2, 2]))) < 0.6
    assert off < 0.15
    assert compare(made.trajectory, mission.sensor).ape < 0.06
    assert made.trajectory.T_map_sensor[0, :3, 3].tolist() == [0.0, 0.0, 0.0]
    # points lie where the world is: 20 m and more below a drone, around a ground robot
    low, high = np.quantile(made.cloud.xyz[:, 2], [0.1, 0.9])
    assert (-30.0 < low < high < -10.0) if robot == "uav" else (-2.0 < low < high < 6.0)
    assert made.cloud.origin is not None and 10_000 < len(made.cloud.xyz) <= 200_000
    start = np.linalg.norm(made.cloud.origin, axis=1).min()
    assert start < 0.5
    assert (made.n_turns, made.n_left_out, made.troubles) == (len(scans), 0, ())
    shares = [share for step, share in told if step == "odometry of the log"]
    assert shares == [0.0, 0.25, 0.5, 0.75, 1.0]
    assert [step for step, share in told if share == 0.0] == [
        "odometry of the log", "map of the log", "level the map of the log",
    ]  # fmt: skip


def test_same_turns_give_the_same_bytes() -> None:
    scans, _ = recorded("ugv", 8.0)
    one, two = (map_log(lambda: iter(scans[:15])) for _ in range(2))
    assert one.cloud.xyz.tobytes() == two.cloud.xyz.tobytes()
    assert one.trajectory.T_map_sensor.tobytes() == two.trajectory.T_map_sensor.tobytes()


def test_known_poses_keep_their_frame_and_what_they_do_not_cover_is_left_out() -> None:
    scans, mission = recorded("ugv", 8.0)
    true = mission.sensor
    part = Trajectory(true.time[:41], true.T_map_sensor[:41])  # 0.8 s
    made = map_log(lambda: iter(scans[:20]), method="poses", poses=part)
    assert np.array_equal(made.trajectory.T_map_sensor, part.T_map_sensor)
    assert (made.n_turns, made.n_left_out) == (20, 12)
    assert "12 turns" in " ".join(made.notes) and "12 of 20" in " ".join(made.notes)
    assert np.array_equal(made.levelling.T_level_map, np.eye(4))
    T_world_map, off = fit_truth(made.cloud, made.trajectory, true)
    assert T_world_map == pytest.approx(np.eye(4), abs=1e-6) and off < 1e-3
    late = Trajectory(true.time[:41] + 500.0, true.T_map_sensor[:41])
    with pytest.raises(InputError, match="must cover the scans"):
        map_log(lambda: iter(scans[:20]), method="poses", poses=late)


@pytest.fixture
def troubled(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return a way to have odometry tell trouble at some turns."""

    def put(*, lost: range, open_: range) -> None:
        def told(scans: Iterator[Scan], **options: Any) -> Odometry:
            answer = estimate(scans, **options)
            ahead = np.eye(6)[:1]  # along x of the first sensor frame
            health = tuple(
                replace(h, lost=k in lost, degenerate=ahead if k in open_ else h.degenerate)
                for k, h in enumerate(answer.health)
            )
            return replace(answer, health=health)

        monkeypatch.setattr(pipeline_logs, "estimate", told)

    return put


def test_turns_that_are_lost_are_not_in_the_map_and_trouble_is_told(troubled: Any) -> None:
    scans, _ = recorded("uav", 8.0)
    troubled(lost=range(6, 9), open_=range(20, 30))
    made = map_log(lambda: iter(scans[:40]))
    assert made.n_left_out == 3
    assert made.cloud.time is not None
    of_turn = np.floor(made.cloud.time * 10 + 1e-6).astype(int)
    present = set(np.unique(of_turn).tolist())
    assert present == set(range(40)) - {6, 7, 8}
    lost, open_ = made.troubles
    assert (lost.kind, lost.n, open_.kind, open_.n) == ("lost", 3, "degenerate", 10)
    # the lidar looks straight down: its x axis is the map's -z
    assert open_.directions[0, :3] == pytest.approx([0, 0, -1], abs=0.15)
    assert any("lost from 0.6" in note for note in made.notes)
    assert any("does not hold the position along (" in note for note in made.notes)
    values = describe_robot(made)
    assert (values["turns_lost"], values["turns_degenerate"]) == (3, 10)
    assert [t["kind"] for t in values["troubles"]] == ["lost", "degenerate"]
    assert values["troubles"][0]["begin"] == pytest.approx(0.65, abs=0.03)


def test_of_a_log_that_was_lost_for_long_the_longest_part_is_mapped(troubled: Any) -> None:
    scans, _ = recorded("ugv", 8.0)
    troubled(lost=range(12, 18), open_=range(0))
    made = map_log(lambda: iter(scans[:40]))
    assert made.sound == range(18, 40)
    assert made.n_left_out == 18
    assert made.cloud.time is not None
    assert made.cloud.time.min() >= scans[18].time.min()
    assert any("longest part" in note and "22 of 40 turns" in note for note in made.notes)
    moments = [h.moment for h in made.odometry.health]
    assert describe_robot(made)["mapped"] == [moments[18], moments[39]]


def test_the_sound_part_in_numbers() -> None:
    none = np.zeros((0, 6))

    def part(pattern: str) -> range:
        return find_sound_part(
            [ScanHealth(0.1 * k, 99, 0.9, 0.02, none, c == "x") for k, c in enumerate(pattern)]
        )

    assert part("........") == range(0, 8)
    assert part("...xxxx...") == range(0, 10)  # too short a guess to part them
    assert part("...xxxxx....") == range(8, 12)
    assert part("xx....xxxxx...") == range(2, 6)
    assert part("...x...xxxxx..") == range(0, 7)
    assert part("xxxxxx") == range(0)


def test_a_log_that_is_mostly_lost_gives_no_map(troubled: Any) -> None:
    scans, _ = recorded("ugv", 8.0)
    troubled(lost=range(4, 20), open_=range(0))
    with pytest.raises(InputError, match="lost in 16 of 20 turns"):
        map_log(lambda: iter(scans[:20]), name="x.pcap")


def test_the_way_is_told() -> None:
    scans, mission = recorded("ugv", 8.0)
    made = map_log(lambda: iter(scans[:40]))
    T = interpolate(mission.sensor, made.trajectory.time)
    step = invert(T[:-1]) @ T[1:]
    assert made.way == pytest.approx(np.linalg.norm(step[:, :3, 3], axis=1).sum(), rel=0.02)


def test_the_demo_tells_the_error_of_the_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wrong = from_xyz_yaw(3.0, 0.0, 0.0, 0.5)

    def answer(target: Cloud, source: Cloud, **options: Any) -> Match:
        return Match(
            True, "accepted: so it is said", wrong, 0.9, None, None, 0.9, 2.0, 1.0, (), "evidence"
        )

    monkeypatch.setattr(pipeline, "match", answer)
    shown = run_demo(tmp_path, rng=np.random.default_rng(2), seconds=2.0)
    assert (tmp_path / "drone" / "log.pcap").exists()
    assert (tmp_path / "ground_robot" / "log.mcap").exists()
    assert shown.base.n_turns == shown.draft.n_turns == 20
    assert max(e.ape for e in shown.errors) < 0.05 and max(shown.map_errors) < 0.2
    centre = shown.draft.cloud.xyz.mean(axis=0)
    assert shown.metres is not None and shown.radians is not None
    moved = (wrong - shown.T_target_source) @ [*centre, 1.0]
    assert shown.metres == pytest.approx(float(np.linalg.norm(moved)))
    assert shown.radians == pytest.approx(angle(invert(wrong) @ shown.T_target_source), abs=1e-6)
    # the truth takes the ground robot's ground onto the drone's, some 20 m below where it began
    ground = np.quantile(shown.draft.cloud.xyz[:, 2], 0.05)
    below = (shown.T_target_source @ [0.0, 0.0, ground, 1.0])[2]
    assert -40.0 < below < -15.0
