"""Errors of trajectories against literal numbers."""

from __future__ import annotations

import numpy as np
import pytest

from commonmap.errors import InputError
from commonmap.frames import from_xyz_yaw
from commonmap.odometry import compare
from commonmap.types import Trajectory

T_OTHER = from_xyz_yaw(30.0, -7.0, 2.0, 2.5)


def straight(scale: float = 1.0, n: int = 301, length: float = 30.0) -> Trajectory:
    """Return a drive along x at 1 m/s, told too long by a factor."""
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, 0, 3] = scale * np.linspace(0.0, length, n)
    return Trajectory(np.linspace(0.0, length, n), T)


def bend(rate: float, n: int = 401, radius: float = 20.0) -> Trajectory:
    """Return a drive on a circle whose heading runs away by `rate` radians a metre."""
    s = np.linspace(0.0, 40.0, n)
    yaw = s / radius
    T = np.array([
        from_xyz_yaw(radius * np.sin(a), radius * (1 - np.cos(a)), 0.0, a + rate * d)
        for a, d in zip(yaw, s, strict=True)
    ])  # fmt: skip
    return Trajectory(s, T)


def test_a_wrong_scale() -> None:
    errors = compare(straight(1.01), straight())
    assert errors.relative == pytest.approx(0.01, abs=1e-9)
    assert errors.turn == pytest.approx(0.0, abs=1e-9)
    assert errors.ape == pytest.approx(0.01 * np.std(np.linspace(0, 30, 301)), abs=1e-9)
    assert errors.ape_max == pytest.approx(0.15, abs=1e-9)
    assert errors.way == pytest.approx(30.0)
    assert (errors.stretch, errors.n) == (10.0, 301)


def test_the_frame_does_not_matter() -> None:
    true = bend(0.0)
    moved = Trajectory(true.time, T_OTHER @ true.T_map_sensor)
    errors = compare(moved, true)
    assert errors.ape == pytest.approx(0.0, abs=1e-9)
    assert errors.relative == pytest.approx(0.0, abs=1e-9)
    # the lidar told in another frame of the robot is another trajectory
    assert compare(Trajectory(true.time, true.T_map_sensor @ T_OTHER), true).ape > 1.0


def test_a_heading_that_runs_away() -> None:
    errors = compare(bend(0.002), bend(0.0))
    assert errors.turn == pytest.approx(0.002, rel=2e-3)
    # places are right, but a step of the chord's length is seen from a heading that is off by
    # 0.002 * s, where s is 15 m on average
    assert errors.ape == pytest.approx(0.0, abs=1e-9)
    chord = 2 * 20.0 * np.sin(0.25)
    assert errors.relative == pytest.approx(0.03 * chord / 10.0, rel=5e-3)


def test_truth_is_interpolated_and_moments_outside_are_left_out() -> None:
    true = straight(n=31)
    estimated = Trajectory(
        straight().time + 0.05, from_xyz_yaw(0.05, 0, 0, 0) @ straight().T_map_sensor
    )
    errors = compare(estimated, true)
    assert errors.n == 300
    assert errors.ape == pytest.approx(0.0, abs=1e-9)
    with pytest.raises(InputError, match="at least three"):
        compare(Trajectory(estimated.time + 29.85, estimated.T_map_sensor), true)


def test_a_short_way_is_judged_over_half_its_length() -> None:
    errors = compare(straight(1.02, length=4.0), straight(length=4.0))
    assert errors.stretch == pytest.approx(2.0)
    assert errors.relative == pytest.approx(0.02, abs=1e-9)
