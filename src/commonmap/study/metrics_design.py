"""The design of the metric study: which conditions meet in which pair, and what a record holds.

Per scene kind a replicate is 12 places of 4 areas: the 12 combinations of drift, tilt and change
once each, and the 48 combinations of grid, heights, overlap and noise once each, shuffled. So the
levels of each condition appear equally often within each kind, and any number of whole replicates
is balanced. A record depends on the seed and its index alone.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from itertools import product
from typing import Any

import numpy as np

from commonmap.errors import EmptyMapError, InputError
from commonmap.study.metrics_cases import build_maps, cut_area, record_place
from commonmap.study.metrics_scores import COLUMNS
from commonmap.study.metrics_search import errors, search_all

KINDS = ("paper", "city", "village", "forest", "industrial", "field")
DRIFTS = (0.0, 0.01, 0.03)
"""Share of the distance travelled, of the ground robot's poses."""
TILTS_DEG = (0.0, 3.0)
CHANGES = (0.0, 0.3)
"""Share of the movable things."""
GRIDS = ((10.0, 0.5), (10.0, 1.0), (20.0, 1.0))
"""Edge of the area and of a cell, metres."""
HEIGHTS = ("low", "all")
"""Heights under 1 m, as the source paper takes, or all."""
OVERLAPS = (1.0, 0.8, 0.6, 0.4)
NOISES = (0.0, 0.1)
"""Metres, standard deviation of each coordinate of the area's points."""

AREAS = 4
REPLICATES = 4
PER_REPLICATE = len(DRIFTS) * len(TILTS_DEG) * len(CHANGES)
"""Places of one kind in a replicate."""


@dataclass(frozen=True)
class AreaPlan:
    """The conditions of one pair; units as above."""

    size: float
    cell: float
    heights: str
    overlap: float
    noise: float


@dataclass(frozen=True)
class PlacePlan:
    """One task: a place and its areas. index: counts the tasks of a study."""

    index: int
    kind: str
    replicate: int
    drift: float
    tilt_deg: float
    change: float
    areas: tuple[AreaPlan, ...]


def plan_study(seed: int, *, quick: bool = False) -> list[PlacePlan]:
    """Return all tasks of a study in the order in which they run: replicate by replicate.

    quick: a sixth of one replicate, two places of each kind.
    """
    plans: list[PlacePlan] = []
    for replicate in range(REPLICATES):
        columns = []
        for k, kind in enumerate(KINDS):
            rng = np.random.default_rng([seed, replicate, k])
            places = list(product(DRIFTS, TILTS_DEG, CHANGES))
            pairs = list(product(GRIDS, HEIGHTS, OVERLAPS, NOISES))
            places = [places[i] for i in rng.permutation(len(places))]
            pairs = [pairs[i] for i in rng.permutation(len(pairs))]
            columns.append((kind, places, pairs))
        for n in range(PER_REPLICATE):
            for kind, places, pairs in columns:
                areas = tuple(
                    AreaPlan(*grid, heights, overlap, noise)
                    for grid, heights, overlap, noise in pairs[AREAS * n : AREAS * (n + 1)]
                )
                plans.append(PlacePlan(len(plans), kind, replicate, *places[n], areas))
    return plans[: 2 * len(KINDS)] if quick else plans


def run_place(seed: int, index: int) -> list[dict[str, Any]]:
    """Return the records of one task, one a pair: conditions, and what each metric found."""
    plan = plan_study(seed)[index]
    rng = np.random.default_rng([seed, 1_000_000 + index])
    place = record_place(
        plan.kind, drift=plan.drift, tilt=float(np.radians(plan.tilt_deg)), change=plan.change,
        rng=rng,
    )  # fmt: skip
    records = []
    for number, asked in enumerate(plan.areas):
        conditions = {key: value for key, value in asdict(plan).items() if key != "areas"}
        record: dict[str, Any] = {**conditions, "area": number, **asdict(asked)}
        try:
            area = cut_area(
                place, number, size=asked.size, overlap=asked.overlap, noise=asked.noise,
                rng=np.random.default_rng([seed, 2_000_000 + AREAS * index + number]),
            )  # fmt: skip
            target, source = build_maps(area, asked.cell, low=asked.heights == "low")
        except (EmptyMapError, InputError) as problem:  # nothing to search: no metric finds it
            records.append({**record, "failed": str(problem), **_nothing()})
            continue
        found = search_all(target, source, T_target_source=area.T_target_source)
        xy, yaw = errors(found, area.T_target_source)
        strict_xy, strict_yaw = errors(found, area.T_target_source, strict=True)
        records.append(
            {
                **record,
                "true_overlap": round(area.overlap, 3),
                "n_poses": found.n_poses,
                "yaw_step_deg": round(float(np.degrees(found.yaw_step)), 3),
                "xy": _rounded(xy, 2),
                "yaw_deg": _rounded(np.degrees(yaw), 1),
                "sharpness": _rounded(found.sharpness, 1),
                "margin": _rounded(found.margin, 1),
                "strict_xy": _rounded(strict_xy, 1),
                "strict_yaw_deg": _rounded(np.degrees(strict_yaw), 1),
            }
        )
    return records


def _rounded(values: np.ndarray[Any, np.dtype[np.float64]], digits: int) -> list[float | None]:
    """Return numbers as a record keeps them; what is not finite is None."""
    return [round(float(x), digits) if np.isfinite(x) else None for x in values]


def _nothing() -> dict[str, Any]:
    none = [None] * len(COLUMNS)
    return {
        "true_overlap": None, "n_poses": 0, "yaw_step_deg": None, "xy": none, "yaw_deg": none,
        "sharpness": none, "margin": none, "strict_xy": none, "strict_yaw_deg": none,
    }  # fmt: skip
