"""Accepted or refused, with the reason. A wrong answer accepted is the worst there is.

The figures compare the best pose with what chance reaches in the very same maps: the best pose of
the mirrored source (the decoy), the best pose elsewhere (the second), the best poses of all other
headings; and with how the points lie on each other at the decoy's pose. A logistic model, fitted to
simulated pairs of many kinds (`benchmarks/decision.py`, docs/decision.md), makes one probability of
them. Two things no probability makes up for: a refinement that left the peak, and too little
evidence to fix a pose.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass


@dataclass(frozen=True)
class Figures:
    """What the verdict rests on.

    evidence: nats, at the best pose.
    decoy_ratio: evidence of the best pose over that of the mirrored source's best pose.
    second_ratio: evidence of the best pose over that of the best pose elsewhere.
    prominence: best pose over the median of all yaws' bests, in robust standard deviations.
    support: share of the source's areas, by weight, that speak for the pose (0 to 1).
    effect: evidence as a share of what perfect agreement would give (0 to 1).
    support_t: mean over standard error of the areas' evidence.
    spread: share of the evidence that is left without its best quarter of areas.
    inliers: share of the source's standing points near a standing target point, refined.
    decoy_inliers: the same at the refined pose of the mirrored source.
    overlap: share of the source's known cells on known cells of the target (0 to 1).
    n_overlap: the number of those cells.
    moved: refinement's step at the middle of the overlap, in cells.
    converged: 1 where the refinement stayed in the basin of the search's peak.
    """

    evidence: float
    decoy_ratio: float
    second_ratio: float
    prominence: float
    support: float
    effect: float
    support_t: float
    spread: float
    inliers: float
    decoy_inliers: float
    overlap: float
    n_overlap: float
    moved: float
    converged: float

    def as_dict(self) -> dict[str, float]:
        """Return the figures by name."""
        return {name: float(value) for name, value in asdict(self).items()}


@dataclass(frozen=True)
class Verdict:
    """accepted, with a probability (0 to 1) and one sentence."""

    accepted: bool
    confidence: float
    reason: str


ACCEPT_AT = 0.9
"""Probability from which a pose is accepted."""

LEAST_EVIDENCE = 100.0
"""Evidence in nats under which no pose is accepted. Neighbouring cells say much the same, so an
independent tenth of it is left, which chance among a million poses reaches once in a while."""

WEIGHTS = {"bias": -8.2, "ratios": 3.1, "prominence": 2.75, "inliers": 3.4}
"""Of the logistic model; see `features`."""


def features(figures: Figures) -> dict[str, float]:
    """Return what the logistic model sees: logarithms of bounded ratios, and a bounded share."""
    return {
        "bias": 1.0,
        "ratios": _log(figures.decoy_ratio) + _log(figures.second_ratio),
        "prominence": math.log(max(figures.prominence, 1.0)),
        "inliers": min(max(figures.inliers - figures.decoy_inliers, -0.2), 0.3),
    }


def decide(figures: Figures) -> Verdict:
    """Return the verdict on a best pose."""
    x = features(figures)
    logit = sum(WEIGHTS[name] * x[name] for name in WEIGHTS)
    confidence = 1.0 / (1.0 + math.exp(-max(-40.0, min(40.0, logit))))
    if not figures.converged:
        confidence = min(confidence, 0.5)
        reason = "refused: the refinement on the points left the place that the search had found"
        return Verdict(False, confidence, reason)
    if figures.evidence < LEAST_EVIDENCE:
        confidence = min(confidence, 0.5)
        reason = (
            f"refused: the best pose has only {figures.evidence:.0f} nats of evidence, too little "
            f"to rely on (at least {LEAST_EVIDENCE:.0f} are needed)"
        )
        return Verdict(False, confidence, reason)
    if confidence >= ACCEPT_AT and figures.decoy_ratio > 1.0 and figures.second_ratio > 1.0:
        return Verdict(
            True,
            confidence,
            f"accepted: the evidence is {figures.decoy_ratio:.1f} times what a mirrored map finds "
            f"and {figures.second_ratio:.1f} times that of any other pose, and "
            f"{100 * figures.support:.0f} % of the draft's areas support it",
        )
    return Verdict(False, confidence, "refused: " + _weakness(figures))


def _weakness(figures: Figures) -> str:
    """Return the clause that names what speaks most against the pose."""
    if figures.second_ratio < 1.15:
        return (
            "another pose is nearly as good as the best one (evidence ratio "
            f"{figures.second_ratio:.2f}); the place repeats itself or the maps do not overlap"
        )
    if figures.decoy_ratio < 1.5:
        return (
            f"a mirrored map, which cannot match, finds almost as much evidence (ratio "
            f"{figures.decoy_ratio:.2f}); the best pose may be a coincidence"
        )
    if figures.support < 0.8 or figures.spread < 0.0:
        return (
            f"only {100 * figures.support:.0f} % of the draft's areas support the best pose; "
            "elsewhere the base saw something else"
        )
    if figures.inliers - figures.decoy_inliers < 0.2:
        return (
            "the points lie no better on each other than by chance: "
            f"{100 * figures.inliers:.0f} % within one cell, a mirrored map "
            f"{100 * figures.decoy_inliers:.0f} %"
        )
    return "the signs of a true match, taken together, are too weak to rely on"


def _log(ratio: float) -> float:
    """Return the logarithm of a ratio between 1/4 and 20."""
    return math.log(min(max(ratio, 0.25), 20.0))
