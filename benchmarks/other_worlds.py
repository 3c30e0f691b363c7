"""Pairs of places that share nothing with `commonmap.sim` but the ray caster below.

Another hand's worlds: other shapes, other sensors, other drift. A drone with a non-repeating lidar
(a cone of 38 degrees straight down), a ground robot with 16, 32 or 64 channels, up to 2.5 million
points. Yards and streets repeat themselves on purpose. `other_worlds_run.py` matches them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

KINDS = ("yard", "village", "wood", "campus", "park", "street")
RELIEF = {"yard": 0.15, "village": 2.5, "wood": 5.0, "campus": 0.6, "park": 1.5, "street": 0.4}
"""Metres, amplitude of the ground."""

Part = tuple[np.ndarray, np.ndarray]
"""Vertices (V, 3) and triangles (F, 3)."""


@dataclass
class World:
    """kind: one of `KINDS`. size: metres, edge. objects: parts of each, and whether it may move."""

    kind: str
    size: float
    height: Callable[[Any, Any], Any]
    objects: list[tuple[list[Part], bool]] = field(default_factory=list)
    taken: list[tuple[float, float, float]] = field(default_factory=list)

    def z(self, x: float, y: float) -> float:
        """Return the ground's height."""
        return float(self.height(np.float64(x), np.float64(y)))

    def add(self, *parts: Part, movable: bool = False) -> None:
        """Put a thing there."""
        self.objects.append((list(parts), movable))

    def scatter(
        self, rng: np.random.Generator, per_hectare: float, radius: float,
        put: Callable[[float, float], None],
    ) -> None:  # fmt: skip
        """Put things at free places, so many a hectare, `radius` metres wide."""
        n = int(per_hectare * (self.size / 100.0) ** 2)
        for _ in range(6 * n):
            if n == 0:
                return
            x, y = rng.uniform(-self.size / 2, self.size / 2, 2)
            if all((x - a) ** 2 + (y - b) ** 2 >= (radius + c) ** 2 for a, b, c in self.taken):
                self.taken.append((x, y, radius))
                put(x, y)
                n -= 1


def box(
    x: float, y: float, z: float, length: float, width: float, height: float, yaw: float
) -> Part:
    """Return a box that stands on z, open below."""
    turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    corner = np.array([[-length, -width], [length, -width], [length, width], [-length, width]]) / 2
    base = corner @ turn + [x, y]
    low, high = np.full(4, z), np.full(4, z + height)
    vertices = np.concatenate([np.column_stack([base, low]), np.column_stack([base, high])])
    sides = [[i, (i + 1) % 4, (i + 1) % 4 + 4] for i in range(4)]
    sides += [[i, (i + 1) % 4 + 4, i + 4] for i in range(4)]
    return vertices, np.array([*sides, [4, 5, 6], [4, 6, 7]])


def house(x: float, y: float, z: float, length: float, width: float, height: float, yaw: float,
          ridge: float) -> list[Part]:  # fmt: skip
    """Return walls and a pitched roof, the ridge so many metres above the walls."""
    turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    a, b = length / 2 + 0.3, width / 2 + 0.4
    eaves = np.array([[-a, -b], [a, -b], [a, b], [-a, b]]) @ turn + [x, y]
    top = np.array([[-a, 0.0], [a, 0.0]]) @ turn + [x, y]
    vertices = np.concatenate(
        [np.column_stack([eaves, np.full(4, z + height - 0.2)]),
         np.column_stack([top, np.full(2, z + height + ridge)])]
    )  # fmt: skip
    roof = np.array([[0, 1, 5], [0, 5, 4], [2, 3, 4], [2, 4, 5], [1, 2, 5], [3, 0, 4]])
    return [box(x, y, z, length, width, height, yaw), (vertices, roof)]


def post(x: float, y: float, z: float, low: float, high: float, height: float,
         lean: tuple[float, float] = (0.0, 0.0), sides: int = 9) -> Part:  # fmt: skip
    """Return a tapered round post; low, high: its radii."""
    angle = np.arange(sides) * 2 * np.pi / sides
    ring = np.column_stack([np.cos(angle), np.sin(angle)])
    tip = np.array([x + lean[0] * height, y + lean[1] * height])
    vertices = np.concatenate(
        [np.column_stack([ring * low + [x, y], np.full(sides, z)]),
         np.column_stack([ring * high + tip, np.full(sides, z + height)]),
         [[*tip, z + height]]]
    )  # fmt: skip
    i = np.arange(sides)
    j = (i + 1) % sides
    faces = [np.column_stack([i, j, j + sides]), np.column_stack([i, j + sides, i + sides])]
    faces.append(np.column_stack([i + sides, j + sides, np.full(sides, 2 * sides)]))
    return vertices, np.concatenate(faces)


def foliage(rng: np.random.Generator, centre: np.ndarray, radii: np.ndarray, n: int,
            size: float) -> Part:  # fmt: skip
    """Return n small triangles within an ellipsoid."""
    u = rng.normal(size=(n, 3))
    u /= np.linalg.norm(u, axis=1)[:, None]
    at = centre + u * radii * np.sqrt(rng.uniform(0.15, 1.0, (n, 1)))
    triangles = at[:, None] + rng.normal(size=(n, 3, 3)) * size
    return triangles.reshape(-1, 3), np.arange(3 * n).reshape(-1, 3)


def tree(rng: np.random.Generator, x: float, y: float, z: float, *, tall: bool) -> list[Part]:
    """Return a stem that leans a little, and its crown."""
    height = rng.uniform(11, 22) if tall else rng.uniform(5, 9)
    radius = rng.uniform(0.12, 0.32) if tall else rng.uniform(0.08, 0.18)
    lean = rng.normal(0, 0.02, 2)
    parts = [post(x, y, z - 0.3, 1.1 * radius, 0.4 * radius, 0.9 * height + 0.3, tuple(lean))]
    for share in (0.5, 0.7, 0.9) if tall else (0.55, 0.8):
        up = share * height
        centre = np.array([x + lean[0] * up, y + lean[1] * up, z + up]) + rng.normal(0, 0.4, 3)
        radii = np.array([1.0, 1.0, 0.9]) * rng.uniform(1.2, 2.4) * (1.3 if tall else 1.0)
        parts.append(foliage(rng, centre, radii, 220, 0.16))
    return parts


def car(x: float, y: float, z: float, yaw: float) -> list[Part]:
    """Return a car's body and cabin."""
    return [box(x, y, z + 0.25, 4.2, 1.8, 0.7, yaw), box(x, y, z + 0.95, 2.2, 1.6, 0.55, yaw)]


def build(kind: str, rng: np.random.Generator) -> World:
    """Return a world of a kind, 90 to 170 m wide."""
    wave = rng.normal(0, 1, (6, 2)) * 2 * np.pi / rng.uniform(40, 120, (6, 1))
    phase, share = rng.uniform(0, 2 * np.pi, 6), rng.uniform(0.2, 1.0, 6)
    share *= RELIEF[kind] / share.sum()
    rough = rng.normal(0, 1, (10, 2)) * 2 * np.pi / rng.uniform(3, 10, (10, 1))
    rough_phase, rough_size = rng.uniform(0, 2 * np.pi, 10), 0.03 if kind == "wood" else 0.015

    def height(x: Any, y: Any) -> Any:
        hills = np.sin(np.multiply.outer(x, wave[:, 0]) + np.multiply.outer(y, wave[:, 1]) + phase)
        bumps = np.sin(
            np.multiply.outer(x, rough[:, 0]) + np.multiply.outer(y, rough[:, 1]) + rough_phase
        )
        return hills @ share + rough_size * bumps.sum(-1)

    world = World(kind, float(rng.uniform(90, 170)), height)
    BUILDERS[kind](world, rng)
    return world


def build_yard(world: World, rng: np.random.Generator) -> None:
    """Parallel halls at one distance, containers in rows, tanks, pallets."""
    yaw, pitch = rng.uniform(0, np.pi / 2), rng.uniform(26, 34)
    c, s = np.cos(yaw), np.sin(yaw)
    for i in range(-4, 5):
        for j in range(-2, 3):
            u, v = i * pitch, j * 62 + rng.normal(0, 3)
            x, y = u * c - v * s, u * s + v * c
            if max(abs(x), abs(y)) < world.size / 2 and rng.random() < 0.7:
                length = rng.uniform(25, 50)
                tall = rng.uniform(6.5, 9.5)
                world.add(box(x, y, world.z(x, y) - 0.5, 14, length, tall, yaw))
                for along in (-length / 3, 0.0, length / 3):
                    world.taken.append((x - s * along, y + c * along, 10.0))

    def containers(x: float, y: float) -> None:
        turned = yaw + rng.choice([0, np.pi / 2])
        for m in range(rng.integers(1, 4)):
            a, b = x - np.sin(turned) * 2.7 * m, y + np.cos(turned) * 2.7 * m
            for level in range(rng.integers(1, 3)):
                at = world.z(x, y) + 2.6 * level
                world.add(box(a, b, at, 6.06, 2.44, 2.6, turned), movable=True)

    def tank(x: float, y: float) -> None:
        radius = rng.uniform(2.5, 4.5)
        world.add(post(x, y, world.z(x, y) - 0.3, radius, radius, rng.uniform(5, 10), sides=24))

    def pallet(x: float, y: float) -> None:
        at = world.z(x, y)
        thing = box(x, y, at, 1.2, 0.8, rng.uniform(0.4, 1.6), rng.uniform(0, 3))
        world.add(thing, movable=True)

    world.scatter(rng, 6, 5.0, containers)
    world.scatter(rng, 1.8, 6.0, tank)
    world.scatter(rng, 13, 1.5, pallet)


def build_village(world: World, rng: np.random.Generator) -> None:
    """Houses at any angle, hedges, trees and cars on rolling ground."""

    def put_house(x: float, y: float) -> None:
        world.add(
            *house(x, y, world.z(x, y) - 1.2, rng.uniform(8, 14), rng.uniform(6, 9),
                   rng.uniform(4.2, 7.2), rng.uniform(0, np.pi), rng.uniform(2, 4))
        )  # fmt: skip

    world.scatter(rng, 9.8, 11.0, put_house)
    for _ in range(int(8 * (world.size / 100) ** 2)):
        x, y = rng.uniform(-world.size / 2, world.size / 2, 2)
        yaw = rng.uniform(0, np.pi)
        for step in np.arange(0.0, rng.uniform(6, 20), 1.5):
            a, b = x + np.cos(yaw) * step, y + np.sin(yaw) * step
            world.add(box(a, b, world.z(a, b) - 0.2, 1.5, 0.3, 1.4, yaw))
    world.scatter(rng, 13, 1.5, lambda x, y: world.add(*tree(rng, x, y, world.z(x, y), tall=False)))
    world.scatter(
        rng, 9, 3.0,
        lambda x, y: world.add(*car(x, y, world.z(x, y), rng.uniform(0, 3)), movable=True),
    )  # fmt: skip


def build_wood(world: World, rng: np.random.Generator) -> None:
    """Tall trees, bushes and rocks on a slope."""
    world.scatter(rng, 187, 0.7, lambda x, y: world.add(*tree(rng, x, y, world.z(x, y), tall=True)))

    def bush(x: float, y: float) -> None:
        centre = np.array([x, y, world.z(x, y) + 0.4])
        world.add(foliage(rng, centre, np.array([0.8, 0.8, 0.6]), 120, 0.08), movable=True)

    def rock(x: float, y: float) -> None:
        at = world.z(x, y) - 0.3
        size = rng.uniform(0.5, 1.6), rng.uniform(0.5, 1.4), rng.uniform(0.6, 1.3)
        world.add(box(x, y, at, *size, rng.uniform(0, 3)))

    world.scatter(rng, 27, 0.8, bush)
    world.scatter(rng, 11, 1.0, rock)


def build_campus(world: World, rng: np.random.Generator) -> None:
    """Large flat roofs in the shape of an L, lamps, trees and parked cars."""

    def block(x: float, y: float) -> None:
        yaw = 0.3 + rng.choice([0.0, np.pi / 2])
        a, b, tall = rng.uniform(18, 36), rng.uniform(10, 14), rng.uniform(6, 16)
        off = a / 2 - b / 2
        wing = (x + np.cos(yaw) * off - np.sin(yaw) * b, y + np.sin(yaw) * off + np.cos(yaw) * b)
        at = world.z(x, y) - 1
        main = box(x, y, at, a, b, tall + 1, yaw)
        world.add(main, box(*wing, at, b, 1.5 * b, 0.8 * tall + 1, yaw))

    def lamp(x: float, y: float) -> None:
        world.add(post(x, y, world.z(x, y) - 0.2, 0.09, 0.06, rng.uniform(4, 8)))

    def parked(x: float, y: float) -> None:
        yaw = 0.3 + rng.choice([0.0, np.pi / 2])
        world.add(box(x, y, world.z(x, y) + 0.2, 4.5, 1.8, 1.3, yaw), movable=True)

    world.scatter(rng, 4, 22.0, block)
    world.scatter(rng, 18, 2.0, lambda x, y: world.add(*tree(rng, x, y, world.z(x, y), tall=False)))
    world.scatter(rng, 11, 1.0, lamp)
    world.scatter(rng, 16, 3.0, parked)


def build_park(world: World, rng: np.random.Generator) -> None:
    """Scattered trees of two sizes, benches, bushes, two huts."""

    def plant(x: float, y: float) -> None:
        world.add(*tree(rng, x, y, world.z(x, y), tall=bool(rng.random() < 0.5)))

    def bench(x: float, y: float) -> None:
        yaw, at = rng.uniform(0, 3), world.z(x, y)
        seat = box(x, y, at + 0.35, 1.6, 0.5, 0.12, yaw)
        world.add(seat, box(x, y, at, 1.5, 0.1, 0.9, yaw), movable=True)

    def bush(x: float, y: float) -> None:
        centre = np.array([x, y, world.z(x, y) + 0.6])
        world.add(foliage(rng, centre, np.array([1.2, 1.2, 0.8]), 220, 0.08))

    def hut(x: float, y: float) -> None:
        world.add(*house(x, y, world.z(x, y) - 0.5, 7, 5, 3.5, rng.uniform(0, 3), 1.8))

    world.scatter(rng, 31, 3.0, plant)
    world.scatter(rng, 11, 1.5, bench)
    world.scatter(rng, 9, 2.0, bush)
    world.scatter(rng, 1, 6.0, hut)


def build_street(world: World, rng: np.random.Generator) -> None:
    """A straight street between rows of houses of one depth, trees and cars along it."""
    yaw, half = rng.uniform(0, np.pi), world.size / 2
    c, s = np.cos(yaw), np.sin(yaw)
    for side in (-1, 1):
        for row in (0, 1):
            u = -1.4 * half
            while u < 1.4 * half:
                width, v = rng.uniform(9, 18), side * (16 + 34 * row)
                x, y = (u + width / 2) * c - v * s, (u + width / 2) * s + v * c
                if max(abs(x), abs(y)) < half + 5 and rng.random() < 0.88:
                    at, tall = world.z(x, y) - 0.8, rng.uniform(6, 13)
                    depth = rng.uniform(10, 13)
                    world.add(*house(x, y, at, width, depth, tall, yaw, rng.uniform(2, 4)))
                u += width + rng.choice([0, 0, 0, 4])
    for side in (-1, 1):
        for u in np.arange(-half, half, rng.uniform(9, 14)):
            x, y = u * c - side * 6.5 * s, u * s + side * 6.5 * c
            if rng.random() < 0.5:
                world.add(*tree(rng, x, y, world.z(x, y), tall=False))
            elif rng.random() < 0.6:
                at = world.z(x, y) + 0.2
                world.add(box(x + 3 * c, y + 3 * s, at, 4.4, 1.8, 1.35, yaw), movable=True)


BUILDERS = {
    "yard": build_yard, "village": build_village, "wood": build_wood,
    "campus": build_campus, "park": build_park, "street": build_street,
}  # fmt: skip
