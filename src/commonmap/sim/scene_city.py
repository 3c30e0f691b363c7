"""Town blocks between streets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from commonmap.sim.buildings import build_block
from commonmap.sim.objects import OBJECTS, build_tree
from commonmap.sim.terrain import Terrain, roll_terrain
from commonmap.sim.world import Site, World

Streets = list[tuple[float, float]]
"""(middle, width) of parallel streets, metres, rising."""


def build_city(rng: np.random.Generator, *, size: float, relief: float) -> World:
    """Return town blocks between streets: facades, courtyards, cars, lamps, trees, small parks."""
    terrain = roll_terrain(rng, size=size, relief=relief, wavelength=(60.0, 200.0), roughness=0.008)
    streets = [_streets(rng, size), _streets(rng, size)]
    terrain = _raise_blocks(terrain, streets)
    site = Site("city", size, terrain, "asphalt")
    for axis in (0, 1):
        for middle, width in streets[axis]:
            along = (size * 2, width) if axis == 1 else (width, size * 2)
            x, y = (middle, 0.0) if axis == 0 else (0.0, middle)
            site.keep_free(x, y, 0.0, along)
    for x0, x1 in _between(streets[0], size):
        for y0, y1 in _between(streets[1], size):
            if min(x1 - x0, y1 - y0) > 4.0:
                _fill_block(site, rng, (x0, x1), (y0, y1))
    _furnish_streets(site, rng, streets)
    return site.finish()


def _streets(rng: np.random.Generator, size: float) -> Streets:
    """Return parallel streets across a place."""
    at = -size / 2 + rng.uniform(4.0, 26.0)
    streets: Streets = []
    while at < size / 2 - 3.0:
        width = rng.uniform(8.0, 13.0)
        streets.append((at, width))
        at += width + rng.uniform(22.0, 42.0)
    return streets


def _between(streets: Streets, size: float) -> list[tuple[float, float]]:
    """Return the stretches between the streets."""
    edges = [-size / 2]
    for middle, width in streets:
        edges += [middle - width / 2, middle + width / 2]
    edges.append(size / 2)
    return [(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b > a]


def _raise_blocks(terrain: Terrain, streets: list[Streets]) -> Terrain:
    """Return the ground with the blocks one kerb (0.13 m) above the streets."""
    block = np.ones(terrain.z.shape, dtype=bool)
    for axis in (0, 1):
        at = terrain.origin[axis] + terrain.cell * np.arange(terrain.z.shape[axis])
        for middle, width in streets[axis]:
            on = np.abs(at - middle) < width / 2
            block &= ~(on[:, None] if axis == 0 else on[None, :])
    return replace(terrain, z=(terrain.z + 0.13 * block).astype(np.float32))


def _fill_block(
    site: Site, rng: np.random.Generator, x: tuple[float, float], y: tuple[float, float]
) -> None:
    """Put buildings along the edges of a block, or a park into it."""
    walk = 2.2
    x0, x1, y0, y1 = x[0] + walk, x[1] - walk, y[0] + walk, y[1] - walk
    if rng.uniform() < 0.18 or min(x1 - x0, y1 - y0) < 7.0:
        n = int((x1 - x0) * (y1 - y0) / 45.0)
        for kind, count in (("tree", n), ("bush", n // 2), ("table", n // 4), ("wall", n // 6)):
            site.scatter(kind, count, rng, x=(x0, x1), y=(y0, y1), margin=0.4, tries=8)
        return
    depth = rng.uniform(8.0, 12.0)
    style = rng.uniform(5.0, 16.0)
    for side in (-1.0, 1.0):  # the rows along x, at low and high y
        at = x0
        while at < x1 - 5.0:
            a = min(rng.uniform(9.0, 20.0), x1 - at)
            b = min(depth * rng.uniform(0.85, 1.1), (y1 - y0) / 2 - 0.5)
            h = float(np.clip(style * rng.uniform(0.6, 1.4), 3.5, 25.0))
            if rng.uniform() < 0.92 and b > 3.0:
                middle = y0 + b / 2 if side < 0 else y1 - b / 2
                model = build_block(rng, a - 0.2, b, h)
                site.put("building", model, at + a / 2, middle, 0.0, margin=-1.0)
            at += a + (rng.uniform(2.5, 5.0) if rng.uniform() < 0.3 else 0.0)
    if y1 - y0 > 3.2 * depth:
        for side in (-1.0, 1.0):  # closing the yard at low and high x
            if rng.uniform() < 0.6:
                b = (y1 - y0) - 2 * depth * 1.1 - rng.uniform(3.0, 6.0)
                middle = x0 + depth / 2 if side < 0 else x1 - depth / 2
                h = float(np.clip(style * rng.uniform(0.6, 1.4), 3.5, 25.0))
                model = build_block(rng, b, depth - 0.5, h)
                site.put("building", model, middle, (y0 + y1) / 2, np.pi / 2, margin=-1.0)
    site.scatter("tree", 2, rng, x=(x0, x1), y=(y0, y1), margin=0.4, tries=8)
    site.scatter("boxes", 2, rng, x=(x0, x1), y=(y0, y1), margin=0.4, tries=8)


def _furnish_streets(site: Site, rng: np.random.Generator, streets: list[Streets]) -> None:
    """Put parked cars, lamps and trees along the streets, clear of the crossings."""
    for axis in (0, 1):
        for middle, width in streets[axis]:
            for side in (-1.0, 1.0):
                kerb = middle + side * (width / 2 - 1.15)
                walk = middle + side * (width / 2 + 0.9)
                facing = (np.pi / 2 if axis == 0 else 0.0) + (np.pi if side > 0 else 0.0)
                at = -site.size / 2 + rng.uniform(2.0, 8.0)
                while at < site.size / 2 - 3.0:
                    crossing = any(abs(at - m) < w / 2 + 3.5 for m, w in streets[1 - axis])
                    if not crossing:
                        if rng.uniform() < 0.55:
                            kind = "truck" if rng.uniform() < 0.08 else "car"
                            _put_at(site, kind, rng, axis, kerb, at, facing)
                        draw = rng.uniform()
                        if draw < 0.35:
                            kind = "lamp" if draw < 0.17 else "tree"
                            across = facing + np.pi / 2
                            _put_at(site, kind, rng, axis, walk, at + 1.0, across)
                    at += rng.uniform(5.4, 8.0)


def _put_at(
    site: Site, kind: str, rng: np.random.Generator, axis: int, across: float, along: float,
    yaw: float,
) -> None:  # fmt: skip
    x, y = (across, along) if axis == 0 else (along, across)
    yaw += rng.normal(0.0, 0.03)
    small = kind == "tree"
    model = build_tree(rng, height=rng.uniform(4.5, 8.0)) if small else OBJECTS[kind](rng)
    inside = site.size / 2 - 0.6 * max(model.footprint)
    if max(abs(x), abs(y)) < inside:
        # the street itself is kept free: stand on it nevertheless
        site.put(kind, model, x, y, yaw, force=True)
