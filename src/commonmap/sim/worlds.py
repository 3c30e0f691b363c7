"""The kinds of places that can be simulated: one builder a kind, one table of them all.

Two seeds are two different places: streets, relief, shapes, numbers and positions are all drawn.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from commonmap.errors import InputError
from commonmap.sim import buildings
from commonmap.sim.objects import build_conifer, build_fence, build_hedge, build_tree, build_wall
from commonmap.sim.terrain import Terrain, roll_terrain
from commonmap.sim.world import Site, World
from commonmap.types import Float64s


def build_paper(rng: np.random.Generator, *, size: float, relief: float) -> World:
    """Return the source paper's scene: trees, roofs on posts, walls, boxes, vehicles, and things
    that only one of the two robots can see or that look different from above and from the side."""
    site = Site("paper", size, roll_terrain(rng, size=size, relief=relief), "soil")
    share = size**2 / 60.0**2
    n = lambda low, high: max(1, round(share * rng.integers(low, high + 1)))  # noqa: E731
    for _ in range(n(1, 3)):
        a, b, h = rng.uniform(6.0, 11.0), rng.uniform(5.0, 8.0), rng.uniform(3.0, 6.0)
        _scatter(site, "block", lambda a=a, b=b, h=h: buildings.build_block(rng, a, b, h), 1, rng)
    site.scatter("canopy", n(3, 6), rng, margin=1.0)
    site.scatter("wall", n(4, 8), rng)
    site.scatter("car", n(4, 8), rng)
    site.scatter("truck", n(0, 2), rng)
    site.scatter("boxes", n(7, 12), rng)
    site.scatter("table", n(3, 6), rng)
    site.scatter("mushroom", n(4, 8), rng)
    site.scatter("taper", n(4, 8), rng)
    site.scatter("tree", n(9, 18), rng, margin=1.2)
    site.scatter("bush", n(3, 8), rng)
    site.scatter("lamp", n(1, 4), rng)
    return site.finish()


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


Streets = list[tuple[float, float]]
"""(middle, width) of parallel streets, metres, rising."""


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
            _scatter_in(site, kind, count, rng, (x0, x1), (y0, y1))
        return
    depth = rng.uniform(8.0, 12.0)
    style = rng.uniform(5.0, 16.0)
    for side in (-1.0, 1.0):  # the rows along x, at low and high y
        at = x0
        while at < x1 - 5.0:
            a = min(rng.uniform(9.0, 20.0), x1 - at)
            b = min(depth * rng.uniform(0.85, 1.1), (y1 - y0) / 2 - 0.5)
            h = float(np.clip(style * rng.uniform(0.6, 1.4), 3.5, 25.0))
            if rng.uniform() < 0.85 and b > 3.0:
                middle = y0 + b / 2 if side < 0 else y1 - b / 2
                model = buildings.build_block(rng, a - 0.2, b, h)
                site.put("building", model, at + a / 2, middle, 0.0, margin=-1.0)
            at += a + (rng.uniform(2.5, 5.0) if rng.uniform() < 0.3 else 0.0)
    if y1 - y0 > 3.2 * depth:
        for side in (-1.0, 1.0):  # closing the yard at low and high x
            if rng.uniform() < 0.6:
                b = (y1 - y0) - 2 * depth * 1.1 - rng.uniform(3.0, 6.0)
                middle = x0 + depth / 2 if side < 0 else x1 - depth / 2
                h = float(np.clip(style * rng.uniform(0.6, 1.4), 3.5, 25.0))
                model = buildings.build_block(rng, b, depth - 0.5, h)
                site.put("building", model, middle, (y0 + y1) / 2, np.pi / 2, margin=-1.0)
    _scatter_in(site, "tree", 2, rng, (x0, x1), (y0, y1))
    _scatter_in(site, "boxes", 2, rng, (x0, x1), (y0, y1))


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
                            across = facing + (np.pi / 2 if axis == 0 else np.pi / 2)
                            _put_at(site, kind, rng, axis, walk, at + 1.0, across)
                    at += rng.uniform(5.4, 8.0)


def _put_at(
    site: Site, kind: str, rng: np.random.Generator, axis: int, across: float, along: float,
    yaw: float,
) -> None:  # fmt: skip
    from commonmap.sim.objects import OBJECTS

    x, y = (across, along) if axis == 0 else (along, across)
    yaw += rng.normal(0.0, 0.03)
    if kind == "tree":
        model = build_tree(rng, height=rng.uniform(4.5, 8.0))
    else:
        model = OBJECTS[kind](rng)
    inside = site.size / 2 - 0.6 * max(model.footprint)
    if max(abs(x), abs(y)) < inside:
        # the street itself is kept free: stand on it nevertheless
        site.put(kind, model, x, y, yaw, force=True)


def build_forest(rng: np.random.Generator, *, size: float, relief: float) -> World:
    """Return a wood on a slope: stems with crowns, young trees, rocks, fallen stems, a clearing."""
    slope = rng.uniform(0.0, np.radians(13.0))
    terrain = roll_terrain(
        rng, size=size, relief=relief, wavelength=(12.0, 80.0), slope=slope, roughness=0.03
    )
    site = Site("forest", size, terrain, "soil")
    for _ in range(int(rng.integers(0, 3))):  # clearings
        x, y = rng.uniform(-size / 2, size / 2, 2)
        site.keep_free(x, y, rng.uniform(0.0, np.pi), (rng.uniform(8, 18), rng.uniform(6, 14)))
    conifers = rng.uniform(0.15, 0.95)
    density = rng.uniform(0.028, 0.055)  # stems a square metre
    height = rng.uniform(11.0, 20.0)
    for _ in range(int(density * size**2)):
        x, y = rng.uniform(-size / 2 + 0.6, size / 2 - 0.6, 2)
        tall = height * (rng.uniform(0.75, 1.15) if rng.uniform() < 0.8 else rng.uniform(0.2, 0.6))
        grow = build_conifer if rng.uniform() < conifers else build_tree
        kind = "conifer" if grow is build_conifer else "tree"
        gap = float(rng.uniform(0.5, 1.3))
        site.put(kind, grow(rng, height=tall), x, y, rng.uniform(0, 2 * np.pi), margin=gap)
    rocks = rng.uniform(0.002, 0.012) * size**2
    site.scatter("rock", int(rocks), rng, margin=0.1)
    site.scatter("log", int(rng.uniform(0.0005, 0.003) * size**2), rng, margin=0.0)
    site.scatter("bush", int(rng.uniform(0.001, 0.008) * size**2), rng, margin=0.1)
    return site.finish()


def build_village(rng: np.random.Generator, *, size: float, relief: float) -> World:
    """Return houses with pitched roofs in gardens with hedges and fences, on rolling ground."""
    terrain = roll_terrain(rng, size=size, relief=relief, wavelength=(40.0, 160.0))
    site = Site("village", size, terrain, "grass")
    road = _winding_line(rng, size)
    heading = np.arctan2(*np.gradient(road, axis=0).T[::-1])
    for (x, y), yaw in zip(road[::2], heading[::2], strict=False):
        site.keep_free(x, y, yaw, (4.0, 6.0))
    for i in np.arange(2, len(road) - 2, max(1, int(rng.uniform(8.0, 11.0)))):
        for side in (-1.0, 1.0):
            if rng.uniform() < 0.12:
                continue
            away = rng.uniform(11.0, 17.0)
            normal = np.array([-np.sin(heading[i]), np.cos(heading[i])]) * side
            x, y = road[i] + away * normal + rng.normal(0.0, 1.0, 2)
            turn = np.pi / 2 if rng.uniform() < 0.35 else 0.0
            yaw = float(heading[i]) + turn + rng.normal(0.0, 0.12)
            _put_garden(site, rng, float(x), float(y), yaw, float(heading[i]), road[i], normal)
    _scatter(site, "house", lambda: buildings.build_house(rng), int(size**2 / 1600), rng)
    for kind, per_hectare in (("tree", 22), ("bush", 14), ("car", 7), ("wall", 5), ("boxes", 7)):
        site.scatter(kind, int(per_hectare * size**2 / 1e4 * rng.uniform(0.7, 1.3)), rng)
    for kind, per_hectare in (("hedge", 6), ("fence", 5), ("lamp", 4), ("table", 3)):
        site.scatter(kind, int(per_hectare * size**2 / 1e4 * rng.uniform(0.7, 1.3)), rng)
    return site.finish()


def _winding_line(rng: np.random.Generator, size: float) -> Float64s:
    """Return a winding line across a place, one point about every metre, (N, 2)."""
    yaw = rng.uniform(0.0, 2 * np.pi)
    along = np.arange(-0.75 * size, 0.75 * size, 1.0)
    bend = rng.uniform(4.0, 10.0) * np.sin(
        along * 2 * np.pi / rng.uniform(60, 140) + rng.uniform(0, 6.28)
    )
    across = bend + rng.uniform(-0.12, 0.12) * size
    c, s = np.cos(yaw), np.sin(yaw)
    line = np.column_stack([c * along - s * across, s * along + c * across])
    kept: Float64s = line[np.abs(line).max(axis=1) < size / 2]
    return kept


def _put_garden(
    site: Site, rng: np.random.Generator, x: float, y: float, yaw: float, road_yaw: float,
    road: Float64s, normal: Float64s,
) -> None:  # fmt: skip
    """Put a house, its shed, a car before it and a hedge or fence along the road."""
    if not site.put("house", buildings.build_house(rng), x, y, yaw, margin=1.5):
        return
    for _ in range(10):
        shed = buildings.build_shed(rng)
        sx, sy = np.array([x, y]) + rng.uniform(-14.0, 14.0, 2)
        if rng.uniform() < 0.7 and site.put("shed", shed, sx, sy, yaw, margin=0.8):
            break
    border = road + 4.3 * normal
    length = float(rng.uniform(5.0, 9.0))
    along = np.array([np.cos(road_yaw), np.sin(road_yaw)])
    for shift in (-0.5 * length - 1.7, 0.5 * length + 1.7):  # a gateway between the two
        bx, by = border + shift * along
        draw = rng.uniform()
        if draw < 0.4:
            site.put("hedge", build_hedge(rng, length=length), bx, by, road_yaw, margin=0.0)
        elif draw < 0.7:
            site.put("fence", build_fence(rng, length=length), bx, by, road_yaw, margin=0.0)
        elif draw < 0.85:
            site.put("wall", build_wall(rng, length=length), bx, by, road_yaw, margin=0.0)
    if rng.uniform() < 0.6:
        from commonmap.sim.objects import build_car

        cx, cy = road + 6.8 * normal
        site.put("car", build_car(rng), cx, cy, road_yaw + np.pi / 2 + rng.normal(0, 0.05))


def build_industrial(rng: np.random.Generator, *, size: float, relief: float) -> World:
    """Return a works: long parallel halls, rows of containers, tanks, pipe racks, lorries."""
    terrain = roll_terrain(rng, size=size, relief=relief, wavelength=(60.0, 200.0), roughness=0.008)
    site = Site("industrial", size, terrain, "asphalt")
    a, b = rng.uniform(0.42, 0.62) * size, rng.uniform(13.0, 20.0)
    h, lane = rng.uniform(6.0, 10.0), rng.uniform(9.0, 14.0)
    n_halls = int(rng.integers(2, 4))
    top = size / 2 - 6.0
    shift = rng.uniform(-0.12, 0.12) * size
    for i in range(n_halls):
        length = a if rng.uniform() < 0.6 else a * rng.uniform(0.6, 1.0)
        y = top - b / 2 - i * (b + lane)
        if y - b / 2 < -size / 2 + 6:
            break
        site.put("hall", buildings.build_hall(rng, length, b, h), shift, y, 0.0, margin=1.0)
        if rng.uniform() < 0.5:
            rack = buildings.build_pipe_rack(rng, 0.8 * length)
            site.put("pipe rack", rack, shift, y - b / 2 - lane / 2, 0.0, margin=0.2)
    _put_containers(site, rng)
    _put_tanks(site, rng)
    for _ in range(2):
        rack_length = rng.uniform(15.0, 30.0)
        turn = float(rng.choice([0.0, np.pi / 2]))
        _scatter(
            site, "pipe rack", lambda a=rack_length: buildings.build_pipe_rack(rng, a), 1, rng,
            yaw=turn,
        )  # fmt: skip
    share = size**2 / 1e4
    _scatter(site, "lying tank", lambda: buildings.build_lying_tank(rng), int(3 * share), rng)
    for kind, count in (("truck", 6), ("car", 10), ("boxes", 14), ("lamp", 8), ("wall", 4)):
        site.scatter(kind, int(count * share * rng.uniform(0.7, 1.3)), rng)
    site.scatter("canopy", int(2 * share), rng)
    site.scatter("tree", int(3 * share), rng)
    return site.finish()


def _put_containers(site: Site, rng: np.random.Generator) -> None:
    """Put yards of containers in equal rows, some stacked, some missing."""
    from commonmap.sim.mesh import join, shifted
    from commonmap.sim.objects import Model, build_container

    for _ in range(int(rng.integers(2, 4))):
        rows, columns = int(rng.integers(2, 5)), int(rng.integers(2, 6))
        across, along = rng.uniform(2.8, 4.5), rng.uniform(6.6, 9.0)
        for _ in range(20):
            x0, y0 = rng.uniform(-site.size / 2, site.size / 2, 2)
            placed = 0
            for i in range(columns):
                for j in range(rows):
                    if rng.uniform() < 0.15:
                        continue
                    model = build_container(rng)
                    levels = int(rng.choice([1, 1, 2, 3]))
                    stack = [shifted(model.mesh, 0, 0, 2.6 * k) for k in range(levels)]
                    model = Model(join(stack), model.footprint, tilts=True)
                    x, y = x0 + i * along, y0 + j * across
                    placed += site.put("container", model, x, y, rng.normal(0, 0.01), margin=0.1)
            if placed >= 3:
                break


def _put_tanks(site: Site, rng: np.random.Generator) -> None:
    """Put a group of equal standing tanks."""
    for _ in range(int(rng.integers(1, 3))):
        radius, h = rng.uniform(2.5, 5.5), rng.uniform(5.0, 11.0)
        step = 2 * radius + rng.uniform(2.5, 4.0)
        columns, rows = int(rng.integers(1, 4)), int(rng.integers(1, 3))
        for _ in range(30):
            x0, y0 = rng.uniform(-site.size / 2, site.size / 2, 2)
            placed = 0
            for i in range(columns):
                for j in range(rows):
                    model = buildings.build_tank(rng, radius, h)
                    placed += site.put("tank", model, x0 + i * step, y0 + j * step, 0.0)
            if placed:
                break


def build_field(rng: np.random.Generator, *, size: float, relief: float) -> World:
    """Return an almost empty place: rolling ground, a ditch, a fence, few bushes and bales."""
    terrain = roll_terrain(rng, size=size, relief=relief, wavelength=(15.0, 120.0), roughness=0.025)
    terrain = _dig_ditch(terrain, rng, size)
    site = Site("field", size, terrain, "grass")
    line = _winding_line(rng, size)
    length = 6.0
    heading = np.arctan2(*np.gradient(line, axis=0).T[::-1])
    for i in range(3, len(line) - 3, 6):
        if rng.uniform() < 0.9:
            x, y = line[i]
            site.put("fence", build_fence(rng, length=length), x, y, heading[i], margin=-0.1)
    share = size**2 / 1e4
    for kind, count in (("bush", 8), ("tree", 2), ("bale", 5), ("rock", 5)):
        site.scatter(kind, max(1, int(count * share * rng.uniform(0.6, 1.4))), rng)
    return site.finish()


def _dig_ditch(terrain: Terrain, rng: np.random.Generator, size: float) -> Terrain:
    """Return the ground with a winding ditch of 0.4 to 0.9 m depth."""
    from scipy.spatial import cKDTree

    line = _winding_line(rng, size + 20.0)
    nx, ny = terrain.z.shape
    i, j = np.meshgrid(np.arange(nx), np.arange(ny), indexing="ij")
    xy = terrain.origin + terrain.cell * np.stack([i.ravel(), j.ravel()], axis=1)
    away, _ = cKDTree(line).query(xy, workers=1)
    depth, width = rng.uniform(0.4, 0.9), rng.uniform(0.8, 1.4)
    ditch = depth * np.exp(-0.5 * (away / width) ** 4)
    return replace(terrain, z=(terrain.z - ditch.reshape(nx, ny)).astype(np.float32))


def _scatter(
    site: Site, kind: str, build: Callable[[], buildings.Model], n: int, rng: np.random.Generator,
    *, yaw: float | None = None,
) -> None:  # fmt: skip
    """Put up to `n` models, each built anew, at random free places."""
    for _ in range(n):
        model = build()
        reach = max(0.0, site.size / 2 - 0.5 * max(model.footprint) - 1.5)
        for _ in range(40):
            x, y = rng.uniform(-reach, reach, 2)
            turn = rng.uniform(0.0, 2 * np.pi) if yaw is None else yaw
            if site.put(kind, model, x, y, turn, margin=1.2):
                break


def _scatter_in(
    site: Site, kind: str, n: int, rng: np.random.Generator, x: tuple[float, float],
    y: tuple[float, float],
) -> None:  # fmt: skip
    """Put up to `n` things of one kind at random free places of a rectangle."""
    from commonmap.sim.objects import OBJECTS

    for _ in range(n):
        model = OBJECTS[kind](rng)
        for _ in range(8):
            at = rng.uniform(*x), rng.uniform(*y)
            if site.put(kind, model, *at, rng.uniform(0.0, 2 * np.pi), margin=0.4):
                break


@dataclass(frozen=True)
class WorldKind:
    """A row of the table. size: metres; relief: metres, standard deviation of the ground."""

    build: Callable[..., World]
    size: float
    relief: float
    summary: str


WORLDS: dict[str, WorldKind] = {
    "paper": WorldKind(build_paper, 60.0, 0.35, "the scene of the source paper"),
    "city": WorldKind(build_city, 110.0, 0.4, "streets, facades, cars, lamps, trees"),
    "village": WorldKind(build_village, 110.0, 1.6, "pitched roofs, hedges, rolling ground"),
    "forest": WorldKind(build_forest, 80.0, 0.9, "stems with crowns, rocks, slopes"),
    "industrial": WorldKind(build_industrial, 120.0, 0.15, "halls, containers, tanks, pipe racks"),
    "field": WorldKind(build_field, 100.0, 1.2, "rolling ground, few bushes, a ditch, a fence"),
}


def build_world(
    kind: str, rng: np.random.Generator, *, size: float | None = None, relief: float | None = None
) -> World:
    """Return a new place of one kind; size and relief in metres, from the table unless given."""
    if kind not in WORLDS:
        raise InputError(f"world must be one of {', '.join(WORLDS)}; '{kind}' came")
    row = WORLDS[kind]
    size = row.size if size is None else float(size)
    relief = row.relief if relief is None else float(relief)
    if not 20.0 <= size <= 1000.0:
        raise InputError(f"size of a world must lie in 20 to 1000 m; {size:g} came")
    if not 0.0 <= relief <= 20.0:
        raise InputError(f"relief of a world must lie in 0 to 20 m; {relief:g} came")
    return row.build(rng, size=size, relief=relief)
