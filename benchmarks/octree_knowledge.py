"""Does it help the search to know what the octree knows: what was seen free, and what was not seen?

    python benchmarks/octree_knowledge.py [--first 30000] [--pairs 48] [--out benchmarks/records]

Two robots are simulated in one place; the rays of both go into octrees. The occupied slabs of a
column are the same in all ways of looking at it, what counts as *not occupied* is not:

    points   a column that holds any point is known in all slabs (what `match` does)
    octree   a slab is known where the octree saw at least half of it free, or it is occupied (what
             `match` does with `--rays`)
    seen     both: a slab of a column with points counts only where the octree saw it free
    either   one or the other: free columns without a point are known too

Every way searches the same pair, and the mirrored draft. The record of a pair holds for each way
whether the best pose is within 1 m and 2 degrees of the truth, and its score over the mirrored
draft's best and over the best pose elsewhere. Every second pair uses heights under 1 m only.
"""

from __future__ import annotations

import argparse
import logging
import time
from pathlib import Path
from typing import Any

import numpy as np
from record_lines import add_lines, read_lines

from commonmap.config import Config
from commonmap.frames import difference, invert
from commonmap.matching.figures import other_poses
from commonmap.matching.maps import Layers, build_layers, choose_grid, prepare
from commonmap.matching.match import least_overlap
from commonmap.matching.search import search
from commonmap.matching.seen_free import see_free
from commonmap.matching.slabs import SlabGrid, pack_slabs
from commonmap.sim.pairs import simulate_pair
from commonmap.types import Bools

KINDS = ("forest", "village", "industrial", "city", "field", "paper")
WAYS = ("points", "octree", "seen", "either")


def slabs_of(way: str, layers: Layers, free: Bools) -> SlabGrid:
    """Return the slabs of a map, known in one of the ways."""
    grid = layers.grid
    occupied, column = grid["slab_occupied"], grid["slab_known"]
    known = {
        "points": column, "octree": free, "seen": column & free, "either": column | free,
    }[way]  # fmt: skip
    return pack_slabs(grid.origin, grid.cell, occupied, known | occupied)


def run(seed: int) -> dict[str, Any]:
    """Return the record of a pair."""
    rng = np.random.default_rng(seed)
    kind = KINDS[seed % len(KINDS)]
    conditions = {
        "overlap": float(rng.choice([0.45, 0.3, 0.2, 0.15])),
        "drift": float(rng.choice([0, 0.003])),
        "change": float(rng.choice([0, 0.3])),
    }
    pair = simulate_pair(kind, rng=rng, max_points=250_000, azimuth_decimation=8, **conditions)
    config = Config().with_values(grid={"max_height": 1.0 if (seed // len(KINDS)) % 2 else None})
    clouds = (pair.target, pair.source)
    items = [prepare(c, n, config) for c, n in zip(clouds, ("target", "source"), strict=True)]
    cell, edges, max_height = choose_grid(*items, config)
    layers = [build_layers(item, cell, edges, max_height) for item in items]
    free = [
        see_free(each, cloud, item) for item, cloud, each in zip(items, clouds, layers, strict=True)
    ]
    assert free[0] is not None and free[1] is not None
    T_true = items[0].T_prepared_map @ pair.T_target_source @ invert(items[1].T_prepared_map)
    middle = items[1].xyz.mean(axis=0)
    record: dict[str, Any] = {
        "seed": seed, "kind": kind, **conditions, "overlap": pair.overlap, "max_height": max_height,
        "cell": cell,
    }  # fmt: skip
    for way in WAYS:
        start = time.process_time()
        target, source = (slabs_of(way, one, f) for one, f in zip(layers, free, strict=True))
        found, decoy = (
            search(target, source, min_overlap=least_overlap(config), mirrored=m, workers=1)
            for m in (False, True)
        )
        record[way] = {"right": False, "cpu_seconds": time.process_time() - start}
        if len(found.score) and len(decoy.score):
            flat = T_true.copy()
            T = found.T_target_source()
            T[2, 3] = flat[2, 3] = 0.0
            metres, radians = difference(T, flat, middle * (1, 1, 0))
            away = other_poses(found, found.pose[0], cell)
            second = float(found.score[away].max(initial=1e-9))
            record[way] |= {
                "right": bool(metres < 1.0 and radians < np.radians(2.0)),
                "score": float(found.score[0]),
                "decoy_ratio": float(found.score[0] / max(decoy.score[0], 1e-9)),
                "second_ratio": float(found.score[0] / second),
            }
    return record


def main() -> None:
    """Run the pairs, keep their records, and print the success of every way."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--first", type=int, default=30_000)
    parser.add_argument("--pairs", type=int, default=48)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "records")
    options = parser.parse_args()
    logging.getLogger("commonmap").setLevel(logging.ERROR)
    path = options.out / "octree_knowledge.jsonl"
    records = read_lines(path)
    done = {r["seed"] for r in records}
    for seed in range(options.first, options.first + options.pairs):
        if seed in done:
            continue
        records.append(run(seed))
        add_lines(path, records[-1:])
        print(
            seed,
            records[-1]["kind"],
            f"{records[-1]['overlap']:.2f}",
            *(f"{way} {'right' if records[-1][way]['right'] else '-'}" for way in WAYS),
            flush=True,
        )
    show(records)


def show(records: list[dict[str, Any]]) -> None:
    """Print the table: right answers by kind and way, and the median ratios where all are right."""
    print("| | pairs | " + " | ".join(WAYS) + " |\n|---|---|" + "---|" * len(WAYS))
    for kind in (*KINDS, "all"):
        some = [r for r in records if kind in (r["kind"], "all")]
        print(
            f"| {kind} | {len(some)} | "
            + " | ".join(str(sum(r[way]["right"] for r in some)) for way in WAYS)
            + " |"
        )
    both = [r for r in records if all(r[way]["right"] for way in WAYS)]
    for name in ("decoy_ratio", "second_ratio"):
        print(
            f"median {name} where all are right ({len(both)}): "
            + ", ".join(f"{w} {np.median([r[w][name] for r in both]):.2f}" for w in WAYS if both)
        )


if __name__ == "__main__":
    main()
