"""How well a refined pose is known: what the points' misfits say, and what the surfaces resist.

The pose is where the summed pull `g = sum J w r` of the point-to-plane residuals is zero. An error
of the pulls, `dg`, moves it by `K^-1 dg`, so its covariance is `K^-1 B K^-T` with B the covariance
of `g` (the sandwich of Huber 1967). Neighbouring points err together: B adds up the pulls of
patches of the plan (Liang and Zeger 1986), as much as they say at the width that says the most.

K is not the Hessian `H = J^T w J` of fixed pairs. Where a point slides along its surface another
pair takes over, and nothing resists: noisy normals of a rough floor make H see a grip sideways that
is not there. K is measured instead: the pulls at poses moved a little, each with its own pairs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numba
import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from commonmap.frames import from_rotation
from commonmap.mapping.points import bounds, move, sample
from commonmap.matching.neighbours import Normals, PlanIndex
from commonmap.types import Float64s

STEP = 2.0
"""The poses at which K is measured lie so many times the residuals' scale away."""

PATCHES = (64, 32, 16, 8, 4)
"""Patches along the longer side of the plan."""

LEAST_GRIP = 0.02
"""K resists at least this share of H: what is flatter than that is as good as unknown anyway."""

PROBED_POINTS = 5_000
"""Points that K is measured on."""

SMALLEST = np.diag([1e-4**2] * 3 + [1e-6**2] * 3)
"""Nothing is known better than to a tenth of a millimetre and a microradian, (6, 6)."""

FLAT = 0.02
"""Metres, the residuals' scale of two lidars on flat surfaces."""

COMMON = 0.1
"""Share of what the scale exceeds that by, by which all surfaces may be shifted alike.

Crowns and hedges are entered by rays: what one robot sees of them lies on its own side, and the
other's on the other. Such a shift is common to all patches, so none of them tells of it."""


@dataclass(frozen=True, eq=False)
class Surface:
    """A target to register on. points, normals: (N, 3) or on demand. tree: of the points.

    origin: (3,) of the frame that it is seen in, in the frame of the points.
    """

    points: Float64s
    normals: Float64s | Normals
    tree: cKDTree | PlanIndex
    origin: Float64s = field(default_factory=lambda: np.zeros(3))

    def about(self, origin: Float64s) -> Surface:
        """Return the surface as seen from another origin (3,), in the frame of its points."""
        return replace(self, origin=np.asarray(origin, dtype=np.float64))


@dataclass(frozen=True, eq=False)
class Pairs:
    """Source points on the surface. p: (M, 3) placed. J: (M, 6) of r. w: (M,) weights. r: (M,) m.

    J is in the order x, y, z, rotation about x, y, z, about the origin of the target's frame.
    """

    p: Float64s
    J: Float64s
    w: Float64s
    r: Float64s
    scale: float

    def pulls(self) -> Float64s:
        """Return (M, 6), what each pair adds to the gradient."""
        return np.asarray(self.J * (self.w * self.r)[:, None])

    def curvature(self) -> Float64s:
        """Return (6, 6), how the pulls of pairs that stay grow: weights fall as residuals rise."""
        square = (self.r / (2.0 * self.scale)) ** 2
        slope = np.maximum((1.0 - square) / (1.0 + square) ** 2, 0.0)
        return np.asarray((self.J * slope[:, None]).T @ self.J)

    def hessian(self) -> Float64s:
        """Return (6, 6), of pairs that stay as they are."""
        return np.asarray((self.J * self.w[:, None]).T @ self.J)


def pair_points(
    surface: Surface, source: Float64s, T: Float64s, *, reach: float, scale: float | None = None
) -> Pairs | None:
    """Return the pairs of the source placed by T, or None where fewer than 20 are within reach.

    Residual `r = n . (T p - q)`, Cauchy weights of the given scale or their own, metres.
    """
    moved = move(from_rotation(np.eye(3), surface.origin) @ T, source)
    _, index = surface.tree.query(moved, distance_upper_bound=reach, workers=1)
    hit = np.flatnonzero(index < len(surface.points))
    if len(hit) < 20:
        return None
    on, normals = index[hit], surface.normals
    if isinstance(normals, Normals):
        normals = normals.at_least(on)
    p, J, r = _lay_on(moved, surface.origin, hit, surface.points, normals, on)
    if scale is None:
        scale = max(1.4826 * float(np.median(np.abs(r))), 0.01)
    w = 1.0 / (1.0 + (r / (2.0 * scale)) ** 2)
    return Pairs(p, J, w, r, scale)


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _lay_on(moved, origin, hit, points, normals, on):  # type: ignore[no-untyped-def]
    """Return p (M, 3), J (M, 6) and r (M,) of the points `hit`, each on one of a surface's."""
    p, J, r = np.empty((hit.shape[0], 3)), np.empty((hit.shape[0], 6)), np.empty(hit.shape[0])
    for k in range(hit.shape[0]):
        x, y, z = moved[hit[k], 0], moved[hit[k], 1], moved[hit[k], 2]
        q, n = points[on[k]], normals[on[k]]
        r[k] = n[0] * (x - q[0]) + n[1] * (y - q[1]) + n[2] * (z - q[2])
        x, y, z = x - origin[0], y - origin[1], z - origin[2]
        p[k, 0], p[k, 1], p[k, 2] = x, y, z
        J[k, 0], J[k, 1], J[k, 2] = n[0], n[1], n[2]
        J[k, 3], J[k, 4], J[k, 5] = y * n[2] - z * n[1], z * n[0] - x * n[2], x * n[1] - y * n[0]
    return p, J, r


def measure_covariance(
    surface: Surface, source: Float64s, T: Float64s, pairs: Pairs, *, reach: float,
    spacing: float,
) -> Float64s:  # fmt: skip
    """Return the covariance (6, 6) of a pose T that the pairs settled on, metres and radians."""
    K_inverse = _invert_grip(pairs.curvature(), *_grip(surface, source, T, pairs, reach, spacing))
    # the shape of B from patches of all widths, its size from the width that says the most
    pulls, (low, high) = pairs.pulls(), bounds(pairs.p)
    xy, size = (pairs.p - low)[:, :2], float((high - low)[:2].max())
    spreads = [_spread(xy, pulls, size, n) for n in PATCHES]
    sizes = [float(np.trace(K_inverse @ B)) for B in spreads]
    B = np.mean(spreads, axis=0) * (max(sizes) / max(float(np.mean(sizes)), 1e-300))
    covariance = K_inverse @ B @ K_inverse + SMALLEST + _common(pairs.scale)
    return np.asarray(0.5 * (covariance + covariance.T))


def _common(scale: float) -> Float64s:
    """Return the covariance (6, 6) of a level shift that all loose surfaces have in common."""
    loose = max(scale**2 - FLAT**2, 0.0)
    return np.asarray(np.diag([COMMON**2 * loose] * 2 + [0.0] * 4))


def _spread(xy: Float64s, pulls: Float64s, side: float, n_side: int) -> Float64s:
    """Return the covariance (6, 6) of the summed pulls, from what patches of the plan pull.

    xy: (M, 2) metres, from the plan's lower corner. side: of the plan, the longer one.
    """
    ij = (xy / max(side / n_side, 1e-6)).astype(np.int64)
    patch = ij[:, 0] * (n_side + 1) + ij[:, 1]
    n = np.count_nonzero(np.bincount(patch))
    each = np.stack([np.bincount(patch, weights=column) for column in pulls.T])
    # six parameters were fitted: what they took from the patches is given back
    return np.asarray(each @ each.T * (n / max(n - 6.0, 0.25 * n)))


def _grip(
    surface: Surface, source: Float64s, T: Float64s, pairs: Pairs, reach: float, spacing: float
) -> tuple[Float64s, Float64s]:
    """Return (K, H), (6, 6) each: how the pulls grow by central differences, and with fixed pairs.

    The steps are as wide as the points are apart, so that others take over, and the weights
    so wide that they hardly change.
    """
    few = sample(source, PROBED_POINTS)
    step = max(STEP * pairs.scale, spacing)
    radius = max(math.sqrt(float((pairs.p**2).sum(axis=1).mean())), 1e-3)
    steps = step / np.array([1.0, 1.0, 1.0, radius, radius, radius])

    def pair(d: Float64s) -> Pairs | None:
        nudge = from_rotation(Rotation.from_rotvec(d[3:]).as_matrix(), d[:3])
        return pair_points(surface, few, nudge @ T, reach=reach + step, scale=2.0 * step)

    K = np.zeros((6, 6))
    for a, h in enumerate(steps):
        ends = [pair(sign * h * np.eye(6)[a]) for sign in (1.0, -1.0)]
        up, down = (np.zeros(6) if end is None else end.pulls().sum(axis=0) for end in ends)
        K[:, a] = (up - down) / (2.0 * h)
    still = pair(np.zeros(6))
    H = np.eye(6) if still is None else still.hessian()
    return 0.5 * (K + K.T), H


def _invert_grip(curvature: Float64s, K: Float64s, H: Float64s) -> Float64s:
    """Return the inverse of the curvature, lessened by the share of H that K has.

    The share lies between `LEAST_GRIP` and one, axis by axis.
    """
    root = np.linalg.cholesky(H + 1e-9 * np.trace(H) * np.eye(6))
    inverse = np.linalg.inv(root)
    share, axes = np.linalg.eigh(inverse @ K @ inverse.T)
    half = (axes / np.sqrt(np.clip(share, LEAST_GRIP, 1.0))) @ axes.T  # S^-1/2, symmetric
    middle = np.linalg.inv(
        inverse @ (curvature + 1e-9 * np.trace(curvature) * np.eye(6)) @ inverse.T
    )
    return np.asarray(inverse.T @ half @ middle @ half @ inverse)
