"""The search on a GPU against this machine's CPU: the same bytes, how fast.

    python benchmarks/gpu.py [--sides 125 500 2000] [--yaws 192]

Needs a CUDA GPU and CuPy; without them it says so, writes no record and ends with 0. For a base of
each side, metres, at 2 m cells:

evidence: the peaks of a 60 x 60 m draft of six slabs at all translations and so many yaws, as the
search asks for them (`evidence_peaks`), on one thread of the CPU, on two, and on CuPy.
k: the K divergence of all translations at 16 of these yaws, height maps of the same size.
search: the whole search of `large_base.py`, of the draft and its mirror image, pyramid and climbs
included, on two threads and with CuPy for the exhaustive part; two threads feed the device.

The first run of each is not counted. Peaks and searches must agree to the bit, the K divergence to
1e-4.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from large_base import digest, make_base, make_draft

from commonmap.config import ComputeConfig
from commonmap.errors import MissingExtraError
from commonmap.matching.arrays import find_arrays
from commonmap.matching.correlate import prepare_target, score_surface
from commonmap.matching.evidence_fft import evidence_peaks, transform_target
from commonmap.matching.search import search_both
from commonmap.matching.slabs import SlabGrid, pack_slabs

RECORD = Path(__file__).parent / "records" / "gpu.json"
SIDE = 44
"""Cells of a side of the draft's square at 2 m."""


def find_gpu() -> dict[str, str] | None:
    """Return the first CUDA GPU and CuPy's version, or None, having said why there is none."""
    try:
        xp = find_arrays("cupy").xp
        name = xp.cuda.runtime.getDeviceProperties(0)["name"].decode()
        float(xp.zeros(1).sum())
    except MissingExtraError as problem:
        print(f"no GPU was measured: {problem}")
    except Exception as problem:
        print(f"no GPU was measured: CuPy finds none that works ({problem})")
    else:
        return {"gpu": str(name), "cupy": str(xp.__version__)}
    return None


def evidence_job(arrays: str, n_cells: int, n_yaws: int, threads: int) -> tuple[float, Any]:
    """Return (seconds a yaw, the peaks of all yaws)."""
    rng = np.random.default_rng(1)
    occupied = rng.random((6, n_cells, n_cells)) < 0.2
    known = np.broadcast_to(rng.random((n_cells, n_cells)) < 0.9, occupied.shape)
    base = pack_slabs(np.zeros(2), 2.0, occupied & known, known)
    drafts = rng.random((6, SIDE, SIDE, n_yaws)) < 0.2
    seen = rng.random((SIDE, SIDE, n_yaws)) < 0.9
    bits = sum((drafts[k] & seen).astype(np.uint32) << k for k in range(6))
    full = np.where(seen, np.uint32(63), np.uint32(0))
    spectra = transform_target(base, (SIDE, SIDE), arrays=find_arrays(arrays))
    step = spectra.at_once

    def some(start: int) -> Any:
        part = slice(start, start + step)
        return evidence_peaks(
            spectra, bits[..., part], full[..., part], (0, 0, 0, 0), 6, min_overlap=400.0
        )

    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(some, range(0, min(n_yaws, threads * step), step)))  # compiled, warm
        start = time.perf_counter()
        found = [one for part in pool.map(some, range(0, n_yaws, step)) for one in part]
    return (time.perf_counter() - start) / n_yaws, np.concatenate(found)


def divergence_job(arrays: str, n_cells: int, n_yaws: int) -> tuple[float, Any]:
    """Return (seconds a yaw, the last score) of the K divergence."""
    rng = np.random.default_rng(2)
    height, known = rng.random((n_cells, n_cells)), rng.random((n_cells, n_cells)) < 0.9
    prepared = prepare_target("k", height, known, (SIDE, SIDE), min_cells=900, xp=arrays)
    start = 0.0
    for n in range(n_yaws + 1):
        if n == 1:
            start = time.perf_counter()
        part = slice(n, n + SIDE)
        surface = score_surface(prepared, height[part, part], known[part, part])
    return (time.perf_counter() - start) / n_yaws, surface.score


def search_job(arrays: str, base: SlabGrid, draft: SlabGrid) -> tuple[float, str]:
    """Return (seconds, digest of the answer) of a whole search."""
    compute = ComputeConfig(arrays=arrays, memory_gb=2.0)  # type: ignore[arg-type]
    search_both(base, draft, min_overlap=0.1, workers=2, compute=compute)
    start = time.perf_counter()
    found = search_both(base, draft, min_overlap=0.1, workers=2, compute=compute)
    return time.perf_counter() - start, digest(*found)


def measure(side: float, n_yaws: int) -> dict[str, Any]:
    """Return the record of a base of that side, metres."""
    n_cells, record = round(side / 2.0), {"side_m": side, "cell_m": 2.0, "yaws": n_yaws}
    one, expected = evidence_job("numpy", n_cells, n_yaws, 1)
    two, _ = evidence_job("numpy", n_cells, n_yaws, 2)
    device, found = evidence_job("cupy", n_cells, n_yaws, 2)
    if found.tobytes() != expected.tobytes():
        raise SystemExit(f"evidence, {side:g} m: the GPU's peaks are others")
    record["evidence_s_a_yaw"] = {"cpu 1 thread": one, "cpu 2 threads": two, "gpu": device}
    one, expected = divergence_job("numpy", n_cells, 16)
    device, found = divergence_job("cupy", n_cells, 16)
    told = np.isfinite(expected)
    off = float(np.abs(found[told] - expected[told]).max())
    if off > 1e-4 or not np.array_equal(told, np.isfinite(found)):
        raise SystemExit(f"k, {side:g} m: the GPU's scores are off by {off:g}")
    record["k_s_a_yaw"] = {"cpu 1 thread": one, "gpu": device, "off": off}
    with tempfile.TemporaryDirectory() as name:
        base, draft = make_base(side, Path(name)), make_draft()
        two, expected = search_job("numpy", base, draft)
        device, found = search_job("cupy", base, draft)
    if found != expected:
        raise SystemExit(f"search, {side:g} m: the GPU's answer is another")
    record["search_s"] = {"cpu 2 threads": two, "gpu": device}
    return record


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--sides", type=float, nargs="+", default=[125.0, 500.0, 2000.0])
    parser.add_argument("--yaws", type=int, default=192)
    given = parser.parse_args()
    gpu = find_gpu()
    if gpu is None:
        return
    on = {**gpu, "machine": platform.machine(), "cores": os.cpu_count(), "numpy": np.__version__}
    records = []
    for side in given.sides:
        records.append(measure(side, given.yaws))
        print(json.dumps(records[-1]), flush=True)
        RECORD.write_text(json.dumps({"on": on, "records": records}, indent=1) + "\n")


if __name__ == "__main__":
    main()
