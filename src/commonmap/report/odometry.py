"""The section of the report on odometry: the ways of the robots, and how far to believe them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from commonmap.odometry import TrajectoryErrors
from commonmap.pipeline_logs import RobotMap
from commonmap.report import tables
from commonmap.types import Bools, Float64s, Trajectory

ROOM = 500.0
"""Width of the picture, in its own units."""

MOST_PLACES = 2000
"""Places of a way that are drawn."""


@dataclass(frozen=True, eq=False)
class Way:
    """A robot of the section. name: as the user knows it. part: "base" or "draft".

    trajectory: in the frame of the picture; None where that is not known. errors: from the truth.
    """

    name: str
    part: str
    robot: RobotMap
    trajectory: Trajectory | None
    errors: TrajectoryErrors | None = None


def odometry_section(ways: Sequence[Way]) -> str:
    """Return the section as HTML, empty where no robot handed in a log."""
    if not ways:
        return ""
    drawn = [way for way in ways if way.trajectory is not None]
    notes = "".join(
        f'<p class="note">{escape(way.name)}: {escape(note)}.</p>'
        for way in ways
        for note in way.robot.notes
    )
    picture = draw_ways(drawn) if drawn else ""
    return (
        "<section><h2>Odometry</h2><p>Where each robot's lidar was, from its raw log. A robot is "
        "lost where nothing of a turn fits its map; those turns are left out. Along a degenerate "
        "direction the scene says nothing, and the pose goes on as before.</p>"
        f"{_table(ways)}{_error_table(ways)}{notes}{picture}</section>"
    )


def _table(ways: Sequence[Way]) -> str:
    rows = []
    for way in ways:
        robot, health = way.robot, way.robot.odometry.health
        residuals = [h.residual for h in health if math.isfinite(h.residual)]
        residual = 1e3 * float(np.median(residuals)) if residuals else math.nan
        values = (
            tables.number(robot.n_turns), tables.number(robot.way), tables.number(residual, 2),
            tables.number(robot.odometry.n_lost), tables.number(robot.odometry.n_degenerate),
            tables.number(math.degrees(robot.levelling.tilt)),
        )  # fmt: skip
        rows.append(
            [
                f'<th scope="row">{escape(way.name)}</th>',
                f"<td>{escape(robot.odometry.method)}</td>",
                *(f'<td class="number">{value}</td>' for value in values),
            ]
        )
    names = ["log", "method", "#turns", "#way, m", "#residual, mm", "#lost", "#degenerate"]
    return tables.table("How far the odometry held", [*names, "#levelled by, °"], rows)


def _error_table(ways: Sequence[Way]) -> str:
    """Return the errors from the truth where it is known."""
    rows = []
    for way in ways:
        if way.errors is None:
            continue
        e = way.errors
        values = (e.ape, e.ape_max, 100.0 * e.relative, math.degrees(e.turn))
        rows.append(
            [
                f'<th scope="row">{escape(way.name)}</th>',
                *(f'<td class="number">{tables.number(value)}</td>' for value in values),
            ]
        )
    if not rows:
        return ""
    names = ["log", "#absolute, m (RMS)", "#absolute, m (most)", "#relative, %", "#relative, °/m"]
    return tables.table(
        "Errors from the truth: absolute after the best alignment, relative over stretches of 10 m",
        names, rows,
    )  # fmt: skip


def draw_ways(ways: Sequence[Way]) -> str:
    """Return a figure of the ways from above, x to the right, y up; lost stretches are dotted."""
    places = [way.trajectory.T_map_sensor[:, :2, 3] for way in ways if way.trajectory is not None]
    low = np.min([xy.min(axis=0) for xy in places], axis=0)
    high = np.max([xy.max(axis=0) for xy in places], axis=0)
    per_metre = ROOM / max(float((high - low).max()), 1.0)
    size = np.maximum((high - low) * per_metre, 40.0) + 40.0
    lines = []
    for way, xy in zip(ways, places, strict=True):
        at = np.column_stack([xy[:, 0] - low[0], high[1] - xy[:, 1]]) * per_metre + 20.0
        lost = np.array([h.lost for h in way.robot.odometry.health], dtype=bool)
        lost = lost if len(lost) == len(at) else np.zeros(len(at), dtype=bool)
        lines.append(_way(at, lost, f"var(--{way.part})"))
    legend = "".join(
        f'<li><span class="swatch" style="background:var(--{way.part})"></span> '
        f"{escape(way.name)}</li>"
        for way in ways
    )
    alt = "The ways of the robots from above"
    return (
        f'<figure><svg class="plot" role="img" viewBox="0 0 {size[0]:.0f} {size[1]:.0f}" '
        f'xmlns="http://www.w3.org/2000/svg"><title>{alt}</title>{"".join(lines)}</svg>'
        f'<ul class="legend">{legend}</ul><figcaption>{alt}, in the common frame; rings are where '
        f"they start, dots where a robot was lost. The longer side is "
        f"{float((high - low).max()):.0f} m.</figcaption></figure>"
    )


def _way(at: Float64s, lost: Bools, colour: str) -> str:
    step = len(at) // MOST_PLACES + 1
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in at[::step])
    dots = "".join(
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2.5" fill="var(--conflict)"/>' for x, y in at[lost]
    )
    return (
        f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="2"/>'
        f'<circle cx="{at[0, 0]:.1f}" cy="{at[0, 1]:.1f}" r="6" fill="none" stroke="{colour}" '
        f'stroke-width="2"/>{dots}'
    )
