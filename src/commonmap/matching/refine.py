"""From the grid's pose to the points' pose: z in closed form, then 6-DoF registration.

Robust point-to-plane steps (Chen and Medioni 1992) walk from the search's peak, a few points with
pairs of falling reach, then more of them, and settle on fine ones. What the answer is worth is
measured by `covariance.py`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from commonmap.frames import apply, from_rotation, invert
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

TOLD = 0.02
"""Share of the residuals' scale that is less than points tell, where that is more."""

STEPS = 8
"""Steps at most of the first walk, and of the last ones."""

STEPS_BETWEEN = 5
"""Steps at most of those between: a pose that is right has hardly any left, a wrong one no end."""


@dataclass(frozen=True, eq=False)
class Settled:
    """The last step of all: points (M, 3) on a surface at a pose T (4, 4), with their pairs.

    reach, spacing: metres, of the pairs, and between the surface's points.
    """

    surface: Surface
    source: Float64s
    T: Float64s
    pairs: Pairs
    reach: float
    spacing: float


@dataclass(frozen=True, eq=False)
class Refined:
    """The refined pose and how well it holds.

    T_target_source: (4, 4). centre: (3,) about which the covariance's rotation turns, target frame.
    rms: metres, robust, of the point-to-plane residuals.
    moved: (metres at the centre, radians) between the search's pose and this one.
    converged: False where the registration left the basin of the search's peak; then
        `T_target_source` is the pose that went in.
    settled: None where it did not come to that.
    """

    T_target_source: Float64s
    centre: Float64s
    rms: float
    moved: tuple[float, float]
    converged: bool
    settled: Settled | None

    @cached_property
    def covariance(self) -> Float64s:
        """Return (6, 6) of [x, y, z, rotation about x, y, z], metres and radians.

        Measured when asked for; the identity, which says nothing, where the pose did not settle.
        """
        s = self.settled
        if s is None:
            return np.eye(6)
        return measure_covariance(
            s.surface, s.source, s.T, s.pairs, reach=s.reach, spacing=s.spacing
        )


def lift(
    T_planar: Float64s, ground_target: Ground, ground_source: Ground, *, n_most: int = 5_000
) -> Float64s:
    """Return the planar motion with z in closed form: the median step between the two grounds.

    Cells whose ground both maps measured count, about `n_most` of the source's; where there are
    fewer than 10, all cells that overlap count.
    """
    seen = ground_source.seen if ground_source.seen.any() else np.ones_like(ground_source.seen)
    i, j = np.unravel_index(sample(np.flatnonzero(seen), n_most), seen.shape)
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


@dataclass(frozen=True, eq=False)
class Walkers:
    """Points of the source that walk from the search's peak, and more that walk on. (M, 3) each."""

    few: Float64s
    some: Float64s

    def moved(self, T: Float64s) -> Walkers:
        """Return the points in another frame."""
        return Walkers(move(T, self.few), move(T, self.some))


def choose_walkers(source_xyz: Float64s, cell: float) -> Walkers:
    """Return the walkers of (N, 3) points for a search on cells of that width, metres."""
    some = thin(source_xyz, walking_voxel(cell), MOST_ARRIVING)
    return Walkers(thin(some, cell, MOST_WALKING), some)


def walking_voxel(cell: float) -> float:
    """Return how far apart points are that walk from cells of that width, metres."""
    return max(cell / 3.0, 0.03)


def find_surface(xyz: Float64s, voxel: float) -> Surface:
    """Return the points, one a voxel, with their unit normals, from 20 neighbours, on demand."""
    index = index_points(xyz, voxel)
    return Surface(xyz, Normals(index, 20), index)


@dataclass(frozen=True, eq=False)
class Walk:
    """Where walkers came to. start: (4, 4) of the search. centre: (3,) metres, target frame.

    low, high: (3,) what the source may reach, target frame. cell: metres, of the search.
    T: (4, 4) from the start, about the centre. pairs: there, None where there are too few.
    surface: that was walked on, seen from the centre.
    """

    start: Float64s
    centre: Float64s
    low: Float64s
    high: Float64s
    cell: float
    T: Float64s
    pairs: Pairs | None
    surface: Surface

    def refined(self, T: Float64s, pairs: Pairs | None, settled: Settled | None = None) -> Refined:
        """Return the answer, T (4, 4) from the start about the centre.

        Where nothing is within reach of the source, it has not come to stay.
        """
        shift = float(np.linalg.norm(T[:3, 3]))
        turn = float(Rotation.from_matrix(T[:3, :3]).magnitude())
        radius = 0.5 * float(np.linalg.norm((self.high - self.low)[:2]))
        most = max(math.radians(3.0), 4.0 * self.cell / radius)
        stayed = pairs is not None and shift <= 3.0 * self.cell and turn <= most
        if not stayed:
            T = np.eye(4)
        to_centre = from_rotation(np.eye(3), self.centre)
        T = to_centre @ T @ invert(to_centre) @ self.start
        rms = math.inf if pairs is None else pairs.scale
        return Refined(T, self.centre, rms, (shift, turn), stayed, settled)

    def arrived(self) -> Refined:
        """Return the pose where the walk ended."""
        return self.refined(self.T, self.pairs)


def refine(
    target_xyz: Float64s,
    source_xyz: Float64s,
    T_target_source: Float64s,
    *,
    cell: float,
    apart: float = 0.0,
    n_most: int = 40_000,
) -> Refined:
    """Return the pose refined on the points, starting from within about one `cell` of the truth.

    target_xyz: (N, 3), source_xyz: (M, 3) metres. cell: metres, of the search. Points are thinned
    to one per voxel of a third of the cell, or coarser, to walk from the search's peak, and settle
    on finer ones, about `n_most` of the source. apart: metres, the width of voxels of which each
    holds a point at most, where that is known.
    """
    start = np.asarray(T_target_source, dtype=np.float64)
    if len(source_xyz) < 20:
        return _unrefined(start, source_xyz)
    low, high = _reached(move(start, source_xyz), cell)
    inside = inside_box(target_xyz, low, high)
    if np.count_nonzero(inside) < 20:
        return _unrefined(start, source_xyz)
    voxel = walking_voxel(cell)
    surface = find_surface(thin(rows_of(target_xyz, inside), voxel, MOST_SURFACE), voxel)
    way = walk(surface, choose_walkers(source_xyz, cell), start, cell=cell)
    return settle(way, target_xyz, source_xyz, apart=apart, n_most=n_most)


def _reached(moved_source: Float64s, cell: float) -> tuple[Float64s, Float64s]:
    """Return the lowest and highest coordinates that placed points may reach, metres."""
    low, high = bounds(moved_source)
    return low - 2.0 * cell, high + 2.0 * cell


def walk(surface: Surface, walkers: Walkers, T_target_source: Float64s, *, cell: float) -> Walk:
    """Return where at least 20 walkers come to that start within about one `cell` of the truth.

    surface: of the target, in its frame; what of it lies beyond the source does not matter.
    """
    start = np.asarray(T_target_source, dtype=np.float64)
    moved = walkers.moved(start)
    low, high = _reached(moved.some, cell)

    # Work about the middle of the overlap: small numbers, and rotations that mean something
    centre = 0.5 * (low + high)
    there = surface.about(centre)
    few, some = moved.few - centre, moved.some - centre
    until, T, pairs = WALKED * cell, np.eye(4), None
    T, _ = _solve_point_to_plane(there, few, T, reach=3.0 * cell, until=until)
    for xyz, cells in ((few, 2.0), (few, 1.5), (some, 1.5), (some, 0.75)):
        T, pairs = _solve_point_to_plane(
            there, xyz, T, reach=cells * cell, until=until, most=STEPS_BETWEEN
        )
    return Walk(start, centre, low, high, cell, T, pairs, there)


def settle(
    way: Walk, target_xyz: Float64s, source_xyz: Float64s, *, apart: float = 0.0,
    n_most: int = 40_000,
) -> Refined:  # fmt: skip
    """Return the pose that the finest points settle on after a walk.

    The last centimetres come from the finest points, within reach of what the walk left.
    """
    if way.pairs is None:
        return way.arrived()
    fine = max(0.05, 0.3 * walking_voxel(way.cell))

    def widened(xyz: Float64s, most: int) -> float:
        return max(fine, apart * math.sqrt(len(xyz) / most))

    T_about_target = from_rotation(np.eye(3), -way.centre)
    source = move(T_about_target @ way.start, source_xyz)
    source = thin(source, widened(source, n_most), n_most)
    surface, reach, spacing = way.surface, 0.75 * way.cell, walking_voxel(way.cell)
    if 4.0 * way.pairs.scale < reach:
        reach, spacing = max(4.0 * way.pairs.scale, 2.0 * fine), fine
        inside = inside_box(target_xyz, way.low, way.high)
        there = move(T_about_target, rows_of(target_xyz, inside))
        voxel = widened(there, 2 * n_most)
        surface = find_surface(thin(there, voxel, 2 * n_most), voxel)
    few = sample(source, MOST_ARRIVING)
    T, _ = _solve_point_to_plane(surface, few, way.T, reach=reach, until=1e-3)
    T, pairs = _solve_point_to_plane(surface, source, T, reach=reach, until=SETTLED)
    if pairs is None:
        return way.refined(T, None)
    return way.refined(T, pairs, Settled(surface, source, T, pairs, reach, spacing))


def _unrefined(start: Float64s, source_xyz: Float64s) -> Refined:
    centre = apply(start, source_xyz).mean(axis=0) if len(source_xyz) else start[:3, 3]
    return Refined(start, centre, math.inf, (0.0, 0.0), False, None)


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
        longest = max(float(np.abs(step[:3]).max()), 10.0 * float(np.abs(step[3:]).max()))
        if longest < max(until, TOLD * pairs.scale):
            break
    return T, pairs
