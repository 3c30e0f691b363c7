"""The page itself: one HTML file that opens anywhere, without a network."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from html import escape
from importlib import resources
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from commonmap.config import Config
from commonmap.frames import apply
from commonmap.io.atomic import writing
from commonmap.mapping.ground import find_ground
from commonmap.mapping.points import points_of
from commonmap.merging.products import COLOURS, SOURCE, TARGET, CommonMap, Map
from commonmap.report import pictures, tables
from commonmap.report.areas import areas_table, areas_text, drift_figure, enlargement
from commonmap.report.points import Box, enclose, encode, take_evenly, thin
from commonmap.report.pose import pose_figures, static_transform_command, to_json
from commonmap.types import Areas, Float64s, Match, SearchPicture
from commonmap.version import __version__

MAX_POINTS = 90_000
"""Points of each map that the page holds; what is more is thinned evenly."""

MAX_VOXELS = 110_000
"""Voxels of the common octree that the page holds."""

BASE, DRAFT, BOTH = COLOURS[TARGET], COLOURS[SOURCE], COLOURS[TARGET | SOURCE]
CONFLICT = (214, 51, 108)


@dataclass(frozen=True, eq=False)
class Shown:
    """One map as the page shows it. xyz: (N, 3) target's frame; height: (N,) above its ground."""

    xyz: Float64s
    height: Float64s
    seen_by: NDArray[np.uint8]


def write_report(
    path: str | Path,
    *,
    target: Map,
    source: Map,
    match: Match,
    config: Config,
    common: CommonMap | None = None,
    names: tuple[str, str] = ("base", "draft"),
    notes: Sequence[str] = (),
    error: tuple[float, float] | None = None,
    sections: Sequence[str] = (),
) -> None:
    """Write the report of a match, and of the common map where there is one, as one HTML file.

    names: of the two maps, as the user knows them. notes: sentences shown under the verdict.
    error: (metres, radians) from the truth, where the truth is known. sections: HTML of further
        sections, shown after the plans.
    """
    html = build_page(target, source, match, config, common, names, notes, error, sections)
    with writing(path) as part:
        part.write_text(html, encoding="utf-8")


def build_page(
    target: Map, source: Map, match: Match, config: Config, common: CommonMap | None,
    names: tuple[str, str], notes: Sequence[str], error: tuple[float, float] | None,
    extra: Sequence[str] = (),
) -> str:  # fmt: skip
    """Return the report as the text of an HTML page."""
    T = match.T_target_source
    shown_T = T if T is not None else next((r.T_target_source for r in match.rivals), None)
    source_xyz = points_of(source, "draft")
    centre = match.picture.centre if match.picture is not None else np.median(source_xyz, axis=0)
    base = _show(points_of(target, "base"), None, TARGET)
    draft = _show(source_xyz, shown_T, SOURCE) if shown_T is not None else None
    sections = [
        _verdict(match, names, notes, error),
        _viewer(base, draft, common, accepted=T is not None),
        _plans(base, draft, common, accepted=T is not None),
        *extra,
        _search(match, centre),
        _areas(match.areas),
        _section(
            "Why this verdict", "All figures are of the best pose that the search found.",
            tables.evidence_table(match.evidence),
        ),
        _section(
            "Rival poses",
            "Other poses that the search found, best first. Where the match is refused, the first "
            "is the best pose of all.",
            tables.rivals_table(match.rivals, centre, T),
        ),
        _section("Timings", "", tables.timings_table(match.timings)),
        _settings(match, config, names),
    ]  # fmt: skip
    files = resources.files("commonmap.report")
    style = (files / "page.css").read_text(encoding="utf-8")
    script = (files / "viewer.js").read_text(encoding="utf-8")
    title = f"{names[1]} on {names[0]}: {'accepted' if match.accepted else 'refused'}"
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>\n{style}</style>\n</head>\n<body>\n"
        f"<header><h1>commonmap report</h1><p>Base map <strong>{escape(names[0])}</strong>, draft "
        f"map <strong>{escape(names[1])}</strong></p></header>\n<main>\n"
        + "\n".join(sections)
        + f"\n</main>\n<footer><p>Made by commonmap {escape(__version__)}. This file is complete: "
        "it loads nothing from elsewhere.</p></footer>\n"
        f"<script>\n{script}</script>\n</body>\n</html>\n"
    )


def _show(xyz: Float64s, T_target_map: Float64s | None, bit: int) -> Shown:
    """Return a map thinned for the page, moved by T, with heights above its own ground."""
    few = xyz[take_evenly(len(xyz), 8 * MAX_POINTS)]
    ground = find_ground(few)
    kept = few[thin(few, MAX_POINTS)]
    height = np.maximum(ground.height_above(kept), 0.0)
    moved = kept if T_target_map is None else apply(T_target_map, kept)
    return Shown(moved, height, np.full(len(kept), bit, np.uint8))


def _verdict(
    match: Match, names: tuple[str, str], notes: Sequence[str], error: tuple[float, float] | None
) -> str:
    kind = "accepted" if match.accepted else "refused"
    reason = match.reason.removeprefix(f"{kind}: ")
    reason = reason[:1].upper() + reason[1:] + ("" if reason.endswith(".") else ".")
    word = "Accepted" if match.accepted else "Refused"
    parts = [f'<h2>{word}</h2><p class="reason">{escape(reason)}</p>', tables.verdict_tiles(match)]
    if match.accepted and match.T_target_source is not None:
        parts.append(
            "<h3>Pose of the draft's frame in the base's frame</h3>" + tables.pose_tiles(match)
        )
    else:
        parts.append(
            '<p class="note">No common map was made. Pictures show the best pose that was found, '
            "which is not to be believed.</p>"
        )
    if error is not None:
        parts.append(
            f'<p class="note">The truth is known here: the answer is {error[0]:.3f} m and '
            f"{math.degrees(error[1]):.3f}° from it, in the middle of the draft.</p>"
        )
    parts += [f'<p class="note">{escape(note)}</p>' for note in notes]
    return f'<section class="verdict {kind}">{"".join(parts)}</section>'


def _viewer(base: Shown, draft: Shown | None, common: CommonMap | None, *, accepted: bool) -> str:
    """Return the section with the 3D picture and its data."""
    parts = [base] if draft is None else [base, draft]
    box = enclose(*(part.xyz for part in parts))
    heights = np.concatenate([part.height for part in parts])
    top = max(float(np.quantile(heights, 0.99)), 0.5)
    sets = [
        _set("base", base.xyz, base.height, base.seen_by, box, top, BASE, shown=True),
    ]
    boxes = [("base", "base map", "var(--base)", True)]
    if draft is not None:
        sets.append(_set("draft", draft.xyz, draft.height, draft.seen_by, box, top, DRAFT, True))
        boxes.append(("draft", "draft map", "var(--draft)", True))
    if common is not None:
        occupied = np.flatnonzero(common.leaves.occupied)
        xyz = common.leaves.centres()[occupied] + common.octree_origin
        kept = thin(xyz, MAX_VOXELS)
        height = _height_in(common, xyz[kept])
        seen_by = common.leaves_seen_by[occupied[kept]]
        sets.append(_set("common", xyz[kept], height, seen_by, box, top, BOTH, shown=False))
        boxes.append(("common", "common octree", "var(--both)", False))
    data = json.dumps({"half": box.half.tolist(), "sets": sets}, allow_nan=False)
    toggles = "".join(
        f'<label><input type="checkbox" data-set="{name}" autocomplete="off"'
        f"{' checked' if on else ''}>"
        f'<span class="swatch" style="background:{colour}"></span>{label}</label>'
        for name, label, colour, on in boxes
    )
    modes = "".join(
        f'<label><input type="radio" name="colour" value="{value}" autocomplete="off"'
        f"{' checked' if value == 0 else ''}>{label}</label>"
        for value, label in enumerate(("map", "height above ground", "seen by"))
    )
    place = "in the base's frame" if accepted else "at the best pose found, which is not believed"
    body = (
        '<div class="viewer-frame"><canvas id="viewer" tabindex="0" role="img" '
        f'aria-label="Points of both maps {place} in 3D"></canvas>'
        '<p id="viewer-message" role="status" hidden></p></div>'
        f'<div class="controls"><fieldset><legend>Show</legend>{toggles}</fieldset>'
        f"<fieldset><legend>Colour by</legend>{modes}</fieldset>"
        '<label>point size <input id="viewer-size" type="range" min="-1.5" max="2" step="0.25" '
        'value="0" autocomplete="off"></label>'
        '<span><button type="button" id="viewer-top">from above</button> '
        '<button type="button" id="viewer-reset">reset view</button></span></div>'
        '<noscript><p class="note">The 3D picture needs JavaScript; the pictures below do not.</p>'
        "</noscript>"
        f'<script type="application/json" id="viewer-data">{data}</script>'
    )
    return _section(
        "Both maps in 3D",
        f"Points {place}. Drag to turn, shift-drag or right-drag to move, click and then use the "
        "wheel to zoom. Keys: arrows, shift + arrows, + and −, r. “Seen by” paints what the "
        "base's robot saw blue, the draft's orange and both green.",
        body,
    )


def _set(
    name: str, xyz: Float64s, height: Float64s, seen_by: NDArray[np.uint8], box: Box,
    top: float, colour: tuple[int, int, int], shown: bool,
) -> dict[str, object]:  # fmt: skip

    return {
        "name": name,
        "colour": [round(c / 255.0, 3) for c in colour],
        "shown": shown,
        "points": encode(xyz, height, seen_by, box, top=top),
    }


def _height_in(common: CommonMap, xyz: Float64s) -> Float64s:
    """Return the height (N,) of points above the common ground; 0 where it is not known."""
    grid = common.heights
    ij = np.floor((xyz[:, :2] - grid.origin) / grid.cell).astype(np.int64)
    ij = np.clip(ij, 0, np.array(grid.shape) - 1)
    height = xyz[:, 2] - grid["ground"][ij[:, 0], ij[:, 1]]
    return np.asarray(np.nan_to_num(np.maximum(height, 0.0)), dtype=np.float64)


def _plans(base: Shown, draft: Shown | None, common: CommonMap | None, *, accepted: bool) -> str:
    """Return the section with the pictures from above."""
    parts = [base] if draft is None else [base, draft]
    box = enclose(*(part.xyz for part in parts))
    low, size = box.centre[:2] - box.half[:2], 2.0 * box.half[:2]
    cell = float(size.max()) / 420.0
    shape = (math.ceil(size[0] / cell), math.ceil(size[1] / cell))

    def standing(part: Shown | None) -> Float64s:
        if part is None:
            return np.zeros(shape)
        tall = part.height > 0.3
        return pictures.density(part.xyz[tall if tall.any() else slice(None), :2], low, cell, shape)

    picture = pictures.overlay(standing(base), standing(draft), (BASE, DRAFT, BOTH))
    alt = "Both maps from above: what stands on the ground, base blue, draft orange, both green"
    legend = _legend([("base", BASE), ("draft", DRAFT), ("both", BOTH)])
    figures = [
        _figure(
            "From above",
            pictures.map_figure(picture, origin=low, cell=(cell, cell), alt=alt),
            legend,
            "What stands more than 0.3 m above the ground.",
        )
    ]
    if common is not None:
        figures += _common_figures(common)
    text = (
        "The two maps laid on each other"
        if accepted
        else "The two maps at the best pose found, which is not believed"
    )
    return _section(
        "Plans", f"{text}; x to the right, y up.", f'<div class="pair">{"".join(figures)}</div>'
    )


def _common_figures(common: CommonMap) -> list[str]:
    grid = common.heights
    classes = grid["seen_by"].astype(np.int64)
    classes = np.where(grid["conflict"], 4, classes)
    colours = {
        TARGET: (*BASE, 235),
        SOURCE: (*DRAFT, 235),
        TARGET | SOURCE: (*BOTH, 235),
        4: (*CONFLICT, 255),
    }
    n_known = max(int((grid["seen_by"] > 0).sum()), 1)
    counts = [int((classes == value).sum()) for value in (1, 2, 3, 4)]
    shares = [
        f"{name} {100 * count / n_known:.1f} %"
        for name, count in zip(("base only", "draft only", "both", "conflict"), counts, strict=True)
    ]
    who = _figure(
        "Who saw what",
        pictures.map_figure(
            pictures.paint(classes, colours), origin=grid.origin, cell=(grid.cell, grid.cell),
            alt="Cells of the plan by the robots that saw them: " + ", ".join(shares),
        ),
        _legend(list(zip(shares, (BASE, DRAFT, BOTH, CONFLICT), strict=True))),
        "A conflict: one robot saw an obstacle where the other saw bare ground.",
    )  # fmt: skip
    top = float(np.nanquantile(grid["height"], 0.99)) if np.isfinite(grid["height"]).any() else 1.0
    top = max(top, 0.5)
    tall = _figure(
        "Height above ground",
        pictures.map_figure(
            pictures.shade(grid["height"], 0.0, top), origin=grid.origin,
            cell=(grid.cell, grid.cell), alt="Common height map, height above ground in metres",
            scale=(0.0, top, "m"),
        ),
        "",
        f"The higher of what the two robots saw, cells of {grid.cell:g} m.",
    )  # fmt: skip
    occupancy = common.navigation["occupancy"].astype(np.int64)
    free, wall = (214, 226, 236, 255), (38, 50, 64, 255)
    drive = _figure(
        "Map for navigation",
        pictures.map_figure(
            pictures.paint(occupancy, {0: free, 100: wall}), origin=grid.origin,
            cell=(grid.cell, grid.cell), alt="Navigation map: free, occupied and unknown cells",
        ),
        _legend([("free", free[:3]), ("occupied", wall[:3])]),
        "Unknown cells are left empty.",
    )  # fmt: skip
    return [who, tall, drive]


def _search(match: Match, centre: Float64s) -> str:
    """Return the section with the score over translations and headings."""
    picture = match.picture
    if picture is None:
        return ""
    best = match.T_target_source
    rivals = list(match.rivals)
    if best is None and rivals:
        best = rivals.pop(0).T_target_source
    first = 1 if match.T_target_source is not None else 2
    marks = [_mark(r.T_target_source, centre, str(n)) for n, r in enumerate(rivals, start=first)]
    marks = marks[::-1] + ([] if best is None else [_mark(best, centre, "best", strong=True)])
    picture = _cropped(picture)
    finite = picture.score[np.isfinite(picture.score)]
    low = float(finite.min()) if len(finite) else 0.0
    high = float(finite.max()) if len(finite) else 1.0
    step = [
        float(np.median(np.diff(axis))) if len(axis) > 1 else 1.0 for axis in (picture.x, picture.y)
    ]
    corner = np.array([picture.x[0] - 0.5 * step[0], picture.y[0] - 0.5 * step[1]])
    surface = pictures.map_figure(
        pictures.shade(picture.score, low, high), origin=corner, cell=(step[0], step[1]),
        alt="Score over all translations at the best heading", marks=marks,
        scale=(low, high, "score"), x_name="x of the draft's middle",
        y_name="y of the draft's middle",
    )  # fmt: skip
    return _section(
        "The search",
        "Every place and heading is tried. A true match is one narrow peak far above the rest, and "
        "above the best that the mirrored draft (the decoy), which cannot match, finds anywhere.",
        '<div class="pair">'
        + _figure(
            "Score over places", surface, "",
            "At the best heading. Rings: the best pose, and rivals by number, which may have "
            "another heading. Blank: too little overlap to count.",
        )
        + _figure(
            "Best score of each heading", _yaw_curve(picture, best), "",
            "On the coarse cells with which the search begins. Dashed: the decoy's best.",
        )
        + "</div>",
    )  # fmt: skip


def _areas(areas: Areas | None) -> str:
    """Return the section on the draft's areas, nothing where they were not asked for."""
    if areas is None:
        return ""
    return _section(
        "The draft by areas",
        areas_text(areas),
        _figure(
            "Drift", drift_figure(areas), "",
            "How far each area would move to lie on the base, seen from above in the base's frame; "
            f"arrows {enlargement(areas):g} times as long as the way. Blank: too few points there.",
        )
        + f"<details><summary>All areas</summary>{areas_table(areas)}</details>",
    )  # fmt: skip


def _cropped(picture: SearchPicture) -> SearchPicture:
    """Return the picture without the rows and columns that hold no score, but for a margin."""
    finite = np.isfinite(picture.score)
    if not finite.any():
        return picture
    parts = []
    for axis in (1, 0):
        used = np.flatnonzero(finite.any(axis=axis))
        margin = 1 + len(used) // 20
        parts.append(slice(max(used[0] - margin, 0), used[-1] + margin + 1))
    i, j = parts
    return replace(picture, score=picture.score[i, j], x=picture.x[i], y=picture.y[j])


def _yaw_curve(picture: SearchPicture, best: Float64s | None) -> str:
    yaw = (np.degrees(picture.yaw) + 180.0) % 360.0 - 180.0
    order = np.argsort(yaw, kind="stable")
    x, y = yaw[order], np.asarray(picture.best_per_yaw, dtype=np.float64)[order]
    marks = []
    if best is not None and np.isfinite(y).any():
        top = int(np.nanargmax(y))
        at = pose_figures(best).yaw_deg
        marks = [pictures.Mark(float(x[top]), float(y[top]), f"best pose {tables.fixed(at, 1)}°")]
    return pictures.curve_figure(
        x, y, alt="Best score over all translations for each heading, and the decoy's best score",
        level=(picture.decoy_best, "decoy"), marks=marks,
    )  # fmt: skip


def _mark(T: Float64s, centre: Float64s, label: str, *, strong: bool = False) -> pictures.Mark:
    x, y, _ = apply(T, centre[None])[0]
    return pictures.Mark(float(x), float(y), label, strong)


def _settings(match: Match, config: Config, names: tuple[str, str]) -> str:
    parts = []
    if match.T_target_source is not None:
        command = static_transform_command(match.T_target_source, "base_map", "draft_map")
        parts.append(
            "<h3>Transform</h3><p>Points of the draft become points of the base: "
            "p<sub>base</sub> = T p<sub>draft</sub>.</p>"
            f"<pre>{escape(tables.matrix_text(match.T_target_source))}</pre>"
            f"<h3>For ROS 2</h3><pre class=command>{escape(command)}</pre>"
        )
    parts.append(
        "<h3>Configuration</h3><details><summary>All values, resolved"
        f"</summary><pre>{escape(to_json(config.to_dict()))}</pre></details>"
    )
    return _section("Transform and configuration", "", "".join(parts))


def _section(title: str, text: str, body: str) -> str:
    lead = f"<p>{escape(text)}</p>" if text else ""
    return f"<section><h2>{escape(title)}</h2>{lead}{body}</section>"


def _figure(title: str, picture: str, legend: str, caption: str) -> str:
    return (
        f"<figure><h3>{escape(title)}</h3>{picture}{legend}"
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


def _legend(items: Sequence[tuple[str, Sequence[int]]]) -> str:
    rows = "".join(
        f'<li><span class="swatch" style="background:rgb({c[0]},{c[1]},{c[2]})"></span> '
        f"{escape(name)}</li>"
        for name, c in items
    )
    return f'<ul class="legend">{rows}</ul>'
