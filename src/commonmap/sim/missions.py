"""How the robots move: a ground robot on the relief between the things, a drone above them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter1d, label
from scipy.spatial.transform import Rotation

from commonmap.errors import InputError
from commonmap.frames import from_rotation, invert
from commonmap.sim.world import GROUND, World
from commonmap.types import Bools, Float64s, Trajectory

POSE_RATE = 50.0
"""True poses a second."""

STEP = 0.25
"""Metres between the points of a planned path."""


@dataclass(frozen=True, eq=False)
class Mission:
    """A robot's true way through a world.

    robot: "ugv" or "uav". sensor: true poses of the lidar in the world, T_world_sensor.
    T_body_sensor: (4, 4), how the lidar is mounted (x forward, y left, z up on both).
    distance: (M,) metres travelled by the body at each pose.
    """

    robot: str
    sensor: Trajectory
    T_body_sensor: Float64s
    distance: Float64s

    @property
    def body(self) -> Trajectory:
        """True poses of the robot's body in the world."""
        return Trajectory(self.sensor.time, self.sensor.T_map_sensor @ invert(self.T_body_sensor))


@dataclass(frozen=True)
class Area:
    """A turned rectangle of a world. x, y: its middle; length along `yaw`; width across it."""

    x: float
    y: float
    length: float
    width: float
    yaw: float = 0.0

    def holds(self, xy: Float64s) -> Bools:
        """Return which of (N, 2) points lie inside."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        dx, dy = xy[:, 0] - self.x, xy[:, 1] - self.y
        along, across = np.abs(c * dx + s * dy), np.abs(c * dy - s * dx)
        return np.asarray((along <= self.length / 2) & (across <= self.width / 2))


def mount(*, x: float = 0.0, z: float = 0.0, pitch: float = 0.0) -> Float64s:
    """Return T_body_sensor of a lidar shifted by x, z and pitched down by `pitch` radians."""
    return from_rotation(Rotation.from_euler("y", pitch).as_matrix(), [x, 0.0, z])


# ---------------------------------------------------------------- ground robot


def drive(
    world: World,
    area: Area,
    rng: np.random.Generator,
    *,
    spacing: float = 9.0,
    max_length: float | None = None,
    speed: float = 1.2,
    mount_height: float = 0.8,
    radius: float = 0.5,
    start_time: float = 0.0,
) -> Mission:
    """Return a drive of a ground robot through an area, between the things that stand there.

    The robot visits random places about `spacing` metres apart, follows the relief (height, roll
    and pitch from its four wheels) and slows down in turns.

    speed: m/s. mount_height: metres from the ground to the lidar. radius: metres, of the robot.
    max_length: metres, where the drive ends at the latest.
    """
    clearance, origin, cell = free_space(world)
    path = _plan(clearance, origin, cell, area, rng, spacing, radius, max_length)
    heading, time = _headings(path, speed)
    heading += 0.01 * np.sin(time * rng.uniform(1.0, 2.0))
    return _ride(world, path, heading, time + start_time, mount_height, rng)


def free_space(
    world: World, *, cell: float = 0.5, low: float = 0.25, high: float = 1.6
) -> tuple[Float64s, Float64s, float]:
    """Return the distance to the nearest thing in the way at each cell (nx, ny), the origin (2,)
    of the grid and its cell, all in metres.

    In the way is what stands between `low` and `high` above the ground, and ground steeper than
    30 deg; what hangs higher (roofs, crowns) is not.
    """
    n = int(np.ceil(world.size / cell))
    origin = np.full(2, -world.size / 2)
    things = world.faces[world.face_object != GROUND]
    points = _sample_triangles(world.vertices[things].astype(np.float64), 0.6 * cell)
    above = points[:, 2] - world.height(points[:, :2])
    points = points[(above > low) & (above < high)]
    at = np.floor((points[:, :2] - origin) / cell).astype(int)
    at = at[(at >= 0).all(axis=1) & (at < n).all(axis=1)]
    blocked = np.zeros((n + 2, n + 2), dtype=bool)
    blocked[[0, -1], :] = True
    blocked[:, [0, -1]] = True
    blocked[at[:, 0] + 1, at[:, 1] + 1] = True
    centre = origin + cell * (np.stack(np.meshgrid(*2 * [np.arange(n)], indexing="ij"), -1) + 0.5)
    z = world.height(centre.reshape(-1, 2)).reshape(n, n)
    steep = np.hypot(*np.gradient(z, cell)) > np.tan(np.radians(30.0))
    blocked[1:-1, 1:-1] |= steep
    clearance = distance_transform_edt(~blocked)[1:-1, 1:-1] * cell
    return clearance, origin, cell


def _sample_triangles(corners: Float64s, spacing: float) -> Float64s:
    """Return points on triangles (F, 3, 3), at most `spacing` metres apart, (N, 3)."""
    edges = corners[:, [1, 2, 0]] - corners
    longest = np.sqrt((edges**2).sum(axis=2)).max(axis=1)
    n = np.maximum(1, np.ceil(longest / spacing)).astype(int)
    found = []
    for k in np.unique(n):
        i, j = np.nonzero(np.add.outer(np.arange(k + 1), np.arange(k + 1)) <= k)
        u, v = (i / k)[:, None], (j / k)[:, None]
        group = corners[n == k]
        found.append(
            (1 - u - v) * group[:, None, 0] + u * group[:, None, 1] + v * group[:, None, 2]
        )
    return np.concatenate([points.reshape(-1, 3) for points in found])


def _plan(
    clearance: Float64s, origin: Float64s, cell: float, area: Area, rng: np.random.Generator,
    spacing: float, radius: float, max_length: float | None,
) -> Float64s:  # fmt: skip
    """Return a smooth path through free space, (N, 2), points `STEP` apart."""
    free = clearance > radius + 0.35
    n = clearance.shape
    centres = origin + cell * (np.stack(np.meshgrid(*map(np.arange, n), indexing="ij"), -1) + 0.5)
    inside = area.holds(centres.reshape(-1, 2)).reshape(n)
    parts, _ = label(free)
    sizes = np.bincount(parts[inside & free], minlength=2)
    sizes[0] = 0
    if not sizes.any():
        raise InputError("the ground robot finds no free ground in its area")
    free = parts == int(np.argmax(sizes))
    stops = _choose_stops(centres, free & inside, clearance, rng, spacing)
    route = _route(free, clearance, stops, None if max_length is None else max_length / cell)
    rough = _resample(centres[route[:, 0], route[:, 1]], STEP)
    path = rough
    for sigma in (2.0, 1.2, 0.7, 0.35):  # as smooth as the things in the way allow
        path = gaussian_filter1d(rough, sigma / STEP, axis=0, mode="nearest")
        at = np.clip(np.floor((path - origin) / cell).astype(int), 0, np.array(n) - 1)
        if (clearance[at[:, 0], at[:, 1]] > radius).all():
            break
    return _resample(path, STEP)


def _choose_stops(
    centres: Float64s, free: Bools, clearance: Float64s, rng: np.random.Generator, spacing: float
) -> NDArray[np.intp]:
    """Return cells (K, 2) to visit, about `spacing` metres apart, in the order of a short tour."""
    cells = np.argwhere(free)
    cells = cells[rng.permutation(len(cells))]
    roomy = clearance[cells[:, 0], cells[:, 1]]
    cells = cells[np.argsort(-np.minimum(roomy, 1.5), kind="stable")]
    where = centres[cells[:, 0], cells[:, 1]]
    open_ = np.ones(len(cells), dtype=bool)
    stops = []
    while open_.any():
        k = int(np.argmax(open_))
        stops.append(k)
        open_ &= ((where - where[k]) ** 2).sum(axis=1) > spacing**2
    order, left = [stops[0]], set(stops[1:])
    while left:
        nearest = min(left, key=lambda k: float(((where[k] - where[order[-1]]) ** 2).sum()))
        order.append(nearest)
        left.remove(nearest)
    return cells[order]


def _route(
    free: Bools, clearance: Float64s, stops: NDArray[np.intp], max_cells: float | None
) -> NDArray[np.intp]:
    """Return the cells (N, 2) of the cheapest way through the stops, keeping clear of things."""
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import dijkstra

    number = np.full(free.shape, -1)
    number[free] = np.arange(int(free.sum()))
    cells = np.argwhere(free)
    cost = 1.0 + 1.5 / np.maximum(clearance, 0.3)
    heads, tails, weights = [], [], []
    for di, dj in ((0, 1), (1, 0), (1, 1), (1, -1)):
        a = cells + [di, dj]
        ok = (a >= 0).all(axis=1) & (a < free.shape).all(axis=1)
        ok[ok] &= free[a[ok, 0], a[ok, 1]]
        b, a = cells[ok], a[ok]
        heads.append(number[b[:, 0], b[:, 1]])
        tails.append(number[a[:, 0], a[:, 1]])
        mean = (cost[a[:, 0], a[:, 1]] + cost[b[:, 0], b[:, 1]]) / 2
        weights.append(np.hypot(di, dj) * mean)
    graph = csr_matrix(
        (np.concatenate(weights), (np.concatenate(heads), np.concatenate(tails))),
        shape=(len(cells), len(cells)),
    )
    route = [int(number[tuple(stops[0])])]
    for stop in stops[1:]:
        goal = int(number[tuple(stop)])
        _, previous = dijkstra(
            graph, directed=False, indices=route[-1], return_predecessors=True, min_only=False
        )
        leg = [goal]
        while leg[-1] != route[-1]:
            leg.append(int(previous[leg[-1]]))
        route += leg[-2::-1]
        if max_cells is not None and len(route) > max_cells:
            break
    if max_cells is not None:
        route = route[: max(8, int(max_cells))]
    return cells[route]


def _resample(path: Float64s, step: float) -> Float64s:
    """Return points at equal steps along a polyline, (N, 2)."""
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
    at = np.linspace(0.0, length[-1], max(4, int(length[-1] / step) + 1))
    return np.stack([np.interp(at, length, path[:, k]) for k in range(2)], axis=1)


def _headings(
    path: Float64s, speed: float, *, max_turn: float = 0.9, smooth: float = 0.6
) -> tuple[Float64s, Float64s]:
    """Return the heading (N,) radians, continuous, and the time (N,) seconds along a path."""
    tangent = np.gradient(path, axis=0)
    heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    heading = gaussian_filter1d(heading, smooth / STEP, mode="nearest")
    ds = np.hypot(*np.diff(path, axis=0).T)
    dt = np.maximum(ds / speed, np.abs(np.diff(heading)) / max_turn)
    dt = gaussian_filter1d(dt, 2.0, mode="nearest")
    return heading, np.concatenate([[0.0], np.cumsum(dt)])


def _ride(
    world: World, path: Float64s, heading: Float64s, time: Float64s, mount_height: float,
    rng: np.random.Generator,
) -> Mission:  # fmt: skip
    """Return the mission of a robot whose four wheels follow the ground along a path."""
    clock = np.arange(time[0], time[-1], 1.0 / POSE_RATE)
    x, y = (np.interp(clock, time, path[:, k]) for k in range(2))
    yaw = np.interp(clock, time, heading)
    c, s = np.cos(yaw), np.sin(yaw)
    wheel = []
    for along in (0.35, -0.35):
        for across in (0.3, -0.3):
            at = np.stack([x + along * c - across * s, y + along * s + across * c], axis=1)
            wheel.append(world.height(at))
    z = np.stack(wheel)
    soft = 0.12 * POSE_RATE  # tyres and springs: about 0.12 s
    pitch = -np.arctan((z[0] + z[1] - z[2] - z[3]) / 2 / 0.7)
    roll = np.arctan((z[0] + z[2] - z[1] - z[3]) / 2 / 0.6)
    roll, pitch, mean = (gaussian_filter1d(a, soft) for a in (roll, pitch, z.mean(axis=0)))
    shake = np.radians(0.15) * gaussian_filter1d(rng.standard_normal((2, len(clock))), 2.0) * 2.6
    R = Rotation.from_euler("ZYX", np.stack([yaw, pitch + shake[0], roll + shake[1]], axis=1))
    T_world_body = _stack(R.as_matrix(), np.stack([x, y, mean], axis=1))
    T_body_sensor = mount(z=mount_height)
    sensor = Trajectory(clock, T_world_body @ T_body_sensor)
    return Mission("ugv", sensor, T_body_sensor, _distance(T_world_body))


# ---------------------------------------------------------------- drone


def fly(
    world: World,
    area: Area,
    rng: np.random.Generator,
    *,
    height: float = 20.0,
    pitch: float = np.pi / 2,
    row_spacing: float | None = None,
    speed: float = 4.0,
    sway: float = 0.03,
    start_time: float = 0.0,
) -> Mission:
    """Return the flight of a drone over an area in rows, there and back.

    height: metres above the middle ground of the area, more where something stands taller.
    pitch: radians that the lidar looks down; at pi/2 its scan plane lies across the flight.
    row_spacing: metres between rows; the height unless given.
    sway: radians, standard deviation of roll and pitch.
    """
    spacing = height if row_spacing is None else row_spacing
    n_rows = max(2, int(np.ceil(area.width / spacing)))
    across = (np.arange(n_rows) - (n_rows - 1) / 2) * area.width / n_rows
    ends = np.array([-area.length / 2, area.length / 2])
    corners = []
    for k, v in enumerate(across):
        corners += [[u, v] for u in (ends if k % 2 == 0 else ends[::-1])]
    c, s = np.cos(area.yaw), np.sin(area.yaw)
    turned = np.array(corners) @ np.array([[c, s], [-s, c]]) + [area.x, area.y]
    path = _resample(turned, STEP)
    path = _resample(gaussian_filter1d(path, 2.0 / STEP, axis=0, mode="nearest"), STEP)
    heading, time = _headings(path, speed, max_turn=0.8, smooth=2.0)
    clock = np.arange(0.0, time[-1], 1.0 / POSE_RATE)
    x, y = (np.interp(clock, time, path[:, k]) for k in range(2))
    yaw = np.interp(clock, time, heading)
    z = flight_level(world, area, height)
    roll, tip = sway * _sway(clock, rng), sway * _sway(clock, rng)
    R = Rotation.from_euler("ZYX", np.stack([yaw + 0.5 * sway * _sway(clock, rng), tip, roll], 1))
    drift = 0.25 * np.stack([_sway(clock, rng) for _ in range(3)], axis=1)
    T_world_body = _stack(R.as_matrix(), np.stack([x, y, np.full_like(x, z)], axis=1) + drift)
    T_body_sensor = mount(z=-0.15, pitch=pitch)
    sensor = Trajectory(clock + start_time, T_world_body @ T_body_sensor)
    return Mission("uav", sensor, T_body_sensor, _distance(T_world_body))


def flight_level(world: World, area: Area, height: float) -> float:
    """Return the altitude of a flight: `height` above the middle ground, 3 m above all things."""
    xy = world.vertices[:, :2].astype(np.float64)
    below = area.holds(xy)
    if not below.any():
        raise InputError("the drone's area lies outside the world")
    ground = float(np.median(world.height(xy[below])))
    return max(ground + height, float(world.vertices[below, 2].max()) + 3.0)


def _sway(clock: Float64s, rng: np.random.Generator) -> Float64s:
    """Return a smooth oscillation of standard deviation about 1 over a clock."""
    frequency, phase = rng.uniform(0.1, 0.7, 5), rng.uniform(0.0, 2 * np.pi, 5)
    waves = np.sin(2 * np.pi * frequency * clock[:, None] + phase)
    return np.asarray(waves.sum(axis=1) / np.sqrt(2.5))


def _stack(R: Float64s, t: Float64s) -> Float64s:
    """Return motions (M, 4, 4) of rotations (M, 3, 3) and translations (M, 3)."""
    T = np.zeros((len(R), 4, 4))
    T[:, :3, :3], T[:, :3, 3], T[:, 3, 3] = R, t, 1.0
    return T


def _distance(T_world_body: Float64s) -> Float64s:
    """Return the metres travelled at each pose, (M,)."""
    steps = np.linalg.norm(np.diff(T_world_body[:, :3, 3], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])
