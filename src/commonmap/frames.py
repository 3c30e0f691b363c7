"""Rigid motions. `T_a_b` takes points of frame b into frame a: `p_a = T_a_b @ p_b`.

x forward, y left, z up, right-handed (REP 103). Yaw turns from x towards y. Quaternions are xyzw.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from commonmap.errors import InputError
from commonmap.types import Float64s


def check_T(T: ArrayLike, name: str = "T") -> Float64s:
    """Return `T` as a float64 (4, 4) rigid motion, or raise `InputError` naming what came."""
    matrix = np.asarray(T, dtype=np.float64)
    if matrix.shape != (4, 4):
        raise InputError(f"{name} must be a 4x4 rigid motion; shape {matrix.shape} came")
    if not np.isfinite(matrix).all():
        raise InputError(f"{name} must hold finite numbers; it holds NaN or infinity")
    if not np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-9):
        raise InputError(f"{name} must end in the row 0 0 0 1; the row is {matrix[3].tolist()}")
    R = matrix[:3, :3]
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-5) or np.linalg.det(R) < 0:
        raise InputError(f"{name} must turn and shift only; its 3x3 part is no rotation")
    return matrix


def check_points(xyz: ArrayLike, name: str = "points") -> Float64s:
    """Return `xyz` as float64 (N, 3), or raise `InputError` naming the shape that came."""
    points = np.asarray(xyz)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"{name} must be an (N, 3) array of x, y, z; shape {points.shape} came")
    if not np.issubdtype(points.dtype, np.number) or np.iscomplexobj(points):
        raise InputError(f"{name} must hold real numbers; an array of {points.dtype} came")
    return points.astype(np.float64, copy=False)


def invert(T_a_b: Float64s) -> Float64s:
    """Return `T_b_a` of a rigid motion (4, 4), or of a stack (..., 4, 4)."""
    R_b_a = np.swapaxes(T_a_b[..., :3, :3], -1, -2)
    T_b_a = np.zeros_like(T_a_b)
    T_b_a[..., :3, :3] = R_b_a
    T_b_a[..., :3, 3] = -np.einsum("...ij,...j->...i", R_b_a, T_a_b[..., :3, 3])
    T_b_a[..., 3, 3] = 1.0
    return T_b_a


def apply(T_a_b: Float64s, points_b: NDArray[Any]) -> Float64s:
    """Return the (N, 3) points of frame b in frame a."""
    points_a = np.asarray(points_b, dtype=np.float64) @ T_a_b[:3, :3].T
    points_a += T_a_b[:3, 3]
    return np.asarray(points_a)


def from_xyz_yaw(x: float, y: float, z: float, yaw: float) -> Float64s:
    """Return the motion that turns by `yaw` (radians, x towards y) and then shifts by x, y, z."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0, x], [s, c, 0, y], [0, 0, 1, z], [0, 0, 0, 1]], dtype=np.float64)


def from_rotation(R: Float64s, t: ArrayLike = (0.0, 0.0, 0.0)) -> Float64s:
    """Return the motion of a 3x3 rotation and a translation."""
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = t
    return T


def from_quaternion(t: ArrayLike, q: ArrayLike) -> Float64s:
    """Return the motion of a translation and a quaternion xyzw."""
    return from_rotation(Rotation.from_quat(np.asarray(q, dtype=np.float64)).as_matrix(), t)


def quaternion(T: Float64s) -> Float64s:
    """Return the quaternion xyzw (4,) of a motion, w not negative."""
    q: Float64s = Rotation.from_matrix(T[..., :3, :3]).as_quat()
    return np.where(q[..., 3:] < 0, -q, q)


def yaw_of(T: Float64s) -> float:
    """Return the yaw in radians, -pi to pi, of the x axis of frame b seen in frame a."""
    return float(np.arctan2(T[1, 0], T[0, 0]))


def angle(R: Float64s) -> float:
    """Return the angle of a rotation in radians, 0 to pi."""
    return float(Rotation.from_matrix(R[:3, :3]).magnitude())


def difference(T_a_b: Float64s, T_a_b_other: Float64s, centre_b: ArrayLike) -> tuple[float, float]:
    """Return how far two motions are apart: (metres at the point `centre_b`, radians).

    The distance is taken where the map is, not at a frame origin that may be kilometres away.
    """
    centre = np.append(np.asarray(centre_b, dtype=np.float64), 1.0)
    distance = float(np.linalg.norm((T_a_b @ centre - T_a_b_other @ centre)[:3]))
    return distance, angle(T_a_b[:3, :3].T @ T_a_b_other[:3, :3])


def fit_motion(points_a: Float64s, points_b: Float64s) -> Float64s:
    """Return T_a_b that takes (N, 3) points of b onto those of a with least squares (Kabsch)."""
    centre_a, centre_b = points_a.mean(axis=0), points_b.mean(axis=0)
    U, _, Vt = np.linalg.svd((points_a - centre_a).T @ (points_b - centre_b))
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R = U @ sign @ Vt
    return from_rotation(R, centre_a - R @ centre_b)


def rotation_between(a: ArrayLike, b: ArrayLike) -> Float64s:
    """Return the smallest rotation (3, 3) that takes direction `a` onto direction `b`."""
    u = np.asarray(a, dtype=np.float64) / np.linalg.norm(a)
    v = np.asarray(b, dtype=np.float64) / np.linalg.norm(b)
    axis = np.cross(u, v)
    sine, cosine = float(np.linalg.norm(axis)), float(u @ v)
    if sine < 1e-12:
        if cosine > 0:
            return np.eye(3)
        axis = np.cross(u, np.eye(3)[int(np.argmin(np.abs(u)))])
        return np.asarray(Rotation.from_rotvec(np.pi * axis / np.linalg.norm(axis)).as_matrix())
    return np.asarray(Rotation.from_rotvec(axis / sine * np.arctan2(sine, cosine)).as_matrix())
