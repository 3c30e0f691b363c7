"""The paper's claim on its three scores, tested for every reading of the formulas, over scenes.

"Best similarity scores are achieved by K divergence, while KL divergence is very close to it.
Jeffreys similarity score is almost two times of K divergence." One record a scene is kept (raw, as
measured); tables are made of the records afterwards.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from commonmap.errors import InputError
from commonmap.io.atomic import writing
from commonmap.mapping.octree import octree_from_points
from commonmap.mapping.points import points_of
from commonmap.sim.pairs import simulate_pair
from commonmap.study.paper_maps import cut_areas, make_height_maps
from commonmap.study.paper_run import AREAS_READ, VOXEL, AreaReadings, busiest, read_area
from commonmap.study.readings import METRICS, READINGS, Reading
from commonmap.types import Float64s, Progress, no_progress

CLOSE = 1.25
"""KL counts as "very close" to K up to this many times K."""

TWICE = (1.6, 2.2)
"""Jeffreys counts as "almost two times" K between these many times K."""

RIGHT = (1.0, np.radians(5.0))
"""A pose is right within so many metres and radians: a cell of 0.5 m and a yaw step of 4 degrees
allow no less."""

FORMAT = 1


@dataclass(frozen=True, eq=False)
class ReadingRow:
    """What one reading of the formulas gives over n areas.

    truth, best: medians (3,) of the scores at the true pose and at each metric's best pose.
    kl_k, jeffreys_k: medians of the ratios at the true pose, and at the best.
    holds_truth, holds_best: share of the areas in which the paper's claim holds. right: (3,) share
    of the areas that each metric places right. metres: (3,) median error.
    """

    reading: Reading
    n: int
    truth: Float64s
    best: Float64s
    kl_k: tuple[float, float]
    jeffreys_k: tuple[float, float]
    holds_truth: float
    holds_best: float
    right: Float64s
    metres: Float64s


def claim_holds(kl: Any, jeffreys: Any, k: Any) -> Any:
    """Return whether K is the lowest, KL very close to it and Jeffreys almost twice it.

    Numbers or arrays; of scores that are not positive no ratio is told, and the claim fails.
    """
    kl, jeffreys, k = (np.asarray(x, np.float64) for x in (kl, jeffreys, k))
    positive = (kl > 0.0) & (jeffreys > 0.0) & (k > 0.0)
    close = (k <= kl) & (kl <= CLOSE * k)
    twice = (TWICE[0] * k <= jeffreys) & (jeffreys <= TWICE[1] * k)
    return positive & close & twice


def measure_scene(
    seed: int, *, areas_read: int = AREAS_READ, size: float | None = None,
    progress: Progress = no_progress,
) -> dict[str, Any]:  # fmt: skip
    """Return the raw record of one scene: every reading on its busiest areas.

    The maps are made with the true poses: odometry is left out, which makes a scene cheap.
    """
    progress(f"scene {seed}")
    pair = simulate_pair("paper", rng=np.random.default_rng(seed), size=size)
    points = [
        points_of(octree_from_points(cloud.xyz, VOXEL), "map")
        for cloud in (pair.target, pair.source)
    ]
    maps = make_height_maps(points[0], points[1], pair.T_target_source)
    areas = cut_areas(maps.grids[1])
    found = [read_area(maps, areas[n], n) for n in busiest(areas, areas_read)]
    return {
        "format": FORMAT,
        "seed": seed,
        "areas": [
            {"objects": round(areas[item.area].objects, 4), **as_record(item)} for item in found
        ],
    }


def as_record(item: AreaReadings) -> dict[str, Any]:
    """Return the readings of an area as plain numbers, (R, 3) row by row; None for no score."""
    return {
        "area": item.area,
        "at_truth": _plain(item.at_truth, 7),
        "best": _plain(item.best.score, 7),
        "metres": _plain(item.metres, 3),
        "radians": _plain(item.radians, 4),
    }


def measure_scenes(
    seeds: Iterable[int], records: Path | None, *, areas_read: int = AREAS_READ,
    size: float | None = None, progress: Progress = no_progress,
) -> list[dict[str, Any]]:  # fmt: skip
    """Return a record for each seed; those that `records` holds already are not measured again.

    records: a file of one record a line, to which new ones are added as they come.
    """
    known = {} if records is None or not records.exists() else read_records(records)
    if records is not None and records.exists():
        _drop_torn_line(records)
    answer = []
    for seed in seeds:
        if seed not in known:
            known[seed] = measure_scene(seed, areas_read=areas_read, size=size, progress=progress)
            if records is not None:
                with open(records, "a", encoding="utf-8") as file:
                    file.write(json.dumps(known[seed], separators=(",", ":")) + "\n")
        answer.append(known[seed])
    return answer


def read_records(path: Path) -> dict[int, dict[str, Any]]:
    """Return the records of a file by seed. A last line that was cut short is left out."""
    found: dict[int, dict[str, Any]] = {}
    lines = path.read_text(encoding="utf-8").split("\n")
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        try:
            record = json.loads(line)
            if record["format"] != FORMAT or len(record["areas"][0]["best"]) != len(READINGS):
                raise KeyError("format")
        except (ValueError, KeyError, TypeError, IndexError):
            if number == len(lines):  # the measurement was ended while it wrote this line
                continue
            raise InputError(f"{path}, line {number}: this is no record of the study") from None
        found[int(record["seed"])] = record
    return found


def _drop_torn_line(path: Path) -> None:
    """Take off a last line that was not written to its end, so that the next begins a new one."""
    data = path.read_bytes()
    if not data.endswith(b"\n"):
        with writing(path) as part:
            part.write_bytes(data[: data.rfind(b"\n") + 1])


def tabulate(records: Sequence[dict[str, Any]]) -> list[ReadingRow]:
    """Return a row for each reading over all areas of the records."""
    areas = [area for record in records for area in record["areas"]]
    if not areas:
        raise InputError("there are no records to make a table of")
    truth, best, metres, radians = (
        np.array([area[name] for area in areas], np.float64)  # (n, R, 3); None becomes NaN
        for name in ("at_truth", "best", "metres", "radians")
    )
    rows = []
    for r, reading in enumerate(READINGS):
        right = (metres[:, r] < RIGHT[0]) & (radians[:, r] < RIGHT[1])
        rows.append(
            ReadingRow(
                reading, len(areas), _median(truth[:, r]), _median(best[:, r]),
                (_ratio(truth[:, r], 0), _ratio(best[:, r], 0)),
                (_ratio(truth[:, r], 1), _ratio(best[:, r], 1)),
                float(claim_holds(*truth[:, r].T).mean()),
                float(claim_holds(*best[:, r].T).mean()),
                right.mean(axis=0), _median(metres[:, r]),
            )
        )  # fmt: skip
    return rows


def _ratio(scores: Float64s, metric: int) -> float:
    """Return the median ratio of a metric's score (n, 3) to that of K, where both are positive."""
    k = scores[:, METRICS.index("k")]
    used = (k > 1e-9) & (scores[:, metric] > 0.0)
    return float(np.median(scores[used, metric] / k[used])) if used.any() else float("nan")


def _median(values: Float64s) -> Float64s:
    """Return the median over the areas, those without a score left out."""
    known = [column[np.isfinite(column)] for column in values.T]
    return np.array([np.median(c) if len(c) else np.nan for c in known])


def _plain(values: Float64s, digits: int) -> list[Any]:
    """Return an array as nested lists, NaN as None."""
    rounded = np.round(values, digits)
    return [[None if not np.isfinite(x) else float(x) for x in row] for row in rounded]
