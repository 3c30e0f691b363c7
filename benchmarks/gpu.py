"""Speed of the exhaustive scores on a GPU against this machine's CPU, for the same bytes or bounds.

    python benchmarks/gpu.py [--side 500] [--yaws 60]

Needs a CUDA GPU and the extra `gpu`; without them it says so, writes no record and ends with 0. Two
jobs, each on NumPy (one thread) and on CuPy: the evidence of a 60 x 60 m draft at all translations
on a base of `side` metres, 2 m cells, one tile; and the K divergence on height maps of the same
size. The first run on each is not counted. The evidence must agree to the bit, the K divergence
to 1e-4.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from pathlib import Path
from typing import Any

import numpy as np

from commonmap.errors import MissingExtraError
from commonmap.matching.arrays import find_arrays
from commonmap.matching.correlate import prepare_target, score_surface
from commonmap.matching.evidence import evidence_surface, transform_target
from commonmap.matching.slabs import pack_slabs

RECORD = Path(__file__).parent / "records" / "gpu.json"


def find_gpu() -> str | None:
    """Return the name of the first CUDA GPU, or None, having said why there is none."""
    try:
        xp = find_arrays("cupy").xp
        name = xp.cuda.runtime.getDeviceProperties(0)["name"].decode()
        float(xp.zeros(1).sum())
    except MissingExtraError as problem:
        print(f"no GPU was measured: {problem}")
    except Exception as problem:
        print(f"no GPU was measured: CuPy finds none that works ({problem})")
    else:
        return str(name)
    return None


def evidence_job(arrays: str, n_cells: int, n_yaws: int) -> tuple[float, Any]:
    """Return (seconds a yaw, the last score) of the evidence of six slabs."""
    rng = np.random.default_rng(1)
    occupied = rng.random((6, n_cells, n_cells)) < 0.2
    known = np.broadcast_to(rng.random((n_cells, n_cells)) < 0.9, occupied.shape)
    base = pack_slabs(np.zeros(2), 2.0, occupied & known, known)
    spectra = transform_target(base, (44, 44), arrays=find_arrays(arrays))
    start = 0.0
    for n in range(n_yaws + 1):
        if n == 1:
            start = time.perf_counter()
        part = slice(n, n + 44)
        source = base.occupied[part, part].copy(), base.known[part, part].copy()
        score, _ = evidence_surface(spectra, *source, min_overlap=50.0, workers=1)
    return (time.perf_counter() - start) / n_yaws, score


def divergence_job(arrays: str, n_cells: int, n_yaws: int) -> tuple[float, Any]:
    """Return (seconds a yaw, the last score) of the K divergence."""
    rng = np.random.default_rng(2)
    height, known = rng.random((n_cells, n_cells)), rng.random((n_cells, n_cells)) < 0.9
    prepared = prepare_target("k", height, known, (44, 44), min_cells=900, xp=arrays)
    start = 0.0
    for n in range(n_yaws + 1):
        if n == 1:
            start = time.perf_counter()
        part = slice(n, n + 44)
        surface = score_surface(prepared, height[part, part], known[part, part])
    return (time.perf_counter() - start) / n_yaws, surface.score


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--side", type=float, default=500.0, help="metres")
    parser.add_argument("--yaws", type=int, default=60)
    given = parser.parse_args()
    gpu = find_gpu()
    if gpu is None:
        return
    n_cells, record = round(given.side / 2.0), {"gpu": gpu, "machine": platform.machine()}
    for name, job in (("evidence", evidence_job), ("k", divergence_job)):
        on_cpu, expected = job("numpy", n_cells, given.yaws)
        on_gpu, found = job("cupy", n_cells, given.yaws)
        off = float(np.nanmax(np.abs(np.where(np.isfinite(expected), found - expected, 0.0))))
        if off > (0.0 if name == "evidence" else 1e-4):
            raise SystemExit(f"{name}: the GPU's scores are off by {off:g}")
        record[name] = {"cpu_s": on_cpu, "gpu_s": on_gpu, "off": off, "cells": n_cells}
        print(f"{name}: CPU {on_cpu:.4f} s a yaw, GPU {on_gpu:.4f} s, off by {off:g}")
    RECORD.write_text(json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main()
