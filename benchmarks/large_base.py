"""Time and memory of search and decoy over the size of the base, up to kilometres at 0.25 m.

    python benchmarks/large_base.py run [--sides 62 125 250 500 1000 2000 4000]
    python benchmarks/large_base.py draw

A made-up town: walls at any angle, trees, posts and clutter, made block by block and written to a
file that the search maps. The base sees roofs and misses a tenth of what stands; the draft, 60 x
60 m from the middle and turned, sees no roofs, misses a quarter and has clutter of its own. These
are layers, not points: levelling, ground and height map are not part of this benchmark. Each size
runs in a process of its own; what is compiled is compiled before. CPU time, as the machine may be
busy; peak memory is that of the process, the part of the file in memory included. Bases of up to
2 km are also searched with 30 MB; the digests of the answers must be the same.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from commonmap.config import ComputeConfig
from commonmap.matching.search import Peaks, plan_search, search_both
from commonmap.matching.slabs import SlabGrid

RECORD = Path(__file__).parent / "records" / "large_base.json"
FIGURE = Path(__file__).parent.parent / "docs" / "images" / "large_base.png"
SIDES = (62, 125, 250, 500, 1000, 2000, 4000)
CELL, BLOCK, DRAFT, YAW, LITTLE = 0.25, 64, 60.0, 0.7, 0.03
EDGES = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
ALL = np.uint8((1 << (len(EDGES) - 1)) - 1)
Bits = NDArray[np.uint8]


def slabs_between(low: float, high: float) -> np.uint8:
    """Return the bits of the slabs that something from `low` to `high` metres touches."""
    touched = (k for k, (a, b) in enumerate(pairwise(EDGES)) if low < b and high > a)
    return np.uint8(sum(1 << k for k in touched))


def make_block(i: int, j: int) -> tuple[Bits, Bits]:
    """Return (standing, roofs) of block (i, j), each (256, 256) bits; the same on every call."""
    rng = np.random.default_rng([7, i + 1000, j + 1000])
    n = round(BLOCK / CELL)
    at = (np.arange(n, dtype=np.float32) + 0.5) * np.float32(CELL)
    x, y = at[:, None], at[None, :]
    standing, roofs = np.zeros((n, n), np.uint8), np.zeros((n, n), np.uint8)
    for _ in range(rng.integers(2, 6)):  # buildings
        (cx, cy), angle = rng.uniform(6, BLOCK - 6, 2), rng.uniform(0, math.pi)
        half, top = rng.uniform(3, 10, 2), rng.uniform(3, 14)
        u = np.abs((x - cx) * math.cos(angle) + (y - cy) * math.sin(angle)) - half[0]
        v = np.abs((y - cy) * math.cos(angle) - (x - cx) * math.sin(angle)) - half[1]
        edge = np.maximum(u, v)
        standing[np.abs(edge) < 0.25] |= slabs_between(0, top)
        roofs[edge < 0.25] |= slabs_between(top - 0.3, top)
    for _ in range(rng.integers(5, 25)):  # trees
        (cx, cy), crown, top = rng.uniform(0, BLOCK, 2), rng.uniform(1, 4), rng.uniform(4, 14)
        d = np.hypot(x - cx, y - cy)
        leaves = (d < crown) & (rng.random((n, n), dtype=np.float32) < 0.5)
        standing[d < 0.3] |= slabs_between(0, top)
        standing[leaves] |= slabs_between(0.4 * top, top)
    for _ in range(rng.integers(10, 40)):  # posts, hedges, cars
        low = rng.uniform(0, BLOCK, 2)
        high = low + rng.uniform(0.2, 4.5, 2)
        box = (x > low[0]) & (x < high[0]) & (y > low[1]) & (y < high[1])
        standing[box] |= slabs_between(0, rng.uniform(0.4, 2.5))
    return standing, roofs


def make_base(side: float, folder: Path) -> SlabGrid:
    """Write the layers of a base of `side` metres about the world's origin, and map them."""
    n = 2 * math.ceil(0.5 * side / CELL)
    files = [folder / name for name in ("occupied.npy", "known.npy")]
    occupied, known = (
        np.lib.format.open_memmap(file, mode="w+", dtype=np.uint8, shape=(n, n)) for file in files
    )
    size, low = round(BLOCK / CELL), -n // 2
    for i in range(low // size, (low + n - 1) // size + 1):
        for j in range(low // size, (low + n - 1) // size + 1):
            standing, roofs = make_block(i, j)
            rng = np.random.default_rng([8, i + 1000, j + 1000])
            seen = (standing | roofs) * (rng.random(standing.shape) > 0.1)
            (a0, a1), (b0, b1) = (
                (max(k * size - low, 0), min((k + 1) * size - low, n)) for k in (i, j)
            )
            part = (slice(a0 + low - i * size, a1 + low - i * size),
                    slice(b0 + low - j * size, b1 + low - j * size))  # fmt: skip
            occupied[a0:a1, b0:b1] = seen[part]
            known[a0:a1, b0:b1] = np.where(rng.random(standing.shape) > 0.05, ALL, 0)[part]
            known[a0:a1, b0:b1] |= np.where(occupied[a0:a1, b0:b1] > 0, ALL, np.uint8(0))
    del occupied, known
    layers = [np.load(file, mmap_mode="c") for file in files]
    return SlabGrid(np.array([low, low]) * CELL, CELL, layers[0], layers[1], len(EDGES) - 1)


def make_draft() -> SlabGrid:
    """Return the draft: turned by -`YAW` about the world's origin, with faults of its own."""
    rng = np.random.default_rng(9)
    n, size = round(DRAFT / CELL), round(BLOCK / CELL)
    world = np.block([[make_block(i, j)[0] for j in (-1, 0)] for i in (-1, 0)])
    at = (np.arange(n) + 0.5) * CELL - 0.5 * DRAFT
    x, y = at[:, None], at[None, :]
    i = np.floor((math.cos(YAW) * x - math.sin(YAW) * y) / CELL).astype(int) + size
    j = np.floor((math.sin(YAW) * x + math.cos(YAW) * y) / CELL).astype(int) + size
    seen = world[i, j] * (rng.random((n, n)) > 0.25)
    clutter = rng.random((n, n)) < 0.005
    seen[clutter] |= slabs_between(0, 1)
    known = np.where((rng.random((n, n)) > 0.1) | (seen > 0), ALL, np.uint8(0))
    return SlabGrid(np.full(2, -0.5 * DRAFT), CELL, seen, known, len(EDGES) - 1)


def digest(*peaks: Peaks) -> str:
    """Return a hash of all bytes of the peaks."""
    arrays = [a for p in peaks for a in (p.pose, p.score, p.overlap, p.per_yaw)]
    return hashlib.sha256(b"".join(np.ascontiguousarray(a).tobytes() for a in arrays)).hexdigest()


def measure(side: float, memory_gb: float, workers: int) -> dict[str, Any]:
    """Return the record of one size, measured in this process."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "small").mkdir()
        draft, small = make_draft(), make_base(100.0, folder / "small")
        compute = ComputeConfig(memory_gb=memory_gb)
        search_both(small, draft, min_overlap=0.1, workers=workers, compute=compute)  # compile
        base = make_base(side, folder)
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        plan = plan_search(base, draft)
        wall, cpu = time.perf_counter(), time.process_time()
        found = search_both(base, draft, min_overlap=0.1, workers=workers, compute=compute)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    at = found[0].T_target_source()
    turned = math.remainder(math.atan2(at[1, 0], at[0, 0]) - YAW, 2 * math.pi)
    return {
        "side_m": side, "cells": int(np.prod(base.shape)), "memory_gb": memory_gb,
        "workers": workers, "coarse_to_fine_m": plan.cells, "n_yaw": plan.n_yaw,
        "cpu_s": cpu, "wall_s": wall,
        "peak_mb_before": before / 1024, "peak_mb": peak / 1024,
        "error_m": float(np.hypot(*at[:2, 3])), "error_deg": abs(math.degrees(turned)),
        "best": float(found[0].score[0]), "second": float(found[0].score[1]),
        "best_mirrored": float(found[1].score[0]), "digest": digest(*found),
    }  # fmt: skip


def run(sides: list[float], memory_gb: float, workers: int) -> None:
    """Measure each size in its own process and write the record as it goes."""
    records = []
    for side in sides:
        for memory in (memory_gb, LITTLE) if side <= 2000 else (memory_gb,):
            command = [sys.executable, __file__, "one", str(side), str(memory), str(workers)]
            told = subprocess.run(command, check=True, capture_output=True, text=True).stdout
            records.append(json.loads(told.splitlines()[-1]))
            print(json.dumps(records[-1]), flush=True)
        here = {
            "machine": platform.machine(), "cores": os.cpu_count(),
            "python": sys.version.split()[0], "numpy": np.__version__,
            "scipy": scipy.__version__,
        }  # fmt: skip
        RECORD.write_text(json.dumps({"on": here, "records": records}, indent=1) + "\n")


def draw() -> None:
    """Draw CPU time and memory over the area, with n log n, from the record."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    records = [r for r in json.loads(RECORD.read_text())["records"] if r["memory_gb"] != LITTLE]
    area = np.array([r["side_m"] ** 2 for r in records]) / 1e6
    cpu = np.array([r["cpu_s"] for r in records])
    n = np.array([r["cells"] for r in records], float)
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6), constrained_layout=True)
    left.loglog(area, cpu, "o-", label="search and decoy")
    line = n * np.log(n)
    # from the first size that is searched on the same coarsest cell as the largest
    coarsest = [r["coarse_to_fine_m"][0] for r in records]
    start = coarsest.index(coarsest[-1])
    left.loglog(area, line * (cpu / line)[start], "k--", lw=1, label="n log n")
    for r, a, t in zip(records, area, cpu, strict=True):
        left.annotate(f"{r['coarse_to_fine_m'][0]:g} m", (a, t), (0, 6), textcoords="offset points",
                      fontsize=8, ha="center")  # fmt: skip
    left.set(xlabel="base, km²", ylabel="CPU time, s", title="time (labels: coarsest cell)")
    left.set_ylim(0.5 * cpu.min(), 20 * cpu.max())
    left.legend(fontsize=8)
    right.semilogx(area, [r["peak_mb"] for r in records], "o-", label="peak of the process")
    right.semilogx(area, n * 2e-6, "k:", label="the base's file")
    right.set(xlabel="base, km²", ylabel="MB", title="memory", ylim=(0, None))
    right.legend(fontsize=8)
    figure.savefig(FIGURE, dpi=110)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("what", nargs="?", default="run", choices=("run", "draw", "one"))
    parser.add_argument("one", nargs="*", type=float, help=argparse.SUPPRESS)
    parser.add_argument("--sides", type=float, nargs="+", default=list(SIDES))
    parser.add_argument("--memory-gb", type=float, default=0.5)
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args()
    if given.what == "one":
        print(json.dumps(measure(given.one[0], given.one[1], int(given.one[2]))))
    elif given.what == "draw":
        draw()
    else:
        run(given.sides, given.memory_gb, given.workers)
        draw()


if __name__ == "__main__":
    main()
