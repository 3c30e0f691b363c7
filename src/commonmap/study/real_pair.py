"""Which metric places a real draft: crops of several sizes of one pair, every metric of the table.

The draft is first moved at random: over the full circle and by up to 200 m. The truth is known for
the pair as it lies in its files, so it is known for the moved draft, and the software is not told.
A raw record a crop is written as it comes; tables are made of the records afterwards.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from commonmap.config import Config
from commonmap.errors import CommonmapError, InputError
from commonmap.frames import apply, check_T, from_xyz_yaw, invert
from commonmap.io.atomic import writing
from commonmap.mapping.height_map import build_height_map, choose_cell, choose_slabs
from commonmap.matching.maps import Prepared, prepare
from commonmap.study.metrics_scores import LABELS
from commonmap.study.metrics_search import Found, errors, search_all
from commonmap.types import Float64s, GridMap, Progress, no_progress

SIZES: tuple[float | None, ...] = (6.0, 10.0, 16.0, None)
"""Metres, edges of the crops; None is the whole draft."""

LOW = 1.0
"""Metres: the heights that the source paper looks at."""

SUCCESS = ((1.0, 2.0), (0.5, 5.0))
"""Metres and degrees within which a pose counts as found, two ways."""

DISPLACED = 200.0
"""Metres, along x, y and z, by which the draft is moved at most."""

MAX_CELL = 0.5
"""Metres; cells are no coarser, whatever the extent of the draft: crops are small."""

FORMAT = 1


@dataclass(frozen=True)
class Case:
    """One crop. size: metres, None for the whole; low: only heights under 1 m; draw: its number."""

    size: float | None
    low: bool
    draw: int

    @property
    def name(self) -> str:
        """Name of its record."""
        size = "whole" if self.size is None else f"{self.size:g}m"
        return f"{size}-{'low' if self.low else 'all'}-{self.draw:02d}"


@dataclass(frozen=True)
class Row:
    """How a metric did on the crops of one size and height range. found: share, for `SUCCESS`."""

    metric: str
    size: float | None
    low: bool
    n: int
    found: tuple[float, float]
    median_metres: float


def read_motion(path: Path) -> Float64s:
    """Return the (4, 4) motion that a text file holds, four rows of four numbers."""
    try:
        rows = np.array([line.split() for line in path.read_text().splitlines() if line.strip()])
        values = rows.astype(np.float64)
    except OSError as error:
        raise InputError(f"cannot read {path}: {(error.strerror or str(error)).lower()}") from None
    except ValueError:
        raise InputError(f"{path} must hold four rows of four numbers") from None
    if values.shape != (4, 4):
        raise InputError(f"{path} must hold four rows of four numbers; {values.shape} came")
    return check_T(values, f"the motion in {path}")


def plan_cases(draws: int) -> list[Case]:
    """Return the crops of a study: `draws` of each size and height range."""
    return [
        Case(size, low, draw) for draw in range(draws) for low in (False, True) for size in SIZES
    ]


def study_real(
    base: Float64s, draft: Float64s, T_base_draft: Float64s, records: Path, *,
    seed: int, draws: int = 4, cell: float | None = None, progress: Progress = no_progress,
) -> list[dict[str, Any]]:  # fmt: skip
    """Return the record of every crop of a pair; those in the folder `records` are not run again.

    base, draft: (N, 3) metres, z roughly up. T_base_draft: (4, 4) the truth. draws: crops of each
    size and height range. cell: metres; chosen from the data unless given.
    """
    if cell is not None and not 0.05 <= cell <= 5.0:
        raise InputError(f"--resolution must lie in 0.05 to 5 m; {cell:g} came")
    if not 1 <= draws <= 100:
        raise InputError(f"--draws must lie in 1 to 100; {draws} came")
    records.mkdir(parents=True, exist_ok=True)
    cases = plan_cases(draws)
    width = min(MAX_CELL, choose_cell(base, draft)) if cell is None else cell
    target: Prepared | None = None
    answers = []
    for number, case in enumerate(cases):
        path = records / f"{case.name}.json"
        progress(f"crop {case.name}", number / len(cases))
        if path.exists():
            answers.append(read_record(path, seed))
            continue
        if target is None:
            target = prepare(base, "base map", Config())
        answers.append(run_case(target, draft, T_base_draft, case, seed=seed, cell=width))
        with writing(path) as part:
            part.write_text(json.dumps(answers[-1]) + "\n", encoding="utf-8")
    return answers


def run_case(
    target: Prepared, draft: Float64s, T_base_draft: Float64s, case: Case, *, seed: int,
    cell: float,
) -> dict[str, Any]:  # fmt: skip
    """Return the record of one crop: the error and the sharpness of every metric."""
    # 1. a crop at a random place, moved by a random motion; what is true of it
    size_number = SIZES.index(case.size)
    rng = np.random.default_rng([seed, case.draw, size_number])
    xyz = crop(draft, case.size, rng)
    x, y, z = rng.uniform(-DISPLACED, DISPLACED, 3)
    moved = from_xyz_yaw(x, y, z, rng.uniform(-np.pi, np.pi))
    record: dict[str, Any] = {
        "format": FORMAT, "seed": seed, "case": asdict(case), "cell": cell, "points": len(xyz),
        "labels": list(LABELS),
    }  # fmt: skip
    try:
        # 2. the product's own way to height maps
        source = prepare(apply(moved, xyz), "crop", Config())
        T_truth = (
            target.T_prepared_map @ T_base_draft @ invert(moved) @ invert(source.T_prepared_map)
        )
        grids = _height_maps(target, source, cell, low=case.low)
        # 3. every metric at every pose
        found = search_all(*grids, T_target_source=T_truth)
    except CommonmapError as error:  # nothing stands in this crop: no metric has an answer
        return record | {"failed": str(error)}
    return record | _measured(found, T_truth)


def crop(xyz: Float64s, size: float | None, rng: np.random.Generator) -> Float64s:
    """Return a square piece of an (N, 3) cloud at a random place inside it; all where None."""
    low, high = np.quantile(xyz[:, :2], [0.01, 0.99], axis=0)
    room = rng.uniform(0.0, 1.0, 2)
    if size is None:
        return xyz
    if (high - low).min() < size:
        raise InputError(
            f"the draft is {(high - low)[0]:.1f} x {(high - low)[1]:.1f} m, too small for a crop "
            f"of {size:g} m"
        )
    corner = low + room * (high - low - size)
    inside = ((xyz[:, :2] >= corner) & (xyz[:, :2] < corner + size)).all(axis=1)
    return np.asarray(xyz[inside])


def _height_maps(
    target: Prepared, source: Prepared, cell: float, *, low: bool
) -> tuple[GridMap, GridMap]:
    limit = LOW if low else None
    edges = choose_slabs(source.height, cell=cell, max_height=limit)
    first, second = (
        build_height_map(
            item.xyz, cell=0.5 * cell, slab_edges=edges, ground=item.ground, max_height=limit,
            height=item.height,
        )
        for item in (target, source)
    )  # fmt: skip
    return first, second


def _measured(found: Found, T_truth: Float64s) -> dict[str, Any]:
    metres, radians = errors(found, T_truth)

    def plain(values: Float64s, digits: int) -> list[float | None]:
        return [None if not np.isfinite(v) else round(float(v), digits) for v in values]

    return {
        "metres": plain(metres, 3),
        "degrees": plain(np.degrees(radians), 2),
        "sharpness": plain(found.sharpness, 3),
        "margin": plain(found.margin, 3),
        "poses": found.n_poses,
    }


def read_record(path: Path, seed: int) -> dict[str, Any]:
    """Return a record, or raise where it is none, or one of another study."""
    try:
        record: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        fits = record["format"] == FORMAT and record["labels"] == list(LABELS)
        own = record["seed"]
    except (ValueError, KeyError, TypeError):
        raise InputError(f"{path} is no record of this study") from None
    if not fits or own != seed:
        raise InputError(f"{path} is of another study (seed {own}); give another folder")
    return record


def tabulate(records: Sequence[dict[str, Any]]) -> list[Row]:
    """Return a row for each metric, size and height range. A crop without an answer counts as not
    found."""
    return list(_rows(records))


def _rows(records: Sequence[dict[str, Any]]) -> Iterator[Row]:
    for size in SIZES:
        for low in (False, True):
            mine = [
                r for r in records if r["case"]["size"] == size and r["case"]["low"] == low
            ]  # fmt: skip
            if not mine:
                continue
            nothing = [None] * len(LABELS)
            metres, degrees = (
                np.array([r.get(name, nothing) for r in mine], np.float64)
                for name in ("metres", "degrees")
            )
            for k, label in enumerate(LABELS):
                within = [
                    float(((metres[:, k] <= m) & (degrees[:, k] <= d)).mean()) for m, d in SUCCESS
                ]
                known = metres[np.isfinite(metres[:, k]), k]
                median = float(np.median(known)) if len(known) else float("nan")
                yield Row(label, size, low, len(mine), (within[0], within[1]), median)


def make_table(rows: Sequence[Row]) -> list[str]:
    """Return a table in Markdown: a line a metric, a column a size and height range, best first.

    A cell: crops found within the first of `SUCCESS`, then within the second.
    """
    columns = sorted({(row.low, SIZES.index(row.size)) for row in rows})
    by_metric: dict[str, dict[tuple[bool, int], Row]] = {}
    for row in rows:
        by_metric.setdefault(row.metric, {})[(row.low, SIZES.index(row.size))] = row
    heads = [
        ("whole" if SIZES[s] is None else f"{SIZES[s]:g} m") + (", under 1 m" if low else "")
        for low, s in columns
    ]
    numbers = {column: next(r.n for r in rows if (r.low, SIZES.index(r.size)) == column)
               for column in columns}  # fmt: skip
    lines = [
        "| metric | " + " | ".join(heads) + " | all |",
        "|---|" + "---|" * (len(columns) + 1),
        "| *crops* | " + " | ".join(str(numbers[c]) for c in columns)
        + f" | {sum(numbers.values())} |",
    ]  # fmt: skip

    def total(metric: str, way: int) -> int:
        return sum(round(r.found[way] * r.n) for r in by_metric[metric].values())

    for metric in sorted(by_metric, key=lambda m: (-total(m, 0), -total(m, 1), LABELS.index(m))):
        cells = [
            " / ".join(str(round(share * by_metric[metric][c].n)) for share in
                       by_metric[metric][c].found) for c in columns
        ]  # fmt: skip
        both = f"{total(metric, 0)} / {total(metric, 1)}"
        lines.append(f"| {metric} | " + " | ".join(cells) + f" | {both} |")
    return lines
