"""An IMU in a bag: its axes, its unit, and the up that it tells."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from commonmap.frames import from_rotation
from commonmap.io.logs import Acceleration, read_acceleration
from commonmap.mapping.level_log import find_felt_up
from commonmap.types import Float64s, Trajectory
from lidar_scans import vlp16_scans
from log_files import clouds, header, ros2_store, write_bag2


def imu(time: float, felt: tuple[float, float, float], frame: str) -> tuple[str, str, int, Any]:
    """Return an Imu message for `write_bag2`."""
    store = ros2_store()
    types = store.types
    vector, turn = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]
    none = np.zeros(9)
    message = types["sensor_msgs/msg/Imu"](
        header=header(store, round(time * 1e9), frame), orientation=turn(x=0, y=0, z=0, w=1.0),
        orientation_covariance=none, angular_velocity=vector(x=0.0, y=0.0, z=0.0),
        angular_velocity_covariance=none, linear_acceleration=vector(*felt),
        linear_acceleration_covariance=none,
    )  # fmt: skip
    return "/imu", "sensor_msgs/msg/Imu", round(time * 1e9), message


def static(parent: str, child: str, xyzw: tuple[float, ...]) -> tuple[str, str, int, Any]:
    """Return a /tf_static message with one turn."""
    store = ros2_store()
    types = store.types
    transform = types["geometry_msgs/msg/Transform"](
        translation=types["geometry_msgs/msg/Vector3"](x=1.0, y=2.0, z=3.0),
        rotation=types["geometry_msgs/msg/Quaternion"](*xyzw),
    )
    stamped = types["geometry_msgs/msg/TransformStamped"](
        header=header(store, 10**9, parent), child_frame_id=child, transform=transform
    )
    message = types["tf2_msgs/msg/TFMessage"](transforms=[stamped])
    return "/tf_static", "tf2_msgs/msg/TFMessage", 10**9, message


def bag(folder: Path, *messages: tuple[str, str, int, Any]) -> Path:
    """Return a bag with one scan of the frame `lidar` and some messages."""
    scan = vlp16_scans(1, start=1.0, every=8)
    return write_bag2(folder / "b", sorted([*clouds(scan), *messages], key=lambda m: m[2]))


def test_what_was_felt_is_turned_into_the_axes_of_the_lidar(tmp_path: Path) -> None:
    half = float(np.sqrt(0.5))
    path = bag(
        tmp_path,
        # x of the IMU points along z of the lidar
        static("lidar", "imu_link", (0.0, -half, 0.0, half)),
        *(imu(1.0 + 0.01 * k, (9.81, 0.0, 0.5), "imu_link") for k in range(5)),
    )
    found = read_acceleration(path)
    assert found is not None
    assert found.time == pytest.approx(1.0 + 0.01 * np.arange(5))
    assert found.felt == pytest.approx(np.tile([-0.5, 0.0, 9.81], (5, 1)), abs=1e-9)


def test_multiples_of_gravity_and_numbers_that_are_none(tmp_path: Path) -> None:
    path = bag(
        tmp_path, imu(1.0, (0.0, 0.0, 1.0), "lidar"), imu(1.1, (np.nan, 0.0, 1.0), "lidar"),
        imu(1.2, (0.0, 0.5, 1.0), "lidar"),
    )  # fmt: skip
    found = read_acceleration(path)
    assert found is not None
    assert found.felt == pytest.approx(np.array([[0, 0, 9.81], [0, 4.905, 9.81]]))


def test_an_imu_that_nothing_joins_is_left_out_and_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = bag(tmp_path, *(imu(1.0 + k, (0.0, 0.0, 9.8), "elsewhere") for k in range(3)))
    assert read_acceleration(path) is None
    assert "no /tf_static joins elsewhere and lidar" in caplog.text
    assert read_acceleration(bag(tmp_path / "without")) is None
    assert read_acceleration(tmp_path / "x.pcap") is None


def spinning(mount: Float64s, n: int = 101) -> Trajectory:
    """Return 10 s of a sensor that turns once about the vertical and gains 5 m/s along x."""
    time = np.linspace(0.0, 10.0, n)
    R = Rotation.from_euler("z", 2 * np.pi * time[:, None] / 10.0).as_matrix() @ mount
    T = np.array([from_rotation(r, [0.25 * t * t, 0.0, 0.0]) for r, t in zip(R, time, strict=True)])
    return Trajectory(time, T)


def test_up_is_what_is_felt_but_for_the_gain_of_speed() -> None:
    mount = Rotation.from_euler("xyz", [10.0, 80.0, 30.0], degrees=True).as_matrix()
    trajectory = spinning(mount)
    R = trajectory.T_map_sensor[:, :3, :3]
    world = np.array([0.5, 0.0, 9.81])  # speeding up along x
    felt = np.einsum("nji,j->ni", R, world)
    biased = felt + np.array([0.3, -0.2, 0.1])  # constant in the sensor's axes
    up = find_felt_up(trajectory, Acceleration(trajectory.time, felt))
    assert up == pytest.approx(np.array([0.0, 0.0, 1.0]), abs=1e-3)
    up = find_felt_up(trajectory, Acceleration(trajectory.time, biased))
    assert up is not None and up[2] > np.cos(np.radians(0.1))
    for wrong in (felt[:5], 0.2 * felt):
        assert find_felt_up(trajectory, Acceleration(trajectory.time[: len(wrong)], wrong)) is None
