"""Tables of the metric study, computed from its records alone."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import Any

import numpy as np

from commonmap.metrics.table import METRICS
from commonmap.study.metrics_records import (
    CONDITIONS,
    PACKED,
    STRICT_OVERLAP,
    Results,
    bootstrap_weights,
    gaps,
    gather,
    median_where,
    pack_records,
    read_records,
    strict_rates,
    success,
)
from commonmap.study.metrics_scores import COLUMNS, LABELS
from commonmap.types import Float64s

MAIN = ("evidence", "mi", "zncc", "ncc", "sad", "ssd", "jensen-shannon", "k", "kl", "jeffreys")
"""Metrics that are told by condition: the best known of each family and the source paper's."""


def write_report(out: Path) -> str:
    """Write tables and figures of the records in `out`; return a summary in a few lines.

    metrics.csv: a row a metric. conditions.csv: a row a metric and level of a condition. The
    records are packed into one file beside them. The same records give the same bytes.
    """
    from commonmap.study.metrics_figures import draw_figures

    records = read_records(out)
    results = gather(records)
    weights = bootstrap_weights(results)
    pack_records(records, out / PACKED)
    _write(out / "metrics.csv", metric_rows(results, weights))
    _write(out / "conditions.csv", condition_rows(results, weights))
    draw_figures(results, weights, out)
    best = rank(results)[:5]
    rates = success(results, weights)
    lines = [f"{len(records)} pairs of {len(np.unique(results.place))} places; right most often:"]
    lines += [f"  {LABELS[m]:24s} {interval(rates[m])}" for m in best]
    return "\n".join([*lines, f"tables and figures are in {out}"])


def rank(results: Results) -> list[int]:
    """Return the metrics by success, the best first; of equals in the table's order."""
    return [int(m) for m in np.argsort(-results.right.mean(axis=0), kind="stable")]


def interval(rate: Float64s) -> str:
    """Return a rate and its interval in per cent."""
    return f"{100 * rate[0]:.1f} % ({100 * rate[1]:.1f} to {100 * rate[2]:.1f})"


def metric_rows(results: Results, weights: Float64s) -> list[dict[str, Any]]:
    """Return a row a metric, the best first."""
    rates = success(results, weights)
    order = rank(results)
    behind = gaps(results, weights, order[0])
    loose, strict = strict_rates(results)
    right, wrong = results.right, np.isfinite(results.xy) & ~results.right
    medians = {
        "error_m": median_where(results.xy, right),
        "error_deg": median_where(results.yaw_deg, right),
        "sharpness_right": median_where(results.sharpness, right),
        "sharpness_wrong": median_where(results.sharpness, wrong),
    }
    return [
        {
            "metric": LABELS[m],
            "family": METRICS[COLUMNS[m][0]].family,
            "reading": COLUMNS[m][1],
            "pairs": len(results.place),
            "right": int(right[:, m].sum()),
            **_percent("success", rates[m]),
            **_percent("behind_best", behind[m]),
            "success_06": f"{100.0 * loose[m]:.1f}",
            "success_06_strict": f"{100.0 * strict[m]:.1f}",
            **{key: _number(value[m]) for key, value in medians.items()},
        }
        for m in order
    ]


def condition_rows(results: Results, weights: Float64s) -> list[dict[str, Any]]:
    """Return a row a condition, level and metric."""
    rows = []
    for condition in CONDITIONS:
        values = [c[condition] for c in results.conditions]
        for level in dict.fromkeys(sorted(values)):
            kept = np.array([v == level for v in values])
            rates = success(results, weights, kept)
            rows += [
                {
                    "condition": condition, "level": level, "metric": LABELS[m],
                    "pairs": int(kept.sum()), **_percent("success", rates[m]),
                }
                for m in range(len(LABELS))
            ]  # fmt: skip
    return rows


def _percent(name: str, rate: Float64s) -> dict[str, str]:
    keys = (name, f"{name}_low", f"{name}_high")
    return {key: f"{100.0 * x:.1f}" for key, x in zip(keys, rate, strict=True)}


def _number(x: float) -> str:
    return f"{x:.2f}" if np.isfinite(x) else ""


def _write(path: Path, rows: list[dict[str, Any]]) -> None:
    text = io.StringIO()
    table = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    table.writeheader()
    table.writerows(rows)
    part = path.with_name(f".{path.name}.part")
    part.write_text(text.getvalue(), encoding="utf-8")
    part.replace(path)


# Tables for the page ------------------------------------------------------------------------------


SHORT = (
    "evidence", "zncc", "mi", "squared-euclidean", "cosine", "city-block", "hellinger",
    "jensen-shannon", "k", "jeffreys", "kl", "k (map)", "k (off)", "jeffreys (off)",
)  # fmt: skip
"""Metrics of the short table at the head of the page."""


def markdown_answer(out: Path) -> str:
    """Return the short table of docs/metrics.md from the records in `out`."""
    results = gather(read_records(out))
    weights = bootstrap_weights(results)
    rows = {row["metric"]: row for row in metric_rows(results, weights)}
    n_wide = sum(c["overlap"] >= STRICT_OVERLAP for c in results.conditions)
    lines = [
        f"| metric | right, of {len(results.place)} pairs | less than the best by | "
        f"right, of the {n_wide} that share 60 % or more | the same, poses of 50 % or more only |",
        "|---|---|---|---|---|",
    ]
    for name in SHORT:
        row = rows[name]
        rate = f"{row['success']} % ({row['success_low']} to {row['success_high']})"
        gap = f"{row['behind_best']} ({row['behind_best_low']} to {row['behind_best_high']})"
        lines.append(
            f"| `{name}` | {rate} | {gap} | {row['success_06']} % | {row['success_06_strict']} % |"
        )
    return "\n".join(lines)


def markdown_tables(out: Path) -> str:
    """Return the tables of docs/metrics.md from the records in `out`."""
    results = gather(read_records(out))
    weights = bootstrap_weights(results)
    times = json.loads((out / "times.json").read_text(encoding="utf-8"))
    lines = [
        f"{len(results.place)} pairs of {len(np.unique(results.place))} places. Success: share of "
        "the pairs, and its 95 % interval. 30 % / 50 %: success on the pairs that share "
        f"{100 * STRICT_OVERLAP:.0f} % or more,",
        "by the smallest overlap that a pose may have. Error: median of the right poses. "
        "Sharpness: medians where the best pose is right / wrong. Time: of one yaw in the",
        "search (128 x 128 target, 64 x 64 source cells, one thread), as a multiple of `evidence`.",
        "",
        "| metric | success | 30 % / 50 % | error | sharpness | time |",
        "|---|---|---|---|---|---|",
    ]
    unit = times["evidence"]
    for row in metric_rows(results, weights):
        name = row["metric"].split(" ")[0]
        cost = f"{times[name] / unit:.1f}" if name in times else "no fast form"
        error = f"{row['error_m']} m, {row['error_deg']} deg" if row["error_m"] else "–"
        sharp = f"{row['sharpness_right'] or '–'} / {row['sharpness_wrong'] or '–'}"
        rate = f"{row['success']} % ({row['success_low']} to {row['success_high']})"
        both = f"{row['success_06']} / {row['success_06_strict']}"
        lines.append(f"| `{row['metric']}` | {rate} | {both} | {error} | {sharp} | {cost} |")
    lines += ["", "Success in per cent by condition:", ""]
    lines += ["| condition | pairs | " + " | ".join(f"`{m}`" for m in MAIN) + " |"]
    lines += ["|---|---|" + "---|" * len(MAIN)]
    for condition in CONDITIONS:
        values = [c[condition] for c in results.conditions]
        for level in dict.fromkeys(sorted(values)):
            kept = np.array([v == level for v in values])
            rates = results.right[kept].mean(axis=0)
            cells = " | ".join(f"{100 * rates[LABELS.index(m)]:.0f}" for m in MAIN)
            lines.append(f"| {_told(condition, level)} | {kept.sum()} | {cells} |")
    return "\n".join(lines)


def _told(condition: str, level: Any) -> str:
    """Return a level in words."""
    return {
        "kind": f"{level}",
        "heights": "heights under 1 m" if level == "low" else "all heights",
        "grid": f"area of {level}",
        "overlap": f"overlap {level}",
        "noise": f"noise {level} m",
        "drift": f"drift {level}",
        "tilt_deg": f"tilt {level} deg",
        "change": f"change {level}",
    }[condition]
