"""Poses as a drifting odometry knows them."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from commonmap.frames import invert
from commonmap.types import Float64s, Trajectory


def add_drift(
    trajectory: Trajectory, distance: Float64s, share: float, rng: np.random.Generator
) -> Trajectory:
    """Return the poses as a drifting odometry knows them, starting at the true first pose.

    The error grows smoothly: a scale, a turn and a climb that change over some ten metres. It is
    scaled so that the mean error of position over stretches of 10 m (a quarter of the way, if
    that is less), as in the KITTI measure, is `share` of their length.
    """
    if share == 0.0 or distance[-1] < 1.0:
        return trajectory
    at = np.arange(0.0, distance[-1] + 0.5, 0.5)
    smooth = 12.0 / 0.5
    noise = gaussian_filter1d(rng.standard_normal((5, len(at))), smooth, axis=1, mode="reflect")
    noise *= np.sqrt(2 * np.sqrt(np.pi) * smooth)
    constant = rng.standard_normal((5, 1))
    raw = noise + 0.4 * constant
    # scale, sideways, climb as shares; yaw and lean as radians a metre
    rates = raw * np.array([[0.7], [0.4], [0.35], [0.012], [0.004]])
    level = _drift_with(trajectory, distance, at, share * rates)
    for _ in range(3):  # nearly linear in the rates: converges at once
        rates = rates * (share / max(relative_error(trajectory, level, distance), 1e-12))
        level = _drift_with(trajectory, distance, at, share * rates)
    return level


def _drift_with(
    trajectory: Trajectory, distance: Float64s, at: Float64s, rates: Float64s
) -> Trajectory:
    """Return the trajectory whose steps carry the errors `rates` (5, K) at distances `at`."""
    T = trajectory.T_map_sensor
    rate = np.stack([np.interp(distance, at, row) for row in rates])
    ds = np.diff(distance, prepend=0.0)
    yaw = np.cumsum(rate[3] * ds)
    lean = np.cumsum(rate[4] * ds)
    turn = Rotation.from_euler("ZY", np.stack([yaw, lean], axis=1)).as_matrix()
    steps = np.diff(T[:, :3, 3], axis=0)
    sideways = np.stack([-steps[:, 1], steps[:, 0], 0.0 * steps[:, 2]], axis=1)
    steps = steps * (1.0 + rate[0, 1:, None]) + sideways * rate[1, 1:, None]
    steps[:, 2] += rate[2, 1:] * ds[1:]
    moved = np.einsum("nij,nj->ni", turn[1:], steps)
    known = T.copy()
    known[1:, :3, 3] = T[0, :3, 3] + np.cumsum(moved, axis=0)
    known[:, :3, :3] = turn @ T[:, :3, :3]
    return Trajectory(trajectory.time, known)


def relative_error(
    true: Trajectory, known: Trajectory, distance: Float64s, *, stretch: float = 10.0
) -> float:
    """Return the mean error of position over stretches of the way, as share of their length."""
    stretch = min(stretch, distance[-1] / 4)
    starts = np.searchsorted(distance, np.arange(0.0, distance[-1] - stretch, stretch / 4))
    ends = np.minimum(np.searchsorted(distance, distance[starts] + stretch), len(distance) - 1)
    T_true = invert(true.T_map_sensor[starts]) @ true.T_map_sensor[ends]
    T_known = invert(known.T_map_sensor[starts]) @ known.T_map_sensor[ends]
    error = np.linalg.norm((invert(T_true) @ T_known)[:, :3, 3], axis=1)
    return float(np.mean(error / (distance[ends] - distance[starts])))
