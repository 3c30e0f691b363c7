"""Time and memory of the whole `match`, stage by stage, over the area of the base.

    python benchmarks/match_speed.py run [--sides 62 125 250 500] [--threads 1 2]
    python benchmarks/match_speed.py draw

The made-up town of `large_base.py` as points, at constant density: 83 points a square metre seen
from the air (ground, roofs, crowns, walls thinly), so that 250 x 250 m hold 5.2 million. The draft
is 60 x 60 m of it, turned, seen from the ground by 3.5 million points, which hold no roofs, miss a
quarter of what stands and have clutter of their own. Every size and number of threads runs in a
process of its own, after a first match of a small place, so that nothing is compiled within the
measurement. Of each stage: wall and CPU seconds, and the peak of the process's memory (its points
included). The n log n of the curve counts base points, from the 250 m base.
"""

from __future__ import annotations

import argparse
import json
import logging
import math
import os
import platform
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from large_base import BLOCK, CELL, EDGES, make_block
from numpy.typing import NDArray

from commonmap.frames import apply, difference, from_xyz_yaw, invert

RECORD = Path(__file__).parent / "records" / "match_speed.json"
FIGURE = Path(__file__).parent.parent / "docs" / "images" / "match_speed.png"
SIDES = (62, 125, 250, 500)
DRAFT, DENSITY, DRAFT_POINTS = 60.0, 83.0, 2_850_000
T_BASE_DRAFT = from_xyz_yaw(31.0, -12.0, 1.5, 2.2)
STAGES = {
    "prepare the maps": "prepare", "height maps": "grid", "search": "search",
    "refine": "verify", "decide": "decide",
}  # fmt: skip
Floats = NDArray[np.float64]


def ground(xy: Floats) -> Floats:
    """Return the town's relief at (N, 2): some metres over a hundred."""
    return 2.0 * np.sin(xy[:, 0] / 37.0) + 1.5 * np.cos(xy[:, 1] / 29.0)


def look(i: int, j: int, rng: np.random.Generator, n: int, *, air: bool) -> Floats:
    """Return about n points of block (i, j), (n, 3) metres, as seen from the air or the ground."""
    standing, roofs = make_block(i, j)
    seen = np.where(rng.random(standing.shape) > (0.1 if air else 0.25), standing, np.uint8(0))
    if air:
        seen |= roofs
    a, b = np.nonzero(seen)
    bits = (seen[a, b][:, None] >> np.arange(len(EDGES) - 1)) & 1
    which, slab = np.nonzero(bits)
    # what stands is hit by as many points a metre of height as the ground by points a metre
    low, high = np.array(EDGES[:-1])[slab], np.array(EDGES[1:])[slab]
    weight = np.minimum(high - low, 2.0) * (0.5 if air else 1.0)
    share = weight.sum() / (weight.sum() + 0.25 * seen.size * CELL)
    hit = rng.choice(len(slab), round(n * share), p=weight / weight.sum())
    cells = np.column_stack([a[which[hit]], b[which[hit]]])
    up = rng.uniform(low[hit], high[hit])
    flat = np.stack(np.divmod(rng.integers(0, seen.size, n - len(hit)), seen.shape[1]), axis=1)
    flat = flat[(roofs[flat[:, 0], flat[:, 1]] == 0) if air else slice(None)]
    corner = np.array([i, j]) * BLOCK
    xy = np.concatenate([cells, flat]) * CELL + rng.uniform(0.0, CELL, (len(cells) + len(flat), 2))
    xy = xy + corner
    up = np.concatenate([up, np.zeros(len(flat))]) + rng.normal(0.0, 0.02, len(xy))
    return np.column_stack([xy, ground(xy) + up])


def make_base(side: float) -> Floats:
    """Return the base, (N, 3): `DENSITY` points a square metre about the world's origin."""
    half, parts = 0.5 * side, []
    blocks = range(math.floor(-half / BLOCK), math.ceil(half / BLOCK))
    for i in blocks:
        for j in blocks:
            rng = np.random.default_rng([10, i + 1000, j + 1000])
            part = look(i, j, rng, round(DENSITY * BLOCK * BLOCK), air=True)
            parts.append(part[(np.abs(part[:, :2]) < half).all(axis=1)])
    return np.concatenate(parts)


def make_draft() -> Floats:
    """Return the draft in its own frame, (M, 3)."""
    parts = []
    for i in (-1, 0):
        for j in (-1, 0):
            rng = np.random.default_rng([11, i + 1000, j + 1000])
            n = round(DRAFT_POINTS * (BLOCK / DRAFT) ** 2)
            part = look(i, j, rng, n, air=False)
            parts.append(part[(np.abs(part[:, :2]) < 0.5 * DRAFT).all(axis=1)])
    xyz = np.concatenate(parts)
    rng = np.random.default_rng(12)
    clutter = rng.uniform(-0.5 * DRAFT, 0.5 * DRAFT, (60, 2))[rng.integers(0, 60, 60_000)]
    clutter = clutter + rng.normal(0.0, 0.3, clutter.shape)
    up = ground(clutter) + rng.uniform(0.0, 1.5, len(clutter))
    return apply(invert(T_BASE_DRAFT), np.concatenate([xyz, np.column_stack([clutter, up])]))


class Stages:
    """Wall, CPU and peak memory of each stage, by what `match` tells of its progress."""

    def __init__(self) -> None:
        self.seen: dict[str, dict[str, float]] = {}
        self.name = ""

    def __call__(self, step: str, share: float = 0.0) -> None:
        """Begin the stage of that step, unless it is the one under way."""
        name = STAGES.get(step, step)
        if name != self.name:
            self.end()
            self.name, self.wall, self.cpu = name, time.perf_counter(), time.process_time()
            reset_peak()

    def end(self) -> None:
        """End the stage under way."""
        if self.name:
            self.seen[self.name] = {
                "wall_s": time.perf_counter() - self.wall,
                "cpu_s": time.process_time() - self.cpu,
                "peak_mb": peak_mb(),
            }


def reset_peak() -> None:
    """Let the system forget the process's peak of memory."""
    Path("/proc/self/clear_refs").write_text("5")


def peak_mb() -> float:
    """Return the process's peak of memory since it was reset, 2^20 bytes."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM"):
            return int(line.split()[1]) / 1024.0
    return math.nan


def measure(side: float, threads: int) -> dict[str, Any]:
    """Return the record of one base, measured in this process."""
    from commonmap.matching import match as job

    logging.getLogger("commonmap").setLevel(logging.ERROR)
    job.WORKERS = threads
    draft = make_draft()
    warm = make_base(70.0)[::5]
    job.match(warm, draft[::10])
    base = make_base(side)
    stages, load = Stages(), os.getloadavg()[0]
    reset_peak()
    held = peak_mb()
    wall, cpu = time.perf_counter(), time.process_time()
    found = job.match(base, draft, progress=stages)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    stages.end()
    T = found.T_target_source
    error = (math.nan, math.nan)
    if T is not None:
        error = difference(T, T_BASE_DRAFT, draft.mean(axis=0))
    return {
        "side_m": side, "threads": threads, "base_points": len(base), "draft_points": len(draft),
        "wall_s": wall, "cpu_s": cpu, "peak_mb": max(s["peak_mb"] for s in stages.seen.values()),
        "held_before_mb": held, "stages": stages.seen, "accepted": found.accepted,
        "error_m": error[0], "error_deg": math.degrees(error[1]), "cell_m": found.evidence["cell"],
        "load": load,
    }  # fmt: skip


def run(sides: list[float], threads: list[int]) -> None:
    """Measure each size in its own process; it takes its place in the record as it comes."""
    records = json.loads(RECORD.read_text())["records"] if RECORD.exists() else []
    for side in sides:
        for n in threads:
            command = [sys.executable, __file__, "one", str(side), str(n)]
            cores = f"0-{n - 1}" if n < (os.cpu_count() or 1) else None
            pinned = ["taskset", "-c", cores, *command] if cores else command
            env = os.environ | {"OPENBLAS_NUM_THREADS": str(n)}
            told = subprocess.run(pinned, check=True, capture_output=True, text=True, env=env)
            new = json.loads(told.stdout.splitlines()[-1])
            records = [r for r in records if (r["side_m"], r["threads"]) != (side, n)] + [new]
            records.sort(key=lambda r: (r["side_m"], r["threads"]))
            print(json.dumps(new), flush=True)
            on = {"machine": platform.machine(), "cores": os.cpu_count(), "numpy": np.__version__}
            RECORD.write_text(json.dumps({"on": on, "records": records}, indent=1) + "\n")


def draw() -> None:
    """Draw the time of each stage over the area, with n log n, from the record."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    records = json.loads(RECORD.read_text())["records"]
    most = max(r["threads"] for r in records)
    rows = sorted((r for r in records if r["threads"] == most), key=lambda r: r["side_m"])
    area = np.array([r["side_m"] ** 2 / 1e4 for r in rows])
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    left.loglog(area, [r["cpu_s"] for r in rows], "o-", color="black", label="match, CPU")
    left.loglog(area, [r["wall_s"] for r in rows], "s--", color="black", label="match, wall")
    for name in ("prepare", "search", "verify"):
        left.loglog(area, [r["stages"][name]["cpu_s"] for r in rows], "o-", label=name)
    n = np.array([r["base_points"] for r in rows], float)
    middle = next((k for k, r in enumerate(rows) if r["side_m"] == 250), len(rows) // 2)
    law = n * np.log(n)
    left.loglog(area, law / law[middle] * rows[middle]["cpu_s"], ":", color="grey", label="n log n")
    left.set(xlabel="area of the base, hectares", ylabel="seconds", title=f"{most} threads")
    left.legend(fontsize=8)
    right.loglog(area, [r["peak_mb"] for r in rows], "o-", color="black", label="peak")
    right.loglog(
        area, [r["held_before_mb"] for r in rows], "o-", color="grey", label="points, code"
    )
    right.set(xlabel="area of the base, hectares", ylabel="MB", title="memory")
    right.legend(fontsize=8)
    figure.savefig(FIGURE, dpi=110)


def main() -> None:
    """Run the job named on the command line."""
    if len(sys.argv) > 1 and sys.argv[1] == "one":
        print(json.dumps(measure(float(sys.argv[2]), int(sys.argv[3]))))
        return
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("job", choices=["run", "draw"])
    parser.add_argument("--sides", type=float, nargs="+", default=SIDES)
    parser.add_argument("--threads", type=int, nargs="+", default=(1, 2))
    options = parser.parse_args()
    if options.job == "run":
        run(list(options.sides), list(options.threads))
    draw()


if __name__ == "__main__":
    main()
