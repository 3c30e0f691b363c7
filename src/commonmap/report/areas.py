"""The draft by areas on the page: its drift from above, and what each area found by itself."""

from __future__ import annotations

import math
from html import escape

import numpy as np
from scipy.spatial import cKDTree

from commonmap.report import pictures, tables
from commonmap.types import Area, Areas


def drift_figure(areas: Areas) -> str:
    """Return an SVG of the areas from above, coloured by how far each would move, with arrows.

    Base's frame, metres; the arrows are drawn enlarged. Rings: areas whose own accepted pose is
    not that of the whole.
    """
    told = [area for area in areas.items if area.drift is not None]
    xy = np.array([area.centre[:2] for area in areas.items])
    low, high = xy.min(axis=0) - areas.size, xy.max(axis=0) + areas.size
    cell = float((high - low).max()) / 240.0
    shape = tuple(np.ceil((high - low) / cell).astype(int))
    at = np.indices(shape).reshape(2, -1).T * cell + low + 0.5 * cell
    distance, nearest = cKDTree(xy).query(at, workers=1)
    metres = np.array([_length(area) for area in areas.items])
    picture = np.where(distance < 0.5 * areas.size, metres[nearest], np.nan).reshape(shape)
    top = max(float(np.nanmax(metres)), 0.01) if told else 0.01
    shifts = [area.drift[:2] for area in told if area.drift is not None]
    factor = enlargement(areas)
    arrows = [
        pictures.Arrow(area.centre[0], area.centre[1], factor * x, factor * y)
        for area, (x, y) in zip(told, shifts, strict=True)
    ]
    elsewhere = [area for area in areas.items if area.accepted and not area.agrees]
    return pictures.map_figure(
        pictures.shade(picture, 0.0, top), origin=low, cell=(cell, cell),
        alt=f"{len(told)} areas of the draft, and how far each would move to lie on the base",
        marks=[pictures.Mark(area.centre[0], area.centre[1], "elsewhere") for area in elsewhere],
        arrows=arrows, scale=(0.0, top, "m"),
    )  # fmt: skip


def enlargement(areas: Areas) -> float:
    """Return how many times longer than the drift the arrows are: 1, 2 or 5 times a power of ten.

    The longest is then at most as long as an area is wide.
    """
    longest = max(
        (float(np.hypot(*area.drift[:2])) for area in areas.items if area.drift is not None),
        default=0.0,
    )
    room = areas.size / max(longest, 1e-4)
    power = 10.0 ** math.floor(math.log10(room))
    return power * max(step for step in (1.0, 2.0, 5.0) if step * power <= room)


def areas_text(areas: Areas) -> str:
    """Return two sentences: what the areas found by themselves, and what became of the drift."""
    searched = [area for area in areas.items if area.T_target_source is not None]
    n_accepted = sum(area.accepted for area in searched)
    found = f"None of the {len(areas.items)} areas holds enough to be searched by itself."
    if searched:
        n_agree = sum(area.agrees for area in searched)
        found = (
            f"{len(searched)} of {len(areas.items)} areas of {areas.size:g} m were matched by "
            f"themselves on the whole base: {n_agree} find the pose of the whole, and the verdict "
            f"accepts {n_accepted} of them alone."
        )
    return f"{found} Drift: {areas.reason}."


def areas_table(areas: Areas) -> str:
    """Return a table of the areas: place, own verdict, whether it agrees, drift."""
    rows = []
    for area in areas.items:
        values = ["", "", "", ""]
        if area.T_target_source is not None:
            values = [
                "accepted" if area.accepted else "refused", "yes" if area.agrees else "no",
                f"{100 * area.confidence:.0f} %", tables.fixed(area.score, 0),
            ]  # fmt: skip
        drift = tables.fixed(_length(area), 3) if area.drift is not None else ""
        numbers = (tables.fixed(area.centre[0], 1), tables.fixed(area.centre[1], 1))
        cells = [*numbers, *values, drift]
        rows.append([f'<td class="number">{escape(cell)}</td>' for cell in cells])
    names = ["#x, m", "#y, m", "#by itself", "#at the whole's pose", "#confidence", "#score"]
    return tables.table("The areas, in the base's frame", [*names, "#drift, m"], rows)


def _length(area: Area) -> float:
    return float("nan") if area.drift is None else float(np.linalg.norm(area.drift))
