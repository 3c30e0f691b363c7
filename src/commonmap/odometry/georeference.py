"""The cloud that the sensor saw, deskewed and in the map frame, turn by turn."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from commonmap.errors import InputError
from commonmap.frames import invert
from commonmap.odometry.motion import T_to_motion, deskew
from commonmap.types import Cloud, Float64s, Scan, Trajectory


def georeference(
    scans: Iterable[Scan], trajectory: Trajectory, *, min_range: float = 0.0
) -> Iterator[Cloud]:
    """Yield each scan as a cloud in the frame of the trajectory, with time and ray origins.

    Every point is placed by the pose of its own moment; between poses the motion is interpolated
    (Eq. 4), before the first and after the last pose it goes on for at most two steps of the
    trajectory. Points that are not finite or nearer than `min_range` metres are left out.
    """
    time = np.asarray(trajectory.time, np.float64)
    T = np.asarray(trajectory.T_map_sensor, np.float64)
    if len(time) < 1 or T.shape != (len(time), 4, 4):
        raise InputError(f"a trajectory is (M,) times and (M, 4, 4) poses; {T.shape} came")
    motions = np.zeros((max(len(time) - 1, 1), 6))
    for k in range(len(time) - 1):
        motions[k] = T_to_motion(invert(T[k]) @ T[k + 1])
    limit = _limit(time)
    for number, scan in enumerate(scans):
        xyz = np.asarray(scan.xyz, np.float64)
        x, y, z = xyz.T
        squared = x * x + y * y + z * z
        fit = np.isfinite(squared) & (squared > min_range**2)
        xyz, t = xyz[fit], np.asarray(scan.time, np.float64)[fit]
        if len(t) and (t.min() < time[0] - limit or t.max() > time[-1] + limit):
            raise InputError(
                f"scan {number} ({t.min():.3f} to {t.max():.3f} s) lies outside the trajectory "
                f"({time[0]:.3f} to {time[-1]:.3f} s)"
            )
        placed, origin = _place(xyz, t, time, T, motions)
        yield Cloud(
            xyz=placed, time=t, origin=origin.astype(np.float32), intensity=scan.intensity[fit]
        )


def covers(trajectory: Trajectory, scan: Scan) -> bool:
    """Return whether `georeference` can place every point of a scan."""
    time, limit = np.asarray(trajectory.time, np.float64), _limit(trajectory.time)
    t = np.asarray(scan.time, np.float64)
    if not len(t):
        return True
    return bool(t.min() >= time[0] - limit and t.max() <= time[-1] + limit)


def _limit(time: Float64s) -> float:
    """Return how far before the first and after the last pose the motion is taken to go on."""
    return 2.0 * float(np.median(np.diff(time))) if len(time) > 1 else np.inf


def _place(
    xyz: Float64s, t: Float64s, time: Float64s, T: Float64s, motions: Float64s
) -> tuple[Float64s, Float64s]:
    """Return points and where the sensor was, (N, 3) each, map frame."""
    placed, origin = np.empty_like(xyz), np.empty_like(xyz)
    before = np.clip(np.searchsorted(time, t, side="right") - 1, 0, max(len(time) - 2, 0))
    for k in np.unique(before):
        chosen = np.flatnonzero(before == k)
        dt = time[k + 1] - time[k] if len(time) > 1 else 1.0
        share = (t[chosen] - time[k]) / dt
        local, start = _along(xyz[chosen], share, motions[k])
        placed[chosen] = local @ T[k, :3, :3].T + T[k, :3, 3]
        origin[chosen] = start @ T[k, :3, :3].T + T[k, :3, 3]
    return placed, origin


def _along(xyz: Float64s, share: Float64s, motion: Float64s) -> tuple[Float64s, Float64s]:
    """Return points and sensor positions in the frame at the start of a motion (Eq. 4)."""
    zero = np.zeros(6)
    return deskew(xyz, share, motion, zero), share[:, None] * motion[:3]
