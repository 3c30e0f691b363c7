"""What the points say of the search's best poses: refined, compared with chance, chosen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from commonmap.mapping.points import move, thin
from commonmap.matching.covariance import Surface
from commonmap.matching.decide import Figures, is_lost, is_open, rank_value
from commonmap.matching.figures import (
    lift_mirrored,
    measure_figures,
    measure_inliers,
    mirror,
    ranks_elsewhere,
)
from commonmap.matching.halves import measure_halves
from commonmap.matching.maps import (
    MOST_POINTS,
    Layers,
    Points,
    Prepared,
    choose_points,
)
from commonmap.matching.refine import (
    MOST_SURFACE,
    Refined,
    Walk,
    Walkers,
    choose_walkers,
    find_surface,
    lift,
    settle,
    walk,
    walking_voxel,
)
from commonmap.matching.search import Peaks
from commonmap.matching.threads import both, in_order
from commonmap.types import Float64s

CLOSE = 0.64
"""Peaks with at least this share of the best evidence are looked at on the points too."""

MOST_RIVALS = 4
"""Peaks that are looked at on the points."""

MOST_SHARED = 4 * MOST_SURFACE
"""Points of the surface that all looks share."""


@dataclass(frozen=True, eq=False)
class Target:
    """The base as poses are looked at on it: its points, and their surface to walk on."""

    points: Points
    surface: Surface


@dataclass(frozen=True, eq=False)
class Source:
    """What is laid on it: a draft's points, and those of them that walk."""

    points: Points
    walkers: Walkers

    def moved(self, T: Float64s) -> Source:
        """Return the points in another frame; their heights stay."""
        xyz = move(T, self.points.xyz)
        return Source(replace(self.points, xyz=xyz), self.walkers.moved(T))


def find_target(points: Points, cell: float, *, n_most: int = MOST_SURFACE) -> Target:
    """Return the base's points to look at poses on, found on cells of that width, metres.

    n_most: points that its surface has at most.
    """
    voxel = walking_voxel(cell)
    return Target(points, find_surface(thin(points.xyz, voxel, n_most), voxel))


def find_source(points: Points, cell: float) -> Source:
    """Return the draft's points to look at poses with, found on cells of that width, metres."""
    return Source(points, choose_walkers(points.xyz, cell))


@dataclass(frozen=True, eq=False)
class Maps:
    """Both maps as the search and the points see them. cell: metres. edges: of the slabs.

    searched: metres, the cell that poses were found on. target: the whole base, where it is so
    small that every look may share it.
    """

    base: Prepared
    draft: Prepared
    base_layers: Layers
    draft_layers: Layers
    cell: float
    edges: Float64s
    max_height: float | None
    searched: float
    target: Target | None = None

    def target_near(self, source: Source, T_target_source: Float64s) -> Target:
        """Return the base about the source at a pose."""
        if self.target is not None:
            return self.target
        placed = move(T_target_source, source.points.xyz)
        points = choose_points(self.base, self.cell, self.edges, self.max_height, around=placed)
        return find_target(points, self.searched)

    def with_target(self) -> Maps:
        """Return the maps with the whole base to look at, if it is small enough."""
        if len(self.base.xyz) > min(MOST_POINTS, 2 * len(self.draft.xyz)):
            return self
        points = choose_points(self.base, self.cell, self.edges, self.max_height)
        return replace(self, target=find_target(points, self.searched, n_most=MOST_SHARED))

    def source(self) -> Source:
        """Return the draft to look at poses with."""
        points = choose_points(self.draft, self.cell, self.edges, self.max_height)
        return find_source(points, self.searched)


@dataclass(frozen=True, eq=False)
class Look:
    """A pose on the points. inliers: share, 0 to 1. ground: metres, see `ground_misfit`."""

    way: Walk
    refined: Refined
    inliers: float
    ground: float | None


def verify(
    maps: Maps, found: Peaks, witness: Peaks, decoy: Peaks, *, on_evidence: bool, sure: bool,
    workers: int,
) -> tuple[Peaks, Refined, Figures]:  # fmt: skip
    """Return the peaks with the one chosen first, its pose refined, and what speaks for it.

    found: at least one peak. witness, decoy: peaks of the evidence, of the source as it is and
    mirrored. on_evidence: the peaks of `found` are the evidence's own, so that close ones may
    change places by what the points say. sure: the pose will be taken whatever speaks against it;
    else one that is lost already does not settle on the finest points.
    """
    source, maps = both(maps.source, maps.with_target, workers)
    looks: dict[int, Look] = {}
    if on_evidence:
        found, looks = _choose(maps, source, found, workers)
    figures = measure_figures(maps.base_layers, maps.draft_layers, found, witness, decoy, maps.cell)
    settled = sure or not is_lost(figures)
    look, chance = both(
        lambda: _look(maps, source, found, looks.get(0), settled=settled),
        lambda: look_mirrored(maps.base, maps.target_near, source, decoy, maps.cell),
        workers,
    )
    figures = with_looks(figures, look, chance, maps.cell)
    if is_open(figures):
        figures = _look_closer(maps, source, found, looks, figures, workers)
    return found, look.refined, figures


def _look_closer(
    maps: Maps, source: Source, found: Peaks, looks: dict[int, Look], figures: Figures,
    workers: int,
) -> Figures:  # fmt: skip
    """Return the figures with what settles a doubt: the overlap's halves, the ground elsewhere.

    looks: those that were had already, by rank.
    """
    elsewhere = ranks_elsewhere(found, maps.cell)

    def second_ground() -> float | None:
        if len(elsewhere) == 0:
            return None
        rank = int(elsewhere[0])
        if rank in looks:
            return looks[rank].ground
        refined = _walk(maps, source, found, rank)[0].arrived()
        return ground_misfit(maps.base, source.points, refined.T_target_source)

    halves, ground = both(
        lambda: measure_halves(
            maps.base_layers.slabs, maps.draft_layers.slabs, found, maps.cell, workers=workers
        ),
        second_ground,
        workers,
    )
    if halves is not None:
        figures = replace(figures, half_1=halves[0], half_2=halves[1])
    return replace(figures, second_ground=ground)


def _choose(
    maps: Maps, source: Source, found: Peaks, workers: int
) -> tuple[Peaks, dict[int, Look]]:
    """Return the peaks with the one first that evidence and points together speak for most.

    Also the looks that were had, by the new ranks.
    """
    elsewhere = ranks_elsewhere(found, maps.cell)
    close = [int(n) for n in elsewhere if found.score[n] >= CLOSE * found.score[0]]
    if not close:
        return found, {}
    ranks = [0, *close[: MOST_RIVALS - 1]]
    looks = list(in_order(lambda rank: _glimpse(maps, source, found, rank), ranks, workers))
    values = [
        rank_value(float(found.score[rank]), look.inliers, look.ground)
        for rank, look in zip(ranks, looks, strict=True)
    ]
    best = ranks[int(np.argmax(values))]
    order = [best, *(n for n in range(len(found.score)) if n != best)]
    chosen = replace(
        found, pose=found.pose[order], score=found.score[order], overlap=found.overlap[order]
    )
    return chosen, {order.index(rank): look for rank, look in zip(ranks, looks, strict=True)}


def _glimpse(maps: Maps, source: Source, found: Peaks, rank: int) -> Look:
    """Return how the points lie where a walk from a peak ends."""
    way, target = _walk(maps, source, found, rank)
    return look_at(maps.base, target, source, way, way.arrived(), maps.cell)


def _walk(maps: Maps, source: Source, found: Peaks, rank: int) -> tuple[Walk, Target]:
    """Return a walk from a peak, and what it was on."""
    T = lift(found.T_target_source(rank), maps.base.ground, maps.draft.ground)
    target = maps.target_near(source, T)
    return walk(target.surface, source.walkers, T, cell=maps.searched), target


def _look(maps: Maps, source: Source, found: Peaks, glimpse: Look | None, *, settled: bool) -> Look:
    """Return the best pose refined, and how the points lie there.

    glimpse: what was had of it. settled: on the finest points, if the walk did not leave the peak.
    """
    if glimpse is None:
        way, target = _walk(maps, source, found, 0)
    else:
        way, target = glimpse.way, maps.target_near(source, glimpse.way.start)
    refined, points = way.arrived(), source.points
    if settled and refined.converged:
        refined = settle(way, target.points.xyz, points.xyz, apart=points.voxel)
    elif glimpse is not None:
        return glimpse
    return look_at(maps.base, target, source, way, refined, maps.cell)


def look_at(
    base: Prepared, target: Target, source: Source, way: Walk, refined: Refined, cell: float
) -> Look:
    """Return how the source's points lie on those of the target at a refined pose."""
    T = refined.T_target_source
    inliers = measure_inliers(target.points, source.points, T, cell)
    return Look(way, refined, inliers, ground_misfit(base, source.points, T))


def look_mirrored(
    base: Prepared, near: Callable[[Source, Float64s], Target], source: Source, decoy: Peaks,
    cell: float,
) -> Look | None:  # fmt: skip
    """Return the same of the mirrored draft's best pose: what chance makes of points.

    near: returns the base about a source at a pose. None where the decoy found no pose.
    """
    if len(decoy.score) == 0:
        return None
    mirrored = source.moved(mirror(decoy))
    T = lift_mirrored(decoy.T_target_source(), base, mirrored.points)
    target = near(mirrored, T)
    way = walk(target.surface, mirrored.walkers, T, cell=max(cell, decoy.cell))
    refined = way.arrived()
    return Look(
        way,
        refined,
        measure_inliers(target.points, mirrored.points, refined.T_target_source, cell),
        ground_misfit(base, mirrored.points, T),
    )


def with_looks(figures: Figures, look: Look, chance: Look | None, cell: float) -> Figures:
    """Return the figures with what the points say, at the pose and at the mirrored draft's."""
    return replace(
        figures,
        moved=look.refined.moved[0] / cell,
        converged=float(look.refined.converged),
        inliers=look.inliers,
        ground=look.ground,
        decoy_inliers=0.0 if chance is None else chance.inliers,
        decoy_ground=None if chance is None else chance.ground,
    )


def ground_misfit(base: Prepared, points: Points, T_target_source: Float64s) -> float | None:
    """Return how far the draft's ground undulates against the base's, metres, robust.

    The median absolute deviation of their difference (times 1.48), over the cells whose ground the
    base measured; a constant step between the two does not count. None where fewer than 50 points
    tell.
    """
    placed = move(T_target_source, points.xyz[points.low])
    ground = base.ground
    ij = np.floor((placed[:, :2] - ground.origin) / ground.cell).astype(np.int64)
    inside = ((ij >= 0) & (ij < ground.z.shape)).all(axis=1)
    seen = np.zeros(len(ij), dtype=bool)
    seen[inside] = ground.seen[ij[inside, 0], ij[inside, 1]]
    if np.count_nonzero(seen) < 50:
        return None
    step = placed[seen, 2] - ground.height_at(placed[seen, :2])
    return float(1.4826 * np.median(np.abs(step - np.median(step))))
