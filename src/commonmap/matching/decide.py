"""Accepted or refused, with the reason. A wrong answer accepted is the worst there is.

The figures compare the best pose with what chance reaches in the very same maps: the best pose of
the mirrored source (the decoy) and the best pose elsewhere (the second); and with how the points
lie on each other at the decoy's pose. The points have a word of their own: how far they move away
from the search's pose. A logistic model, fitted to simulated pairs of many kinds
(`benchmarks/decision.py`, docs/matching.md), makes one probability of them. Two things no
probability makes up for: a refinement that left the peak, and too little evidence to fix a pose.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace


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
    ground, decoy_ground: metres, by which the source's ground undulates against the target's at the
        pose, and at the mirrored source's; None where too little ground is shared.
    second_ground: the same at the best pose elsewhere; None also where it was not looked at (the
        verdict was clear).
    half_1, half_2: evidence of each half of the overlap at the pose, over that half's best at any
        other pose; None where it was not looked for (the verdict was clear) or too little stands.
    overlap: share of the source's known cells on known cells of the target (0 to 1).
    n_overlap: the number of those cells.
    moved: how far the refinement went from the search's pose, at the middle of the overlap, cells.
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
    ground: float | None = None
    decoy_ground: float | None = None
    second_ground: float | None = None
    half_1: float | None = None
    half_2: float | None = None

    def as_dict(self) -> dict[str, float]:
        """Return the figures that were measured, by name."""
        return {k: float(value) for k, value in asdict(self).items() if value is not None}


NOTHING = Figures(*[0.0] * 14)
"""Where the search found no pose at all."""


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

APART = 8.0
"""Two poses whose evidence differs by a factor f are told apart with odds of f to this power: even
odds for one, nine to one for a third more."""

WEIGHTS = {
    "bias": -4.51, "ratios": 0.48, "inliers": 1.67, "ground": 3.55, "better_half": 5.07,
    "weaker_half": 0.83, "moved": -3.64,
}  # fmt: skip
"""Of the logistic model; see `features`."""

QUICK_WEIGHTS = {
    "bias": -2.85, "ratios": 1.62, "inliers": 1.53, "ground": 3.53, "moved": -6.08,
}  # fmt: skip
"""Of the model without the closer look, which decides where it is sure."""

OPEN = (0.001, 0.9995)
"""Between these probabilities the quick model is not sure, and a closer look follows: at the halves
of the overlap, and at the ground under the best pose elsewhere."""

HOPELESS = 0.1
"""Probability at first look under which a pose that is refused anyway is not looked at closer."""

GROUND_NOISE = 0.15
"""Metres, of what two lidars see of one ground under growth."""


def features(figures: Figures) -> dict[str, float]:
    """Return what the logistic model sees: logarithms of bounded ratios, odds and distances."""
    seen = {
        "bias": 1.0,
        "ratios": _log(figures.decoy_ratio) + _log(figures.second_ratio),
        "inliers": min(max(_odds(figures.inliers) - _odds(figures.decoy_inliers), -1.0), 3.0),
        "ground": 0.0,
        "moved": math.log1p(max(figures.moved, 0.0)),
    }
    chance = [g for g in (figures.decoy_ground, figures.second_ground) if g is not None]
    if figures.ground is not None and chance:
        flatter = [(g + GROUND_NOISE) / (figures.ground + GROUND_NOISE) for g in chance]
        seen["ground"] = sum(math.log(min(max(f, 0.4), 10.0)) for f in flatter) / len(flatter)
    if figures.half_1 is not None and figures.half_2 is not None:
        halves = (math.log(min(max(h, 0.25), 4.0)) for h in (figures.half_1, figures.half_2))
        seen["weaker_half"], seen["better_half"] = sorted(halves)
    return seen


def probability(figures: Figures) -> float:
    """Return the probability, 0 to 1, that the pose is right."""
    x = features(figures)
    weights = WEIGHTS if "better_half" in x else QUICK_WEIGHTS
    return _logistic(max(-40.0, min(40.0, sum(weights[name] * x[name] for name in weights))))


def told_apart(second_ratio: float) -> float:
    """Return the probability, 0 to 1, that the best pose is not the best one elsewhere.

    Where a place repeats itself the points lie on each other at the wrong pose as well, and only
    the evidence of what does not repeat itself tells.
    """
    return _logistic(APART * math.log(max(second_ratio, 1e-3)))


def at_first_look(figures: Figures) -> Figures:
    """Return the figures without those of the closer look."""
    return replace(figures, half_1=None, half_2=None, second_ground=None)


def is_open(figures: Figures) -> bool:
    """Return whether the figures at first look leave the verdict open.

    Where no probability could make up for what else they say, only how unlikely the pose is is
    open, and that matters from `HOPELESS` on.
    """
    first = at_first_look(figures)
    if is_lost(figures) and decide(first).confidence < HOPELESS:
        return False
    return OPEN[0] < probability(first) < OPEN[1]


def is_lost(figures: Figures) -> bool:
    """Return whether something refuses the pose that no probability makes up for."""
    return (
        not _is_held(figures)
        or figures.decoy_ratio <= 1.0
        or told_apart(figures.second_ratio) < ACCEPT_AT
    )


def _is_held(figures: Figures) -> bool:
    """Return whether the points stayed at the pose, and enough speaks for it to fix one at all."""
    return bool(figures.converged) and figures.evidence >= LEAST_EVIDENCE


def rank_value(score: float, inliers: float, ground: float | None) -> float:
    """Return what poses of one search are compared by, in logits of the model."""
    value = 2.0 * WEIGHTS["ratios"] * math.log(max(score, 1e-9))
    value += WEIGHTS["inliers"] * _odds(inliers)
    if ground is not None:
        value -= WEIGHTS["ground"] * math.log(ground + GROUND_NOISE)
    return value


def decide(figures: Figures) -> Verdict:
    """Return the verdict on a best pose."""
    confidence = min(probability(figures), told_apart(figures.second_ratio))
    if not _is_held(figures):
        confidence = min(confidence, 0.5)
    if confidence >= ACCEPT_AT and not is_lost(figures):
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
    if not figures.converged:
        return "the refinement on the points left the place that the search had found"
    if figures.evidence < LEAST_EVIDENCE:
        return (
            f"the best pose has only {figures.evidence:.0f} nats of evidence, too little to rely "
            f"on (at least {LEAST_EVIDENCE:.0f} are needed)"
        )
    if told_apart(figures.second_ratio) < ACCEPT_AT:
        return (
            "another pose is nearly as good as the best one (evidence ratio "
            f"{figures.second_ratio:.2f}); the place repeats itself or the maps do not overlap"
        )
    if figures.decoy_ratio < 1.5:
        return (
            f"a mirrored map, which cannot match, finds almost as much evidence (ratio "
            f"{figures.decoy_ratio:.2f}); the best pose may be a coincidence"
        )
    if figures.half_1 is not None and figures.half_2 is not None:
        weaker = min(figures.half_1, figures.half_2)
        if weaker < 1.0:
            return (
                "one half of the overlap, searched for by itself, fits better elsewhere (evidence "
                f"ratio {weaker:.2f}); the other half alone may be a coincidence"
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
    if figures.moved > 1.0:
        return (
            f"the points settle {figures.moved:.1f} cells away from where the height maps agree "
            "best; what both show of one place settles within one"
        )
    return "the signs of a true match, taken together, are too weak to rely on"


def _log(ratio: float) -> float:
    """Return the logarithm of a ratio between 1/4 and 20."""
    return math.log(min(max(ratio, 0.25), 20.0))


def _logistic(logit: float) -> float:
    return 1.0 / (1.0 + math.exp(-logit))


def _odds(share: float) -> float:
    """Return the logarithm of the odds of a share, of one between 0.02 and 0.98."""
    share = min(max(share, 0.02), 0.98)
    return math.log(share / (1.0 - share))
