"""The paper's six figures, and one of its claims, drawn from the data of one run."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")

import matplotlib.pyplot as plt
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle

from commonmap.frames import apply
from commonmap.study.claims import CLOSE, TWICE, ReadingRow
from commonmap.study.paper_maps import AREA, CELL, MAX_HEIGHT
from commonmap.study.paper_run import VOXEL, Experiment, Found
from commonmap.study.paper_views import (
    BASE,
    BOTH,
    DRAFT,
    HEIGHT_COLOURS,
    INK,
    LINE,
    SOFT,
    WRONG,
    draw_clouds,
    draw_common_map,
    draw_octrees,
    draw_scene,
    in_thousands,
)
from commonmap.study.readings import LEAST, make_lattice
from commonmap.types import Float64s, Progress, no_progress

DPI = 110


def draw_figures(
    run: Experiment, rows: Sequence[ReadingRow], folder: Path, *, progress: Progress = no_progress
) -> list[str]:
    """Write every figure of a run into a folder; return their names in the paper's order.

    rows: of the readings, for the figure of the paper's claim.
    """
    drawn: dict[str, Callable[[Experiment], Figure]] = {
        "figure1_diagram": draw_diagram,
        "figure2_scene": draw_scene,
        "figure3_clouds": draw_clouds,
        "figure4_octrees": draw_octrees,
        "figure5_areas": draw_areas,
        "figure6_common_map": draw_common_map,
        "figure7_claim": lambda run: draw_claim(rows),
    }
    names = []
    with plt.rc_context(_STYLE):
        for number, (name, draw) in enumerate(drawn.items()):
            progress("figures", number / len(drawn))
            figure = draw(run)
            if name == "figure1_diagram":
                figure.savefig(folder / f"{name}.svg", metadata={"Date": None})
                names.append(f"{name}.svg")
            write_png(figure, folder / f"{name}.png")
            plt.close(figure)
            names.append(f"{name}.png")
    return names


_STYLE: Any = {
    "font.family": "DejaVu Sans", "font.size": 9.0, "axes.edgecolor": LINE,
    "axes.labelcolor": SOFT, "xtick.color": SOFT, "ytick.color": SOFT, "text.color": INK,
    "axes.titlesize": 10.0, "axes.titlecolor": INK, "svg.hashsalt": "commonmap",
    "svg.fonttype": "none",
    "axes.linewidth": 0.8, "figure.facecolor": "white",
}  # fmt: skip


def write_png(figure: Figure, path: Path, *, colours: int = 256) -> None:
    """Write a figure as a PNG of a limited palette, which keeps pictures of points small."""
    from PIL import Image

    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    buffer.seek(0)
    picture = Image.open(buffer).convert("RGB")
    small = picture.quantize(
        colors=colours, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE
    )
    small.save(path, format="PNG", optimize=True)


# Figure 1


def draw_diagram(run: Experiment) -> Figure:
    """Return the block diagram of how the common map is obtained, with the run's own numbers."""
    figure, axis = plt.subplots(figsize=(10.0, 4.1))
    axis.set(xlim=(0, 100), ylim=(0, 41))
    axis.axis("off")

    def block(x: float, y: float, w: float, title: str, text: str, colour: str) -> None:
        axis.add_patch(Rectangle((x, y), w, 10, facecolor="white", edgecolor=colour, lw=1.6))
        axis.text(x + w / 2, y + 6.6, title, ha="center", va="center", weight="bold")
        axis.text(x + w / 2, y + 3.1, text, ha="center", va="center", fontsize=7.4, color=SOFT)

    def arrow(start: tuple[float, float], end: tuple[float, float], label: str = "") -> None:
        axis.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "color": INK, "lw": 1.1})
        if label:
            axis.text((start[0] + end[0]) / 2, start[1] + 1.2, label, ha="center", fontsize=7.4)

    for y, colour, robot, name, errors, leaves in (
        (28.0, BASE, run.base, "UAV, VLP-16", run.errors[0], run.octrees[0]),
        (3.0, DRAFT, run.draft, "UGV, VLP-16", run.errors[1], run.octrees[1]),
    ):
        block(0.5, y, 15, name, f"{robot.n_turns} turns, {errors.way:.0f} m", colour)
        block(19.5, y, 17, "Lidar odometry", f"LOAM, error {100 * errors.ape:.1f} cm", colour)
        block(40.5, y, 15, "Octree map", f"{VOXEL:g} m, {in_thousands(leaves)} occupied", colour)
        block(59.5, y, 15, "Height map", f"under {MAX_HEIGHT:g} m, {CELL:g} m cells", colour)
        for x in (15.5, 36.5, 55.5):
            arrow((x, y + 5), (x + 4, y + 5))
    block(56, 15.5, 22, "Similarity metrics", "KL, Jeffreys, K at every position\nand yaw p", BOTH)
    block(84, 15.5, 15.5, "Common map", f"at the best p by K,\n{100 * run.off[0]:.0f} cm off", BOTH)
    arrow((67, 28), (67, 25.5))
    arrow((67, 13), (67, 15.5))
    arrow((78, 20.5), (84, 20.5), "best p")
    axis.text(69, 26.3, "base map", fontsize=7.4, color=BASE)
    axis.text(69, 13.7, f"draft map, {AREA:g} m areas", fontsize=7.4, color=DRAFT)
    for level, end in ((33.0, 25.5), (8.0, 15.5)):
        axis.plot([74.5, 91.75], [level, level], color=INK, lw=1.1)
        arrow((91.75, level), (91.75, end))
    figure.subplots_adjust(0.01, 0.01, 0.99, 0.99)
    return figure


# Figure 5


def draw_areas(run: Experiment) -> Figure:
    """Return where each area of the draft was placed, and some pairs of areas side by side."""
    figure = plt.figure(figsize=(11.6, 5.2))
    grid = figure.add_gridspec(
        2, 5, width_ratios=[2.55, 0.12, 1, 1, 1], hspace=0.1, wspace=0.1,
        left=0.05, right=0.93, top=0.91, bottom=0.13,
    )  # fmt: skip
    whole = figure.add_subplot(grid[:, 0])
    lattice = run.maps.lattice
    shown = np.where(lattice.known, np.maximum(lattice.height, 0.0), np.nan)
    _height_picture(whole, shown, lattice.origin, lattice.cell)
    right = wrong = 0
    for area, found in zip(run.areas, run.found, strict=True):
        corners = area.corner + AREA * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
        true = apply(run.maps.T_truth, np.column_stack([corners, np.zeros(4)]))[:, :2]
        ok = found["k"].right
        right, wrong = right + ok, wrong + (not ok)
        place = true
        if ok:
            T = run.maps.T_target_source(area.columns, found["k"].pose)
            place = apply(T, np.column_stack([corners, np.zeros(4)]))[:, :2]
        whole.add_patch(
            Polygon(
                place, fill=False, lw=1.8, edgecolor=BOTH if ok else WRONG,
                linestyle="-" if ok else (0, (3, 2)),
            )
        )  # fmt: skip
    whole.plot([], [], color=BOTH, lw=1.8, label=f"{right} areas placed right by K")
    whole.plot([], [], color=WRONG, lw=1.8, ls="--", label=f"{wrong} placed wrong (true place)")
    whole.legend(loc="upper center", bbox_to_anchor=(0.5, -0.09), ncol=2, frameon=False)
    whole.set(xlabel="x, m", ylabel="y, m")
    whole.set_title("Fig. 5  Base map under 1 m, and the draft's 10 m areas on it", loc="left")

    picked = _pairs(run)
    for column, number in enumerate(picked):
        area, by_k = run.areas[number], run.found[number]["k"]
        own = make_lattice(area.grid, CELL)
        upper = figure.add_subplot(grid[0, 2 + column])
        _height_picture(upper, np.where(own.known, own.height, np.nan), own.origin, CELL)
        lower = figure.add_subplot(grid[1, 2 + column])
        there, origin = _base_under(run, number)
        picture = _height_picture(lower, there, origin, CELL)
        for axis in (upper, lower):
            axis.set(xticks=[], yticks=[])
            for side in axis.spines.values():
                side.set(color=BOTH if by_k.right else WRONG, linewidth=1.8)
        upper.set_title(f"area {number + 1}: {_off(by_k)}", fontsize=8.5)
        if column == 0:
            upper.set_ylabel("draft, as it was", color=DRAFT)
            lower.set_ylabel("base, where K lays it", color=BASE)
    bar = figure.add_axes((0.945, 0.25, 0.011, 0.45))
    figure.colorbar(picture, cax=bar, label="height above ground, m")
    return figure


def _off(found: Found) -> str:
    return f"{found.metres:.1f} m, {np.degrees(found.radians):.0f}° off"


def _pairs(run: Experiment) -> list[int]:
    """Return the three areas to show: the two with most objects placed right, then a wrong one.

    Where there are not so many of one sort, the other fills up.
    """
    order = sorted(range(len(run.areas)), key=lambda n: -run.areas[n].objects)
    right = [n for n in order if run.found[n]["k"].right]
    wrong = [n for n in order if not run.found[n]["k"].right]
    chosen = [*right[:2], *wrong[:1]]
    rest = [n for n in order if n not in chosen]
    return [*chosen, *rest][:3]


def _base_under(run: Experiment, number: int) -> tuple[Float64s, Float64s]:
    """Return the base's heights under an area where K lays it, in the area's own frame."""
    area, lattice = run.areas[number], run.maps.lattice
    T = run.maps.T_target_source(area.columns, run.found[number]["k"].pose)
    n = round(AREA / CELL)
    i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    xy = area.corner + (np.column_stack([i.ravel(), j.ravel()]) + 0.5) * CELL
    at = apply(T, np.column_stack([xy, np.zeros(len(xy))]))[:, :2]
    cell = np.floor((at - lattice.origin) / lattice.cell).astype(int)
    inside = ((cell >= 0) & (cell < lattice.height.shape)).all(axis=1)
    values = np.full(len(xy), np.nan)
    x, y = cell[inside].T
    values[inside] = np.where(lattice.known[x, y], lattice.height[x, y], np.nan)
    return values.reshape(n, n), area.corner


def _height_picture(axis: Any, values: Float64s, origin: Float64s, cell: float) -> Any:
    """Draw heights under 1 m; grey is known and bare, white is not known."""
    axis.set_facecolor("white")
    n_x, n_y = values.shape
    extent = (origin[0], origin[0] + n_x * cell, origin[1], origin[1] + n_y * cell)
    bare = np.where(values < LEAST, 0.0, np.nan)
    axis.imshow(bare.T, origin="lower", extent=extent, cmap=ListedColormap(["#e3e7ec"]))
    things = np.where(values >= LEAST, values, np.nan)
    return axis.imshow(
        things.T, origin="lower", extent=extent, cmap=HEIGHT_COLOURS, vmin=0.0, vmax=MAX_HEIGHT
    )


# The claim


def draw_claim(rows: Sequence[ReadingRow]) -> Figure:
    """Return KL / K and Jeffreys / K of every reading, and what the paper says they are."""
    figure, axis = plt.subplots(figsize=(9.0, 5.6))
    places = np.arange(len(rows))[::-1]
    axis.axvspan(1.0, CLOSE, color=BASE, alpha=0.16, lw=0)
    axis.axvspan(*TWICE, color=DRAFT, alpha=0.18, lw=0)
    for place, row in zip(places, rows, strict=True):
        axis.plot([row.kl_k[0], row.jeffreys_k[0]], [place, place], color=LINE, lw=2, zorder=1)
    for ratio, colour, marker, name in (
        ([row.kl_k[0] for row in rows], BASE, "o", "KL / K"),
        ([row.jeffreys_k[0] for row in rows], DRAFT, "D", "Jeffreys / K"),
    ):
        axis.plot(ratio, places, marker, color=colour, ms=6, label=name, zorder=2)
    for value, colour, name in ((4.0, BASE, "4: KL"), (8.0, DRAFT, "8: Jeffreys")):
        axis.axvline(value, color=colour, lw=0.9, ls=(0, (4, 3)), zorder=0)
        axis.text(value, len(rows) - 0.2, name, color=colour, fontsize=7.5, ha="center")
    axis.set_xscale("log")
    ticks = [1, 2, 4, 8, 16, 32]
    axis.set_xticks(ticks, [str(t) for t in ticks])
    axis.minorticks_off()
    axis.set_yticks(places, [row.reading.name for row in rows], fontsize=8)
    axis.set(xlabel="median ratio at the true pose", ylim=(-0.8, len(rows) + 0.6))
    axis.grid(axis="x", color=LINE, lw=0.6)
    axis.set_title(
        f"Medians over {rows[0].n} areas. Shaded: what the paper says; dashed: small "
        "differences", loc="left", fontsize=9,
    )  # fmt: skip
    axis.legend(loc="lower right", frameon=False)
    for side in ("top", "right"):
        axis.spines[side].set_visible(False)
    figure.tight_layout()
    return figure
