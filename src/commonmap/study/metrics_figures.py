"""Figures of the metric study, drawn from its records."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from commonmap.metrics.table import METRICS
from commonmap.study.metrics_records import Results, strict_rates, success
from commonmap.study.metrics_scores import COLUMNS, LABELS
from commonmap.types import Float64s

SHOWN = ("evidence", "mi", "zncc", "sad", "k", "kl", "jeffreys")
"""Metrics that are drawn by condition."""


def draw_figures(results: Results, weights: Float64s, out: Path) -> None:
    """Write success.png, kinds.png, conditions.png and sharpness.png to `out`."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    for name, draw in (
        ("success", _success), ("kinds", _kinds), ("conditions", _conditions),
        ("sharpness", _sharpness),
    ):  # fmt: skip
        figure = draw(plt, results, weights)
        part = out / f".{name}.part.png"
        figure.savefig(part, dpi=90, bbox_inches="tight", metadata={"Software": None})
        part.replace(out / f"{name}.png")
        plt.close(figure)


def _order(results: Results) -> list[int]:
    return [int(m) for m in np.argsort(-results.right.mean(axis=0), kind="stable")]


def _success(plt: Any, results: Results, weights: Float64s) -> Any:
    """Draw the success of every metric with its interval, coloured by family."""
    rates, order = 100.0 * success(results, weights), _order(results)
    families = list(dict.fromkeys(METRICS[name].family for name, _ in COLUMNS))
    colours = dict(zip(families, plt.get_cmap("tab20").colors, strict=False))
    figure, axes = plt.subplots(figsize=(7.5, 11.0))
    told = set()
    strict = 100.0 * strict_rates(results)[1]
    axes.plot(strict[order], range(len(order)), "x", color="0.6", ms=4,
              label="overlap of 60 % or more, and poses of 50 % or more")  # fmt: skip
    for row, m in enumerate(order):
        family = METRICS[COLUMNS[m][0]].family
        label = None if family in told else family
        told.add(family)
        axes.plot(rates[m, 1:], [row, row], color=colours[family], lw=2)
        axes.plot(rates[m, 0], row, "o", color=colours[family], ms=4, label=label)
    axes.set_yticks(range(len(order)), [LABELS[m] for m in order], fontsize=7)
    axes.set_ylim(len(order) - 0.5, -0.5)
    axes.set_xlim(left=0.0)
    axes.set_xlabel("pairs with the right pose, per cent (95 % interval)")
    axes.grid(axis="x", alpha=0.3)
    axes.legend(fontsize=8, loc="lower right")
    return figure


def _kinds(plt: Any, results: Results, weights: Float64s) -> Any:
    """Draw success by metric and scene kind, for low and for all heights."""
    kinds = list(dict.fromkeys(c["kind"] for c in results.conditions))
    levels = [(kind, heights) for heights in ("low", "all") for kind in kinds]
    order = _order(results)
    table = np.full((len(order), len(levels)), np.nan)
    for column, (kind, heights) in enumerate(levels):
        kept = [c["kind"] == kind and c["heights"] == heights for c in results.conditions]
        if any(kept):
            table[:, column] = 100.0 * results.right[np.array(kept)][:, order].mean(axis=0)
    figure, axes = plt.subplots(figsize=(8.0, 11.0))
    picture = axes.imshow(table, aspect="auto", cmap="viridis", vmin=0.0, vmax=100.0)
    axes.set_yticks(range(len(order)), [LABELS[m] for m in order], fontsize=7)
    words = [f"{kind}, {'< 1 m' if heights == 'low' else 'all'}" for kind, heights in levels]
    axes.set_xticks(range(len(levels)), words, rotation=60, ha="right", fontsize=8)
    for (row, column), value in np.ndenumerate(table):
        if np.isfinite(value) and value >= 0.5:
            colour = "white" if value < 60.0 else "black"
            axes.text(
                column, row, f"{value:.0f}", ha="center", va="center", fontsize=6, color=colour
            )
    figure.colorbar(picture, ax=axes, shrink=0.5, label="right, per cent")
    return figure


def _conditions(plt: Any, results: Results, weights: Float64s) -> Any:
    """Draw success of the main metrics against each condition, with intervals."""
    names = ("heights", "grid", "overlap", "noise", "drift", "tilt_deg", "change")
    figure, grid = plt.subplots(2, 4, figsize=(13.0, 6.0), sharey=True)
    for axes, condition in zip(grid.ravel(), names, strict=False):
        values = [c[condition] for c in results.conditions]
        levels = list(dict.fromkeys(sorted(values)))
        rates = [
            100.0 * success(results, weights, np.array([v == level for v in values]))
            for level in levels
        ]
        for k, name in enumerate(SHOWN):
            m = LABELS.index(name)
            own = np.array([rate[m] for rate in rates])
            at = np.arange(len(levels)) + 0.05 * (k - len(SHOWN) / 2)
            away = np.abs(own[:, 1:] - own[:, :1]).T
            axes.errorbar(at, own[:, 0], away, marker="o", ms=3, lw=1, capsize=2, label=name)
        axes.set_xticks(range(len(levels)), [str(level) for level in levels], fontsize=8)
        axes.set_title(condition.replace("_", ", "), fontsize=10)
        axes.grid(alpha=0.3)
    handles, labels = grid[0, 0].get_legend_handles_labels()
    grid[-1, -1].axis("off")
    grid[-1, -1].legend(handles, labels, loc="center")
    for axes in grid[:, 0]:
        axes.set_ylabel("right, per cent")
    figure.tight_layout()
    return figure


def _sharpness(plt: Any, results: Results, weights: Float64s) -> Any:
    """Draw how sharp the best pose is where it is right and where it is wrong."""
    figure, axes = plt.subplots(figsize=(7.5, 4.5))
    for k, name in enumerate(SHOWN):
        m = LABELS.index(name)
        told = np.isfinite(results.sharpness[:, m])
        for side, right, colour in ((-0.17, True, "tab:green"), (0.17, False, "tab:red")):
            some = results.sharpness[told & (results.right[:, m] == right), m]
            if len(some):
                low, q1, q2, q3, high = np.quantile(some, [0.05, 0.25, 0.5, 0.75, 0.95])
                axes.plot([k + side] * 2, [low, high], color=colour, lw=1)
                axes.plot([k + side] * 2, [q1, q3], color=colour, lw=6, alpha=0.6)
                axes.plot(k + side, q2, "o", color="black", ms=3)
    axes.set_xticks(range(len(SHOWN)), SHOWN)
    axes.set_yscale("symlog", linthresh=0.1)
    axes.set_ylim(bottom=0.0)
    axes.set_ylabel("best less best elsewhere, robust sd")
    axes.set_title(
        "green: the best pose is right; red: it is wrong (5, 25, 50, 75, 95 %)", fontsize=9
    )
    axes.grid(axis="y", alpha=0.3)
    return figure
