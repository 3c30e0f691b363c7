"""Houses in gardens on rolling ground."""

from __future__ import annotations

import numpy as np

from commonmap.sim.buildings import build_house, build_shed
from commonmap.sim.objects import build_fence, build_hedge, build_wall
from commonmap.sim.terrain import roll_terrain, winding_line
from commonmap.sim.world import Site, World
from commonmap.types import Float64s


def build_village(rng: np.random.Generator, *, size: float, relief: float) -> World:
    """Return houses with pitched roofs in gardens with hedges and fences, on rolling ground."""
    terrain = roll_terrain(rng, size=size, relief=relief, wavelength=(40.0, 160.0))
    site = Site("village", size, terrain, "grass")
    road = winding_line(rng, size)
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
    site.scatter("house", int(size**2 / 1600), rng, build=build_house, margin=1.2, tries=40)
    for kind, per_hectare in (("tree", 22), ("bush", 14), ("car", 7), ("wall", 5), ("boxes", 7)):
        site.scatter(kind, int(per_hectare * size**2 / 1e4 * rng.uniform(0.7, 1.3)), rng)
    for kind, per_hectare in (("hedge", 6), ("fence", 5), ("lamp", 4), ("table", 3)):
        site.scatter(kind, int(per_hectare * size**2 / 1e4 * rng.uniform(0.7, 1.3)), rng)
    return site.finish()


def _put_garden(
    site: Site, rng: np.random.Generator, x: float, y: float, yaw: float, road_yaw: float,
    road: Float64s, normal: Float64s,
) -> None:  # fmt: skip
    """Put a house, its shed, a car before it and a hedge or fence along the road."""
    if not site.put("house", build_house(rng), x, y, yaw, margin=1.5):
        return
    for _ in range(10):
        shed = build_shed(rng)
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
