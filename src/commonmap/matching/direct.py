"""The slow twin of `matching.correlate`: the literal formula at every shift, one by one."""

from __future__ import annotations

import numpy as np

from commonmap.metrics.table import Metric, evaluate, find_metric, raise_to_floor
from commonmap.types import Bools, Float64s, Floats


def direct_surface(
    metric: Metric | str,
    height_s: Floats,
    known_s: Bools,
    height_t: Floats,
    known_t: Bools,
    *,
    normalise: str = "overlap",
    floor: float = 0.05,
    height_range: tuple[float, float] = (0.0, 1.0),
    bins: int = 8,
    min_cells: int = 1,
) -> Float64s:
    """Return the score at every shift, (tx + sx - 1, ty + sy - 1), NaN below `min_cells`.

    `[u, v]`: source cell [i, j] lies on target cell [i + u - (sx - 1), j + v - (sy - 1)]. Costs a
    full evaluation a shift: for tests, and to check a pose or two.
    """
    row = find_metric(metric) if isinstance(metric, str) else metric
    (sx, sy), (tx, ty) = height_s.shape, height_t.shape
    lifted_s, lifted_t = (
        raise_to_floor(row, np.asarray(h, float), floor) for h in (height_s, height_t)
    )
    totals = float(lifted_s[known_s].sum()), float(lifted_t[known_t].sum())
    scores = np.full((tx + sx - 1, ty + sy - 1), np.nan)
    for u in range(scores.shape[0]):
        du = u - (sx - 1)
        on_t = slice(max(du, 0), min(du + sx, tx))
        on_s = slice(on_t.start - du, on_t.stop - du)
        for v in range(scores.shape[1]):
            dv = v - (sy - 1)
            across_t = slice(max(dv, 0), min(dv + sy, ty))
            across_s = slice(across_t.start - dv, across_t.stop - dv)
            source = (height_s[on_s, across_s], known_s[on_s, across_s])
            target = (height_t[on_t, across_t], known_t[on_t, across_t])
            if np.count_nonzero(source[1] & target[1]) >= min_cells:
                scores[u, v] = evaluate(
                    row, *source, *target, normalise=normalise, floor=floor, totals=totals,
                    height_range=height_range, bins=bins,
                )  # fmt: skip
    return scores
