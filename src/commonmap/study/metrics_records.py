"""Reading the records of the metric study, loose or packed, and what follows from them.

Success: within 2 cells and 1.5 yaw steps of the truth. Pairs of one place are not independent, so
intervals come from a bootstrap over places, within each scene kind.
"""

from __future__ import annotations

import json
import lzma
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from commonmap.errors import InputError
from commonmap.study.metrics_scores import LABELS
from commonmap.types import Bools, Float64s

NEAR = (2.0, 1.5)
"""Cells and yaw steps within which a pose is right."""

PACKED = "records.jsonl.xz"
N_BOOTSTRAP = 2000
CONDITIONS = ("kind", "heights", "grid", "overlap", "noise", "drift", "tilt_deg", "change")
"""What the success rate is told by; "grid" is the edge of the area and of a cell."""


STRICT_OVERLAP = 0.6
"""Asked overlap from which on the stricter rule of the smallest overlap is told."""


@dataclass(frozen=True, eq=False)
class Results:
    """Records as arrays: N pairs, M metrics of `LABELS`.

    conditions: one dict a pair. place: (N,) the task, within which pairs are alike. right: (N, M);
    right_strict: the same where only poses with half of the source's known cells may win.
    xy, yaw_deg, sharpness, margin: (N, M), NaN where there was none.
    """

    conditions: list[dict[str, Any]]
    place: np.ndarray[tuple[int], np.dtype[np.int64]]
    right: Bools
    right_strict: Bools
    xy: Float64s
    yaw_deg: Float64s
    sharpness: Float64s
    margin: Float64s

    @property
    def places_by_kind(self) -> list[np.ndarray[tuple[int], np.dtype[np.int64]]]:
        """The tasks of each scene kind."""
        kinds = np.array([c["kind"] for c in self.conditions])
        return [np.unique(self.place[kinds == kind]) for kind in dict.fromkeys(kinds.tolist())]


def read_records(out: Path) -> list[dict[str, Any]]:
    """Return the records of a study's folder in the order of their index, loose ones and packed."""
    by_key: dict[tuple[int, int], dict[str, Any]] = {}
    packed = out / PACKED
    if packed.exists():
        with lzma.open(packed, "rt", encoding="utf-8") as file:
            for line in file:
                record = json.loads(line)
                by_key[record["index"], record["area"]] = record
    for path in sorted((out / "records").glob("place-*.json")):
        for record in json.loads(path.read_text(encoding="utf-8")):
            by_key[record["index"], record["area"]] = record
    if not by_key:
        raise InputError(f"{out} holds no records of the study of metrics; run it first")
    return [by_key[key] for key in sorted(by_key)]


def pack_records(records: list[dict[str, Any]], path: Path) -> None:
    """Write the records to one compressed file, a line each; same records, same bytes."""
    lines = "".join(json.dumps(record, separators=(",", ":")) + "\n" for record in records)
    part = path.with_name(f".{path.name}.part")
    part.write_bytes(lzma.compress(lines.encode(), preset=9 | lzma.PRESET_EXTREME))
    part.replace(path)


def gather(records: list[dict[str, Any]]) -> Results:
    """Return records as arrays, and which metric was right where."""

    def table(key: str) -> Float64s:
        rows = [[np.nan if x is None else x for x in record[key]] for record in records]
        return np.array(rows, dtype=np.float64).reshape(len(records), len(LABELS))

    def column(key: str) -> Float64s:
        return np.array([np.nan if r[key] is None else r[key] for r in records], np.float64)[
            :, None
        ]

    xy, yaw = table("xy"), table("yaw_deg")
    far, turned = NEAR[0] * column("cell"), NEAR[1] * column("yaw_step_deg")
    right = (xy <= far) & (yaw <= turned)
    strict = (table("strict_xy") <= far) & (table("strict_yaw_deg") <= turned)
    conditions = [{**r, "grid": f"{r['size']:g} m, {r['cell']:g} m cells"} for r in records]
    place = np.array([r["index"] for r in records], np.int64)
    return Results(conditions, place, right, strict, xy, yaw, table("sharpness"), table("margin"))


def bootstrap_weights(results: Results) -> Float64s:
    """Return (N_BOOTSTRAP, N): how often each pair counts in each resample of the places."""
    rng = np.random.default_rng(0)
    weights = np.zeros((N_BOOTSTRAP, len(results.place)))
    for places in results.places_by_kind:
        drawn = rng.multinomial(len(places), np.full(len(places), 1.0 / len(places)), N_BOOTSTRAP)
        which = np.searchsorted(places, results.place)
        own = np.isin(results.place, places)
        weights[:, own] = drawn[:, which[own]]
    return weights


def success(results: Results, weights: Float64s, kept: Bools | None = None) -> Float64s:
    """Return (M, 3): the success rate of each metric and its 95 % interval, over kept pairs."""
    kept = np.ones(len(results.place), np.bool_) if kept is None else kept
    right = results.right[kept].astype(np.float64)
    n = weights[:, kept].sum(axis=1, keepdims=True)
    rates = np.divide(weights[:, kept] @ right, n, out=np.full((len(n), right.shape[1]), np.nan),
                      where=n > 0)  # fmt: skip
    low, high = np.nanquantile(rates, [0.025, 0.975], axis=0)
    return np.column_stack([right.mean(axis=0), low, high])


def gaps(results: Results, weights: Float64s, best: int) -> Float64s:
    """Return (M, 3): success of the metric `best` less that of each, on the same pairs."""
    less = results.right[:, [best]].astype(np.float64) - results.right
    n = weights.sum(axis=1, keepdims=True)
    low, high = np.quantile(weights @ less / n, [0.025, 0.975], axis=0)
    return np.column_stack([less.mean(axis=0), low, high])


def median_where(values: Float64s, where: Bools) -> Float64s:
    """Return the median of each column over the rows where it is told, NaN where none is."""
    out = np.full(values.shape[1], np.nan)
    for m in range(values.shape[1]):
        some = values[where[:, m] & np.isfinite(values[:, m]), m]
        if len(some):
            out[m] = np.median(some)
    return out


def strict_rates(results: Results) -> tuple[Float64s, Float64s]:
    """Return the success of each metric where the overlap is `STRICT_OVERLAP` or more.

    First as everywhere; then where a pose must lay half of the source's known cells on known ones.
    """
    wide = np.array([c["overlap"] >= STRICT_OVERLAP for c in results.conditions])
    if not wide.any():
        none = np.full(len(LABELS), np.nan)
        return none, none
    return results.right[wide].mean(axis=0), results.right_strict[wide].mean(axis=0)
