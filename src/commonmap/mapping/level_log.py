"""Which way is up in the map of a log, whose frame is that of the sensor at the start.

A lidar may be mounted anyhow: a drone's looks straight down. Two things tell the vertical. The
attitude: a robot that turns does so about the vertical, a drone exactly but for its sway, a ground
robot about the normal of the ground it stands on. And what stands upright (`mapping.level`), which
is not misled by a slope. The attitude says it roughly, upright things exactly; where there are none
the attitude stands. Where the log has an IMU, what it felt takes the place of the attitude.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from commonmap.frames import from_rotation, rotation_between
from commonmap.io.logs.imu import GRAVITY, Acceleration
from commonmap.io.logs.poses import interpolate
from commonmap.mapping.level import Levelling, find_level
from commonmap.mapping.points import sample
from commonmap.types import Cloud, Float64s, Trajectory

LEAST_GAP = 0.1
"""The mean rotation must keep one direction by so much better than the next: a robot that went
straight ahead has turned about nothing."""

NEAREST = 0.05
"""Share of the points, the nearest, that tell on which side of the sensor the ground is."""


AROUND = math.radians(10.0)
"""How far from the axis of turning upright things are looked for again."""

CLEAR = math.radians(0.5)
"""There the parts of the map must agree this well (standard error)."""


def level_log(
    cloud: Cloud, trajectory: Trajectory, acceleration: Acceleration | None = None
) -> Levelling:
    """Return the rotation about the origin that makes a log's map level.

    cloud: of the map, with ray origins. trajectory: of the sensor in the same frame.
    acceleration: what an IMU felt, in the axes of the sensor, where there is one.
    """
    up = None if acceleration is None else find_felt_up(trajectory, acceleration)
    by_imu = up is not None
    if up is None:
        up = find_turn_axis(cloud, trajectory)
    if up is None:
        return find_level(cloud.xyz)
    R_rough = rotation_between(up, (0.0, 0.0, 1.0))
    found = find_level(cloud.xyz @ R_rough.T)
    if not math.isfinite(found.sigma) and not by_imu:
        R_rough, found = _look_around(cloud, R_rough, found)
    R = found.T_level_map[:3, :3] @ R_rough
    tilt = math.acos(float(np.clip(R[2, 2], -1.0, 1.0)))
    if math.isfinite(found.sigma):
        how = f"upright things agree within {math.degrees(found.sigma):.2f} deg"
    elif by_imu:
        how = "nothing upright was found; up is what the IMU felt"
    else:
        how = "nothing upright was found; up is the axis about which the sensor turned"
    reason = f"turned by {math.degrees(tilt):.2f} deg: {how}"
    return Levelling(from_rotation(R), tilt, found.sigma, reason)


def _look_around(cloud: Cloud, R_rough: Float64s, found: Levelling) -> tuple[Float64s, Levelling]:
    """Return rough rotation and levelling where upright things agree best, if they do so clearly.

    A ground robot on a steep slope turned about the slope's normal, farther from the vertical than
    `find_level` looks: it is asked again from directions around that normal.
    """
    best = (R_rough, found)
    for turn in np.arange(6) * math.pi / 3.0:
        axis = AROUND * np.array([math.cos(turn), math.sin(turn), 0.0])
        R = Rotation.from_rotvec(axis).as_matrix() @ R_rough
        again = find_level(cloud.xyz @ R.T)
        if again.sigma < min(best[1].sigma, CLEAR):
            best = (R, again)
    return best


def find_felt_up(trajectory: Trajectory, acceleration: Acceleration) -> Float64s | None:
    """Return the direction (3,) of the map against gravity, as an IMU felt it, or None.

    What it felt, turned into the map by the pose of each moment and averaged, is gravity's opposite
    plus the change of speed over the time, which the trajectory knows. A constant error of the
    accelerometer averages out over a robot that turns. None where there are fewer than ten
    moments, or their mean is no gravity.
    """
    first, last = float(trajectory.time[0]), float(trajectory.time[-1])
    inside = (acceleration.time >= first) & (acceleration.time <= last)
    if inside.sum() < 10 or len(trajectory.time) < 4:
        return None
    time, felt = acceleration.time[inside], acceleration.felt[inside]
    R = interpolate(trajectory, time)[:, :3, :3]
    t, at = trajectory.T_map_sensor[:, :3, 3], trajectory.time
    gain = (t[-1] - t[-2]) / (at[-1] - at[-2]) - (t[1] - t[0]) / (at[1] - at[0])
    up = np.einsum("nij,nj->ni", R, felt).mean(axis=0) - gain / (last - first)
    length = float(np.linalg.norm(up))
    return up / length if 0.5 * GRAVITY < length < 1.5 * GRAVITY else None


def find_turn_axis(cloud: Cloud, trajectory: Trajectory) -> Float64s | None:
    """Return the direction (3,) of the map about which the sensor turned, away from the ground.

    The mean of all rotations shrinks every direction but the axis: its first singular vectors are
    the axis in the map and in the sensor. None where the robot did not turn enough to tell.
    """
    mean = trajectory.T_map_sensor[:, :3, :3].mean(axis=0)
    U, size, _ = np.linalg.svd(mean)
    if size[0] - size[1] < LEAST_GAP:
        return None
    axis: Float64s = U[:, 0]
    return axis if _ground_lies_below(cloud, axis) else -axis


def _ground_lies_below(cloud: Cloud, axis: Float64s) -> bool:
    """Return whether what is nearest to the sensor lies on the other side of it than `axis`."""
    assert cloud.origin is not None
    ray = sample(cloud.xyz - cloud.origin, 200_000)
    distance = np.linalg.norm(ray, axis=1)
    near = distance <= np.quantile(distance, NEAREST)
    return float(np.mean(ray[near] @ axis)) <= 0.0
