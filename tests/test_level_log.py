"""Up, in maps whose frame is that of a lidar mounted anyhow."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from commonmap.frames import apply, from_rotation, invert
from commonmap.mapping.level_log import find_turn_axis, level_log
from commonmap.sim.missions import Area, drive, fly
from commonmap.sim.scanning import RayCaster, place_points, scan_world, sensor_positions
from commonmap.sim.vlp16 import VLP16
from commonmap.sim.worlds import build_world
from commonmap.types import Cloud, Float64s, Trajectory


def mapped(kind: str, robot: str, pitch: float) -> tuple[Cloud, Trajectory, Float64s]:
    """Return a map in the frame of the first pose, the way in it, and the true up of that frame."""
    rng = np.random.default_rng(5)
    world = build_world(kind, rng)
    area = Area(0.0, 0.0, 50.0, 50.0)
    if robot == "ugv":
        mission = drive(world, area, rng, max_length=60.0)
    else:
        mission = fly(world, area, rng, pitch=pitch)
    sensor = mission.sensor
    stamps = sensor.time[0] + np.arange(0.0, np.ptp(sensor.time) - 0.2, 0.6)
    returns = scan_world(
        RayCaster(world), sensor, VLP16, stamps, rng=rng, azimuth_decimation=4
    )  # fmt: skip
    T_map_world = invert(sensor.T_map_sensor[0])
    cloud = Cloud(
        apply(T_map_world, place_points(sensor, returns.time, returns.xyz)),
        origin=apply(T_map_world, sensor_positions(sensor, returns.time)).astype(np.float32),
    )
    known = Trajectory(sensor.time, T_map_world @ sensor.T_map_sensor)
    return cloud, known, T_map_world[:3, 2]


@pytest.mark.parametrize(
    ("kind", "robot", "pitch_deg"),
    [
        ("paper", "uav", 90.0),
        ("city", "uav", 45.0),
        ("village", "ugv", 0.0),
        ("field", "uav", 90.0),  # nothing upright: the turns of the drone alone
    ],
)
def test_up_is_found_within_half_a_degree(kind: str, robot: str, pitch_deg: float) -> None:
    cloud, known, up = mapped(kind, robot, math.radians(pitch_deg))
    found = level_log(cloud, known)
    found_up = found.T_level_map[2, :3]
    assert math.degrees(math.acos(min(1.0, float(found_up @ up)))) < 0.5
    assert math.degrees(found.tilt) == pytest.approx(pitch_deg, abs=8.0)
    assert ("nothing upright" in found.reason) == (kind == "field")
    assert found.T_level_map[:3, 3].tolist() == [0.0, 0.0, 0.0]


def turning(mount: Float64s, span: float) -> Trajectory:
    """Return poses that turn by `span` about a vertical z, of a sensor mounted by a rotation."""
    yaw = np.linspace(0.0, span, 50)
    R = Rotation.from_euler("z", yaw[:, None]).as_matrix() @ mount
    T = np.array([from_rotation(mount.T @ r) for r in R])
    return Trajectory(np.arange(50.0), T)


def test_the_axis_of_turning_points_away_from_the_ground() -> None:
    mount = Rotation.from_euler("xyz", [20.0, 70.0, -35.0], degrees=True).as_matrix()
    up = mount.T[:, 2]
    rng = np.random.default_rng(1)
    below = np.column_stack([rng.uniform(-9, 9, (500, 2)), np.full(500, -4.0)]) @ mount
    cloud = Cloud(below, origin=np.zeros((500, 3), np.float32))
    axis = find_turn_axis(cloud, turning(mount, 3.0))
    assert axis == pytest.approx(up, abs=1e-9)
    flipped = Cloud(-below, origin=np.zeros((500, 3), np.float32))
    assert find_turn_axis(flipped, turning(mount, 3.0)) == pytest.approx(-up, abs=1e-9)


def test_who_went_straight_has_turned_about_nothing() -> None:
    cloud = Cloud(np.ones((10, 3)), origin=np.zeros((10, 3), np.float32))
    assert find_turn_axis(cloud, turning(np.eye(3), 0.2)) is None
    assert find_turn_axis(cloud, turning(np.eye(3), 2.0)) is not None


def test_stems_on_a_steep_slope_stand_upright() -> None:
    """A ground robot turned about the slope's normal, 14 deg from the vertical."""
    rng = np.random.default_rng(2)
    R_slope = Rotation.from_euler("x", 14.0, degrees=True).as_matrix()
    plane = np.column_stack([rng.uniform(-25, 25, (60_000, 2)), np.zeros(60_000)]) @ R_slope.T
    foot = np.column_stack([rng.uniform(-24, 24, (120, 2)), np.zeros(120)]) @ R_slope.T
    stem = np.repeat(foot, 400, axis=0)
    stem[:, 2] += rng.uniform(0.0, 7.0, len(stem))
    stem[:, :2] += 0.1 * rng.standard_normal((len(stem), 2))
    xyz = np.concatenate([plane, stem])
    # the map's frame is that of the sensor at the start: its z is the slope's normal
    yaw = np.linspace(0.0, 5.0, 200)
    R = R_slope @ Rotation.from_euler("z", yaw[:, None]).as_matrix()
    origin = np.zeros((len(xyz), 3), np.float32) + (R_slope @ [0.0, 0.0, 0.8]).astype(np.float32)
    cloud = Cloud(xyz @ R_slope, origin=origin @ R_slope.astype(np.float32))
    known = Trajectory(np.arange(200.0), np.array([from_rotation(R_slope.T @ r) for r in R]))
    axis = find_turn_axis(cloud, known)
    assert axis == pytest.approx(np.array([0.0, 0.0, 1.0]), abs=1e-6)
    found = level_log(cloud, known)
    up = R_slope.T[:, 2]
    assert math.degrees(math.acos(min(1.0, float(found.T_level_map[2, :3] @ up)))) < 0.5
    assert "upright things agree" in found.reason
