"""What one yaw of the product's search costs with each metric, processor time on one thread."""

from __future__ import annotations

import time

import numpy as np

from commonmap.matching.correlate import prepare_target, score_surface
from commonmap.matching.evidence_fft import evidence_surface, transform_target
from commonmap.matching.slabs import pack_slabs
from commonmap.metrics.table import METRICS

TARGET, SOURCE, SLABS, REPEATS = 128, 64, 5, 5
"""Cells along the edges of target and source, height slabs, scores of which the fastest counts."""


def measure_times() -> dict[str, float]:
    """Return milliseconds a yaw (all translations) of each metric that has a fast form."""
    rng = np.random.default_rng(0)
    target = np.maximum(rng.normal(0.2, 0.4, (TARGET, TARGET)), 0.0).clip(0.0, 1.0)
    known_t = rng.random(target.shape) < 0.8
    source, known_s = target[20 : 20 + SOURCE, 30 : 30 + SOURCE], known_t[:SOURCE, :SOURCE]
    found = {}
    for name, row in METRICS.items():
        if row.fft is None:
            continue
        prepared = prepare_target(
            name, target, known_t, source.shape, height_range=(0.0, 1.0), min_cells=500
        )
        score_surface(prepared, source, known_s)
        spent = []
        for _ in range(REPEATS):
            start = time.process_time()
            score_surface(prepared, source, known_s)
            spent.append(time.process_time() - start)
        found[name] = round(1e3 * min(spent), 3)
    edges = np.linspace(0.2, 0.9, SLABS)
    slabs_t, slabs_s = (
        pack_slabs(np.zeros(2), 1.0, np.stack([(h > e) & known for e in edges]),
                   np.stack([known] * SLABS))
        for h, known in ((target, known_t), (source, known_s))
    )  # fmt: skip
    spectra = transform_target(slabs_t, source.shape)
    spent = []
    for _ in range(REPEATS + 1):
        start = time.process_time()
        evidence_surface(spectra, slabs_s.occupied, slabs_s.known, min_overlap=500)
        spent.append(time.process_time() - start)
    found["evidence"] = round(1e3 * min(spent), 3)
    return found
