"""From the grid's pose to the points' pose: z in closed form, then 6-DoF registration.

Robust point-to-plane steps (Chen and Medioni 1992) walk from the search's peak, a few points with
pairs of falling reach, then more of them, and settle on fine ones. What the answer is worth is
measured by `covariance.py`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from commonmap.frames import apply, from_rotation
from commonmap.mapping.ground import Ground
from commonmap.mapping.points import bounds, inside_box, move, rows_of, sample, thin
from commonmap.matching.covariance import Pairs, Surface, measure_covariance, pair_points
from commonmap.matching.neighbours import Normals, index_points
from commonmap.types import Float64s

MOST_WALKING = 5_000
"""Points of the source that walk from the search's peak."""

MOST_ARRIVING = 8_000
"""Points of the source that walk on where these arrived."""

MOST_SURFACE = 60_000
"""Points of the target that they walk on."""

WALKED = 0.01
"""A walk is over at steps of less than this share of a cell."""

SETTLED = 5e-4
"""Metres, of the last step of all: less than points tell, and half as many steps as a fifth of it
takes."""

STEPS = 8
"""Steps at most of the first walk, and of the last ones."""

STEPS_BETWEEN = 5
"""Steps at most of those between: a pose that is right has hardly any left, a wrong one no end."""


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
    apart: float = 0.0,
    n_most: int = 40_000,
    settle: bool = True,
) -> Refined:
    """Return the pose refined on the points, starting from within about one `cell` of the truth.

    target_xyz: (N, 3), source_xyz: (M, 3) metres. cell: metres, of the search. Points are thinned
    to one per voxel of a third of the cell, or coarser. apart: metres, the width of voxels of which
    each holds a point at most, where that is known. settle: end on finer points, about `n_most`
    of the source, and measure the covariance.
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
    fine = max(0.05, 0.3 * voxel)
    target, source = rows_of(target_xyz, inside) - centre, moved_source - centre
    if settle:
        target, source = (
            thin(xyz, max(fine, apart * math.sqrt(len(xyz) / most)), most)
            for xyz, most in ((target, 2 * n_most), (source, n_most))
        )

    # Walk from the search's peak with few points, then with more of them
    spacing, T = voxel, np.eye(4)
    surface = _surface(thin(target, voxel, MOST_SURFACE), voxel)
    some = thin(source, voxel, MOST_ARRIVING)
    few = thin(some, cell, MOST_WALKING)
    until = WALKED * cell
    T, _ = _solve_point_to_plane(surface, few, T, reach=3.0 * cell, until=until)
    for xyz, cells in ((few, 2.0), (few, 1.5), (some, 1.5), (some, 0.75)):
        reach = cells * cell
        T, pairs = _solve_point_to_plane(
            surface, xyz, T, reach=reach, until=until, most=STEPS_BETWEEN
        )

    # The last centimetres come from the finest points, within reach of what the last step left
    if settle and pairs is not None:
        if 4.0 * pairs.scale < 0.75 * cell:
            reach, spacing = max(4.0 * pairs.scale, 2.0 * fine), fine
            surface = _surface(target, fine)
        few = sample(source, MOST_ARRIVING)
        T, pairs = _solve_point_to_plane(surface, few, T, reach=reach, until=1e-3)
        T, pairs = _solve_point_to_plane(surface, source, T, reach=reach, until=SETTLED)
    covariance, rms = np.eye(6), float("inf")
    if pairs is not None:
        rms = pairs.scale
        if settle:
            covariance = measure_covariance(surface, source, T, pairs, reach=reach, spacing=spacing)

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


def _surface(xyz: Float64s, voxel: float) -> Surface:
    """Return the points, one a voxel, with their unit normals, from 20 neighbours, on demand."""
    index = index_points(xyz, voxel)
    return Surface(xyz, Normals(index, 20), index)


def _unrefined(start: Float64s, source_xyz: Float64s) -> Refined:
    centre = apply(start, source_xyz).mean(axis=0) if len(source_xyz) else start[:3, 3]
    return Refined(start, centre, np.eye(6), float("inf"), (0.0, 0.0), False)


def _solve_point_to_plane(
    surface: Surface, source: Float64s, T: Float64s, *, reach: float, until: float,
    most: int = STEPS,
) -> tuple[Float64s, Pairs | None]:  # fmt: skip
    """Return (T, its pairs) after robust Gauss-Newton steps on point-to-plane residuals.

    until: metres, of the last step. most: how many steps at most. The pairs are None where too few
    points are within reach.
    """
    T = T.copy()
    for _ in range(most):
        pairs = pair_points(surface, source, T, reach=reach)
        if pairs is None:
            return T, None
        H = pairs.hessian() + 1e-6 * np.eye(6) * len(pairs.r)
        step = -np.linalg.solve(H, pairs.pulls().sum(axis=0))
        T = from_rotation(Rotation.from_rotvec(step[3:]).as_matrix(), step[:3]) @ T
        if np.abs(step[:3]).max() < until and np.abs(step[3:]).max() < 0.1 * until:
            break
    return T, pairs
