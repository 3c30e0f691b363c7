"""What the points say of the search's best poses: refined, compared with chance, chosen."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from commonmap.mapping.points import move, sample_where
from commonmap.matching.decide import Figures, is_open, rank_value
from commonmap.matching.figures import (
    LOW,
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
    points_around,
)
from commonmap.matching.refine import Refined, lift, refine
from commonmap.matching.search import Peaks
from commonmap.types import Float64s

First = TypeVar("First")
Second = TypeVar("Second")

CLOSE = 0.64
"""Peaks with at least this share of the best evidence are looked at on the points too."""

MOST_RIVALS = 4
"""Peaks that are looked at on the points."""


@dataclass(frozen=True, eq=False)
class Maps:
    """Both maps as the search and the points see them. cell: metres. edges: of the slabs.

    base_points: of the whole base, where it is so small that every look may share them.
    """

    base: Prepared
    draft: Prepared
    base_layers: Layers
    draft_layers: Layers
    cell: float
    edges: Float64s
    max_height: float | None
    base_points: Points | None = None

    def points_near(self, placed: Float64s) -> Points:
        """Return the base's points about (N, 3) points of its frame."""
        if self.base_points is not None:
            return points_around(self.base_points, placed, self.cell)
        return choose_points(self.base, self.cell, self.edges, self.max_height, around=placed)

    def with_base_points(self) -> Maps:
        """Return the maps with the base's points, if it has few enough for all of them."""
        if len(self.base.xyz) > min(MOST_POINTS, 2 * len(self.draft.xyz)):
            return self
        points = choose_points(self.base, self.cell, self.edges, self.max_height)
        return replace(self, base_points=points)

    def draft_points(self) -> Points:
        """Return the draft's points."""
        return choose_points(self.draft, self.cell, self.edges, self.max_height)


@dataclass(frozen=True, eq=False)
class Look:
    """A pose on the points. inliers: share, 0 to 1. ground: metres, see `ground_misfit`."""

    refined: Refined
    inliers: float
    ground: float | None


def verify(
    maps: Maps, found: Peaks, witness: Peaks, decoy: Peaks, *, on_evidence: bool, workers: int
) -> tuple[Peaks, Refined, Figures]:
    """Return the peaks with the one chosen first, its pose refined, and what speaks for it.

    found: at least one peak. witness, decoy: peaks of the evidence, of the source as it is and
    mirrored. on_evidence: the peaks of `found` are the evidence's own, so that close ones may
    change places by what the points say.
    """
    points, maps = both(maps.draft_points, maps.with_base_points)
    if on_evidence:
        found = _choose(maps, points, found, workers)
    look, chance = both(
        lambda: _look(maps, points, found, 0),
        lambda: look_mirrored(maps.base, maps.points_near, points, decoy, maps.cell),
    )
    figures = measure_figures(
        maps.base_layers, maps.draft_layers, found, witness, decoy, look.refined, maps.cell
    )
    figures = with_looks(figures, look, chance)
    if is_open(figures):
        figures = _look_closer(maps, points, found, figures, workers)
    return found, look.refined, figures


def _look_closer(
    maps: Maps, points: Points, found: Peaks, figures: Figures, workers: int
) -> Figures:
    """Return the figures with what settles a doubt: the overlap's halves, the ground elsewhere."""
    elsewhere = ranks_elsewhere(found, maps.cell)
    halves, second = both(
        lambda: measure_halves(
            maps.base_layers.slabs, maps.draft_layers.slabs, found, maps.cell, workers=workers
        ),
        lambda: (
            _look(maps, points, found, int(elsewhere[0]), quick=True) if len(elsewhere) else None
        ),
    )
    if halves is not None:
        figures = replace(figures, half_1=halves[0], half_2=halves[1])
    return replace(figures, second_ground=None if second is None else second.ground)


def _choose(maps: Maps, points: Points, found: Peaks, workers: int) -> Peaks:
    """Return the peaks with the one first that evidence and points together speak for most."""
    elsewhere = ranks_elsewhere(found, maps.cell)
    close = [int(n) for n in elsewhere if found.score[n] >= CLOSE * found.score[0]]
    if not close:
        return found
    ranks = [0, *close[: MOST_RIVALS - 1]]
    with ThreadPoolExecutor(max_workers=workers) as pool:
        looks = list(pool.map(lambda rank: _look(maps, points, found, rank, quick=True), ranks))
    values = [
        rank_value(float(found.score[rank]), look.inliers, look.ground)
        for rank, look in zip(ranks, looks, strict=True)
    ]
    best = ranks[int(np.argmax(values))]
    order = [best, *(n for n in range(len(found.score)) if n != best)]
    return replace(
        found, pose=found.pose[order], score=found.score[order], overlap=found.overlap[order]
    )


def _look(maps: Maps, points: Points, found: Peaks, rank: int, *, quick: bool = False) -> Look:
    """Return the pose of a peak refined, and how the points lie there."""
    T = lift(found.T_target_source(rank), maps.base.ground, maps.draft.ground)
    there = maps.points_near(move(T, points.xyz))
    cell = max(maps.cell, found.cell)
    refined = refine(there.xyz, points.xyz, T, cell=cell, apart=points.voxel, settle=not quick)
    return look_at(maps.base, there, points, refined, maps.cell)


def look_at(base: Prepared, there: Points, points: Points, refined: Refined, cell: float) -> Look:
    """Return how the draft's points lie on those of the base `there`, at a refined pose."""
    T = refined.T_target_source
    return Look(refined, measure_inliers(there, points, T, cell), ground_misfit(base, points, T))


def look_mirrored(
    base: Prepared, near: Callable[[Float64s], Points], points: Points, decoy: Peaks, cell: float
) -> Look | None:
    """Return the same of the mirrored draft's best pose: what chance makes of points.

    near: returns the base's points about (N, 3) placed points. None where the decoy found no pose.
    """
    if len(decoy.score) == 0:
        return None
    mirrored = mirror(points, decoy)
    T = lift_mirrored(decoy.T_target_source(), base, mirrored)
    there = near(move(T, mirrored.xyz))
    searched = max(cell, decoy.cell)
    refined = refine(there.xyz, mirrored.xyz, T, cell=searched, apart=points.voxel, settle=False)
    return Look(
        refined,
        measure_inliers(there, mirrored, refined.T_target_source, cell),
        ground_misfit(base, mirrored, T),
    )


def with_looks(figures: Figures, look: Look, chance: Look | None) -> Figures:
    """Return the figures with what the points say, at the pose and at the mirrored draft's."""
    return replace(
        figures,
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
    low = sample_where(points.xyz, np.abs(points.height) < LOW, 20_000)
    placed = move(T_target_source, low)
    ground = base.ground
    ij = np.floor((placed[:, :2] - ground.origin) / ground.cell).astype(np.int64)
    inside = ((ij >= 0) & (ij < ground.z.shape)).all(axis=1)
    seen = np.zeros(len(ij), dtype=bool)
    seen[inside] = ground.seen[ij[inside, 0], ij[inside, 1]]
    if np.count_nonzero(seen) < 50:
        return None
    step = placed[seen, 2] - ground.height_at(placed[seen, :2])
    return float(1.4826 * np.median(np.abs(step - np.median(step))))


def both(first: Callable[[], First], second: Callable[[], Second]) -> tuple[First, Second]:
    """Return what both functions return, side by side."""
    with ThreadPoolExecutor(max_workers=2) as pool:
        one, other = pool.submit(first), pool.submit(second)
        return one.result(), other.result()
