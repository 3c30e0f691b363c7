"""K divergence over the overlap at every pose, by FFT, against its direct evaluation by NumPy.

    python benchmarks/k_divergence.py [--yaws 180] [--sample 400] [--out benchmarks/records]

A base map of 200 x 200 m, a draft of 40 x 40 m cut from it with holes, noise and moved
objects, 0.5 m cells, heights under 1 m, a yaw every 2 degrees: 180 yaws, each with all translations
that share at least so many of the draft's cells: half (what `match` asks of this metric) and, as a
second run, a tenth. The FFT scores all of them; the direct evaluation scores a
random sample of the same poses, and its time per pose is multiplied out. Both run in this process;
the direct one is given its crops for nothing but the slicing, and no search around it.
The record holds wall time and CPU time: on a busy machine the second is the one to compare.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy import ndimage

from commonmap.matching.arrays import find_rim
from commonmap.matching.correlate import (
    PreparedTarget,
    Surface,
    prepare_target,
    score_half_turns,
)

CELL, BASE, DRAFT, TOP, FLOOR = 0.5, 400, 80, 1.0, 0.05
Grid = tuple[NDArray[np.float64], NDArray[np.bool_]]


def make_maps(rng: np.random.Generator) -> tuple[Grid, Grid]:
    """Return base and draft: ground with clutter of all heights, 5 % and 20 % of cells unknown."""
    bumps = ndimage.gaussian_filter(rng.normal(size=(BASE, BASE)), 2.0) * 6.0
    height = np.clip(np.exp(bumps - 2.0), 0.0, TOP)
    height[rng.random((BASE, BASE)) < 0.3] = 0.0
    holes = ndimage.gaussian_filter(rng.normal(size=(2, BASE, BASE)), (0, 3, 3))
    known = np.stack(
        [layer > np.quantile(layer, q) for layer, q in zip(holes, (0.05, 0.2), strict=True)]
    )
    cut = (slice(130, 130 + DRAFT), slice(210, 210 + DRAFT))
    draft = np.clip(height[cut] * rng.uniform(0.9, 1.1, (DRAFT, DRAFT)), 0.0, TOP)
    draft[20:35, 40:60] = draft[35:20:-1, 40:60]  # something was moved
    return (height, known[0]), (draft, known[1][cut])


def turn(grid: Grid, yaw: float, size: int) -> Grid:
    """Return the grid turned by `yaw` about its middle, nearest cell, on (size, size) cells."""
    height, known = grid
    middle = 0.5 * (size - 1)
    i, j = np.meshgrid(np.arange(size) - middle, np.arange(size) - middle, indexing="ij")
    c, s = np.cos(yaw), np.sin(yaw)
    x = np.rint(c * i + s * j + 0.5 * (height.shape[0] - 1)).astype(int)
    y = np.rint(-s * i + c * j + 0.5 * (height.shape[1] - 1)).astype(int)
    inside = (x >= 0) & (x < height.shape[0]) & (y >= 0) & (y < height.shape[1])
    x, y = np.where(inside, x, 0), np.where(inside, y, 0)
    return np.where(inside, height[x, y], 0.0), inside & known[x, y]


def k_divergence(source: Grid, target: Grid) -> float:
    """Evaluate the metric directly on two crops: the fewest NumPy calls that it takes."""
    both = source[1] & target[1]
    a, b = np.maximum(source[0][both], FLOOR), np.maximum(target[0][both], FLOOR)
    p, q = a / a.sum(), b / b.sum()
    return float(np.sum(p * np.log(2.0 * p / (p + q))))


def crop(surface: Surface, source: Grid, target: Grid, u: int, v: int) -> tuple[Grid, Grid]:
    """Return the parts of source and target that lie on each other at [u, v]."""
    parts: list[tuple[slice, slice]] = []
    for axis, shift in enumerate(surface.shift(u, v)):
        low = max(shift, 0)
        high = min(shift + source[0].shape[axis], target[0].shape[axis])
        parts.append((slice(low - shift, high - shift), slice(low, high)))
    on_s, on_t = (parts[0][0], parts[1][0]), (parts[0][1], parts[1][1])
    return (source[0][on_s], source[1][on_s]), (target[0][on_t], target[1][on_t])


def score_all(prepared: PreparedTarget, sources: list[Grid], threads: int) -> Iterator[Surface]:
    """Yield the surfaces of all sources and of their half turns."""
    with ThreadPoolExecutor(threads) as pool:
        for start in range(0, len(sources), threads):
            batch = sources[start : start + threads]
            for pair in pool.map(lambda grid: score_half_turns(prepared, *grid), batch):
                yield from pair


def run(
    yaws: int, sample: int, threads: int, tolerance: float, overlap: float
) -> dict[str, object]:
    """Score all poses, check a sample of them, and return the record."""
    load = os.getloadavg()[0]
    rng = np.random.default_rng(0)
    base, draft = make_maps(rng)
    size = int(np.ceil(DRAFT * 2.0**0.5))
    min_cells = int(overlap * draft[1].sum())
    half = [turn(draft, 2.0 * np.pi * k / yaws, size) for k in range(yaws // 2)]
    warm = prepare_target("k", *base, (size, size), height_range=(0.0, TOP), min_cells=min_cells)
    score_half_turns(warm, *half[0])  # compiled loops are loaded
    del warm

    wall, cpu = time.perf_counter(), time.process_time()
    rim = find_rim((known for _, known in half), (size, size), min_cells)
    prepared = prepare_target(
        "k", *base, (size, size), height_range=(0.0, TOP), min_cells=min_cells, rim=rim,
        tolerance=tolerance,
    )  # fmt: skip
    poses, picked, worst = 0, 0, 0.0
    fft_wall, fft_cpu = time.perf_counter() - wall, time.process_time() - cpu
    direct_wall = direct_cpu = 0.0
    best = (np.inf, 0, 0, 0)
    surfaces = score_all(prepared, half, threads)
    per_yaw = max(1, sample // yaws)
    for k in range(0, len(half), threads):
        batch = min(threads, len(half) - k)
        wall, cpu = time.perf_counter(), time.process_time()
        found = [next(surfaces) for _ in range(2 * batch)]
        fft_wall, fft_cpu = (
            fft_wall + time.perf_counter() - wall,
            fft_cpu + time.process_time() - cpu,
        )
        for n, surface in enumerate(found):
            height, known = half[k + n // 2]
            source = (height[::-1, ::-1], known[::-1, ::-1]) if n % 2 else (height, known)
            scored = np.flatnonzero(~np.isnan(surface.score))
            poses += scored.size
            at = int(np.nanargmin(surface.score))
            if surface.score.flat[at] < best[0]:
                u, v = np.unravel_index(at, surface.score.shape)
                best = (
                    float(surface.score.flat[at]),
                    k + n // 2 + n % 2 * yaws // 2,
                    int(u),
                    int(v),
                )
            for flat in rng.choice(scored, per_yaw, replace=False):
                u, v = divmod(int(flat), surface.score.shape[1])
                wall, cpu = time.perf_counter(), time.process_time()
                value = k_divergence(*crop(surface, source, base, u, v))
                direct_wall += time.perf_counter() - wall
                direct_cpu += time.process_time() - cpu
                worst = max(worst, abs(value - float(surface.score[u, v])))
                picked += 1
    yaw_deg, shift = 360.0 * best[1] / yaws, found[0].shift(best[2], best[3])
    kernel = next(iter(prepared.kernels.values()))
    return {
        "benchmark": "k_divergence",
        "base_m": BASE * CELL,
        "draft_m": DRAFT * CELL,
        "cell_m": CELL,
        "yaws": yaws,
        "min_overlap": overlap,
        "threads": threads,
        "poses": poses,
        "transform": list(prepared.frame.shape),
        "transforms_back_per_yaw": 3 + len(kernel.separated.pairs),
        "fft_wall_s": fft_wall,
        "fft_cpu_s": fft_cpu,
        "fft_us_per_pose": 1e6 * fft_wall / poses,
        "direct_sample": picked,
        "direct_us_per_pose": 1e6 * direct_wall / picked,
        "direct_wall_s_all": direct_wall / picked * poses,
        "ratio_wall": direct_wall / picked * poses / fft_wall,
        "ratio_cpu": direct_cpu / picked * poses / fft_cpu,
        "largest_deviation": worst,
        "certified_expansion_error": kernel.separated.error,
        "best": {"score": best[0], "yaw_deg": yaw_deg, "shift_cells": list(shift)},
        "machine": {
            "cpu": platform.processor() or platform.machine(),
            "cores": os.cpu_count(),
            "load_at_start": load,
        },
        "versions": {"numpy": np.__version__, "scipy": scipy.__version__},
    }


def main() -> None:
    """Run the benchmark, print the record and keep it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--yaws", type=int, default=180)
    parser.add_argument("--sample", type=int, default=1800)
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--tolerance", type=float, default=9.9e-6)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "records")
    options = parser.parse_args()
    records = [
        run(options.yaws, options.sample, options.threads, options.tolerance, overlap)
        for overlap in (0.5, 0.1)
    ]
    text = json.dumps(records, indent=2) + "\n"
    print(text, end="")
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / "k_divergence.json"
    beside = path.with_suffix(".tmp")
    beside.write_text(text)
    beside.replace(path)


if __name__ == "__main__":
    main()
