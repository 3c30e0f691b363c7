"""Levenberg-Marquardt on the six numbers of a pose, and which directions the scene leaves open.

A constraint is a row: the point p (frame of the turn) shall lie on the plane through the anchor c
with the unit normal u (both in the reference frame). A planar feature gives one row (Eq. 3), an
edge two, with normals across the line: the sum of their squares is the square of Eq. 2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from commonmap.odometry.motion import motion_between, rotate
from commonmap.types import Float64s

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

    @staticmethod
    def room(n: int) -> Rows:
        """Return n rows that are to be filled."""
        p, c, u = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 3))
        return Rows(p, c, u, np.empty(n), np.empty(n), np.empty(n, np.int64))

    @property
    def arrays(self) -> tuple[NDArray[Any], ...]:
        """p, c, u, sigma, tilt and feature, for kernels."""
        return self.p, self.c, self.u, self.sigma, self.tilt, self.feature

    def head(self, n: int) -> Rows:
        """Return the first n rows."""
        return Rows(
            self.p[:n], self.c[:n], self.u[:n], self.sigma[:n], self.tilt[:n], self.feature[:n]
        )

    def refresh(self, points: Float64s) -> Rows:
        """Return the same rows for the features' points as they are now, (M, 3)."""
        return Rows(points[self.feature], self.c, self.u, self.sigma, self.tilt, self.feature)


@dataclass(frozen=True, eq=False)
class Openness:
    """What the constraints determine (Zhang, Kaess and Singh 2016, ICRA, "On degeneracy of
    optimization-based state estimation problems").

    P: (6, 6) takes a step `[t, theta]` (turn's frame) to its part along directions of which the
        constraints say anything.
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
def pretended(
    R: Float64s, t: Float64s, p: Float64s, c: Float64s, u: Float64s, w: Float64s, tilt: Float64s
) -> tuple[Float64s, Float64s, float]:
    """Return the parts of J^T J, J^T d and d^T d that only the noise of the normals gives.

    A normal that is off by a small angle of variance `tilt` across itself adds
    `tilt A (I - u u^T) A^T` with A = [I; [p]x], and draws the point p to its anchor c within the
    plane: on a flat field this is all there is of x, y, yaw, and it holds the sensor back, since
    the map ends where the sensor has not been yet.
    """
    H, g, cost = np.zeros((6, 6)), np.zeros(6), 0.0
    row, f = np.empty(6), np.empty(3)
    n = x = y = z = xx = yy = zz = xy = xz = yz = 0.0
    for i in range(p.shape[0]):
        s = w[i] * tilt[i]
        if s <= 0.0:
            continue
        # A A^T: the three axes
        a, b, h = p[i, 0], p[i, 1], p[i, 2]
        n += s
        x, y, z = x + s * a, y + s * b, z + s * h
        xx, yy, zz = xx + s * a * a, yy + s * b * b, zz + s * h * h
        xy, xz, yz = xy + s * a * b, xz + s * a * h, yz + s * b * h
        # less that along the normal itself
        d = square = 0.0
        f[0] = f[1] = f[2] = 0.0
        for r in range(3):
            row[r] = R[0, r] * u[i, 0] + R[1, r] * u[i, 1] + R[2, r] * u[i, 2]
            off = R[r, 0] * a + R[r, 1] * b + R[r, 2] * h + t[r] - c[i, r]
            d += u[i, r] * off
            square += off * off
            for k in range(3):
                f[k] += R[r, k] * off
        row[3], row[4] = b * row[2] - h * row[1], h * row[0] - a * row[2]
        row[5] = a * row[1] - b * row[0]
        for j in range(6):
            for k in range(j + 1):
                H[j, k] -= s * row[j] * row[k]
        for k in range(3):
            f[k] = s * (f[k] - d * row[k])
            g[k] += f[k]
        g[3] += b * f[2] - h * f[1]
        g[4] += h * f[0] - a * f[2]
        g[5] += a * f[1] - b * f[0]
        cost += s * (square - d * d)
    H[0, 0], H[1, 1], H[2, 2] = H[0, 0] + n, H[1, 1] + n, H[2, 2] + n
    H[3, 1], H[3, 2] = H[3, 1] - z, H[3, 2] + y
    H[4, 0], H[4, 2] = H[4, 0] + z, H[4, 2] - x
    H[5, 0], H[5, 1] = H[5, 0] - y, H[5, 1] + x
    H[3, 3], H[4, 4], H[5, 5] = H[3, 3] + yy + zz, H[4, 4] + xx + zz, H[5, 5] + xx + yy
    H[4, 3], H[5, 3], H[5, 4] = H[4, 3] - xy, H[5, 3] - xz, H[5, 4] - yz
    for j in range(6):
        for k in range(j):
            H[k, j] = H[j, k]
    return H, g, cost


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def bisquare(whitened: Float64s) -> tuple[Float64s, float]:
    """Return robust weights (N,) of residuals in units of their sigma, and their robust spread.

    Tukey's bisquare, as Zhang and Singh 2014 use it; the spread comes from the median.
    """
    spread = 1.4826 * np.median(np.abs(whitened)) if len(whitened) else 1.0
    spread = max(spread, 0.2)
    weight = np.empty(len(whitened))
    for i in range(len(whitened)):
        ratio = whitened[i] / (BISQUARE * spread)
        weight[i] = (1.0 - ratio * ratio) ** 2 if abs(ratio) < 1.0 else 0.0
    return weight, spread


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def levenberg_marquardt_step(H: Float64s, g: Float64s, damping: float) -> Float64s:
    """Return the step of Eq. 8, (6,): `-(J^T J + lambda diag(J^T J))^-1 J^T d`.

    By Cholesky's decomposition, since J^T J is symmetric and positive.
    """
    ridge = 1e-12 * max(np.trace(H), 1e-12)
    L = np.zeros((6, 6))
    step = np.empty(6)
    for i in range(6):
        for j in range(i + 1):
            s = H[i, j]
            if i == j:
                s += damping * H[i, i] + ridge
            for k in range(j):
                s -= L[i, k] * L[j, k]
            if i == j:
                L[i, i] = np.sqrt(max(s, 0.5 * ridge))
            else:
                L[i, j] = s / L[j, j]
    for i in range(6):
        s = -g[i]
        for k in range(i):
            s -= L[i, k] * step[k]
        step[i] = s / L[i, i]
    for i in range(5, -1, -1):
        s = step[i]
        for k in range(i + 1, 6):
            s -= L[k, i] * step[k]
        step[i] = s / L[i, i]
    return step


def find_openness(
    R: Float64s, rows: Rows, w: Float64s, *, lever: float, tolerance: float
) -> Openness:
    """Return which directions of motion the constraints leave open.

    A direction is degenerate where its information (an eigenvalue of J^T J, angles scaled by the
    lever) is not clearly above what the noise of the normals pretends, or where what is above would
    leave the pose uncertain by more than `tolerance` metres. Steps are taken along the latter, for
    what they are worth beside a prior. w: weights per metre squared.
    """
    H, _, _ = normal_equations(R, np.zeros(3), rows.p, rows.c, rows.u, w)
    noise, _, _ = pretended(R, np.zeros(3), rows.p, rows.c, rows.u, w, rows.tilt)
    return Openness(*_openness(H, noise, lever, tolerance), lever)


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _openness(
    H: Float64s, noise: Float64s, lever: float, tolerance: float
) -> tuple[Float64s, Float64s]:
    """Return P (6, 6) and the open directions (K, 6) of `Openness`."""
    scale = np.array([1.0, 1.0, 1.0, 1.0 / lever, 1.0 / lever, 1.0 / lever])
    scales = scale.reshape(6, 1) * scale
    values, V = np.linalg.eigh(scales * H)
    noise = scales * noise
    kept, open_ = np.zeros((6, 6)), np.empty((6, 6))
    n = 0
    for k in range(6):
        v = V[:, k].copy()
        floor = v @ (noise @ v)
        if values[k] > PRETENDED * floor:
            kept += v.reshape(6, 1) * v
        if values[k] <= PRETENDED * floor or values[k] - floor <= 1.0 / tolerance**2:
            open_[n] = v
            n += 1
    # V_u V^-1 of the paper: a step's parts along open directions are left out
    return scale.reshape(6, 1) * kept / scale, open_[:n].copy()


@dataclass(frozen=True, eq=False)
class Prior:
    """What is known of a pose before the scene is asked.

    T: (4, 4), where the motion so far leads. information: (6,) of `[t, theta]` of the turn's frame,
    per metre squared and per radian squared; zeros where nothing is known.
    """

    T: Float64s
    information: Float64s


NOTHING = Prior(np.eye(4), np.zeros(6))


def minimise(
    T: Float64s, rows: Rows, w: Float64s, openness: Openness | None, *, iterations: int
) -> Float64s:
    """Return the pose (4, 4) after Levenberg-Marquardt from `T` with fixed rows and weights."""
    P = np.eye(6) if openness is None else openness.P
    moved: Float64s = _minimise(
        T, rows.p, rows.c, rows.u, w, np.zeros(len(rows)), P, NOTHING.T, NOTHING.information,
        iterations,
    )  # fmt: skip
    return moved


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _equations(
    T: Float64s, p: Float64s, c: Float64s, u: Float64s, w: Float64s, tilt: Float64s, P: Float64s,
    T_prior: Float64s, information: Float64s,
) -> tuple[Float64s, Float64s, float]:  # fmt: skip
    """Return the normal equations less what is pretended, along what is held, with the prior."""
    R, t = T[:3, :3].copy(), T[:3, 3].copy()
    H, g, cost = normal_equations(R, t, p, c, u, w)
    N, h, less = pretended(R, t, p, c, u, w, tilt)
    H = P.T.copy() @ (H - N) @ P
    g = P.T.copy() @ (g - h)
    cost -= less
    off = motion_between(T_prior, T)
    for k in range(6):
        H[k, k] += information[k]
        g[k] += information[k] * off[k]
        cost += information[k] * off[k] ** 2
    return H, g, cost


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _minimise(
    T: Float64s, p: Float64s, c: Float64s, u: Float64s, w: Float64s, tilt: Float64s, P: Float64s,
    T_prior: Float64s, information: Float64s, iterations: int,
) -> Float64s:  # fmt: skip
    """Return the pose after some steps of Levenberg-Marquardt; along what is open it is the prior's
    where there is one, else that of T."""
    if information.max() > 0.0:
        off = motion_between(T_prior, T)
        T = _stepped(T, P @ off - off)
    damping = 1e-4
    H, g, cost = _equations(T, p, c, u, w, tilt, P, T_prior, information)
    for _ in range(iterations):
        step = P @ levenberg_marquardt_step(H, g, damping)
        trial = _stepped(T, step)
        H_new, g_new, cost_new = _equations(trial, p, c, u, w, tilt, P, T_prior, information)
        if cost_new <= cost:
            T, H, g, cost = trial, H_new, g_new, cost_new
            damping /= 10.0
            if np.abs(step[:3]).max() < 1e-4 and np.abs(step[3:]).max() < 1e-5:
                break
        else:
            damping = max(damping, 1e-6) * 100.0
    return T


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _stepped(T: Float64s, step: Float64s) -> Float64s:
    """Return T (4, 4) moved by a step `[t, theta]` of its own frame."""
    turn, moved = np.empty((3, 3)), np.eye(4)
    R = T[:3, :3].copy()
    rotate(step[3:], turn)
    moved[:3, :3] = R @ turn
    moved[:3, 3] = R @ step[:3] + T[:3, 3]
    return moved


def settle(
    T: Float64s, rows: Rows, open_: Openness | None, prior: Prior, *, lever: float,
    tolerance: float, correct: bool = True,
) -> tuple[Float64s, Openness, Float64s]:  # fmt: skip
    """Return the pose after a few steps with robust weights, what is open, and the weights (N,).

    open_: what the same rows leave open, where it was found before. What the rows say is taken
    along directions that they hold and, where `correct`, less what the noise of their normals
    pretends.
    """
    P, directions = (np.zeros((0, 6)),) * 2 if open_ is None else (open_.P, open_.directions)
    T_new, P, directions, w = _settle(
        T, rows.p, rows.c, rows.u, rows.sigma, rows.tilt, P, directions, prior.T,
        prior.information, lever, tolerance, correct,
    )  # fmt: skip
    return T_new, Openness(P, directions, lever), w


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _settle(
    T: Float64s, p: Float64s, c: Float64s, u: Float64s, sigma: Float64s, tilt: Float64s,
    P: Float64s, directions: Float64s, T_prior: Float64s, information: Float64s, lever: float,
    tolerance: float, correct: bool,
) -> tuple[Float64s, Float64s, Float64s, Float64s]:  # fmt: skip
    """Return T, P, directions and w of `settle`; an empty P is found anew."""
    R, t = T[:3, :3].copy(), T[:3, 3].copy()
    w, spread = bisquare(residuals(R, t, p, c, u) / sigma)
    w /= (spread * sigma) ** 2
    if len(P) == 0:
        H, _, _ = normal_equations(R, t, p, c, u, w)
        noise, _, _ = pretended(R, t, p, c, u, w, tilt)
        P, directions = _openness(H, noise, lever, tolerance)
    taken_off = tilt if correct else np.zeros(len(tilt))
    return _minimise(T, p, c, u, w, taken_off, P, T_prior, information, 2), P, directions, w
