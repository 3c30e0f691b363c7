"""How far an estimated trajectory is from the true one.

The two measures that odometry is usually judged by: the absolute error after the best rigid
alignment (as `evo_ape -a`; Umeyama 1991 without scale) and the relative error over stretches of the
way (the KITTI odometry benchmark's, Geiger et al. 2012, with lengths that fit the log).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from commonmap.errors import InputError
from commonmap.frames import angle, fit_motion, invert
from commonmap.io.logs.poses import interpolate
from commonmap.types import Float64s, Trajectory

STRETCH = 10.0
"""Metres of the way over which the relative error is told, unless the way is shorter."""


@dataclass(frozen=True)
class TrajectoryErrors:
    """ape: metres, root mean square distance of positions after alignment; ape_max: the largest.

    relative: mean error of position over stretches, as a share of their length. turn: radians per
    metre over the same stretches. stretch: their length, metres. way: metres gone in truth.
    n: poses that were compared.
    """

    ape: float
    ape_max: float
    relative: float
    turn: float
    stretch: float
    way: float
    n: int


def compare(
    estimated: Trajectory, true: Trajectory, *, stretch: float = STRETCH
) -> TrajectoryErrors:
    """Return the errors of an estimated trajectory, whatever frame it is in.

    true: poses of the same sensor, interpolated to the moments of the estimate (linear in position,
    slerp in rotation). Moments outside its time are left out; fewer than three raise `InputError`.
    stretch: metres; a way of less than twice that is judged over half its length.
    """
    time = np.asarray(estimated.time, np.float64)
    kept = (time >= true.time[0]) & (time <= true.time[-1])
    if kept.sum() < 3:
        raise InputError(
            "trajectories must share at least three moments to be compared; "
            f"{int(kept.sum())} poses lie within {true.time[0]:.3f} to {true.time[-1]:.3f} s"
        )
    T, T_true = estimated.T_map_sensor[kept], interpolate(true, time[kept])
    T_true_map = fit_motion(T_true[:, :3, 3], T[:, :3, 3])
    moved = T[:, :3, 3] @ T_true_map[:3, :3].T + T_true_map[:3, 3]
    off = np.linalg.norm(moved - T_true[:, :3, 3], axis=1)
    way = np.linalg.norm(np.diff(T_true[:, :3, 3], axis=0), axis=1)
    gone = np.concatenate([[0.0], np.cumsum(way)])
    stretch = min(stretch, 0.5 * float(gone[-1]))
    relative, turn = _over_stretches(T, T_true, gone, stretch)
    return TrajectoryErrors(
        float(np.sqrt(np.mean(off**2))), float(off.max()), relative, turn, stretch,
        float(gone[-1]), int(kept.sum()),
    )  # fmt: skip


def _over_stretches(
    T: Float64s, T_true: Float64s, gone: Float64s, stretch: float
) -> tuple[float, float]:
    """Return the mean errors over all stretches: position as a share, rotation in rad/m."""
    end = np.searchsorted(gone, gone + stretch)
    start = np.flatnonzero(end < len(gone))
    if not len(start) or stretch <= 0.0:
        return float("nan"), float("nan")
    end = end[start]
    step = invert(T[start]) @ T[end]
    true = invert(T_true[start]) @ T_true[end]
    E = invert(true) @ step
    metres = np.linalg.norm(E[:, :3, 3], axis=1)
    radians = np.array([angle(e) for e in E])
    length = gone[end] - gone[start]
    return float(np.mean(metres / length)), float(np.mean(radians / length))
