"""From the grid's pose to the points' pose: z in closed form, then 6-DoF registration.

small_gicp (generalised ICP, Segal et al. 2009) walks from the search's peak with correspondences of
falling reach; a robust point-to-plane solve on fixed correspondences ends it and gives what the
answer needs to be honest: residuals area by area. Neighbouring points err together, so the areas
count as observations and not the points: the covariance is `phi H^-1` with the overdispersion phi
(McCullagh and Nelder 1989) that the areas show.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from commonmap.frames import apply, from_rotation
from commonmap.mapping.ground import Ground
from commonmap.mapping.points import bounds, inside_box, move, thin
from commonmap.types import Float64s

AREAS = 4
"""Areas along the longer side of the plan that count as observations of the pose."""

INFLATION = 7.0
"""Variance is told this many times larger than the areas show: on simulated pairs without drift the
squared normalised error was that much too large (median of 42 for 6 degrees of freedom), as what
the two robots see of one thing differs from area to area in the same way (docs/matching.md)."""


@dataclass(frozen=True, eq=False)
class Refined:
    """The refined pose and how well it holds.

    T_target_source: (4, 4). centre: (3,) about which the covariance's rotation turns, target frame.
    covariance: (6, 6) of [x, y, z, rotation about x, y, z], metres and radians.
    rms: metres, robust, of the point-to-plane residuals.
    moved: (metres at the centre, radians) between the search's pose and this one.
    converged: False where the registration left the basin of the search's peak; then
        `T_target_source` is the pose that went in.
    """

    T_target_source: Float64s
    centre: Float64s
    covariance: Float64s
    rms: float
    moved: tuple[float, float]
    converged: bool


def lift(
    T_planar: Float64s, ground_target: Ground, ground_source: Ground, *, n_most: int = 20_000
) -> Float64s:
    """Return the planar motion with z in closed form: the median step between the two grounds.

    Cells whose ground both maps measured count; where there are fewer than 10, all cells that
    overlap count.
    """
    i, j = np.nonzero(ground_source.seen)
    if len(i) == 0:
        i, j = np.nonzero(np.ones_like(ground_source.seen))
    step = max(1, len(i) // n_most)
    i, j = i[::step], j[::step]
    xy = ground_source.origin + (np.column_stack([i, j]) + 0.5) * ground_source.cell
    z = ground_source.z[i, j]
    moved = apply(T_planar, np.column_stack([xy, z]))
    cell = np.floor((moved[:, :2] - ground_target.origin) / ground_target.cell).astype(np.int64)
    inside = np.all((cell >= 0) & (cell < ground_target.z.shape), axis=1)
    if not inside.any():
        return T_planar
    seen = np.zeros(len(cell), dtype=bool)
    seen[inside] = ground_target.seen[cell[inside, 0], cell[inside, 1]]
    used = seen if np.count_nonzero(seen) >= 10 else inside
    difference = ground_target.height_at(moved[used, :2]) - moved[used, 2]
    lifted = T_planar.copy()
    lifted[2, 3] += float(np.median(difference))
    return lifted


def refine(
    target_xyz: Float64s,
    source_xyz: Float64s,
    T_target_source: Float64s,
    *,
    cell: float,
    threads: int = 1,
    n_most: int = 20_000,
    settle: bool = True,
) -> Refined:
    """Return the pose refined on the points, starting from within about one `cell` of the truth.

    target_xyz: (N, 3), source_xyz: (M, 3) metres. cell: metres, of the search. Points are thinned
    to one per voxel of a third of the cell, or coarser to stay near `n_most`. settle: end on finer
    points. threads: with more than one the last bits differ from run to run (sums in any order).
    """
    start = np.asarray(T_target_source, dtype=np.float64)
    moved_source = move(start, source_xyz)
    low, high = bounds(moved_source)
    low, high = low - 2.0 * cell, high + 2.0 * cell
    inside = inside_box(target_xyz, low, high)
    if np.count_nonzero(inside) < 20 or len(source_xyz) < 20:
        return _unrefined(start, source_xyz)

    # Work about the middle of the overlap: small numbers, and rotations that mean something
    centre = 0.5 * (low + high)
    voxel = max(cell / 3.0, 0.03)
    target = thin(target_xyz[inside] - centre, voxel, 3 * n_most)
    source = thin(moved_source - centre, voxel, n_most)

    # Walk from the search's peak on coarse clouds, then settle on finer ones
    T = _walk(target, source, cell, threads)
    surface = _surface(target, voxel, threads)
    covariance, rms = np.eye(6), float("inf")
    for reach in (1.5 * cell, 0.75 * cell):
        T, covariance, rms = _solve_point_to_plane(*surface, source, T, reach=reach)

    # The last centimetres come from the finest points, within reach of what the last step left
    fine = max(0.05, 0.3 * voxel)
    reach = 4.0 * rms
    if settle and fine < voxel and math.isfinite(rms) and reach < 0.75 * cell:
        surface = _surface(thin(target_xyz[inside] - centre, fine, 4 * n_most), fine, threads)
        source = thin(moved_source - centre, fine, 2 * n_most)
        T, covariance, rms = _solve_point_to_plane(
            *surface, source, T, reach=max(reach, 2.0 * fine)
        )

    shift = float(np.linalg.norm(T[:3, 3]))
    turn = float(Rotation.from_matrix(T[:3, :3]).magnitude())
    radius = 0.5 * float(np.linalg.norm((high - low)[:2]))
    stayed = shift <= 3.0 * cell and turn <= max(math.radians(3.0), 4.0 * cell / radius)
    if not stayed:
        T = np.eye(4)
    to_centre = from_rotation(np.eye(3), centre)
    from_centre = from_rotation(np.eye(3), -centre)
    return Refined(
        to_centre @ T @ from_centre @ start,
        centre,
        covariance,
        rms,
        (shift, turn),
        stayed,
    )


def _surface(xyz: Float64s, voxel: float, threads: int) -> tuple[Float64s, Float64s]:
    """Return the points and their unit normals, each (N, 3), from 20 neighbours."""
    import small_gicp

    cloud, _ = small_gicp.preprocess_points(
        xyz, downsampling_resolution=voxel / 4.0, num_neighbors=20, num_threads=threads
    )
    return np.asarray(cloud.points())[:, :3], np.asarray(cloud.normals())[:, :3]


def _walk(target: Float64s, source: Float64s, cell: float, threads: int) -> Float64s:
    """Return the motion of generalised ICP from the identity, on clouds of about 10,000 points."""
    import small_gicp

    coarse_target, coarse_source = thin(target, cell / 3.0, 30_000), thin(source, cell, 10_000)
    cloud, tree = small_gicp.preprocess_points(
        coarse_target, downsampling_resolution=cell / 12.0, num_neighbors=12, num_threads=threads
    )
    draft, _ = small_gicp.preprocess_points(
        coarse_source, downsampling_resolution=cell / 12.0, num_neighbors=12, num_threads=threads
    )
    T = np.eye(4)
    for reach in (3.0 * cell, 1.5 * cell):
        result = small_gicp.align(
            cloud, draft, tree, init_T_target_source=T, registration_type="GICP",
            max_correspondence_distance=reach, num_threads=threads, max_iterations=20,
        )  # fmt: skip
        if np.isfinite(result.T_target_source).all() and result.num_inliers >= 20:
            T = np.asarray(result.T_target_source)
    return T


def _unrefined(start: Float64s, source_xyz: Float64s) -> Refined:
    centre = apply(start, source_xyz).mean(axis=0) if len(source_xyz) else start[:3, 3]
    return Refined(start, centre, np.eye(6), float("inf"), (0.0, 0.0), False)


def _solve_point_to_plane(
    target: Float64s, normals: Float64s, source: Float64s, T: Float64s, *, reach: float
) -> tuple[Float64s, Float64s, float]:
    """Return (T, covariance, rms) of robust Gauss-Newton steps on point-to-plane residuals.

    Residual `r = n . (T p - q)`, Cauchy weights scaled by its median absolute deviation. The
    covariance counts areas of the plan as observations (`_overdispersion`).
    """
    tree = cKDTree(target, balanced_tree=False)
    T = T.copy()
    H, scale = np.eye(6), float("inf")
    for _ in range(8):
        moved = move(T, source)
        distance, index = tree.query(moved, distance_upper_bound=reach, workers=1)
        hit = np.isfinite(distance)
        if np.count_nonzero(hit) < 20:
            return T, np.eye(6), float("inf")
        p, n = moved[hit], normals[index[hit]]
        r = np.einsum("ij,ij->i", n, p - target[index[hit]])
        scale = max(1.4826 * float(np.median(np.abs(r))), 0.01)
        w = 1.0 / (1.0 + (r / (2.0 * scale)) ** 2)
        J = np.hstack([n, np.cross(p, n)])
        H = (J * w[:, None]).T @ J + 1e-6 * np.eye(6) * len(p)
        g_points = J * (w * r)[:, None]
        step = -np.linalg.solve(H, g_points.sum(axis=0))
        T = from_rotation(Rotation.from_rotvec(step[3:]).as_matrix(), step[:3]) @ T
        if np.abs(step[:3]).max() < 1e-4 and np.abs(step[3:]).max() < 1e-5:
            break
    covariance = INFLATION * _overdispersion(p, J, w, r) * np.linalg.inv(H)
    # Nothing is known better than to a millimetre and a thousandth of a degree
    covariance += np.diag([1e-3**2] * 3 + [1e-5**2] * 3)
    return T, 0.5 * (covariance + covariance.T), scale


def _overdispersion(
    xyz: Float64s, J: Float64s, w: Float64s, r: Float64s, *, n_side: int = AREAS
) -> float:
    """Return the variance in m^2 that makes `H^-1` an honest covariance.

    Every area of the plan (`n_side` along the longer side) would move by `H_a^-1 g_a` if it were
    free. Independent noise of variance v lets `g_a^T H_a^-1 g_a / 6` be v on average; an area that
    is drifted, bent or differently seen as a whole makes it as much larger as there are points
    that err together.
    """
    low, high = xyz[:, :2].min(axis=0), xyz[:, :2].max(axis=0)
    size = max(float((high - low).max()) / n_side, 1e-6)
    ij = np.floor((xyz[:, :2] - low) / size).astype(np.int64)
    _, area = np.unique(ij[:, 0] * 1024 + ij[:, 1], return_inverse=True)
    found, weight = [], []
    for a in range(int(area.max()) + 1):
        inside = area == a
        if np.count_nonzero(inside) < 30:
            continue
        J_a, w_a = J[inside], w[inside]
        g = J_a.T @ (w_a * r[inside])
        H_a = (J_a * w_a[:, None]).T @ J_a
        H_a += 1e-3 * np.trace(H_a) / 6.0 * np.diag(np.diag(H_a) / max(np.diag(H_a).mean(), 1e-12))
        found.append(float(g @ np.linalg.solve(H_a, g)) / 6.0)
        weight.append(float(w_a.sum()))
    noise = float((w * r**2).sum() / max(w.sum() - 6.0, 1.0))
    if len(found) < 3:
        return noise * max(1.0, len(r) / 50.0)
    # Six parameters were fitted to the areas: what they took away is given back
    share = max(len(found) - 1.0, 1.0) / len(found)
    return max(noise, float(np.average(found, weights=weight)) / share)
