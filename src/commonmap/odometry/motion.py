"""Motions of a sweep: rotation vectors, linear interpolation (Eq. 4), rigid motion (Eq. 5), deskew.

A motion is six numbers `[t, theta]`: a translation in metres and a rotation vector in radians.
"Eq." are those of the source paper (Akay et al.), which follow Zhang and Singh 2014, "LOAM: Lidar
Odometry and Mapping in Real-time", RSS.
"""

from __future__ import annotations

import numba
import numpy as np

from commonmap.types import Float64s


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def rotate(theta: Float64s, R: Float64s) -> None:
    """Fill R (3, 3) with the rotation of a rotation vector (Rodrigues; Zhang and Singh, Eq. 6)."""
    x, y, z = theta[0], theta[1], theta[2]
    square = x * x + y * y + z * z
    if square < 0.04:  # a turn's motion: the series is exact to 1e-10 and needs no trigonometry
        a = 1.0 - square / 6.0 * (1.0 - square / 20.0 * (1.0 - square / 42.0))
        b = 0.5 - square / 24.0 * (1.0 - square / 30.0 * (1.0 - square / 56.0))
    else:
        angle = np.sqrt(square)
        a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / square
    R[0, 0], R[0, 1], R[0, 2] = 1 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
    R[1, 0], R[1, 1], R[1, 2] = b * x * y + a * z, 1 - b * (x * x + z * z), b * y * z - a * x
    R[2, 0], R[2, 1], R[2, 2] = b * x * z - a * y, b * y * z + a * x, 1 - b * (x * x + y * y)


def motion_to_T(motion: Float64s) -> Float64s:
    """Return the (4, 4) rigid motion of `[t, theta]`."""
    T = np.eye(4)
    rotate(np.asarray(motion[3:], dtype=np.float64), T[:3, :3])
    T[:3, 3] = motion[:3]
    return T


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def rotation_vector(R: Float64s) -> Float64s:
    """Return the rotation vector (3,) of a rotation, of length 0 to pi (by its quaternion)."""
    q = np.empty(4)
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    if trace > 0.0:
        q[3] = 1.0 + trace
        q[0], q[1], q[2] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    else:
        i = 0
        if R[1, 1] > R[0, 0]:
            i = 1
        if R[2, 2] > R[i, i]:
            i = 2
        j, k = (i + 1) % 3, (i + 2) % 3
        q[i] = 1.0 + R[i, i] - R[j, j] - R[k, k]
        q[j], q[k] = R[j, i] + R[i, j], R[k, i] + R[i, k]
        q[3] = R[k, j] - R[j, k]
    if q[3] < 0.0:
        q = -q
    sine = np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
    scale = 2.0 / q[3] if sine < 1e-12 else 2.0 * np.arctan2(sine, q[3]) / sine
    theta: Float64s = scale * q[:3]
    return theta


def T_to_motion(T: Float64s) -> Float64s:
    """Return `[t, theta]` (6,) of a rigid motion; theta of length 0 to pi."""
    return np.concatenate([T[:3, 3], rotation_vector(T)])


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def motion_between(T_a: Float64s, T_b: Float64s) -> Float64s:
    """Return `[t, theta]` (6,) of T_a^-1 T_b: the pose b seen from the pose a."""
    motion = np.empty(6)
    R = np.zeros((3, 3))
    for r in range(3):
        motion[r] = 0.0
        for k in range(3):
            motion[r] += T_a[k, r] * (T_b[k, 3] - T_a[k, 3])
            for c in range(3):
                R[r, c] += T_a[k, r] * T_b[k, c]
    motion[3:] = rotation_vector(R)
    return motion


def interpolate_motion(motion: Float64s, share: float) -> Float64s:
    """Return the motion (6,) a share of the way: `T_i = share * T` (Eq. 4)."""
    return share * np.asarray(motion, dtype=np.float64)


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def move_point(R: Float64s, t: Float64s, p: Float64s, q: Float64s) -> None:
    """Fill q (3,) with the rigidly moved point `R p + t` (Eq. 5)."""
    for r in range(3):
        q[r] = R[r, 0] * p[0] + R[r, 1] * p[1] + R[r, 2] * p[2] + t[r]


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def deskew(points: Float64s, delay: Float64s, rate: Float64s, bend: Float64s) -> Float64s:
    """Return points (N, 3), each measured at its own moment, in the frame of the reference moment.

    delay: (N,) seconds from the reference moment to the point's.
    rate: (6,) the sweep's motion `[t, theta]` per second; the pose of the sensor at `delay` is
        `delay * rate` seen from the reference frame, linear in time (Eq. 4).
    bend: (6,) per second squared, added as `delay**2 * bend`; zeros give Eq. 4 to the letter.
    """
    out = np.empty((points.shape[0], 3))
    R = np.empty((3, 3))
    motion = np.empty(6)
    p = np.empty(3)
    for i in range(points.shape[0]):
        s = delay[i]
        for k in range(6):
            motion[k] = s * (rate[k] + s * bend[k])
        rotate(motion[3:], R)
        p[0], p[1], p[2] = points[i, 0], points[i, 1], points[i, 2]
        move_point(R, motion[:3], p, out[i])
    return out


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def place(T: Float64s, points: Float64s) -> Float64s:
    """Return points (N, 3) moved by T (4, 4)."""
    out = np.empty((points.shape[0], 3))
    for i in range(points.shape[0]):
        move_point(T[:3, :3], T[:3, 3], points[i], out[i])
    return out


def sweep_motion(
    before: Float64s, dt_before: float, after: Float64s | None = None, dt_after: float = 0.0
) -> tuple[Float64s, Float64s]:
    """Return (rate, bend) of a sweep, (6,) each, for `deskew`.

    before: (6,) motion of the sensor's frame of the sweep before, seen from this sweep's frame
        (where the sensor was), `dt_before` seconds earlier.
    after: (6,) the same of the sweep after, `dt_after` seconds later; where it is not known yet
        the motion goes on at the rate of the last.
    """
    back = -np.asarray(before, dtype=np.float64) / dt_before
    if after is None:
        return back, np.zeros(6)
    ahead = np.asarray(after, dtype=np.float64) / dt_after
    bend = (ahead - back) / (dt_before + dt_after)
    return back + dt_before * bend, bend


def damp_rate(rate: Float64s, previous: Float64s | None) -> Float64s:
    """Return the rate (6,) to deskew with: the mean of this sweep's and the one's before.

    Taken alone, an error e of one sweep's motion distorts the reference of the next and comes back
    as -e, undamped, for ever; the mean takes that oscillation away.
    """
    return rate if previous is None else 0.5 * (rate + previous)
