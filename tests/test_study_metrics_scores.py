"""All metrics at once against the literal formula at every pose, and against evidence's own."""

from __future__ import annotations

import numpy as np
import pytest

from commonmap.matching.correlate import prepare_target, score_surface
from commonmap.matching.direct import direct_surface
from commonmap.matching.evidence_fft import evidence_surface, transform_target
from commonmap.matching.slabs import pack_slabs
from commonmap.metrics.table import METRICS
from commonmap.study import metrics_scores
from commonmap.study.metrics_scores import COLUMNS
from commonmap.types import Bools, Float64s

SIDE = 9


def _maps(top: float) -> tuple[Float64s, Bools, Float64s, Bools]:
    rng = np.random.default_rng(4)
    target = np.where(rng.random((14, 17)) < 0.5, 0.0, rng.uniform(0.0, top, (14, 17)))
    known_t = rng.random((14, 17)) < 0.85
    source = np.clip(target[3:12, 4:13] + rng.normal(0.0, 0.05, (SIDE, SIDE)), 0.0, top)
    known_s = rng.random((SIDE, SIDE)) < 0.8
    known_s[0], known_s[:, -1] = False, False
    return target, known_t, source, known_s


def _score(top: float, min_cells: int) -> metrics_scores.Scores:
    target, known_t, source, known_s = _maps(top)
    edges = top * np.array([0.2, 0.5, 0.8])
    slabs_t, slabs_s = (
        pack_slabs(
            np.zeros(2), 1.0,
            np.stack([(h >= low) & known for low in edges]), np.stack([known] * len(edges)),
        )
        for h, known in ((target, known_t), (source, known_s))
    )  # fmt: skip
    prepared = metrics_scores.prepare(
        target, known_t, slabs_t, (SIDE, SIDE), top=top, min_cells=min_cells
    )
    scores = metrics_scores.score_all(prepared, source, known_s, slabs_s.occupied, slabs_s.known)
    spectra = transform_target(slabs_t, (SIDE, SIDE))
    evidence, _ = evidence_surface(spectra, slabs_s.occupied, slabs_s.known, min_overlap=1.0)
    own = scores.value[[name for name, _ in COLUMNS].index("evidence")]
    np.testing.assert_array_equal(own, evidence[scores.u, scores.v])
    return scores


@pytest.mark.parametrize("top", [1.0, 14.0])
def test_every_metric_is_the_literal_formula_at_every_pose(top: float) -> None:
    target, known_t, source, known_s = _maps(top)
    scores = _score(top, 8)
    for k, (name, reading) in enumerate(COLUMNS):
        if name == "evidence":
            continue
        literal = direct_surface(
            name, source, known_s, target, known_t, normalise=reading, height_range=(0.0, top),
            min_cells=8,
        )  # fmt: skip
        expected = literal[scores.u, scores.v]
        scale = np.nanmax(np.abs(expected))
        np.testing.assert_allclose(
            scores.value[k], expected, rtol=2e-5, atol=2e-6 * max(1.0, scale), err_msg=name
        )
    n_literal = np.count_nonzero(
        np.isfinite(direct_surface("ssd", source, known_s, target, known_t, min_cells=8))
    )
    assert len(scores.u) == n_literal, "every pose with enough overlap is scored, no other"


@pytest.mark.parametrize("name", ["k", "jeffreys", "taneja", "clark", "mi", "zncc"])
def test_it_agrees_with_the_search_s_own_surfaces(name: str) -> None:
    target, known_t, source, known_s = _maps(1.0)
    scores = _score(1.0, 8)
    surface = score_surface(
        prepare_target(
            name, target, known_t, (SIDE, SIDE), height_range=(0.0, 1.0), min_cells=8,
            dtype=np.float64,
        ),
        source, known_s,
    )  # fmt: skip
    own = scores.value[[label for label, _ in COLUMNS].index(name)]
    np.testing.assert_allclose(own, surface.score[scores.u, scores.v], rtol=2e-5, atol=4e-6)


def test_more_is_better_in_the_gain() -> None:
    scores = _score(1.0, 30)
    at = int(np.flatnonzero((scores.u == 3 + SIDE - 1) & (scores.v == 4 + SIDE - 1))[0])
    for k, (name, _) in enumerate(COLUMNS):
        if METRICS[name].family in ("image registration", "likelihood ratio"):
            assert np.nanargmax(scores.gain[k]) == at, name
