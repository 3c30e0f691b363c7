"""How the robots move: a ground robot on the relief between the things, a drone above them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from commonmap.errors import InputError
from commonmap.frames import from_rotation, invert
from commonmap.sim.routes import STEP, free_space, headings, plan_route, resample
from commonmap.sim.world import World
from commonmap.types import Bools, Float64s, Trajectory

POSE_RATE = 50.0
"""True poses a second."""


@dataclass(frozen=True, eq=False)
class Mission:
    """A robot's true way through a world.

    robot: "ugv" or "uav". sensor: true poses of the lidar in the world, T_world_sensor.
    T_body_sensor: (4, 4), how the lidar is mounted (x forward, y left, z up on both).
    distance: (M,) metres travelled by the body at each pose.
    """

    robot: str
    sensor: Trajectory
    T_body_sensor: Float64s
    distance: Float64s

    @property
    def body(self) -> Trajectory:
        """True poses of the robot's body in the world."""
        return Trajectory(self.sensor.time, self.sensor.T_map_sensor @ invert(self.T_body_sensor))


@dataclass(frozen=True)
class Area:
    """A turned rectangle of a world. x, y: its middle; length along `yaw`; width across it."""

    x: float
    y: float
    length: float
    width: float
    yaw: float = 0.0

    def holds(self, xy: Float64s) -> Bools:
        """Return which of (N, 2) points lie inside."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        dx, dy = xy[:, 0] - self.x, xy[:, 1] - self.y
        along, across = np.abs(c * dx + s * dy), np.abs(c * dy - s * dx)
        return np.asarray((along <= self.length / 2) & (across <= self.width / 2))


def mount(*, x: float = 0.0, z: float = 0.0, pitch: float = 0.0) -> Float64s:
    """Return T_body_sensor of a lidar shifted by x, z and pitched down by `pitch` radians."""
    return from_rotation(Rotation.from_euler("y", pitch).as_matrix(), [x, 0.0, z])


# ---------------------------------------------------------------- ground robot


def drive(
    world: World,
    area: Area,
    rng: np.random.Generator,
    *,
    spacing: float = 9.0,
    max_length: float | None = None,
    speed: float = 1.2,
    mount_height: float = 0.8,
    radius: float = 0.5,
    start_time: float = 0.0,
) -> Mission:
    """Return a drive of a ground robot through an area, between the things that stand there.

    The robot visits random places about `spacing` metres apart, follows the relief (height, roll
    and pitch from its four wheels) and slows down in turns.

    speed: m/s. mount_height: metres from the ground to the lidar. radius: metres, of the robot.
    max_length: metres, where the drive ends at the latest.
    """
    clearance, origin, cell = free_space(world)
    path = plan_route(clearance, origin, cell, area, rng, spacing, radius, max_length)
    heading, time = headings(path, speed)
    return _ride(world, path, heading, time + start_time, mount_height, rng)


def _ride(
    world: World, path: Float64s, heading: Float64s, time: Float64s, mount_height: float,
    rng: np.random.Generator,
) -> Mission:  # fmt: skip
    """Return the mission of a robot whose four wheels follow the ground along a path."""
    clock = np.arange(time[0], time[-1], 1.0 / POSE_RATE)
    x, y = (np.interp(clock, time, path[:, k]) for k in range(2))
    yaw = np.interp(clock, time, heading)
    c, s = np.cos(yaw), np.sin(yaw)
    wheel = []
    for along in (0.35, -0.35):
        for across in (0.3, -0.3):
            at = np.stack([x + along * c - across * s, y + along * s + across * c], axis=1)
            wheel.append(world.height(at))
    z = np.stack(wheel)
    soft = 0.12 * POSE_RATE  # tyres and springs: about 0.12 s
    pitch = -np.arctan((z[0] + z[1] - z[2] - z[3]) / 2 / 0.7)
    roll = np.arctan((z[0] + z[2] - z[1] - z[3]) / 2 / 0.6)
    roll, pitch, mean = (gaussian_filter1d(a, soft) for a in (roll, pitch, z.mean(axis=0)))
    shake = np.radians(0.15) * gaussian_filter1d(rng.standard_normal((2, len(clock))), 2.0) * 2.6
    R = Rotation.from_euler("ZYX", np.stack([yaw, pitch + shake[0], roll + shake[1]], axis=1))
    T_world_body = _stack(R.as_matrix(), np.stack([x, y, mean], axis=1))
    T_body_sensor = mount(z=mount_height)
    sensor = Trajectory(clock, T_world_body @ T_body_sensor)
    return Mission("ugv", sensor, T_body_sensor, _distance(T_world_body))


# ---------------------------------------------------------------- drone


def fly(
    world: World,
    area: Area,
    rng: np.random.Generator,
    *,
    height: float = 20.0,
    pitch: float = np.pi / 2,
    row_spacing: float | None = None,
    speed: float = 4.0,
    sway: float = 0.03,
    start_time: float = 0.0,
) -> Mission:
    """Return the flight of a drone over an area in rows, there and back.

    height: metres above the middle ground of the area, more where something stands taller.
    pitch: radians that the lidar looks down; at pi/2 its scan plane lies across the flight.
    row_spacing: metres between rows; the height unless given.
    sway: radians, standard deviation of roll and pitch.
    """
    spacing = height if row_spacing is None else row_spacing
    n_rows = max(2, int(np.ceil(area.width / spacing)))
    across = (np.arange(n_rows) - (n_rows - 1) / 2) * area.width / n_rows
    ends = np.array([-area.length / 2, area.length / 2])
    corners = []
    for k, v in enumerate(across):
        corners += [[u, v] for u in (ends if k % 2 == 0 else ends[::-1])]
    c, s = np.cos(area.yaw), np.sin(area.yaw)
    turned = np.array(corners) @ np.array([[c, s], [-s, c]]) + [area.x, area.y]
    path = resample(turned, STEP)
    path = resample(gaussian_filter1d(path, 2.0 / STEP, axis=0, mode="nearest"), STEP)
    heading, time = headings(path, speed, max_turn=0.8, smooth=2.0)
    clock = np.arange(0.0, time[-1], 1.0 / POSE_RATE)
    x, y = (np.interp(clock, time, path[:, k]) for k in range(2))
    yaw = np.interp(clock, time, heading)
    z = flight_level(world, area, height)
    roll, tip = sway * _sway(clock, rng), sway * _sway(clock, rng)
    R = Rotation.from_euler("ZYX", np.stack([yaw + 0.5 * sway * _sway(clock, rng), tip, roll], 1))
    drift = 0.25 * np.stack([_sway(clock, rng) for _ in range(3)], axis=1)
    T_world_body = _stack(R.as_matrix(), np.stack([x, y, np.full_like(x, z)], axis=1) + drift)
    T_body_sensor = mount(z=-0.15, pitch=pitch)
    sensor = Trajectory(clock + start_time, T_world_body @ T_body_sensor)
    return Mission("uav", sensor, T_body_sensor, _distance(T_world_body))


def flight_level(world: World, area: Area, height: float) -> float:
    """Return the altitude of a flight: `height` above the middle ground, 3 m above all things."""
    xy = world.vertices[:, :2].astype(np.float64)
    below = area.holds(xy)
    if not below.any():
        raise InputError("the drone's area lies outside the world")
    nodes = slice(0, world.terrain.z.size)  # the vertices of the ground come first
    ground = float(np.median(world.vertices[nodes, 2][below[nodes]]))
    return max(ground + height, float(world.vertices[below, 2].max()) + 3.0)


def _sway(clock: Float64s, rng: np.random.Generator) -> Float64s:
    """Return a smooth oscillation of standard deviation about 1 over a clock."""
    frequency, phase = rng.uniform(0.1, 0.7, 5), rng.uniform(0.0, 2 * np.pi, 5)
    waves = np.sin(2 * np.pi * frequency * clock[:, None] + phase)
    return np.asarray(waves.sum(axis=1) / np.sqrt(2.5))


def _stack(R: Float64s, t: Float64s) -> Float64s:
    """Return motions (M, 4, 4) of rotations (M, 3, 3) and translations (M, 3)."""
    T = np.zeros((len(R), 4, 4))
    T[:, :3, :3], T[:, :3, 3], T[:, 3, 3] = R, t, 1.0
    return T


def _distance(T_world_body: Float64s) -> Float64s:
    """Return the metres travelled at each pose, (M,)."""
    steps = np.linalg.norm(np.diff(T_world_body[:, :3, 3], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])
