"""What a run of the paper's experiment leaves behind besides its figures: numbers and a page."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from commonmap.report.pose import to_json
from commonmap.study.claims import CLOSE, TWICE, ReadingRow, as_record
from commonmap.study.paper_maps import AREA, CELL, MAX_HEIGHT
from commonmap.study.paper_run import FLOOR, VOXEL, Experiment, Found
from commonmap.study.readings import METRICS, READINGS
from commonmap.version import __version__

TITLES = {"kl": "Kullback-Leibler", "jeffreys": "Jeffreys", "k": "K divergence"}

ENTRIES = (
    "study.json", "times.json", "scores.csv", "readings.csv", "paper.md", "claims.jsonl",
    "figure1_diagram.svg", "figure1_diagram.png", "figure2_scene.png", "figure3_clouds.png",
    "figure4_octrees.png", "figure5_areas.png", "figure6_common_map.png", "figure7_claim.png",
)  # fmt: skip
"""Every name that a run may leave in its folder, and so may replace there."""

CAPTIONS = {
    "figure1_diagram": "Fig. 1. Block diagram of the common map obtaining process.",
    "figure2_scene": "Fig. 2. The simulated scene, and the true ways of both robots.",
    "figure3_clouds": "Fig. 3. Georeferenced point clouds by LOAM: (a) ground, (b) aerial vehicle.",
    "figure4_octrees": "Fig. 4. Octree maps: (a) ground vehicle, (b) aerial vehicle.",
    "figure5_areas": "Fig. 5. Matched areas of the maps, heights under 1 m.",
    "figure6_common_map": "Fig. 6. The resulting common map: octree and occupancy grid.",
    "figure7_claim": "The paper's claim on its scores, under every reading of its formulas.",
}


def write_tables(
    run: Experiment, rows: Sequence[ReadingRow], n_scenes: int, figures: Sequence[str],
    folder: Path,
) -> None:  # fmt: skip
    """Write study.json, times.json, the two tables as CSV, and paper.md.

    All but times.json is the same for the same seed. n_scenes: further scenes in `rows`.
    """
    (folder / "study.json").write_text(to_json(describe(run, rows, n_scenes)), encoding="utf-8")
    (folder / "times.json").write_text(to_json(describe_times(run)), encoding="utf-8")
    (folder / "scores.csv").write_text(_csv(_score_rows(run)), encoding="utf-8")
    (folder / "readings.csv").write_text(_csv(reading_rows(rows)), encoding="utf-8")
    page = paper_page(run, rows, n_scenes, figures)
    (folder / "paper.md").write_text(page, encoding="utf-8")


def describe(run: Experiment, rows: Sequence[ReadingRow], n_scenes: int) -> dict[str, Any]:
    """Return all numbers of a run but its times as plain values, for JSON."""
    return {
        "version": __version__,
        "seed": run.seed,
        "set_up": {
            "cell": CELL, "voxel": VOXEL, "max_height": MAX_HEIGHT, "area": AREA, "floor": FLOOR,
            "size": run.plan.world.size, "seed_world": run.plan.seed_world,
        },
        "odometry": {
            name: {
                "turns": robot.n_turns, "way": errors.way, "ape_rms": errors.ape,
                "relative_share": errors.relative, "map_rms": map_error,
                "points": len(robot.cloud.xyz),
            }
            for name, robot, errors, map_error in zip(
                ("uav", "ugv"), (run.base, run.draft), run.errors, run.map_errors, strict=True
            )
        },
        "T_target_source": run.T_target_source.tolist(),
        "whole": {name: _found(found) for name, found in run.whole.items()},
        "areas": [
            {
                "corner": area.corner.tolist(),
                "objects": area.objects,
                **{name: _found(found) for name, found in answers.items()},
            }
            for area, answers in zip(run.areas, run.found, strict=True)
        ],
        "pose_by_k": _off(run.off),
        "pose_refined": _off(run.off_merged),
        "product": {
            "accepted": run.product.accepted,
            "reason": run.product.reason,
            "off": None if run.product_off is None else _off(run.product_off),
        },
        "readings": [
            {"names": [r.name for r in READINGS], "metrics": list(METRICS), **as_record(item)}
            for item in run.readings
        ],
        "claim": {"scenes": n_scenes, "rows": reading_rows(rows)},
    }  # fmt: skip


def describe_times(run: Experiment) -> dict[str, Any]:
    """Return the seconds of each step (by the clock), and of each metric's search (one core)."""
    return {
        "steps": dict(run.seconds),
        "search_whole": {name: found.seconds for name, found in run.whole.items()},
        "search_area_mean": {
            name: float(np.mean([answers[name].seconds for answers in run.found]))
            for name in METRICS
        },
    }


def reading_rows(rows: Sequence[ReadingRow]) -> list[dict[str, Any]]:
    """Return a row of plain values for each reading."""
    answer = []
    for row in rows:
        values: dict[str, Any] = {
            "cells": row.reading.cells,
            "zeros": "dropped" if row.reading.floor is None else f"{row.reading.floor:g} m",
            "normalise": row.reading.normalise,
            "areas": row.n,
        }
        for where, scores in (("truth", row.truth), ("best", row.best)):
            for name, score in zip(METRICS, scores, strict=True):
                values[f"{name}_{where}"] = _number(score)
        values |= {
            "kl_over_k_truth": _number(row.kl_k[0]),
            "jeffreys_over_k_truth": _number(row.jeffreys_k[0]),
            "kl_over_k_best": _number(row.kl_k[1]),
            "jeffreys_over_k_best": _number(row.jeffreys_k[1]),
            "claim_holds_truth": _number(row.holds_truth),
            "claim_holds_best": _number(row.holds_best),
        }
        for name, right, metres in zip(METRICS, row.right, row.metres, strict=True):
            values[f"{name}_right"] = _number(right)
            values[f"{name}_median_metres"] = _number(metres)
        answer.append(values)
    return answer


def verdict(rows: Sequence[ReadingRow]) -> str:
    """Return one sentence: which reading reproduces the paper's claim, if any."""
    both = [row for row in rows if row.holds_truth > 0.5 and row.holds_best > 0.5]
    some = [row for row in rows if max(row.holds_truth, row.holds_best) > 0.5]
    if both:
        return "The claim holds in most areas under: " + "; ".join(r.reading.name for r in both)
    if some:
        return (
            "The claim holds in most areas at the true or at the best pose, not at both, under: "
            + "; ".join(r.reading.name for r in some)
        )
    most = max(rows, key=lambda row: max(row.holds_truth, row.holds_best))
    share = max(most.holds_truth, most.holds_best)
    if share == 0.0:
        return "No reading reproduces the claim: it holds in no area under any of them"
    return (
        f"No reading reproduces the claim: at best it holds in {100 * share:.0f} % of the areas "
        f"({most.reading.name})"
    )


def paper_page(
    run: Experiment, rows: Sequence[ReadingRow], n_scenes: int, figures: Sequence[str]
) -> str:
    """Return the page that shows the whole run, as Markdown."""
    lines = [
        "# The paper's experiment, reproduced", "",
        "Akay, Aybakan and Temeltas, *Map Matching Performance under Various Similarity Metrics "
        "for Heterogeneous Robot Teams*.",
        f"Made by `commonmap study paper --seed {run.seed}`"
        + (f" `--scenes {n_scenes}`" if n_scenes else "")
        + f" (commonmap {__version__}); numbers in study.json.", "",
    ]  # fmt: skip
    for name in figures:
        stem, suffix = name.rsplit(".", 1)
        if suffix == "png":
            lines += [f"![{CAPTIONS[stem]}]({name})", "", f"*{CAPTIONS[stem]}*", ""]
    right = {m: sum(found[m].right for found in run.found) for m in METRICS}
    lines += [
        "## Scores", "",
        f"Heights under {MAX_HEIGHT:g} m, cells of {CELL:g} m, all cells known in both, zeros at "
        f"{FLOOR:g} m, normalised over the overlap. A pose is right within 1 m and 5 degrees.", "",
        "| metric | score at the best pose | at the true pose | best pose off | areas right |",
        "|---|---|---|---|---|",
        *(
            f"| {TITLES[m]} | {run.whole[m].score:.4f} | {run.whole[m].at_truth:.4f} | "
            f"{run.whole[m].metres:.2f} m, {np.degrees(run.whole[m].radians):.1f}° | "
            f"{right[m]} of {len(run.areas)} |"
            for m in METRICS
        ),
        "",
        f"The pose by K, made exact: {run.off[0]:.3f} m and {np.degrees(run.off[1]):.2f}° from the "
        f"truth; refined on the points {run.off_merged[0]:.3f} m and "
        f"{np.degrees(run.off_merged[1]):.2f}°. This software's own answer: {run.product.reason}.",
        "",
        "## The claim", "",
        '"Best similarity scores are achieved by K divergence, while KL divergence is very close '
        'to it. Jeffreys similarity score is almost two times of K divergence."', "",
        f"Here: K lowest, KL at most {CLOSE:g} times K, Jeffreys {TWICE[0]:g} to {TWICE[1]:g} "
        f"times K, over {rows[0].n} areas of {AREA:g} m"
        + (f" in {n_scenes} scenes (maps with true poses)." if n_scenes else " of this run."), "",
        f"**{verdict(rows)}.**", "",
        *claim_table(rows), "",
    ]  # fmt: skip
    return "\n".join(lines)


def claim_table(rows: Sequence[ReadingRow]) -> list[str]:
    """Return the table of readings as lines of Markdown."""
    lines = [
        "| cells | zeros | normalised | KL, J, K at the true pose | KL/K | J/K | at the best pose: "
        "KL/K | J/K | claim holds (true, best) | right: KL, J, K |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        zeros = "dropped" if row.reading.floor is None else f"{row.reading.floor:g} m"
        scores = ", ".join(f"{x:.3g}" for x in row.truth)
        right = ", ".join(f"{100 * x:.0f} %" for x in row.right)
        lines.append(
            f"| {row.reading.cells} | {zeros} | {row.reading.normalise} | {scores} | "
            f"{_ratio(row.kl_k[0])} | {_ratio(row.jeffreys_k[0])} | {_ratio(row.kl_k[1])} | "
            f"{_ratio(row.jeffreys_k[1])} | {100 * row.holds_truth:.0f} %, "
            f"{100 * row.holds_best:.0f} % | {right} |"
        )
    return lines


def _ratio(value: float) -> str:
    return f"{value:.2f}" if np.isfinite(value) else "none positive"


def _score_rows(run: Experiment) -> list[dict[str, Any]]:
    """Return a row for each area (0 is the whole draft) and metric."""
    rows: list[dict[str, Any]] = []
    for number, answers in enumerate((run.whole, *run.found)):
        objects = run.areas[number - 1].objects if number else None
        for name, found in answers.items():
            values = {k: v for k, v in _found(found).items() if k != "pose"}
            rows.append({"area": number, "objects": objects, "metric": name, **values})
    return rows


def _found(found: Found) -> dict[str, Any]:
    return {
        "pose": found.pose.tolist(),
        "score": _number(found.score),
        "score_at_truth": _number(found.at_truth),
        "rival": _number(found.rival),
        "metres": found.metres,
        "degrees": float(np.degrees(found.radians)),
        "right": bool(found.right),
    }


def _off(off: tuple[float, float]) -> dict[str, float]:
    return {"metres": float(off[0]), "degrees": float(np.degrees(off[1]))}


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _csv(rows: Sequence[dict[str, Any]]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()
