"""Scans of a VLP-16 with made-up ranges, as its tables say it fires: for tests of logs."""

from __future__ import annotations

import numpy as np

from commonmap.sim.scanning import firing_pattern
from commonmap.sim.vlp16 import VLP16
from commonmap.types import Scan


def vlp16_scans(
    n: int = 3, *, start: float = 1_700_000_000.0, every: int = 1, seed: int = 0,
    drop_out: float = 0.2,
) -> list[Scan]:  # fmt: skip
    """Return turns at 10 Hz: ranges 1 to 60 m in whole 2 mm, some firings without return."""
    rng = np.random.default_rng(seed)
    scans = []
    for i in range(n):
        time, direction, laser = firing_pattern(VLP16, first=i % every, every=every)
        kept = rng.uniform(size=len(time)) > drop_out
        time, direction, laser = time[kept], direction[kept], laser[kept]
        distance = 0.002 * rng.integers(500, 30_000, len(time))
        xyz = direction * distance[:, None]
        xyz[:, 2] += VLP16.height_offset[laser]
        scans.append(
            Scan(
                xyz=xyz.astype(np.float32), time=start + 0.1 * i + time, ring=VLP16.ring[laser],
                intensity=rng.integers(0, 256, len(time)).astype(np.float32),
                stamp=start + 0.1 * i,
            )
        )  # fmt: skip
    return scans
