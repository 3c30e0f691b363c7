"""Matching, from two maps to one verdict: prepare, search, refine, decide."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from commonmap.config import Config
from commonmap.errors import EmptyMapError, InputError
from commonmap.frames import apply, invert
from commonmap.matching.decide import NOTHING, Figures, Verdict, decide
from commonmap.matching.evidence_fft import evidence_surface, transform_target
from commonmap.matching.figures import is_told_at_a_glance, ranks_elsewhere
from commonmap.matching.maps import (
    Layers,
    Prepared,
    build_layers,
    choose_grid,
    prepare,
)
from commonmap.matching.refine import Refined, lift
from commonmap.matching.search import (
    Peaks,
    SearchPlan,
    centre_columns,
    plan_glance,
    plan_search,
    search_both,
)
from commonmap.matching.search_metric import search_metric
from commonmap.matching.seen_free import know_by_rays
from commonmap.matching.slabs import SlabGrid, coarsen, list_columns, scatter
from commonmap.matching.threads import both, count_cores
from commonmap.matching.verify import Maps, verify
from commonmap.metrics.table import METRICS
from commonmap.types import (
    Candidate,
    Cloud,
    Float64s,
    Leaves,
    Match,
    Progress,
    SearchPicture,
    no_progress,
)

WORKERS = count_cores(2)
"""Threads; the answer does not depend on them."""


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
        progress("prepare the maps")
        base, draft = both(
            lambda: prepare(target, "target", config),
            lambda: prepare(source, "source", config),
            WORKERS,
        )

    # 2. height slabs of both on one cell size, taken from the data
    with _timed(timings, "grid"):
        progress("height maps")
        cell, edges, max_height = choose_grid(base, draft, config)
        base_layers, draft_layers = both(
            lambda: build_layers(base, cell, edges, max_height),
            lambda: build_layers(draft, cell, edges, max_height),
            WORKERS,
        )
    if config.grid.rays:
        with _timed(timings, "rays"):
            progress("trace the rays")
            base_layers, draft_layers = both(
                lambda: know_by_rays(base_layers, target, base),
                lambda: know_by_rays(draft_layers, source, draft),
                WORKERS,
            )

    # 3. every x, y and yaw; and again with the source mirrored
    with _timed(timings, "search"):
        found, decoy = _search_both(base_layers, draft_layers, config, progress)
        witness, witness_decoy = found, decoy
        if METRICS[config.search.metric].layers != "slabs":
            # Whatever metric searched, the verdict is on evidence against what chance finds of it
            by_evidence = config.with_values(search={"metric": "evidence"})
            witness, witness_decoy = _search_both(base_layers, draft_layers, by_evidence, progress)

    # 4. z in closed form, then all six degrees of freedom on the points, of the best pose, of those
    #    close to it, and of the mirrored source's, which cannot be right
    refined, figures = None, NOTHING
    if len(found.score):
        with _timed(timings, "refine"):
            progress("refine")
            searched = max(cell, found.cell)
            maps = Maps(base, draft, base_layers, draft_layers, cell, edges, max_height, searched)
            found, refined, figures = verify(
                maps, found, witness, witness_decoy, on_evidence=witness is found,
                sure=config.decide.mode == "off", workers=WORKERS,
            )  # fmt: skip

    # 5. believe it or not
    with _timed(timings, "decide"):
        progress("decide")
        verdict = decide(figures)
        if config.decide.mode == "off":
            verdict = Verdict(True, verdict.confidence, "accepted unseen, as decide.mode is off")
        picture = _draw(base_layers.slabs, draft_layers.slabs, base, draft, found, decoy, config)
    return _answer(base, draft, found, decoy, refined, figures, verdict, config, timings, picture)


def least_overlap(config: Config) -> float:
    """Return the share of the source's known cells that a pose must place on known cells."""
    if config.search.min_overlap is not None:
        return config.search.min_overlap
    return 0.1 if METRICS[config.search.metric].layers == "slabs" else 0.5


def _search_both(
    base: Layers, draft: Layers, config: Config, progress: Progress
) -> tuple[Peaks, Peaks]:
    """Return the best poses of the source as it is, and of the mirrored source.

    At a glance where that tells, else of the whole search. Raises EmptyMapError where nothing
    stands on one of the maps.
    """
    if not draft.slabs.occupied.any() or not base.slabs.occupied.any():
        side = "source" if not draft.slabs.occupied.any() else "target"
        raise EmptyMapError(
            f"nothing stands on the ground of the {side} map between "
            f"{base.grid.slab_edges[0]:.2g} and {base.grid.slab_edges[-1]:.2g} m; "  # type: ignore[index]
            "there is nothing to match"
        )

    if METRICS[config.search.metric].layers == "slabs":
        glance = _search(base, draft, plan_glance(base.slabs, draft.slabs), config, progress)
        if is_told_at_a_glance(*glance):
            return glance
        return _search(base, draft, plan_search(base.slabs, draft.slabs), config, progress)
    found, decoy = (
        search_metric(
            base.grid, draft.grid, metric=config.search.metric, normalise=config.search.normalise,
            floor=config.search.floor, min_overlap=least_overlap(config), mirrored=mirrored,
            arrays=config.compute.arrays, workers=WORKERS, progress=_renamed(progress, mirrored),
        )
        for mirrored in (False, True)
    )  # fmt: skip
    return found, decoy


def _search(
    base: Layers, draft: Layers, plan: SearchPlan, config: Config, progress: Progress
) -> tuple[Peaks, Peaks]:
    """Return the best poses by the evidence, of the source as it is and mirrored."""
    return search_both(
        base.slabs, draft.slabs, min_overlap=least_overlap(config), plan=plan, workers=WORKERS,
        compute=config.compute, progress=progress,
    )  # fmt: skip


def _renamed(progress: Progress, mirrored: bool) -> Progress:
    """Return the progress of a search, which says so where the source is mirrored."""
    if not mirrored:
        return progress
    return lambda step, share=0.0: progress("search the mirrored map", share)


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
        elsewhere = ranks_elsewhere(found, found.cell)
        others = [candidate(int(rank)) for rank in elsewhere[: config.search.n_rivals]]
    T, covariance, centre = None, None, None
    if refined is not None:
        best = in_map_frames(refined.T_target_source)
        if accepted:
            T = best
            R = np.kron(np.eye(2), T_map_prepared[:3, :3])
            with _timed(timings, "refine"):
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
    columns = centre_columns(
        list_columns(coarsen(draft, max(1, round(0.5 * cell / draft.cell)))), found.centre
    )  # fmt: skip
    side = 2 * int(np.ceil(float(np.hypot(*columns.xy.T).max()) / cell)) + 2
    low = np.full(2, -0.5 * side * cell)
    yaw = float(found.pose[0, 2])
    occupied, known = scatter(
        columns.xy, columns.occupied, columns.known, math.cos(yaw), math.sin(yaw), cell, low,
        side, side,
    )  # fmt: skip
    score, _ = evidence_surface(
        transform_target(grid, (side, side)), occupied, known,
        min_overlap=least_overlap(config) * np.count_nonzero(known),
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
    """Add the seconds that the block takes to those of a step."""
    start = time.perf_counter()
    yield
    timings[step] = timings.get(step, 0.0) + time.perf_counter() - start
