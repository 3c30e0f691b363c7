"""Which parts of the source speak for a pose, and which against it.

The evidence at a pose is a sum over cells of `ln(p_ab / (p_a p_b))`. Summed area by area it tells a
right pose, which nearly every well-observed area supports, from a lucky one, which a few strong
lines carry while the rest contradicts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from commonmap.matching.slabs import Columns, SlabGrid
from commonmap.types import Float64s


@dataclass(frozen=True, eq=False)
class Support:
    """Evidence by areas of the source at one pose.

    evidence: (A,) nats per area; it sums to the evidence of the pose. weight: (A,) nats, what the
    area could say at most (the entropy of what it saw). xy: (A, 2) centres, target frame.
    share: 0 to 1, weight of the areas that speak for the pose. effect: 0 to 1, evidence as a share
    of what perfect agreement would give. t: mean over standard error of the areas' evidence.
    spread: share of the evidence left without its best quarter of areas.
    """

    evidence: Float64s
    weight: Float64s
    xy: Float64s
    share: float
    effect: float
    t: float
    spread: float


def measure_support(
    target: SlabGrid, columns: Columns, pose: Float64s, *, n_areas: int = 8
) -> Support:
    """Return the support of a pose (x, y, yaw) by areas of 1 / `n_areas` of the source's extent.

    columns: the source's, about the point that the pose places, on half the target's cell.
    """
    extent = float(np.ptp(columns.xy, axis=0).max())
    size = max(extent / n_areas, 4.0 * target.cell)
    evidence, weight, ij = _by_area(
        target.occupied, target.known, target.origin, target.cell, columns.xy, columns.occupied,
        columns.known, columns.n_slabs, np.asarray(pose, np.float64),
        max(1, round(size / target.cell)),
    )  # fmt: skip
    heard = weight > 0
    evidence, weight, ij = evidence[heard], weight[heard], ij[heard]
    total = float(evidence.sum())
    if len(evidence) < 2 or total <= 0:
        return Support(evidence, weight, target.origin + ij * target.cell, 0.0, 0.0, 0.0, 0.0)
    se = float(evidence.std(ddof=1) * np.sqrt(len(evidence)))
    best_quarter = np.sort(evidence)[::-1][: -(-len(evidence) // 4)]
    return Support(
        evidence=evidence,
        weight=weight,
        xy=target.origin + ij * target.cell,
        share=float(weight[evidence > 0].sum() / weight.sum()),
        effect=total / float(weight.sum()),
        t=total / max(se, 1e-9),
        spread=1.0 - float(best_quarter.sum()) / total,
    )


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _by_area(t_occupied, t_known, origin, cell, xy, s_occupied, s_known, n_slabs, pose, size):  # type: ignore[no-untyped-def]
    n_x, n_y = t_occupied.shape
    occupied = np.zeros((n_x, n_y), np.uint32)
    known = np.zeros((n_x, n_y), np.uint32)
    cosine, sine = np.cos(pose[2]), np.sin(pose[2])
    for n in range(xy.shape[0]):
        i = int(np.floor((cosine * xy[n, 0] - sine * xy[n, 1] + pose[0] - origin[0]) / cell))
        j = int(np.floor((sine * xy[n, 0] + cosine * xy[n, 1] + pose[1] - origin[1]) / cell))
        if 0 <= i < n_x and 0 <= j < n_y:
            occupied[i, j] |= s_occupied[n]
            known[i, j] |= s_known[n]
    table = np.full((n_slabs, 2, 2), 0.5)
    for i in range(n_x):
        for j in range(n_y):
            both = known[i, j] & t_known[i, j]
            for k in range(n_slabs):
                if (both >> k) & 1:
                    table[k, (occupied[i, j] >> k) & 1, (t_occupied[i, j] >> k) & 1] += 1
    gain = np.zeros((n_slabs, 2, 2))
    surprise = np.zeros((n_slabs, 2))
    for k in range(n_slabs):
        n = table[k].sum()
        positive = table[k, 1, 1] * n > table[k, 1].sum() * table[k, :, 1].sum()
        for a in range(2):
            surprise[k, a] = -np.log(table[k, a].sum() / n)
            for b in range(2):
                g = np.log(table[k, a, b] * n / (table[k, a].sum() * table[k, :, b].sum()))
                gain[k, a, b] = g if positive else -g
    a_x, a_y = (n_x + size - 1) // size, (n_y + size - 1) // size
    evidence = np.zeros(a_x * a_y)
    weight = np.zeros(a_x * a_y)
    ij = np.zeros((a_x * a_y, 2))
    for i in range(n_x):
        for j in range(n_y):
            both = known[i, j] & t_known[i, j]
            if both == 0:
                continue
            area = (i // size) * a_y + j // size
            ij[area, 0], ij[area, 1] = (i // size + 0.5) * size, (j // size + 0.5) * size
            for k in range(n_slabs):
                if (both >> k) & 1:
                    a, b = (occupied[i, j] >> k) & 1, (t_occupied[i, j] >> k) & 1
                    evidence[area] += gain[k, a, b]
                    weight[area] += surprise[k, a]
    return evidence, weight, ij
