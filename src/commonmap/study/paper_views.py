"""The paper's figures of three dimensions: the scene, the clouds, the octrees, the common map."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
from numpy.typing import NDArray

matplotlib.use("Agg")

import matplotlib.pyplot as plt
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

from commonmap.sim.mesh import MATERIALS
from commonmap.study.paper_run import VOXEL, Experiment
from commonmap.study.render import Camera, Picture, draw_faces, draw_points, draw_voxels, look_at
from commonmap.types import Float64s, Leaves, Trajectory

BASE, DRAFT, BOTH, WRONG = "#2f7fc2", "#c9730a", "#1d8a62", "#c2326f"
INK, SOFT, LINE, PAPER = "#1b2430", "#5a6675", "#dfe4ea", "#f6f7f9"
"""The colours of the report: drone, ground robot, both, conflict; text, axes, ground."""

HEIGHT_COLOURS = "viridis"
YAW, PITCH = np.radians(62.0), np.radians(38.0)

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


def in_thousands(leaves: Leaves) -> str:
    """Return the occupied volume of an octree in thousands of voxels."""
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
        axis.set_title(f"Fig. 4{name}: {in_thousands(leaves)} occupied voxels of {VOXEL:g} m",
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
