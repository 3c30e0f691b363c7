"""Odometry on simulated drives and flights, on a real log, and on bad input."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from commonmap.errors import InputError, MissingExtraError
from commonmap.frames import angle, invert
from commonmap.odometry import ODOMETRY, LoamOptions, Odometry, estimate, georeference
from commonmap.odometry.loam import Loam
from commonmap.odometry.records import ScanHealth
from commonmap.odometry.table import describe_health
from commonmap.sim.missions import Area, drive, fly
from commonmap.sim.scanning import RayCaster, place_points, scan_world, split_scans, turn_stamps
from commonmap.sim.vlp16 import find_lidar
from commonmap.sim.worlds import build_world
from commonmap.types import Float64s, Scan, Trajectory

REAL = Path(__file__).parent.parent.parent / "shared" / "data" / "lidar-log" / "scans"


@cache
def make_log(
    robot: str, n: int = 40, lidar: str = "vlp16", pitch: float = np.pi / 2, kind: str = "paper"
) -> tuple[tuple[Scan, ...], Trajectory]:
    """Return turns of a robot from its start on, and its true poses."""
    rng = np.random.default_rng(4)
    world = build_world(kind, rng)
    area = Area(0.0, 0.0, 40.0, 40.0)
    if robot == "ugv":
        mission = drive(world, area, rng, max_length=20.0)
    else:
        mission = fly(world, area, rng, pitch=pitch)
    model = find_lidar(lidar)
    stamps = turn_stamps(mission.sensor, model)[:n]
    returns = scan_world(RayCaster(world), mission.sensor, model, stamps, rng=rng)
    return tuple(split_scans(returns, stamps)), mission.sensor


def true_at(sensor: Trajectory, time: Float64s) -> Float64s:
    """Return the true poses (M, 4, 4) at some times, relative to the first."""
    R = Rotation.from_matrix(sensor.T_map_sensor[:, :3, :3]).as_quat()
    T = np.tile(np.eye(4), (len(time), 1, 1))
    for m, t in enumerate(time):
        k = int(np.clip(np.searchsorted(sensor.time, t) - 1, 0, len(R) - 2))
        w = (t - sensor.time[k]) / (sensor.time[k + 1] - sensor.time[k])
        sign = 1.0 if R[k] @ R[k + 1] > 0 else -1.0
        T[m, :3, :3] = Rotation.from_quat((1 - w) * R[k] + w * sign * R[k + 1]).as_matrix()
        a, b = sensor.T_map_sensor[k, :3, 3], sensor.T_map_sensor[k + 1, :3, 3]
        T[m, :3, 3] = (1 - w) * a + w * b
    return np.asarray(invert(T[0]) @ T)


def end_error(answer: Odometry, sensor: Trajectory) -> tuple[float, float, float]:
    """Return metres and degrees that the last pose is off, and the metres gone."""
    T_true = true_at(sensor, answer.trajectory.time)
    T = invert(T_true[-1]) @ answer.trajectory.T_map_sensor[-1]
    way = np.linalg.norm(np.diff(T_true[:, :3, 3], axis=0), axis=1).sum()
    return float(np.linalg.norm(T[:3, 3])), float(np.degrees(angle(T))), float(way)


@pytest.mark.parametrize(
    ("robot", "lidar", "pitch", "n"),
    [
        ("ugv", "vlp16", 0.0, 40),
        ("uav", "vlp16", np.pi / 2, 40),
        ("uav", "vlp16", np.pi / 4, 40),
        ("uav", "hdl32", np.pi / 2, 15),
        ("ugv", "os1-128", 0.0, 6),
    ],
)
def test_the_pose_is_recovered(robot: str, lidar: str, pitch: float, n: int) -> None:
    scans, sensor = make_log(robot, n, lidar, pitch)
    answer = estimate(scans)
    metres, degrees, way = end_error(answer, sensor)
    assert metres < max(0.01 * way, 0.03)
    assert degrees < 0.25
    assert answer.n_lost == 0
    assert len(answer.health) == len(answer.trajectory.time) == n
    assert answer.trajectory.T_map_sensor[0] == pytest.approx(np.eye(4))


def test_same_input_gives_the_same_bytes_whatever_the_source() -> None:
    scans, _ = make_log("ugv")
    one, two = estimate(scans[:10]), estimate(iter(scans[:10]))
    a, b = one.trajectory.T_map_sensor, two.trajectory.T_map_sensor
    assert a.tobytes() == b.tobytes()


def test_the_order_of_points_in_a_scan_does_not_matter() -> None:
    scans, _ = make_log("ugv")
    order = [np.random.default_rng(1).permutation(len(s.xyz)) for s in scans[:6]]
    mixed = [
        Scan(s.xyz[o], s.time[o], s.ring[o], s.intensity[o], s.stamp)
        for s, o in zip(scans[:6], order, strict=True)
    ]
    a, b = estimate(scans[:6]).trajectory.T_map_sensor, estimate(mixed).trajectory.T_map_sensor
    assert a == pytest.approx(b, abs=1e-9)


def test_an_error_of_speed_dies_away() -> None:
    """The trap of deskewing: a wrong speed must not come back turn after turn."""
    scans, sensor = make_log("uav")
    loam = Loam()
    for scan in scans[:12]:
        loam.add(scan)
    loam._rate = loam._rate + np.array([1.5, -1.5, 1.5, 0.0, 0.0, 0.0])
    loam._deskew_rate_last = loam._rate
    for scan in scans[12:26]:
        loam.add(scan)
    T_true = true_at(sensor, np.array(loam.moments))
    steps = invert(np.array(loam.poses)[:-1]) @ np.array(loam.poses)[1:]
    error = np.linalg.norm((invert(invert(T_true[:-1]) @ T_true[1:]) @ steps)[:, :3, 3], axis=1)
    assert error[15:].max() < 0.05
    assert error[15:].mean() < 2.0 * error[4:11].mean() + 0.01


def test_the_cloud_lies_where_the_world_is() -> None:
    scans, sensor = make_log("uav")
    answer = estimate(scans)
    T_world_map = _world(sensor, answer.trajectory.time[0])
    n = 0
    for scan, cloud in zip(scans, georeference(scans, answer.trajectory), strict=True):
        true = place_points(sensor, scan.time, scan.xyz)
        placed = cloud.xyz @ T_world_map[:3, :3].T + T_world_map[:3, 3]
        assert np.linalg.norm(placed - true, axis=1).max() < 0.4
        assert np.median(np.linalg.norm(placed - true, axis=1)) < 0.12
        assert cloud.time is not None and np.array_equal(cloud.time, scan.time)
        assert cloud.origin is not None
        reach = np.linalg.norm(cloud.xyz - cloud.origin, axis=1)
        assert reach == pytest.approx(np.linalg.norm(scan.xyz, axis=1), abs=1e-3)
        n += len(cloud.xyz)
    assert n == sum(len(scan.xyz) for scan in scans)


def _world(sensor: Trajectory, moment: float) -> Float64s:
    """Return T_world_map of an odometry whose first pose is of `moment`."""
    first = true_at(sensor, np.array([sensor.time[0], moment]))[1]
    return np.asarray(sensor.T_map_sensor[0] @ first)


def test_georeferencing_in_numbers() -> None:
    T = np.tile(np.eye(4), (2, 1, 1))
    T[1, 0, 3] = 2.0  # 2 m along x in a second
    zero = np.zeros(3, np.float32)
    xyz = np.array([[1, 0, 0], [1, 0, 0], [np.nan, 0, 0]], np.float32)
    scan = Scan(xyz, np.array([0.25, 1.5, 0.5]), zero.astype(np.uint16), zero, 0.25)
    (cloud,) = georeference([scan], Trajectory(np.array([0.0, 1.0]), T))
    assert cloud.xyz == pytest.approx(np.array([[1.5, 0, 0], [4.0, 0, 0]]))
    assert cloud.origin == pytest.approx(np.array([[0.5, 0, 0], [3.0, 0, 0]]))
    late = Scan(xyz[:1], np.array([9.0]), scan.ring[:1], zero[:1], 9.0)
    with pytest.raises(InputError, match="outside the trajectory"):
        list(georeference([late], Trajectory(np.array([0.0, 1.0]), T)))


def test_known_poses_replace_odometry() -> None:
    scans, sensor = make_log("ugv")
    answer = estimate(scans[:5], method="poses", poses=sensor)
    assert answer.trajectory.T_map_sensor is not None
    cloud = next(georeference(scans[3:4], answer.trajectory))
    true = place_points(sensor, scans[3].time, scans[3].xyz)
    assert cloud.xyz == pytest.approx(true, abs=2e-3)
    early = Trajectory(sensor.time - 1000.0, sensor.T_map_sensor)
    with pytest.raises(InputError, match="must cover the scans"):
        estimate(scans[:5], method="poses", poses=early)
    with pytest.raises(InputError, match="needs known poses"):
        estimate(scans[:5], method="poses")
    with pytest.raises(InputError, match="does not take known poses"):
        estimate(scans[:5], poses=sensor)


def without_times(robot: str, *, deskewed: bool) -> tuple[list[Scan], list[Float64s], Trajectory]:
    """Return turns whose points all have their stamp, where the points truly are (world frame),
    and the true poses."""
    scans, sensor = make_log(robot)
    bare, places = [], []
    for scan in scans[:15]:
        place = place_points(sensor, scan.time, scan.xyz)
        xyz = scan.xyz
        if deskewed:
            T = invert(_world(sensor, scan.stamp))
            xyz = (place @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
        bare.append(replace(scan, xyz=xyz, time=np.full(len(xyz), scan.stamp)))
        places.append(place)
    return bare, places, sensor


@pytest.mark.parametrize("robot", ["ugv", "uav"])
@pytest.mark.parametrize("deskewed", [False, True])
def test_turns_that_were_deskewed_are_not_deskewed_again(robot: str, deskewed: bool) -> None:
    scans, places, sensor = without_times(robot, deskewed=deskewed)
    answer = estimate(scans)
    assert answer.deskewed is deskewed
    T = _world(sensor, answer.trajectory.time[0])
    # the first turns, before errors of odometry add up
    taken = answer.as_taken(scans[:5])
    clouds = list(georeference(taken, answer.trajectory))
    for place, cloud in zip(places, clouds, strict=False):
        off = np.linalg.norm(cloud.xyz @ T[:3, :3].T + T[:3, 3] - place, axis=1)
        # placed the other way: 0.10 m and 0.29 m at least
        assert np.quantile(off, 0.95) < (0.06 if robot == "ugv" else 0.15)


def test_a_stand_at_first_does_not_settle_whether_turns_were_deskewed() -> None:
    scans, _, _ = without_times("uav", deskewed=True)
    still = [
        replace(scans[0], time=scans[0].time - 0.1 * k, stamp=scans[0].stamp - 0.1 * k)
        for k in range(12, 0, -1)
    ]
    assert estimate([*still, *scans]).deskewed


def test_what_the_user_says_of_deskewing_is_not_tried() -> None:
    scans, _, _ = without_times("uav", deskewed=True)
    said = estimate(scans[:3], options=LoamOptions(deskew=True))
    assert not said.deskewed
    assert not any("taken as" in note for note in said.notes)


def test_known_poses_place_turns_without_times_by_their_stamp() -> None:
    scans, places, sensor = without_times("ugv", deskewed=True)
    answer = estimate(scans, method="poses", poses=sensor)
    assert answer.deskewed
    cloud = next(georeference(answer.as_taken(scans[3:4]), answer.trajectory))
    assert cloud.xyz == pytest.approx(places[3], abs=2e-3)


# ---------------------------------------------------------------- trouble


def flat_field(rng: np.random.Generator, k: int) -> Scan:
    """Return a turn over an endless plane, 1.5 m below, seen from a sensor that goes 1 m/s."""
    ring = np.repeat(np.arange(16), 900)
    a = np.tile(np.linspace(0, 2 * np.pi, 900, endpoint=False), 16)
    down = np.radians(5.0 + 1.5 * ring)
    r = 1.5 / np.sin(down) + 0.01 * rng.standard_normal(len(a))
    flat = np.cos(down)
    xyz = r[:, None] * np.stack([flat * np.cos(a), -flat * np.sin(a), -np.sin(down)], axis=1)
    zero = np.zeros(len(a), np.float32)
    time = 0.1 * k + 0.1 * a / (2 * np.pi)
    return Scan(xyz.astype(np.float32), time, ring.astype(np.uint16), zero, 0.1 * k)


def test_on_an_endless_plane_the_open_directions_are_told() -> None:
    rng = np.random.default_rng(2)
    answer = estimate([flat_field(rng, k) for k in range(12)])
    assert answer.n_degenerate >= 8
    worst = max(answer.health, key=lambda h: len(h.degenerate))
    assert len(worst.degenerate) == 3  # x, y, yaw
    held = np.delete(np.arange(6), [0, 1, 5])
    assert np.abs(worst.degenerate[:, held]).max() < 0.3
    assert any("does not hold" in note for note in answer.notes)
    # z, roll and pitch are held
    T = answer.trajectory.T_map_sensor[-1]
    assert abs(T[2, 3]) < 0.05
    assert np.degrees(np.arccos(T[2, 2])) < 0.3


def test_an_empty_turn_and_a_gap_are_survived_and_told() -> None:
    scans, sensor = make_log("ugv")
    none = np.zeros(0, np.float32)
    empty = Scan(none.reshape(0, 3), np.zeros(0), none.astype(np.uint16), none, scans[10].stamp)
    answer = estimate([*scans[:10], empty, *scans[11:16], *scans[19:24]])
    assert [k for k, h in enumerate(answer.health) if h.lost] == [10]
    assert any("lost from" in note for note in answer.notes)
    assert end_error(answer, sensor)[0] < 0.05


def test_a_robot_that_is_carried_away_is_told() -> None:
    scans, _ = make_log("ugv")
    other, _ = make_log("ugv", 8, kind="city")
    shift = scans[15].stamp - other[0].stamp
    carried = [Scan(s.xyz, s.time + shift, s.ring, s.intensity, s.stamp + shift) for s in other]
    answer = estimate([*scans[:15], *carried])
    assert answer.health[15].lost
    assert not any(h.lost for h in answer.health[:15])


def test_notes_tell_each_stretch_once() -> None:
    open_ = np.array([[1.0, 0, 0, 0, 0, 0]])
    none = np.zeros((0, 6))
    health = [
        ScanHealth(0.1 * k, 100, 0.8, 0.02, open_ if 3 <= k < 6 else none, k == 8)
        for k in range(10)
    ]
    notes = describe_health(health)
    assert len(notes) == 2
    assert "from 0.30 to 0.50 s (3 turns)" in notes[0]
    assert "the position along (1.00, 0.00, 0.00)" in notes[0]
    assert notes[1] == "odometry is lost from 0.80 to 0.80 s (1 turns)"


def test_bad_input_is_told_in_one_sentence() -> None:
    scans, _ = make_log("ugv")
    with pytest.raises(InputError, match="at least one scan"):
        estimate([])
    with pytest.raises(InputError, match="in order of time"):
        estimate([scans[1], scans[0]])
    with pytest.raises(InputError, match="one of loam, poses, kiss-icp"):
        estimate(scans[:2], method="slam")
    bad = Scan(scans[0].xyz, scans[0].time[:5], scans[0].ring, scans[0].intensity, 0.0)
    with pytest.raises(InputError, match=r"\(N,\) times"):
        estimate([bad])
    nan = Scan(
        scans[0].xyz, np.full(len(scans[0].xyz), np.nan), scans[0].ring, scans[0].intensity, 0.0
    )
    with pytest.raises(InputError, match="finite times"):
        estimate([nan])


def test_a_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("commonmap.odometry.table.find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match="pip install kiss-icp"):
        estimate([], method="kiss-icp")
    assert ODOMETRY["loam"].available() == ""


# ---------------------------------------------------------------- a real log


def real_scans() -> Iterator[Scan]:
    """Yield the real turns as read: no rings, no times."""
    for k, path in enumerate(sorted(REAL.glob("*.bin"))):
        points = np.fromfile(path, "<f4").reshape(-1, 4)
        n = len(points)
        yield Scan(
            points[:, :3].copy(), np.full(n, 0.1 * k), np.zeros(n, np.uint16),
            points[:, 3].copy(), 0.1 * k,
        )  # fmt: skip


@pytest.mark.skipif(not REAL.is_dir(), reason="needs ../shared/data/lidar-log")
def test_a_real_log_ends_where_kiss_icp_ends() -> None:
    answer = estimate(real_scans())
    T_kiss = np.eye(4)  # KISS-ICP 1.3, voxel 0.5 m, no deskewing: its last pose
    T_kiss[:3, 3] = [11.74293, 0.42729, 0.06525]
    T_kiss[:3, :3] = Rotation.from_rotvec([0.00009, 0.00124, 0.05225]).as_matrix()
    T = invert(T_kiss) @ answer.trajectory.T_map_sensor[-1]
    assert np.linalg.norm(T[:3, 3]) < 0.1
    assert np.degrees(angle(T)) < 0.3
    assert any("64 rings" in note for note in answer.notes)
    assert any("time per point" in note for note in answer.notes)
    assert answer.n_lost == 0


def test_lengths_follow_from_the_first_turn() -> None:
    scans, _ = make_log("ugv")
    loam = Loam(LoamOptions(voxel=0.7))
    loam.add(scans[0])
    assert loam.voxel == 0.7
    small = Scan(scans[0].xyz * 100, scans[0].time, scans[0].ring, scans[0].intensity, 0.0)
    big = Loam()
    big.add(small)
    assert big.voxel == 1.0
