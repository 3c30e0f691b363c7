"""Levenberg-Marquardt on the six numbers of a pose, and which directions the scene leaves open.

A constraint is a row: the point p (frame of the turn) shall lie on the plane through the anchor c
with the unit normal u (both in the reference frame). A planar feature gives one row (Eq. 3), an
edge two, with normals across the line: the sum of their squares is the square of Eq. 2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from commonmap.odometry.motion import motion_to_T
from commonmap.types import Bools, Float64s

PRETENDED = 1.25
"""A direction with less information than so many times what noise pretends is degenerate."""

BISQUARE = 4.685
"""Residuals beyond so many standard deviations do not count (Tukey's 95 % efficiency)."""


@dataclass(frozen=True, eq=False)
class Rows:
    """Constraints. p, c, u: (N, 3). sigma: (N,) metres, standard deviation of the distance that
    the fit predicts. tilt: (N,) radians squared, variance of the direction of u. feature: (N,) the
    feature that the row is of."""

    p: Float64s
    c: Float64s
    u: Float64s
    sigma: Float64s
    tilt: Float64s
    feature: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.p)

    def refresh(self, points: Float64s) -> Rows:
        """Return the same rows for the features' points as they are now, (M, 3)."""
        return Rows(points[self.feature], self.c, self.u, self.sigma, self.tilt, self.feature)


@dataclass(frozen=True, eq=False)
class Openness:
    """What the constraints determine (Zhang, Kaess and Singh 2016, ICRA, "On degeneracy of
    optimization-based state estimation problems").

    P: (6, 6) takes a step `[t, theta]` (turn's frame) to its part along determined directions.
    directions: (K, 6) degenerate directions, unit vectors with theta times `lever`, turn's frame.
    lever: metres, the length that makes angles comparable with shifts.
    """

    P: Float64s
    directions: Float64s
    lever: float


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def residuals(R: Float64s, t: Float64s, p: Float64s, c: Float64s, u: Float64s) -> Float64s:
    """Return the signed distance of each moved point to the plane of its row, (N,), metres."""
    d = np.empty(p.shape[0])
    for i in range(p.shape[0]):
        s = 0.0
        for r in range(3):
            x = R[r, 0] * p[i, 0] + R[r, 1] * p[i, 1] + R[r, 2] * p[i, 2] + t[r]
            s += u[i, r] * (x - c[i, r])
        d[i] = s
    return d


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def normal_equations(
    R: Float64s, t: Float64s, p: Float64s, c: Float64s, u: Float64s, w: Float64s
) -> tuple[Float64s, Float64s, float]:
    """Return (J^T J, J^T d, d^T d), weighted, of the residual functions (Eq. 6).

    The row of the Jacobian for a small motion `[t, theta]` of the turn's own frame is
    `[R^T u, p x R^T u]`.
    """
    H, g, cost = np.zeros((6, 6)), np.zeros(6), 0.0
    row = np.empty(6)
    for i in range(p.shape[0]):
        if w[i] <= 0.0:
            continue
        d = 0.0
        for r in range(3):
            x = R[r, 0] * p[i, 0] + R[r, 1] * p[i, 1] + R[r, 2] * p[i, 2] + t[r]
            d += u[i, r] * (x - c[i, r])
            row[r] = R[0, r] * u[i, 0] + R[1, r] * u[i, 1] + R[2, r] * u[i, 2]
        row[3] = p[i, 1] * row[2] - p[i, 2] * row[1]
        row[4] = p[i, 2] * row[0] - p[i, 0] * row[2]
        row[5] = p[i, 0] * row[1] - p[i, 1] * row[0]
        for a in range(6):
            wr = w[i] * row[a]
            g[a] += wr * d
            for b in range(a + 1):
                H[a, b] += wr * row[b]
        cost += w[i] * d * d
    for a in range(6):
        for b in range(a):
            H[b, a] = H[a, b]
    return H, g, cost


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def pretended(R: Float64s, p: Float64s, u: Float64s, w: Float64s, tilt: Float64s) -> Float64s:
    """Return the part of J^T J that only the noise of the normals gives, (6, 6).

    A normal that is off by a small angle of variance `tilt` across itself adds
    `tilt A (I - u u^T) A^T` with A = [I; [p]x]: on a flat field this is all there is of x, y, yaw.
    """
    H = np.zeros((6, 6))
    v = np.empty(3)
    row = np.empty(6)
    for i in range(p.shape[0]):
        s = w[i] * tilt[i]
        if s <= 0.0:
            continue
        for r in range(3):
            v[r] = R[0, r] * u[i, 0] + R[1, r] * u[i, 1] + R[2, r] * u[i, 2]
        for axis in range(4):  # the three axes, less the normal itself
            for r in range(3):
                row[r] = v[r] if axis == 3 else (1.0 if r == axis else 0.0)
            row[3] = p[i, 1] * row[2] - p[i, 2] * row[1]
            row[4] = p[i, 2] * row[0] - p[i, 0] * row[2]
            row[5] = p[i, 0] * row[1] - p[i, 1] * row[0]
            sign = -s if axis == 3 else s
            for a in range(6):
                for b in range(6):
                    H[a, b] += sign * row[a] * row[b]
    return H


def bisquare(whitened: Float64s) -> tuple[Float64s, float]:
    """Return robust weights (N,) of residuals in units of their sigma, and their robust spread.

    Tukey's bisquare, as Zhang and Singh 2014 use it; the spread comes from the median.
    """
    spread = 1.4826 * float(np.median(np.abs(whitened))) if len(whitened) else 1.0
    spread = max(spread, 0.2)
    ratio = whitened / (BISQUARE * spread)
    return np.where(np.abs(ratio) < 1.0, (1.0 - ratio * ratio) ** 2, 0.0), spread


def levenberg_marquardt_step(H: Float64s, g: Float64s, damping: float) -> Float64s:
    """Return the step of Eq. 8, (6,): `-(J^T J + lambda diag(J^T J))^-1 J^T d`."""
    ridge = 1e-12 * max(float(np.trace(H)), 1e-12)
    A = H + np.diag(damping * np.diag(H) + ridge)
    return np.asarray(-np.linalg.solve(A, g), dtype=np.float64)


def find_openness(
    R: Float64s, rows: Rows, w: Float64s, *, lever: float, tolerance: float
) -> Openness:
    """Return which directions of motion the constraints leave open.

    A direction is degenerate where its information (an eigenvalue of J^T J, angles scaled by the
    lever) is not clearly above what the noise of the normals pretends, or where it would leave the
    pose uncertain by more than `tolerance` metres. w: weights per metre squared.
    """
    H, _, _ = normal_equations(R, np.zeros(3), rows.p, rows.c, rows.u, w)
    noise = pretended(R, rows.p, rows.u, w, rows.tilt)
    S = np.diag([1.0, 1.0, 1.0, 1 / lever, 1 / lever, 1 / lever])
    values, V = np.linalg.eigh(S @ H @ S)
    floor = np.einsum("ik,ij,jk->k", V, S @ noise @ S, V)
    closed: Bools = (values > PRETENDED * floor) & (values > 1.0 / tolerance**2)
    # V_u V^-1 of the paper: a step's parts along open directions are left out
    kept = V[:, closed]
    P = S @ kept @ kept.T @ np.linalg.inv(S)
    return Openness(P, V[:, ~closed].T.copy(), lever)


def minimise(
    T: Float64s, rows: Rows, w: Float64s, openness: Openness | None, *, iterations: int
) -> Float64s:
    """Return the pose (4, 4) after Levenberg-Marquardt from `T` with fixed rows and weights."""
    damping = 1e-4
    H, g, cost = normal_equations(_R(T), T[:3, 3].copy(), rows.p, rows.c, rows.u, w)
    for _ in range(iterations):
        step = levenberg_marquardt_step(H, g, damping)
        if openness is not None:
            step = openness.P @ step
        trial = T @ motion_to_T(step)
        H_new, g_new, cost_new = normal_equations(
            _R(trial), trial[:3, 3].copy(), rows.p, rows.c, rows.u, w
        )
        if cost_new <= cost:
            T, H, g, cost, damping = trial, H_new, g_new, cost_new, damping / 10
            if np.abs(step[:3]).max() < 1e-4 and np.abs(step[3:]).max() < 1e-5:
                break
        else:
            damping = max(damping, 1e-6) * 100
    return T


def _R(T: Float64s) -> Float64s:
    return np.ascontiguousarray(T[:3, :3])
