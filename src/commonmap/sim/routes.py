"""Where a ground robot can drive: free space, and a smooth way through it."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter1d, label
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from commonmap.errors import InputError
from commonmap.sim.world import GROUND, World
from commonmap.types import Bools, Float64s

STEP = 0.25
"""Metres between the points of a planned path."""


class Region(Protocol):
    """A part of the plane."""

    def holds(self, xy: Float64s) -> Bools:
        """Return which of (N, 2) points lie inside."""


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
    height = world.vertices[:, 2] - world.height(world.vertices[:, :2].astype(np.float64))
    things = world.faces[world.face_object != GROUND]
    reach = height[things]  # a roof's triangle hangs high at all its corners, a wall's does not
    things = things[(reach.max(axis=1) > low) & (reach.min(axis=1) < high)]
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
    """Return points on triangles (F, 3, 3), at most `spacing` metres apart, (N, 3).

    Rows run across from the tip to the shortest side, so that slivers cost little.
    """
    edge = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
    first = np.argmin(edge, axis=1)
    row = np.arange(len(corners))
    a, b, tip = (corners[row, (first + k) % 3] for k in range(3))
    n_rows = np.maximum(1, np.ceil(edge.max(axis=1) / spacing)).astype(int)
    n_across = np.maximum(1, np.ceil(edge[row, first] / spacing)).astype(int)
    found = [np.zeros((0, 3))]
    for m, k in np.unique(np.stack([n_rows, n_across], axis=1), axis=0):
        same = (n_rows == m) & (n_across == k)
        t, s = np.meshgrid(np.arange(m + 1) / m, np.arange(k + 1) / k, indexing="ij")
        t, s = t.reshape(-1, 1), s.reshape(-1, 1)
        start, side, end = a[same, None], (b - a)[same, None], tip[same, None]
        found.append(((1 - t) * (start + s * side) + t * end).reshape(-1, 3))
    return np.concatenate(found)


def plan_route(
    clearance: Float64s, origin: Float64s, cell: float, area: Region, rng: np.random.Generator,
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
    rough = resample(centres[route[:, 0], route[:, 1]], STEP)
    path = rough
    for sigma in (2.0, 1.2, 0.7, 0.35):  # as smooth as the things in the way allow
        path = gaussian_filter1d(rough, sigma / STEP, axis=0, mode="nearest")
        at = np.clip(np.floor((path - origin) / cell).astype(int), 0, np.array(n) - 1)
        if (clearance[at[:, 0], at[:, 1]] > radius).all():
            break
    return resample(path, STEP)


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
    order, left = [stops[0]], stops[1:]
    while left:
        nearest = min(left, key=lambda k: float(((where[k] - where[order[-1]]) ** 2).sum()))
        order.append(nearest)
        left.remove(nearest)
    return cells[order]


def _route(
    free: Bools, clearance: Float64s, stops: NDArray[np.intp], max_cells: float | None
) -> NDArray[np.intp]:
    """Return the cells (N, 2) of the cheapest way through the stops, keeping clear of things."""
    number = np.full(free.shape, -1)
    number[free] = np.arange(int(free.sum()))
    cells = np.argwhere(free)
    cost = 1.0 + 1.5 / np.maximum(clearance, 0.3)
    heads, tails, weights = [], [], []
    for di, dj in ((0, 1), (1, 0), (1, 1), (1, -1)):
        a = cells + np.array([di, dj])
        ok: Bools = np.asarray(((a >= 0) & (a < free.shape)).all(axis=1))
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


def resample(path: Float64s, step: float) -> Float64s:
    """Return points at equal steps along a polyline, (N, 2)."""
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
    at = np.linspace(0.0, length[-1], max(4, int(length[-1] / step) + 1))
    return np.stack([np.interp(at, length, path[:, k]) for k in range(2)], axis=1)


def headings(
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
