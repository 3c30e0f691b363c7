"""Matching, from two maps to one verdict: prepare, search, refine, decide."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from commonmap.config import Config
from commonmap.errors import EmptyMapError, InputError
from commonmap.frames import apply, from_rotation, invert
from commonmap.mapping.ground import Ground, find_ground
from commonmap.mapping.height_map import build_height_map, choose_cell, choose_slabs
from commonmap.mapping.level import Levelling, find_level, no_levelling
from commonmap.mapping.points import bounds, points_of, sample
from commonmap.matching.decide import Figures, Verdict, decide
from commonmap.matching.evidence import (
    Columns,
    SlabGrid,
    coarsen,
    evidence_surface,
    list_columns,
    pack_slabs,
    scatter,
    transform_target,
)
from commonmap.matching.refine import Refined, lift, refine, share_of_inliers, thin
from commonmap.matching.search import Peaks, evidence_at, plan_search, search
from commonmap.matching.search_metric import search_metric
from commonmap.matching.support import measure_support
from commonmap.metrics.table import METRICS
from commonmap.types import (
    Bools,
    Candidate,
    Cloud,
    Float64s,
    GridMap,
    Leaves,
    Match,
    Progress,
    SearchPicture,
    no_progress,
)

WORKERS = 2
"""Threads; the answer does not depend on them."""


@dataclass(frozen=True, eq=False)
class Prepared:
    """A map made ready: level, near its own origin, with its ground.

    xyz: (N, 3) metres, in the prepared frame. T_prepared_map: (4, 4) takes the map's points there.
    """

    xyz: Float64s
    T_prepared_map: Float64s
    ground: Ground
    height: Float64s
    levelling: Levelling


@dataclass(frozen=True, eq=False)
class Layers:
    """One map's layers for the search: height map and slabs on half the cell."""

    grid: GridMap
    slabs: SlabGrid


@dataclass(frozen=True, eq=False)
class Points:
    """Points for the refinement and the verdict, one mean per small voxel.

    xyz: (M, 3) metres. height: (M,) metres above ground. standing: (M,) bool, above the lowest
    slab edge.
    """

    xyz: Float64s
    height: Float64s
    standing: Bools


def match(
    target: Cloud | Leaves | Float64s,
    source: Cloud | Leaves | Float64s,
    *,
    config: Config | None = None,
    progress: Progress = no_progress,
) -> Match:
    """Return where the source map lies in the target's frame, with an honest yes or no.

    target, source: a cloud, an octree, or an (N, 3) array in metres, z roughly up. No initial
    guess is needed. Raises InputError where a map cannot be used at all.
    """
    config = config or Config()
    timings: dict[str, float] = {}
    if config.search.metric not in METRICS:
        raise InputError(
            f"no metric named {config.search.metric!r}; there are {', '.join(METRICS)}"
        )

    # 1. each map: points, level, ground
    with _timed(timings, "prepare"):
        progress("prepare the target")
        base = prepare(target, "target", config)
        progress("prepare the source")
        draft = prepare(source, "source", config)

    # 2. height slabs of both on one cell size, taken from the data
    with _timed(timings, "grid"):
        progress("height maps")
        cell, edges, max_height = choose_grid(base, draft, config)
        base_layers = build_layers(base, cell, edges, max_height)
        draft_layers = build_layers(draft, cell, edges, max_height)

    # 3. every x, y and yaw; and again with the source mirrored
    with _timed(timings, "search"):
        found = _search(base_layers, draft_layers, config, False, progress)
    with _timed(timings, "decoy"):
        decoy = _search(base_layers, draft_layers, config, True, progress)
    witness, witness_decoy = found, decoy
    if METRICS[config.search.metric].layers != "slabs":
        # Whatever metric searched, the verdict is on evidence against what chance finds of it
        with _timed(timings, "witness"):
            by_evidence = config.with_values(search={"metric": "evidence"})
            witness = _search(base_layers, draft_layers, by_evidence, False, progress)
            witness_decoy = _search(base_layers, draft_layers, by_evidence, True, progress)

    # 4. z in closed form, then all six degrees of freedom on the points
    with _timed(timings, "refine"):
        progress("refine")
        draft_points = choose_points(draft, cell, edges, max_height)
        base_points, refined = draft_points, None
        if len(found.score):
            T = lift(found.T_target_source(), base.ground, draft.ground)
            around = apply(T, draft_points.xyz)
            base_points = choose_points(base, cell, edges, max_height, around=around)
            refined = refine(base_points.xyz, draft_points.xyz, T, cell=max(cell, found.cell))

    # 5. believe it or not
    with _timed(timings, "decide"):
        progress("decide")
        figures = Figures(*[0.0] * 14)
        if refined is not None:
            inliers = measure_inliers(base_points, draft_points, refined.T_target_source, cell)
            chance = 0.0
            if len(witness_decoy.score):
                # How well points lie at a pose that cannot be right
                mirrored = mirror(draft_points, witness_decoy)
                T = lift_mirrored(witness_decoy.T_target_source(), base, mirrored)
                around = apply(T, mirrored.xyz)
                there = choose_points(base, cell, edges, max_height, around=around)
                again = refine(
                    there.xyz, mirrored.xyz, T, cell=max(cell, witness_decoy.cell), n_most=8_000,
                    settle=False,
                )  # fmt: skip
                chance = measure_inliers(there, mirrored, again.T_target_source, cell)
            figures = measure_figures(
                base_layers, draft_layers, found, witness, witness_decoy, refined, inliers, chance,
                cell,
            )  # fmt: skip
        verdict = decide(figures)
        if config.decide.mode == "off":
            verdict = Verdict(True, verdict.confidence, "accepted unseen, as decide.mode is off")
        picture = _draw(base_layers.slabs, draft_layers.slabs, base, draft, found, decoy, config)
    return _answer(base, draft, found, decoy, refined, figures, verdict, config, timings, picture)


def prepare(item: Cloud | Leaves | Float64s, name: str, config: Config) -> Prepared:
    """Return a map with its points level and near the origin, and its ground."""
    xyz = points_of(item, name)
    middle = np.round(np.median(sample(xyz, 100_000), axis=0))
    local = xyz - middle
    low, high = bounds(local)
    extent = (high - low)[:2]
    if len(local) < 100 or float(extent.max()) < 1.0:
        raise EmptyMapError(
            f"the {name} has only {len(local)} finite points over {extent[0]:.2g} x "
            f"{extent[1]:.2g} m; a map needs at least 100 points over a metre"
        )
    if float(extent.max()) > 100_000:
        raise InputError(
            f"the {name} spans {extent.max() / 1000:.0f} km; a map is of one place, in metres"
        )
    if config.level.mode == "off":
        levelling = no_levelling("levelling was turned off")
    elif isinstance(item, Cloud) and item.crs is not None:
        levelling = no_levelling("a map with a coordinate reference system is level")
    else:
        levelling = find_level(local)
        if levelling.tilt > 0:
            local = apply(levelling.T_level_map, local)
    T_prepared_map = levelling.T_level_map @ from_rotation(np.eye(3), -middle)
    ground = find_ground(local)
    height = local[:, 2] - ground.height_at(local[:, :2])
    return Prepared(local, T_prepared_map, ground, height, levelling)


def choose_grid(
    base: Prepared, draft: Prepared, config: Config
) -> tuple[float, Float64s, float | None]:
    """Return (cell, slab edges, max_height) in metres, from the data where not configured.

    Metrics on height maps use heights under 1 m unless told otherwise, as the source paper does.
    """
    cell = config.grid.resolution or choose_cell(base.xyz, draft.xyz)
    max_height = config.grid.max_height
    if max_height is None and METRICS[config.search.metric].layers != "slabs":
        max_height = 1.0
    edges = choose_slabs(draft.height, cell=cell, max_height=max_height)
    return cell, edges, max_height


def build_layers(item: Prepared, cell: float, edges: Float64s, max_height: float | None) -> Layers:
    """Return the layers of a prepared map on half of `cell`."""
    grid = build_height_map(
        item.xyz, cell=0.5 * cell, slab_edges=edges, ground=item.ground, max_height=max_height
    )
    slabs = pack_slabs(grid.origin, grid.cell, grid["slab_occupied"], grid["slab_known"])
    return Layers(grid, slabs)


def choose_points(
    item: Prepared, cell: float, edges: Float64s, max_height: float | None, *,
    around: Float64s | None = None,
) -> Points:  # fmt: skip
    """Return the points of a prepared map below `max_height`, one mean per voxel.

    The voxel is a quarter cell or 0.1 m. around: (K, 3) take only what lies within three cells of
    the plan of these points, metres: a large base is not thinned as a whole.
    """
    used = np.ones(len(item.xyz), bool) if max_height is None else item.height < max_height
    if around is not None:
        low, high = bounds(around)
        for a in range(2):
            used &= item.xyz[:, a] >= low[a] - 3.0 * cell
            used &= item.xyz[:, a] <= high[a] + 3.0 * cell
    xyz = thin(item.xyz[used], min(0.25 * cell, 0.1))
    height = xyz[:, 2] - item.ground.height_at(xyz[:, :2])
    return Points(xyz, height, height > edges[0])


def measure_inliers(base: Points, draft: Points, T_target_source: Float64s, cell: float) -> float:
    """Return the share of the draft's standing points near standing points of the base."""
    placed = apply(T_target_source, draft.xyz)
    return share_of_inliers(base.xyz, base.standing, placed, draft.standing, 0.6 * cell)


def mirror(draft: Points, decoy: Peaks) -> Points:
    """Return the points reflected (x -> -x) about the centre of the source, as the decoy was."""
    xyz = draft.xyz.copy()
    xyz[:, 0] = 2.0 * decoy.centre[0] - xyz[:, 0]
    return Points(xyz, draft.height, draft.standing)


def least_overlap(config: Config) -> float:
    """Return the share of the source's known cells that a pose must place on known cells."""
    if config.search.min_overlap is not None:
        return config.search.min_overlap
    return 0.1 if METRICS[config.search.metric].layers == "slabs" else 0.5


def _search(
    base: Layers, draft: Layers, config: Config, mirrored: bool, progress: Progress
) -> Peaks:
    def tell(step: str, share: float = 0.0) -> None:
        progress("search the mirrored map" if mirrored else step, share)

    if not draft.grid["slab_occupied"].any() or not base.grid["slab_occupied"].any():
        side = "source" if not draft.grid["slab_occupied"].any() else "target"
        raise EmptyMapError(
            f"nothing stands on the ground of the {side} map between "
            f"{base.grid.slab_edges[0]:.2g} and {base.grid.slab_edges[-1]:.2g} m; "  # type: ignore[index]
            "there is nothing to match"
        )
    if METRICS[config.search.metric].layers == "slabs":
        return search(
            base.slabs, draft.slabs, min_overlap=least_overlap(config), mirrored=mirrored,
            workers=WORKERS, progress=tell,
        )  # fmt: skip
    return search_metric(
        base.grid, draft.grid, metric=config.search.metric, normalise=config.search.normalise,
        floor=config.search.floor, min_overlap=least_overlap(config), mirrored=mirrored,
        workers=WORKERS, progress=tell,
    )  # fmt: skip


def measure_figures(
    base_layers: Layers, draft_layers: Layers, found: Peaks, witness: Peaks, decoy: Peaks,
    refined: Refined, inliers: float, decoy_inliers: float, cell: float,
) -> Figures:  # fmt: skip
    """Return what the verdict on the best pose of `found` rests on.

    witness, decoy: peaks of the evidence, of the source as it is and mirrored.
    """
    grid = coarsen(base_layers.slabs, 2)
    columns = _about(list_columns(draft_layers.slabs), found.centre, mirrored=False)
    best_score, n_overlap = evidence_at(grid, columns, found.pose[0])
    elsewhere = other_poses(witness, found.pose[0], cell)
    second_score = float(witness.score[elsewhere].max(initial=0.0))
    decoy_score = float(decoy.score.max(initial=0.0))
    support = measure_support(grid, columns, found.pose[0])
    yaw_best = witness.per_yaw[:, 1][np.isfinite(witness.per_yaw[:, 1])]
    middle = float(np.median(yaw_best))
    spread = 1.4826 * float(np.median(np.abs(yaw_best - middle)))

    return Figures(
        evidence=best_score,
        decoy_ratio=best_score / max(decoy_score, 1e-9),
        second_ratio=best_score / max(second_score, 1e-9),
        prominence=(float(yaw_best.max()) - middle) / max(spread, 1e-9),
        support=support.share,
        effect=support.effect,
        support_t=support.t,
        spread=support.spread,
        inliers=inliers,
        decoy_inliers=decoy_inliers,
        overlap=float(found.overlap[0]),
        n_overlap=float(n_overlap),
        moved=refined.moved[0] / cell,
        converged=float(refined.converged),
    )


def lift_mirrored(T_planar: Float64s, base: Prepared, mirrored: Points) -> Float64s:
    """Return the planar motion of the mirrored source with z set by its ground."""
    low = np.abs(mirrored.height) < 0.3
    moved = apply(T_planar, sample(mirrored.xyz[low] if low.any() else mirrored.xyz, 20_000))
    lifted = T_planar.copy()
    lifted[2, 3] += float(np.median(base.ground.height_at(moved[:, :2]) - moved[:, 2]))
    return lifted


def other_poses(peaks: Peaks, pose: Float64s, cell: float) -> Bools:
    """Return (M,) bool, the peaks that are another place or another heading than `pose`."""
    delta = peaks.pose - pose
    away = np.hypot(delta[:, 0], delta[:, 1]) > max(3.0, 5.0 * cell)
    turned = np.abs((delta[:, 2] + np.pi) % (2.0 * np.pi) - np.pi) > math.radians(10.0)
    return np.asarray(away | turned)


def _about(columns: Columns, centre: Float64s, *, mirrored: bool) -> Columns:
    xy = (columns.xy - centre) * np.array([-1.0 if mirrored else 1.0, 1.0])
    return Columns(np.ascontiguousarray(xy), columns.occupied, columns.known, columns.n_slabs)


def _answer(
    base: Prepared, draft: Prepared, found: Peaks, decoy: Peaks, refined: Refined | None,
    figures: Figures, verdict: Verdict, config: Config, timings: dict[str, float],
    picture: SearchPicture | None,
) -> Match:  # fmt: skip
    """Return the answer in the maps' own frames."""
    T_map_prepared = invert(base.T_prepared_map)

    def in_map_frames(T: Float64s) -> Float64s:
        return np.asarray(T_map_prepared @ T @ draft.T_prepared_map)

    # The search counts up; the answer gives the metric's own value
    own_sign = 1.0 if METRICS[config.search.metric].maximise else -1.0
    score, decoy_score = own_sign * found.score, own_sign * decoy.score

    def candidate(rank: int) -> Candidate:
        T = lift(found.T_target_source(rank), base.ground, draft.ground)
        return Candidate(in_map_frames(T), float(score[rank]), float(found.overlap[rank]))

    accepted = verdict.accepted and refined is not None
    n_found = len(found.score)
    others: list[Candidate] = []
    if n_found:
        elsewhere = np.nonzero(other_poses(found, found.pose[0], found.cell))[0]
        others = [candidate(int(rank)) for rank in elsewhere[: config.search.n_rivals]]
    T, covariance, centre = None, None, None
    if refined is not None:
        best = in_map_frames(refined.T_target_source)
        if accepted:
            T = best
            R = np.kron(np.eye(2), T_map_prepared[:3, :3])
            covariance = R @ refined.covariance @ R.T
            centre = apply(T_map_prepared, refined.centre[None])[0]
        else:
            own = Candidate(best, float(score[0]), float(found.overlap[0]))
            others = [own, *others][: max(config.search.n_rivals, 1)]
    return Match(
        accepted=accepted,
        reason=verdict.reason,
        T_target_source=T,
        confidence=verdict.confidence,
        covariance=covariance,
        covariance_centre=centre,
        overlap=float(found.overlap[0]) if n_found else 0.0,
        score=float(score[0]) if n_found else 0.0,
        decoy_score=float(decoy_score[0]) if len(decoy_score) else 0.0,
        rivals=tuple(others),
        metric=config.search.metric,
        evidence={**figures.as_dict(), "cell": found.cell},
        timings=timings,
        T_level_target=base.levelling.T_level_map,
        T_level_source=draft.levelling.T_level_map,
        picture=picture,
    )


def _draw(
    base: SlabGrid, draft: SlabGrid, base_map: Prepared, draft_map: Prepared, found: Peaks,
    decoy: Peaks, config: Config,
) -> SearchPicture | None:  # fmt: skip
    """Return the evidence over all translations at the best yaw, on the coarsest cell searched."""
    if len(found.score) == 0:
        return None
    cell = plan_search(base, draft).cells[0]
    grid = coarsen(base, round(cell / base.cell))
    columns = _about(
        list_columns(coarsen(draft, max(1, round(0.5 * cell / draft.cell)))), found.centre,
        mirrored=False,
    )  # fmt: skip
    side = 2 * int(np.ceil(float(np.hypot(*columns.xy.T).max()) / cell)) + 2
    low = np.full(2, -0.5 * side * cell)
    yaw = float(found.pose[0, 2])
    occupied, known = scatter(
        columns.xy, columns.occupied, columns.known, math.cos(yaw), math.sin(yaw), cell, low,
        side, side,
    )  # fmt: skip
    score, _ = evidence_surface(
        transform_target(grid, (side, side), workers=WORKERS), occupied, known,
        min_overlap=least_overlap(config) * np.count_nonzero(known), workers=WORKERS,
    )  # fmt: skip
    shift = -invert(base_map.T_prepared_map)[:2, 3]
    x, y = (
        grid.origin[a] + (np.arange(n) - (side - 1)) * cell - low[a] - shift[a]
        for a, n in enumerate(score.shape)
    )
    z = float(np.median(draft_map.ground.z))
    centre = apply(invert(draft_map.T_prepared_map), np.array([[*found.centre, z]]))[0]
    return SearchPicture(
        score=np.where(np.isfinite(score), score, np.nan),
        x=x,
        y=y,
        centre=centre,
        yaw=found.per_yaw[:, 0],
        best_per_yaw=found.per_yaw[:, 1],
        decoy_best=float(decoy.per_yaw[:, 1].max()) if len(decoy.score) else 0.0,
    )


@contextmanager
def _timed(timings: dict[str, float], step: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    timings[step] = time.perf_counter() - start
