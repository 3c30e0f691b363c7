"""The paper's six figures, and one of its claims, drawn from the data of one run."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from numpy.typing import NDArray

matplotlib.use("Agg")

import matplotlib.pyplot as plt
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle

from commonmap.frames import apply
from commonmap.sim.mesh import MATERIALS
from commonmap.study.claims import CLOSE, TWICE, ReadingRow
from commonmap.study.paper_maps import AREA, CELL, MAX_HEIGHT
from commonmap.study.paper_run import VOXEL, Experiment, Found
from commonmap.study.readings import LEAST, make_lattice
from commonmap.study.render import Camera, Picture, draw_faces, draw_points, draw_voxels, look_at
from commonmap.types import Float64s, Leaves, Progress, Trajectory, no_progress

BASE, DRAFT, BOTH, WRONG = "#2f7fc2", "#c9730a", "#1d8a62", "#c2326f"
INK, SOFT, LINE, PAPER = "#1b2430", "#5a6675", "#dfe4ea", "#f6f7f9"
"""The colours of the report: drone, ground robot, both, conflict; text, axes, ground."""

HEIGHT_COLOURS = "viridis"
YAW, PITCH = np.radians(62.0), np.radians(38.0)
DPI = 110

SURFACES = {
    "soil": "#d9d3c7", "grass": "#c8d3b0", "asphalt": "#8c9096", "leaf": "#5d9a62",
    "bark": "#8a6a4f", "concrete": "#b9bec4", "brick": "#c58f77", "metal": "#9fb4c8",
    "paint": "#e3b04b", "wood": "#b88e5e", "stone": "#a8a49c", "glass": "#8fc0d8",
    "rubber": "#565b62",
}  # fmt: skip

NAMED = {
    "canopy": "closed roof, open sides", "tree": "tree", "mushroom": "disc on a stem",
    "taper": "tapered block", "block": "block", "car": "car", "wall": "wall", "table": "table",
}  # fmt: skip


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
        block(40.5, y, 15, "Octree map", f"{VOXEL:g} m, {_thousands(leaves)} occupied", colour)
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


def _thousands(leaves: Leaves) -> str:
    volume = np.exp2(3.0 * (16 - leaves.depth[leaves.occupied].astype(float))).sum()
    return f"{volume / 1000:.0f} k"


# Figure 2


def draw_scene(run: Experiment) -> Figure:
    """Return the scene with both robots' true ways."""
    world = run.plan.world
    table = np.array([matplotlib.colors.to_rgb(SURFACES[name]) for name in MATERIALS])
    half = world.size / 2
    inside = np.abs(world.vertices[world.faces].mean(axis=1)[:, :2]).max(axis=1) < half
    faces, material = world.faces[inside], world.face_material[inside]
    ground = float(np.median(world.terrain.z))
    low, high = np.array([-half, -half, ground - 0.5]), np.array([half, half, ground])
    ways = [
        _until(mission.sensor, robot.n_turns)
        for mission, robot in ((run.plan.flight, run.base), (run.plan.ground, run.draft))
    ]
    seen = np.concatenate([_corners(low, high), *ways])
    camera = look_at(seen, yaw=YAW, pitch=PITCH, width=1060, height=640, margin=0.05)
    picture = draw_faces(world.vertices, faces, table[material], camera)
    figure, axes = _canvas([picture], figsize=(10.0, 6.2))
    axis = axes[0]
    _frame(axis, camera, low, high, low[2])
    height = float(np.median(ways[0][:, 2])) - ground
    for way, colour, name in (
        (ways[0], BASE, f"way of the UAV, {height:.0f} m above the ground"),
        (ways[1], DRAFT, "way of the UGV"),
    ):
        uv = camera.project(way)
        axis.plot(uv[:, 0], uv[:, 1], color="white", lw=3.4, alpha=0.8)
        axis.plot(uv[:, 0], uv[:, 1], color=colour, lw=1.7, label=name)
    for place in ways[0][:: max(1, len(ways[0]) // 6)]:  # plumb lines say where the flight is
        foot = np.array([*place[:2], float(world.height(place[None, :2])[0])])
        uv = camera.project(np.stack([place, foot]))
        axis.plot(uv[:, 0], uv[:, 1], color=BASE, lw=0.7, ls=(0, (1, 2)))
        axis.plot(uv[1, 0], uv[1, 1], "o", color=BASE, ms=2.5)
    _name_things(axis, run, picture)
    axis.legend(loc="lower left", frameon=False, fontsize=8.5)
    axis.set_title(f"Fig. 2  The scene, {world.size:.0f} m wide (seed {run.seed})", loc="left")
    return figure


def _until(sensor: Trajectory, n_turns: int) -> Float64s:
    """Return where a sensor was in the turns that were recorded, twice a second, (N, 3)."""
    kept = sensor.time <= sensor.time[0] + 0.1 * n_turns
    return np.asarray(sensor.T_map_sensor[kept][::25, :3, 3])


def _name_things(axis: Any, run: Experiment, picture: Picture) -> None:
    """Name one thing of each kind: the nearest one whose top is not hidden, where there is room."""
    taken: list[tuple[float, float]] = []
    camera = picture.camera
    for kind, name in NAMED.items():
        tops = [
            np.array([*thing.centre[:2], thing.centre[2] + thing.size[2]])
            for thing in run.plan.world.objects
            if thing.kind == kind
        ]
        places = camera.project(np.array(tops).reshape(-1, 3))
        for u, v, near in places[np.argsort(-places[:, 2], kind="stable")]:
            row, column = int(v) + 2, int(u)
            if not (40 < row < camera.height - 5 and 60 < column < camera.width - 60):
                continue
            hidden = picture.depth[row, column] > near + 1.0
            if hidden or any(abs(u - x) < 118 and abs(v - 30 - y) < 20 for x, y in taken):
                continue
            taken.append((float(u), float(v) - 30))
            axis.annotate(
                name, (u, v), (u, v - 30), ha="center", va="bottom", fontsize=8,
                bbox={"boxstyle": "round,pad=0.2", "fc": "white", "ec": "none", "alpha": 0.85},
                arrowprops={"arrowstyle": "-", "color": INK, "lw": 0.7},
            )  # fmt: skip
            break


# Figures 3 and 4


def draw_clouds(run: Experiment) -> Figure:
    """Return both robots' georeferenced clouds with the ways that odometry found."""
    pictures, cameras, tops = [], [], _tops(run)
    for robot in (run.draft, run.base):
        xyz = robot.cloud.xyz
        low, high = _box(xyz)
        camera = _camera(robot.cloud.xyz, low, high)
        inside = ((xyz[:, :2] >= low[:2]) & (xyz[:, :2] <= high[:2])).all(axis=1)
        tint = _by_height(xyz[inside, 2] - low[2], tops)
        pictures.append(draw_points(xyz[inside], tint, camera))
        cameras.append((camera, low, high))
    figure, axes = _canvas(pictures, figsize=(11.6, 4.9), bar=tops)
    for axis, (camera, low, high), robot, name, colour in zip(
        axes, cameras, (run.draft, run.base), _NAMES, (DRAFT, BASE), strict=True
    ):
        _frame(axis, camera, low, high, low[2])
        way = camera.project(robot.trajectory.T_map_sensor[:, :3, 3])
        above = way[:, 1] > 0
        axis.plot(way[above, 0], way[above, 1], color="white", lw=3.0, alpha=0.7)
        axis.plot(way[above, 0], way[above, 1], color=colour, lw=1.5)
        axis.set_title(f"Fig. 3{name}: {len(robot.cloud.xyz) / 1e6:.1f} M points", loc="left")
    return figure


def draw_octrees(run: Experiment) -> Figure:
    """Return both robots' octree maps: the occupied leaves as the cubes they are."""
    pictures, cameras, tops = [], [], _tops(run)
    for robot, leaves in ((run.draft, run.octrees[1]), (run.base, run.octrees[0])):
        low, high = _box(robot.cloud.xyz)
        camera = _camera(robot.cloud.xyz, low, high)
        centres, size = leaves.centres()[leaves.occupied], leaves.sizes()[leaves.occupied]
        inside = ((centres >= low - 1.0) & (centres <= high + 1.0)).all(axis=1)
        colour = _by_height(centres[inside, 2] - low[2], tops)
        pictures.append(draw_voxels(centres[inside], size[inside], colour, camera))
        cameras.append((camera, low, high))
    figure, axes = _canvas(pictures, figsize=(11.6, 4.9), bar=tops)
    for axis, (camera, low, high), leaves, name in zip(
        axes, cameras, (run.octrees[1], run.octrees[0]), _NAMES, strict=True
    ):
        _frame(axis, camera, low, high, low[2])
        axis.set_title(f"Fig. 4{name}: {_thousands(leaves)} occupied voxels of {VOXEL:g} m",
                       loc="left")  # fmt: skip
    return figure


_NAMES = ("a  Ground vehicle", "b  Aerial vehicle")


def _box(xyz: Float64s) -> tuple[Float64s, Float64s]:
    """Return the box that holds nearly all of a cloud, metres; its floor is near the ground."""
    low, high = np.quantile(xyz, [0.004, 0.996], axis=0)
    return np.asarray(low), np.asarray(high)


def _corners(low: Float64s, high: Float64s) -> Float64s:
    """Return the corners of a box's floor, (4, 3)."""
    return np.array(
        [[x, y, low[2]] for x, y in ((low[0], low[1]), (high[0], low[1]), (high[0], high[1]),
                                     (low[0], high[1]))]
    )  # fmt: skip


def _camera(xyz: Float64s, low: Float64s, high: Float64s) -> Camera:
    """Return the view of a cloud and of the floor of its box."""
    some = xyz[:: len(xyz) // 20_000 + 1]
    some = some[((some >= low) & (some <= high)).all(axis=1)]
    seen = np.concatenate([_corners(low, high), some])
    return look_at(seen, yaw=YAW, pitch=PITCH, width=620, height=470, margin=0.07)


def _tops(run: Experiment) -> float:
    """Return the height at which the colours of figures 3 and 4 end, metres."""
    spans = [np.ptp(np.quantile(r.cloud.xyz[:, 2], [0.01, 0.98])) for r in (run.base, run.draft)]
    return float(np.ceil(max(spans)))


def _by_height(height: Float64s, top: float) -> NDArray[np.float64]:
    """Return (N, 3) colours of heights from 0 to `top` metres."""
    colours = matplotlib.colormaps[HEIGHT_COLOURS](np.clip(height / top, 0.0, 1.0))
    return np.asarray(colours[:, :3], np.float64)


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


# Figure 6


def draw_common_map(run: Experiment) -> Figure:
    """Return the common octree, by who saw what, and the common occupancy grid."""
    common = run.common
    xyz = run.base.cloud.xyz
    low, high = _box(xyz)
    camera = _camera(xyz, low, high)
    leaves = common.leaves
    centres = leaves.centres() + common.octree_origin
    shown = leaves.occupied & ((centres >= low - 1.0) & (centres <= high + 1.0)).all(axis=1)
    palette = np.array([matplotlib.colors.to_rgb(c) for c in (LINE, BASE, DRAFT, BOTH)])
    colour = 0.25 + 0.75 * palette[common.leaves_seen_by[shown]]
    colour = colour * (0.8 + 0.35 * np.clip((centres[shown, 2:] - low[2]) / _tops(run), 0, 1))
    picture = draw_voxels(centres[shown], leaves.sizes()[shown], np.clip(colour, 0, 1), camera)
    figure = plt.figure(figsize=(11.6, 5.4))
    left = figure.add_axes((0.005, 0.03, 0.56, 0.87))
    right = figure.add_axes((0.615, 0.15, 0.37, 0.73))
    _show(left, picture)
    _frame(left, camera, low, high, low[2])
    left.set_title("Fig. 6a  Common octree of both robots", loc="left")
    for name, tint in (("UAV", BASE), ("UGV", DRAFT), ("both", BOTH)):
        left.plot([], [], "s", color=tint, label=f"seen by {name}")
    left.legend(loc="lower left", frameon=False)
    grid = common.navigation
    classes = np.searchsorted([-1, 0, 100], grid["occupancy"])
    n_x, n_y = grid.shape
    extent = (
        grid.origin[0], grid.origin[0] + n_x * grid.cell,
        grid.origin[1], grid.origin[1] + n_y * grid.cell,
    )  # fmt: skip
    right.imshow(
        classes.T, origin="lower", extent=extent, cmap=ListedColormap(["#ffffff", "#d5dbe2", INK]),
        vmin=0, vmax=2, interpolation="nearest",
    )  # fmt: skip
    right.set(
        xlabel="x, m", ylabel="y, m", xlim=(low[0] - 4, high[0] + 4), ylim=(low[1] - 4, high[1] + 4)
    )
    right.set_aspect("equal")
    for name, tint in (("free", "#d5dbe2"), ("occupied", INK), ("unknown", "#ffffff")):
        right.plot([], [], "s", color=tint, mec=SOFT, mew=0.5, label=name)
    right.legend(loc="upper center", bbox_to_anchor=(0.5, -0.11), ncol=3, frameon=False)
    right.set_title("Fig. 6b  Common occupancy grid", loc="left")
    figure.text(
        0.985, 0.945, f"pose by K {_from_truth(run.off)}, refined on the points "
        f"{_from_truth(run.off_merged)} from the truth", ha="right", color=SOFT, fontsize=8.5,
    )  # fmt: skip
    return figure


def _from_truth(off: tuple[float, float]) -> str:
    metres = f"{100 * off[0]:.0f} cm" if off[0] < 1 else f"{off[0]:.1f} m"
    return f"{metres}, {np.degrees(off[1]):.2f}°"


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


# What the pictures of three dimensions share


def _canvas(
    pictures: list[Picture], *, figsize: tuple[float, float], bar: float | None = None
) -> tuple[Figure, list[Any]]:
    """Return a figure with the pictures side by side, and their axes in pixels."""
    figure = plt.figure(figsize=figsize)
    room = 0.935 if bar else 0.99
    axes = []
    for number, picture in enumerate(pictures):
        width = room / len(pictures)
        axis = figure.add_axes((0.005 + number * width, 0.02, width - 0.01, 0.90))
        _show(axis, picture)
        axes.append(axis)
    if bar:
        scale = matplotlib.cm.ScalarMappable(matplotlib.colors.Normalize(0.0, bar), HEIGHT_COLOURS)
        axis = figure.add_axes((0.945, 0.22, 0.012, 0.5))
        figure.colorbar(scale, cax=axis, label="height over the lowest ground, m")
    return figure, axes


def _show(axis: Any, picture: Picture) -> None:
    axis.imshow(picture.rgb, interpolation="lanczos")
    axis.set(xlim=(0, picture.camera.width), ylim=(picture.camera.height, 0))
    axis.axis("off")


def _frame(axis: Any, camera: Camera, low: Float64s, high: Float64s, z: float) -> None:
    """Draw the two near edges of the ground with a mark and a number every 10 metres."""
    corners = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])
    points = np.column_stack([corners, np.full(4, z)])
    nearest = int(np.argmax(camera.project(points)[:, 2]))
    for step in (1, -1):
        other = (nearest + step) % 4
        along = points[other] - points[nearest]
        length = float(np.linalg.norm(along))
        away = points[nearest] - points[(nearest - step) % 4]
        away = away / np.linalg.norm(away)
        ends = camera.project(points[[nearest, other]])
        axis.plot(ends[:, 0], ends[:, 1], color=SOFT, lw=0.9)
        for metres in range(0, int(length) + 1, 10):
            at = points[nearest] + along * (metres / length)
            mark = camera.project(np.array([at, at + 0.012 * length * away, at + 2.6 * away]))
            axis.plot(mark[:2, 0], mark[:2, 1], color=SOFT, lw=0.9)
            if metres:
                axis.text(
                    mark[2, 0], mark[2, 1], f"{metres}", ha="center", va="center", fontsize=7.5,
                    color=SOFT,
                )  # fmt: skip
    corner = camera.project(points[[nearest]] + 0.0)[0]
    axis.text(corner[0], corner[1] + 12, "0 m", ha="center", va="top", fontsize=7.5, color=SOFT)
