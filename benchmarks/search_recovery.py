"""Does the coarse-to-fine search find what the exhaustive search finds? And at what price?

    python benchmarks/search_recovery.py [--first 0] [--places 12] [--crops 18] [--out FOLDER]

Two robots are simulated in each place (all six kinds, a drift of 0.3 %, 30 % of the movable things
changed); square crops of the draft, 12 to 30 m wide, anywhere and turned anyhow, are searched for
on the whole base, with all heights or those under 1 m. The exhaustive search scores every
translation of every yaw on the finest cell by FFT and climbs from its best peaks as the fast one
does on its last cell. The fast search fails where its best score is lower. One line a case is
kept, with the score and the pose of both and the CPU seconds of both; places that are in the
records are not run again.
"""

from __future__ import annotations

import argparse
import logging
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from record_lines import add_lines, read_lines

from commonmap.config import Config
from commonmap.frames import apply, from_xyz_yaw
from commonmap.matching.maps import build_layers, choose_grid, prepare
from commonmap.matching.match import least_overlap
from commonmap.matching.search import Peaks, SearchPlan, plan_search, search
from commonmap.matching.slabs import SlabGrid
from commonmap.sim.pairs import simulate_pair

KINDS = ("paper", "city", "forest", "village", "industrial", "field")
SEED = 40_000


def crops(place: int, n: int) -> Iterator[tuple[dict[str, Any], SlabGrid, SlabGrid]]:
    """Yield what was cut, and the layers of base and crop."""
    rng = np.random.default_rng(SEED + place)
    kind = KINDS[place % len(KINDS)]
    pair = simulate_pair(kind, rng=rng, drift=0.003, change=0.3, max_points=400_000)
    base = prepare(pair.target.xyz, "target", Config())
    xyz = pair.source.xyz
    for crop in range(n):
        width = float(rng.uniform(12.0, 30.0))
        middle = xyz[rng.integers(len(xyz))]
        turned = apply(from_xyz_yaw(0.0, 0.0, 0.0, rng.uniform(-np.pi, np.pi)), xyz - middle)
        part = turned[np.abs(turned[:, :2]).max(axis=1) < 0.5 * width]
        case = {"kind": kind, "place": place, "crop": crop, "width": width, "points": len(part)}
        if len(part) < 2_000:
            continue
        config = Config().with_values(grid={"max_height": 1.0 if crop % 2 else None})
        draft = prepare(part, "source", config)
        cell, edges, max_height = choose_grid(base, draft, config)
        cell = max(cell, 0.5)
        layers = [build_layers(item, cell, edges, max_height) for item in (base, draft)]
        if all(each.slabs.occupied.any() for each in layers):
            case |= {"cell": cell, "under_1_m": bool(crop % 2)}
            yield case, layers[0].slabs, layers[1].slabs


def exhaustive(target: SlabGrid, source: SlabGrid, fast: SearchPlan) -> SearchPlan:
    """Return the plan without a pyramid: every yaw and translation on the finest cell."""
    cell = fast.cells[-1]
    return SearchPlan((cell,), round(fast.n_yaw * fast.cells[0] / cell), (256,))


def run(place: int, n: int) -> Iterator[dict[str, Any]]:
    """Yield a record a case."""
    for case, target, source in crops(place, n):
        fast = plan_search(target, source, budget=2e6)  # small places: make it use its pyramid
        found: list[tuple[Peaks, float]] = []
        for plan in (fast, exhaustive(target, source, fast)):
            start = time.process_time()
            peaks = search(
                target, source, min_overlap=least_overlap(Config()), plan=plan, workers=1
            )
            found.append((peaks, time.process_time() - start))
        (quick, quick_s), (slow, slow_s) = found
        best = [float(p.score[0]) if len(p.score) else 0.0 for p in (quick, slow)]
        away = float(np.hypot(*(quick.pose[0] - slow.pose[0])[:2])) if min(best) > 0 else 0.0
        yield case | {
            "cells": fast.cells, "n_yaw": fast.n_yaw, "score": best[0], "exhaustive": best[1],
            "metres_apart": away, "seconds": quick_s, "exhaustive_seconds": slow_s,
            "found": best[0] >= best[1] * (1.0 - 1e-9),
        }  # fmt: skip


def main() -> None:
    """Run the cases, keep their records and print the failure rate."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--places", type=int, default=12)
    parser.add_argument("--crops", type=int, default=18)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "records")
    options = parser.parse_args()
    logging.getLogger("commonmap").setLevel(logging.ERROR)
    path = options.out / "search_recovery.jsonl"
    records = read_lines(path)
    done = {record["place"] for record in records}
    for place in range(options.first, options.first + options.places):
        if place in done:
            continue
        found = list(run(place, options.crops))
        add_lines(path, found)
        for n, record in enumerate(found):
            print(
                place,
                n,
                record["kind"],
                f"{record['width']:.0f} m",
                f"{record['score']:.0f}",
                f"{record['exhaustive']:.0f}",
                "" if record["found"] else "LOWER",
                flush=True,
            )
        records += found
    show(records)


def show(records: list[dict[str, Any]]) -> None:
    """Print how many cases failed, and how."""
    missed = [r for r in records if not r["found"]]
    elsewhere = [r for r in missed if r["metres_apart"] > 2.0 * r["cell"]]
    ratio = np.median([r["exhaustive_seconds"] / r["seconds"] for r in records])
    higher = sum(r["score"] > r["exhaustive"] * (1.0 + 1e-9) for r in records)
    print(
        f"{len(records)} cases: {len(missed)} scored lower than the exhaustive search, "
        f"{len(elsewhere)} of them elsewhere; {higher} scored higher; {ratio:.1f} times as fast "
        "(median of CPU time)"
    )
    for r in missed:
        print(
            f"  {r['kind']} {r['width']:.0f} m: {r['score']:.0f} instead of "
            f"{r['exhaustive']:.0f}, {r['metres_apart']:.1f} m away"
        )


if __name__ == "__main__":
    main()
