"""The figures behind a verdict: what the best pose has that chance does not reach."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from commonmap.frames import apply
from commonmap.mapping.points import sample
from commonmap.matching.decide import Figures
from commonmap.matching.inliers import share_of_inliers
from commonmap.matching.maps import MOST_LOW, Layers, Points, Prepared
from commonmap.matching.search import Peaks, centre_columns, evidence_at
from commonmap.matching.slabs import coarsen, list_columns
from commonmap.matching.support import measure_support
from commonmap.types import Bools, Float64s

CLEAR_BY = 4.0
"""How many times the score of the mirrored source's best pose, and of the best pose elsewhere, the
score of a pose must be at a glance. Some other places reach more, but with a tenth of the score."""

CLEAR_FROM = 100.0
"""Score, nats, that a pose must have at a glance. Of 11,100 drafts of other places those that stood
four times above chance came to 72 at most (docs/matching.md)."""


def measure_figures(
    base_layers: Layers, draft_layers: Layers, found: Peaks, witness: Peaks, decoy: Peaks,
    cell: float,
) -> Figures:  # fmt: skip
    """Return what the verdict on the best pose of `found` rests on.

    witness, decoy: peaks of the evidence, of the source as it is and mirrored. What the points say
    is left open.
    """
    grid = coarsen(base_layers.slabs, 2)
    columns = centre_columns(list_columns(draft_layers.slabs), found.centre)
    best = evidence_at(grid, columns, found.pose[0])
    elsewhere = other_poses(witness, found.pose[0], cell)
    second_score = float(witness.score[elsewhere].max(initial=0.0))
    decoy_score = float(decoy.score.max(initial=0.0))
    support = measure_support(grid, columns, found.pose[0])
    yaw_best = witness.per_yaw[:, 1][np.isfinite(witness.per_yaw[:, 1])]
    middle = float(np.median(yaw_best))
    spread = 1.4826 * float(np.median(np.abs(yaw_best - middle)))

    return Figures(
        evidence=best.evidence,
        decoy_ratio=best.score / max(decoy_score, 1e-9),
        second_ratio=best.score / max(second_score, 1e-9),
        prominence=(float(yaw_best.max()) - middle) / max(spread, 1e-9),
        support=support.share,
        effect=support.effect,
        support_t=support.t,
        spread=support.spread,
        inliers=0.0,
        decoy_inliers=0.0,
        overlap=float(found.overlap[0]),
        n_overlap=float(best.n_pairs),
        moved=0.0,
        converged=1.0,
    )


def lift_mirrored(T_planar: Float64s, base: Prepared, mirrored: Points) -> Float64s:
    """Return the planar motion of the mirrored source with z set by its ground."""
    low = mirrored.low if len(mirrored.low) else np.arange(len(mirrored.xyz))
    moved = apply(T_planar, mirrored.xyz[sample(low, MOST_LOW)])
    lifted = T_planar.copy()
    lifted[2, 3] += float(np.median(base.ground.height_at(moved[:, :2]) - moved[:, 2]))
    return lifted


def other_poses(peaks: Peaks, pose: Float64s, cell: float) -> Bools:
    """Return (M,) bool, the peaks that are another place or another heading than `pose`."""
    delta = peaks.pose - pose
    away = np.hypot(delta[:, 0], delta[:, 1]) > max(3.0, 5.0 * cell)
    turned = np.abs((delta[:, 2] + np.pi) % (2.0 * np.pi) - np.pi) > math.radians(10.0)
    return np.asarray(away | turned)


def ranks_elsewhere(peaks: Peaks, cell: float) -> NDArray[np.int64]:
    """Return the ranks, best first, of the peaks elsewhere than the one of rank 0."""
    return np.nonzero(other_poses(peaks, peaks.pose[0], cell))[0]


def is_told_at_a_glance(found: Peaks, decoy: Peaks) -> bool:
    """Return whether the best pose stands so far above all others that no search has to go on."""
    if len(found.score) == 0:
        return False
    others = found.score[ranks_elsewhere(found, found.cell)], decoy.score
    chance = max(float(scores.max(initial=0.0)) for scores in others)
    return bool(found.score[0] >= max(CLEAR_FROM, CLEAR_BY * chance))


def measure_inliers(base: Points, draft: Points, T_target_source: Float64s, cell: float) -> float:
    """Return the share of the draft's standing points near standing points of the base."""
    return share_of_inliers(
        base.xyz, base.standing, draft.xyz, draft.standing, T_target_source, reach=0.6 * cell
    )


def mirror(decoy: Peaks) -> Float64s:
    """Return the reflection (4, 4) of the source's points (x -> -x about its centre)."""
    T = np.diag([-1.0, 1.0, 1.0, 1.0])
    T[0, 3] = 2.0 * decoy.centre[0]
    return T
