"""The draft by areas: each matched by itself on the whole base, and laid on it near the whole.

The first says whether the parts of the draft agree on one pose; it knows nothing of the whole's.
The second says how the draft is bent (`drift.py`): a field over the draft's plan, applied where
held-out areas lie measurably better with it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from commonmap.config import Config
from commonmap.errors import InputError
from commonmap.frames import apply, invert
from commonmap.mapping.points import bounds, inside_box, thin
from commonmap.matching.decide import Verdict, decide
from commonmap.matching.drift import (
    LEAST_AREAS,
    LEAST_PER_AREA,
    MOST_PER_AREA,
    Drift,
    Pieces,
    Surface,
    displace,
    find_drift,
    find_surface,
    smooth,
)
from commonmap.matching.figures import (
    measure_figures,
    other_poses,
)
from commonmap.matching.maps import (
    MOST_POINTS,
    Layers,
    Points,
    Prepared,
    build_layers,
    choose_grid,
    choose_points,
    prepare,
)
from commonmap.matching.refine import lift, settle, walk
from commonmap.matching.search import Peaks, search_both
from commonmap.matching.slabs import SlabGrid
from commonmap.matching.verify import (
    Target,
    find_source,
    find_target,
    look_at,
    look_mirrored,
    with_looks,
)
from commonmap.types import (
    Area,
    Areas,
    Cloud,
    DriftField,
    Float64s,
    Leaves,
    Match,
    Progress,
    no_progress,
)

LEAST_CELLS = 4
"""Cells along the edge of an area, at least."""

LEAST_OCCUPIED = 8
"""Cells with something standing under which an area is not searched by itself."""

LEAST_VOXELS = 20
"""Voxels of a cell's width with points under which an area is not searched by itself."""

LEAST_OVERLAP = 0.5
"""Share of an area's known cells that its own pose must place on known cells of the base."""

LARGEST_DRIFT = 1.5
"""Metres, how far from the base the parts of a draft are looked for at first."""

NO_GAIN = float("nan")

Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Tiling:
    """The areas that hold points. ij: (A, 2) their places on the grid of the draft's plan, whose
    area [i, j] spans `[i, j] * size` to `[i+1, j+1] * size` of the prepared frame."""

    ij: Index
    size: float

    def find(self, xyz: Float64s) -> Index:
        """Return the area (N,) of each of (N, 3) points, -1 where it lies in none."""
        ij = np.floor(xyz[:, :2] / self.size).astype(np.int64)
        low = self.ij.min(axis=0)
        shape = self.ij.max(axis=0) - low + 1
        table = np.full(tuple(shape), -1, np.int64)
        table[tuple((self.ij - low).T)] = np.arange(len(self.ij))
        at = ij - low
        inside = ((at >= 0) & (at < shape)).all(axis=1)
        return np.where(inside, table[tuple(np.clip(at, 0, shape - 1).T)], -1)


def tile(xyz: Float64s, size: float) -> Tiling:
    """Return the areas of `size` metres that hold any of (N, 3) points."""
    return Tiling(np.unique(np.floor(xyz[:, :2] / size).astype(np.int64), axis=0), size)


def match_areas(
    target: Cloud | Leaves | Float64s,
    source: Cloud | Leaves | Float64s,
    found: Match,
    *,
    config: Config,
    progress: Progress = no_progress,
) -> Areas:
    """Return the draft's areas of `config.areas.size` metres, their own poses and their drift.

    found: the match of the whole. Where it was refused the areas are compared with the best pose
    that it had, and no drift is told.
    """
    T = found.T_target_source
    if T is None and found.rivals:
        T = found.rivals[0].T_target_source
    if config.areas.size is None or T is None:
        raise InputError("areas need a size in metres, and a match that found any pose at all")

    # 1. both maps as the match had them: points (N, 3), ground, slabs on half the cell
    progress("areas")
    base, draft = prepare(target, "target", config), prepare(source, "source", config)
    cell, edges, max_height = choose_grid(base, draft, config)
    layers = (
        build_layers(base, cell, edges, max_height),
        build_layers(draft, cell, edges, max_height),
    )
    if config.areas.size < LEAST_CELLS * cell:
        raise InputError(
            f"areas.size must be at least {LEAST_CELLS} cells of {cell:g} m; "
            f"{config.areas.size:g} m came"
        )
    points = choose_points(draft, cell, edges, max_height)
    T_prepared = base.T_prepared_map @ T @ invert(draft.T_prepared_map)

    # 2. the areas of the draft's plan that hold points: (A, 2)
    half = layers[1].slabs.cell
    tiling = tile(points.xyz, max(round(config.areas.size / half), 1) * half)

    # 3. each by itself on the whole base: pose, score and verdict
    there = find_target(choose_points(base, cell, edges, max_height), cell, n_most=MOST_POINTS)
    alone = []
    area_of = tiling.find(points.xyz)
    for n, ij in enumerate(tiling.ij):
        progress("areas by themselves", n / len(tiling.ij))
        own = points.where(area_of == n)
        alone.append(_match_alone(base, draft, layers, there, own, ij, tiling.size, cell))

    # 4. how the draft is bent, told by areas near the pose of the whole: (A, 4)
    progress("drift")
    bent, centre = None, _centres(points, tiling, area_of)
    if found.accepted:
        bent = lay_on_base(base, draft, T_prepared, tiling, cell)
    items = []
    for n, one in enumerate(alone):
        items.append(_item(one, bent, tiling, n, centre[n], base, draft, T_prepared, cell))
    searched = [one for one in items if one.T_target_source is not None]
    return Areas(
        size=tiling.size,
        items=tuple(items),
        agreeing=float(np.mean([one.agrees for one in searched])) if searched else float("nan"),
        drift=make_field(bent[0], bent[1], draft, tiling) if bent and bent[0].supported else None,
        reason=_reason(found.accepted, bent[0] if bent else None),
        before=bent[0].before if bent else NO_GAIN,
        gain=bent[0].gain if bent else NO_GAIN,
        gain_z=bent[0].gain_z if bent else NO_GAIN,
    )


@dataclass(frozen=True, eq=False)
class Alone:
    """What an area found by itself. peaks, T: of the base's prepared frame."""

    peaks: Peaks
    T_base_draft: Float64s
    verdict: Verdict


def _match_alone(
    base: Prepared, draft: Prepared, layers: tuple[Layers, Layers], there: Target, own: Points,
    ij: Index, size: float, cell: float,
) -> Alone | None:  # fmt: skip
    """Return an area's own match on the whole base, None where too little stands in it."""
    slabs = _cut(layers[1].slabs, ij, size)
    if slabs is None or np.count_nonzero(slabs.occupied) < LEAST_OCCUPIED:
        return None
    if len(thin(own.xyz, cell)) < LEAST_VOXELS:
        return None
    found, decoy = search_both(layers[0].slabs, slabs, min_overlap=LEAST_OVERLAP)
    if len(found.score) == 0:
        return None
    T = lift(found.T_target_source(), base.ground, draft.ground)
    source = find_source(own, cell)
    way = walk(there.surface, source.walkers, T, cell=cell)
    refined = settle(way, there.points.xyz, own.xyz, n_most=16_000, apart=own.voxel)
    part = replace(layers[1], slabs=slabs)
    figures = with_looks(
        measure_figures(layers[0], part, found, found, decoy, cell),
        look_at(base, there, source, way, refined, cell),
        look_mirrored(base, lambda placed, T: there, source, decoy, cell),
        cell,
    )
    return Alone(found, refined.T_target_source, decide(figures))


def _cut(slabs: SlabGrid, ij: Index, size: float) -> SlabGrid | None:
    """Return the part of the grid in area `ij`, None where it knows nothing there."""
    n = round(size / slabs.cell)
    start = ij * n - np.round(slabs.origin / slabs.cell).astype(np.int64)
    low, high = np.maximum(start, 0), np.minimum(start + n, slabs.shape)
    if (high <= low).any():
        return None
    at = (slice(low[0], high[0]), slice(low[1], high[1]))
    if not slabs.known[at].any():
        return None
    return SlabGrid(
        slabs.origin + low * slabs.cell, slabs.cell, np.ascontiguousarray(slabs.occupied[at]),
        np.ascontiguousarray(slabs.known[at]), slabs.n_slabs,
    )  # fmt: skip


def _centres(points: Points, tiling: Tiling, area_of: Index) -> Float64s:
    """Return the mean of the points of every area, (A, 3)."""
    count = np.maximum(np.bincount(area_of, minlength=len(tiling.ij)), 1)
    sums = [np.bincount(area_of, points.xyz[:, a], minlength=len(tiling.ij)) for a in range(3)]
    return np.asarray(np.column_stack(sums) / count[:, None])


def lay_on_base(
    base: Prepared, draft: Prepared, T_base_draft: Float64s, tiling: Tiling, cell: float
) -> tuple[Drift, Pieces, Index] | None:
    """Return the drift, the pieces it was told by, and the area of each piece."""
    low, high = bounds(draft.xyz)
    T_draft_base = invert(T_base_draft)
    around = apply(T_draft_base, base.xyz)
    margin = 2.0 * LARGEST_DRIFT
    around = around[inside_box(around, (low - margin)[:2], (high + margin)[:2])]
    if len(around) < LEAST_PER_AREA:
        return None
    surface = find_surface(thin(around, min(0.1, 0.25 * cell), 400_000))
    own = find_surface(thin(draft.xyz, min(0.2, 0.5 * cell)))
    pieces, areas = _pieces(own, tiling)
    if len(areas) < LEAST_AREAS:
        return None
    found = find_drift(surface, pieces, size=tiling.size, reach=LARGEST_DRIFT)
    return None if found is None else (found, pieces, areas)


def _pieces(own: Surface, tiling: Tiling) -> tuple[Pieces, Index]:
    """Return the surface by areas with points enough, and which areas these are."""
    area = tiling.find(own.xyz)
    kept: list[Index] = []
    areas: list[int] = []
    for n in range(len(tiling.ij)):
        index = np.flatnonzero(area == n)
        if len(index) < LEAST_PER_AREA:
            continue
        kept.append(index[:: -(-len(index) // MOST_PER_AREA)])
        areas.append(n)
    if not areas:
        return Pieces(own, area, np.zeros((0, 3))), np.zeros(0, np.int64)
    chosen, areas_of = np.concatenate(kept), np.array(areas)
    labels = np.repeat(np.arange(len(areas)), [len(index) for index in kept])
    z = np.bincount(labels, own.xyz[chosen, 2]) / np.bincount(labels)
    centre = np.column_stack([(tiling.ij[areas_of] + 0.5) * tiling.size, z])
    return Pieces(Surface(own.xyz[chosen], own.normal[chosen]), labels, centre), areas_of


def make_field(drift: Drift, pieces: Pieces, draft: Prepared, tiling: Tiling) -> DriftField:
    """Return the drift at all nodes of the grid, one area more on every side."""
    low, high = tiling.ij.min(axis=0) - 1, tiling.ij.max(axis=0) + 1
    shape = high - low + 1
    nodes = np.indices(tuple(shape)).reshape(2, -1).T + low
    at = np.column_stack([(nodes + 0.5) * tiling.size, np.zeros(len(nodes))])
    motion, _ = smooth(drift.readings, pieces.centre, at, drift.prior)
    corner = (low + 0.5) * tiling.size
    return DriftField(draft.T_prepared_map, corner, tiling.size, motion.reshape(*shape, 4))


def _item(
    one: Alone | None, bent: tuple[Drift, Pieces, Index] | None, tiling: Tiling, n: int,
    centre: Float64s, base: Prepared, draft: Prepared, T_base_draft: Float64s, cell: float,
) -> Area:  # fmt: skip
    """Return the record of area `n`, in the maps' own frames."""
    T_map_base = invert(base.T_prepared_map)
    place = apply(T_map_base @ T_base_draft, centre[None])[0]
    moved, weight = None, 0.0
    if bent is not None and n in bent[2]:
        at = int(np.flatnonzero(bent[2] == n)[0])
        if bent[0].readings.heard[at]:
            offset = (centre - bent[1].centre[at])[None]
            shift = displace(bent[0].readings.motion[at][None], offset)[0]
            moved = (T_map_base @ T_base_draft)[:3, :3] @ shift
            weight = float(bent[0].weight[at])
    if one is None:
        reason = "not searched: too little stands in it"
        return Area(place, None, False, 0.0, reason, 0.0, False, moved, weight)
    return Area(
        centre=place,
        T_target_source=T_map_base @ one.T_base_draft @ draft.T_prepared_map,
        accepted=one.verdict.accepted,
        confidence=one.verdict.confidence,
        reason=one.verdict.reason,
        score=float(one.peaks.score[0]),
        agrees=_agrees(one, T_base_draft, cell),
        drift=moved,
        weight=weight,
    )


def _agrees(one: Alone, T_base_draft: Float64s, cell: float) -> bool:
    """Return whether the area's best pose is that of the whole, as the search tells poses apart."""
    middle = apply(T_base_draft, np.array([[*one.peaks.centre, 0.0]]))[0]
    yaw = np.arctan2(T_base_draft[1, 0], T_base_draft[0, 0])
    whole = np.array([middle[0], middle[1], yaw])
    return not bool(other_poses(one.peaks, whole, cell)[0])


def _reason(accepted: bool, drift: Drift | None) -> str:
    """Return the sentence on the correction."""
    if not accepted:
        return "no correction: the match of the whole was refused"
    if drift is None:
        return f"no correction: fewer than {LEAST_AREAS} areas have points enough on the base"
    lie = (
        f"held-out areas lie {100 * abs(drift.gain):.1f} cm {'nearer' if drift.gain > 0 else 'off'}"
        f" the base of {100 * drift.before:.1f} cm ({drift.gain_z:.1f} sigma)"
    )
    if drift.supported:
        return f"corrected: with the drift of the areas around them, {lie}"
    return f"no correction: with the drift of the areas around them, {lie}; too little to rely on"
