"""Tables and figures of the page as HTML. Every text from outside is escaped here."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from html import escape

import numpy as np

from commonmap.frames import apply
from commonmap.report.pose import pose_figures, sigma_figures
from commonmap.types import Candidate, Float64s, Match

EXPLAINED = {
    "decoy_ratio": "evidence of the best pose over the best of the mirrored draft, which cannot "
    "match; about 1 is chance",
    "second_ratio": "evidence of the best pose over the best one at another place or heading",
    "prominence": "best pose above the median of all headings, in robust standard deviations",
    "support": "share of the draft's areas that speak for the pose",
    "effect": "evidence as a share of what perfect agreement would give",
    "support_t": "mean over standard error of the areas' evidence",
    "spread": "share of the evidence left without its best quarter of areas",
    "inliers": "share of the draft's standing points that lie near standing points of the base",
    "decoy_inliers": "the same for the mirrored draft at its best pose",
    "ground": "metres by which the draft's ground undulates against the base's",
    "decoy_ground": "the same for the mirrored draft at its best pose",
    "second_ground": "the same at the best pose elsewhere",
    "half_1": "evidence of one half of the overlap at the pose, over that half's best elsewhere",
    "half_2": "the same for the other half",
    "overlap": "share of the draft's known cells that meet known cells of the base",
    "n_overlap": "number of those cells",
    "moved": "how far the refinement moved the pose of the search, in cells",
    "converged": "1 where the refinement stayed in the basin of the search's peak",
    "cell": "edge of a cell of the search, metres",
}
"""What the figures behind a verdict mean; a figure that is not here is shown by name alone."""


def number(value: float, digits: int = 3) -> str:
    """Return a number as people read it: few digits, a real minus sign."""
    if not math.isfinite(value):
        return "–"
    if value == int(value) and abs(value) < 1e7:
        return f"{int(value)}".replace("-", "−")
    if abs(value) >= 10**digits:
        return f"{value:,.0f}".replace(",", " ").replace("-", "−")
    return f"{value:.{digits}g}".replace("-", "−")


def fixed(value: float, decimals: int) -> str:
    """Return a number with so many decimals and a real minus sign."""
    text = f"{value:.{decimals}f}"
    return text.replace("-", "−") if float(text) != 0 else text.replace("-", "")


def tiles(items: Iterable[tuple[str, str, str]]) -> str:
    """Return figures as tiles: (name, value, small print)."""
    cells = "".join(
        f"<div><dt>{escape(name)}</dt><dd>{escape(value)}"
        + (f"<small>{escape(small)}</small>" if small else "")
        + "</dd></div>"
        for name, value, small in items
    )
    return f'<dl class="tiles">{cells}</dl>'


def pose_tiles(match: Match) -> str:
    """Return the pose with one standard deviation each; nothing where the match was refused."""
    if match.T_target_source is None:
        return ""
    pose = pose_figures(match.T_target_source)
    sigma = None if match.covariance is None else sigma_figures(match.covariance)

    def item(name: str, unit: str, decimals: int) -> tuple[str, str, str]:
        value = fixed(getattr(pose, name), decimals)
        small = "" if sigma is None else f"± {fixed(getattr(sigma, name), decimals + 1)} {unit}"
        return name.removesuffix("_deg"), f"{value} {unit}", small

    return tiles(
        [item(name, "m", 2) for name in ("x", "y", "z")]
        + [item(name, "°", 2) for name in ("yaw_deg", "pitch_deg", "roll_deg")]
    )


def verdict_tiles(match: Match) -> str:
    """Return the figures of the verdict."""
    ratio = match.score / match.decoy_score if match.decoy_score > 0 else math.nan
    confidence = math.floor(1000.0 * match.confidence) / 10.0  # never rounded up to certainty
    return tiles(
        [
            ("Confidence", f"{confidence:.1f} %", "that the best pose is right"),
            ("Overlap", f"{100 * match.overlap:.0f} %", "of the draft meets the base"),
            ("Score", number(match.score), match.metric),
            ("Decoy", number(match.decoy_score), "best of the mirrored draft"),
            ("Score / decoy", number(ratio), "about 1 is chance"),
        ]
    )


def evidence_table(evidence: Mapping[str, float]) -> str:
    """Return the figures behind the verdict with what they mean."""
    rows = [
        [f'<th scope="row">{escape(name.replace("_", " "))}</th>', _number_cell(number(value)),
         f'<td class="explained">{escape(EXPLAINED.get(name, ""))}</td>']
        for name, value in evidence.items()
    ]  # fmt: skip
    return table("Figures behind the verdict", ["figure", "#value", "meaning"], rows)


def rivals_table(rivals: Sequence[Candidate], centre: Float64s, best: Float64s | None) -> str:
    """Return the rival poses: where they put the middle of the draft, (3,) in its own frame."""
    if not rivals:
        return "<p>The search found no other pose worth a look.</p>"
    rows = []
    for rank, rival in enumerate(rivals, start=1):
        x, y, z = apply(rival.T_target_source, centre[None])[0]
        yaw = pose_figures(rival.T_target_source).yaw_deg
        apart = "–"
        if best is not None:
            apart = fixed(float(np.linalg.norm(apply(best, centre[None])[0] - [x, y, z])), 1)
        values = [
            fixed(x, 1), fixed(y, 1), fixed(z, 1), fixed(yaw, 1), apart, number(rival.score),
            f"{100 * rival.overlap:.0f} %",
        ]  # fmt: skip
        rows.append([f'<th scope="row">{rank}</th>', *map(_number_cell, values)])
    names = ["pose", "#x, m", "#y, m", "#z, m", "#yaw, °", "#from the answer, m", "#score"]
    return table("Where each would put the middle of the draft map", [*names, "#overlap"], rows)


def timings_table(timings: Mapping[str, float]) -> str:
    """Return seconds per step with bars."""
    longest = max([*timings.values(), 1e-9])
    rows = [
        [
            f'<th scope="row">{escape(name)}</th>',
            _number_cell(f"{seconds:.2f}"),
            f'<td><span class="bar" style="width:{100 * seconds / longest:.1f}%"></span></td>',
        ]
        for name, seconds in timings.items()
    ]
    return table("Seconds per step", ["step", "#s", "share of the longest"], rows)


def matrix_text(T: Float64s) -> str:
    """Return a 4x4 motion as text, columns aligned."""
    lines = [" ".join(f"{value:18.9f}" for value in row) for row in T]
    return "\n".join(lines)


def table(caption: str, names: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table; a name that begins with # heads a column of numbers. Cells are HTML."""
    head = "".join(
        f'<th scope="col"{" class=number" if name.startswith("#") else ""}>'
        f"{escape(name.removeprefix('#'))}</th>"
        for name in names
    )
    body = "".join(f"<tr>{''.join(row)}</tr>" for row in rows)
    return (
        f'<div class="table"><table><caption>{escape(caption)}</caption>'
        f"<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"
    )


def _number_cell(text: str) -> str:
    return f'<td class="number">{escape(text)}</td>'
