"""Things that stand in simulated worlds: one function a thing, one table of them all.

Every model is built about the origin: x along its length, z up, its ground level at z = 0. Solids
reach below that level so that none floats on a slope.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from commonmap.sim.mesh import (
    BURIED,
    Mesh,
    boulder,
    box,
    frustum,
    join,
    lathe,
    leaves,
    shifted,
    slab,
    tube,
)
from commonmap.types import Float64s


@dataclass(frozen=True, eq=False)
class Model:
    """A thing before it is put into a world.

    footprint: (length, width) metres of the ground that it keeps for itself.
    tilts: whether it lies on the slope as a car does, or stands upright as a tree does.
    """

    mesh: Mesh
    footprint: tuple[float, float]
    tilts: bool = False


def _crown(
    rng: np.random.Generator, centre: Float64s, radii: Float64s, density: float, leaf: float
) -> Mesh:
    """Return leaf clumps inside an ellipsoid.

    density: mean number of leaf layers that a vertical ray meets; a ray misses all of them with a
        chance of about exp(-density).
    """
    area_leaf = 1.3 * leaf**2
    n = int(density * 2 * np.pi * radii[0] * radii[1] / area_leaf)
    n_clumps = max(6, n // 14)
    direction = rng.standard_normal((n_clumps, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    clump = direction * np.sqrt(rng.uniform(0.05, 0.85, (n_clumps, 1)))
    spread = 0.35 * n_clumps ** (-1 / 3) + 0.06
    offset = clump[rng.integers(n_clumps, size=n)] + spread * rng.standard_normal((n, 3))
    return leaves(centre + offset * radii, leaf, rng, "leaf")


def build_tree(rng: np.random.Generator, *, height: float | None = None) -> Model:
    """Return a broad-leaved tree: trunk, boughs, a crown that light comes through."""
    h = rng.uniform(5.0, 11.0) if height is None else height
    r = h * rng.uniform(0.016, 0.024)
    lean = rng.normal(0.0, 0.02, 2) * h
    top = np.array([*lean, 0.75 * h])
    radius = h * rng.uniform(0.2, 0.3)
    low = h * rng.uniform(0.25, 0.4)
    centre = np.array([*lean, (low + h) / 2])
    parts = [tube([0, 0, -BURIED], [0, 0, 0.4], 1.25 * r, 1.1 * r, "bark")]
    parts.append(tube([0, 0, 0.4], top, 1.1 * r, 0.35 * r, "bark"))
    for _ in range(int(rng.integers(3, 6))):
        start = top * rng.uniform(0.45, 0.85)
        angle = rng.uniform(0.0, 2 * np.pi)
        reach = radius * rng.uniform(0.5, 0.9)
        step = np.array([np.cos(angle) * reach, np.sin(angle) * reach, reach * rng.uniform(0.3, 1)])
        parts.append(tube(start, start + step, 0.35 * r, 0.12 * r, "bark", sides=5))
    radii = np.array([radius, radius * rng.uniform(0.85, 1.15), (h - low) / 2])
    parts.append(_crown(rng, centre, radii, rng.uniform(0.9, 1.4), 0.11 + 0.012 * h))
    return Model(join(parts), (0.8, 0.8))


def build_conifer(rng: np.random.Generator, *, height: float | None = None) -> Model:
    """Return a conifer: straight stem, cone of drooping branches, bare below."""
    h = rng.uniform(9.0, 18.0) if height is None else height
    r = h * rng.uniform(0.010, 0.015)
    low, radius = h * rng.uniform(0.15, 0.45), h * rng.uniform(0.11, 0.17)
    leaf = 0.12 + 0.008 * h
    n = int(rng.uniform(1.0, 1.5) * 2 * np.pi * radius**2 / (1.3 * leaf**2))
    n_branches = max(12, n // 10)
    level = 1.0 - np.sqrt(rng.uniform(0.0, 1.0, n_branches))
    angle = rng.uniform(0.0, 2 * np.pi, n_branches)
    branch = rng.integers(n_branches, size=n)
    along = np.sqrt(rng.uniform(0.02, 1.0, n))
    reach = radius * (1.0 - level[branch]) * along
    at = angle[branch] + rng.normal(0.0, 0.12, n)
    z = low + (h - low) * level[branch] - 0.25 * reach + rng.normal(0.0, 0.08, n)
    centres = np.column_stack([reach * np.cos(at), reach * np.sin(at), z])
    parts = [
        tube([0, 0, -BURIED], [0, 0, 0.3], 1.2 * r, 1.1 * r, "bark"),
        tube([0, 0, 0.3], [0, 0, h], 1.1 * r, 0.02, "bark"),
        leaves(centres, leaf, rng, "leaf"),
    ]
    for _ in range(int(rng.integers(2, 7))):  # dead twigs below the crown
        a, z0 = rng.uniform(0.0, 2 * np.pi), rng.uniform(0.3, 1.0) * low
        length = rng.uniform(0.3, 1.2)
        end = [length * np.cos(a), length * np.sin(a), z0 + rng.uniform(-0.2, 0.2)]
        parts.append(tube([0, 0, z0], end, 0.03, 0.01, "bark", sides=4))
    return Model(join(parts), (0.6, 0.6))


def build_bush(rng: np.random.Generator) -> Model:
    """Return a bush: leaves down to the ground."""
    h = rng.uniform(0.6, 2.2)
    radii = np.array([rng.uniform(0.5, 1.3), rng.uniform(0.5, 1.3), 0.55 * h])
    crown = _crown(rng, np.array([0.0, 0.0, 0.45 * h]), radii, 2.0, 0.13)
    stem = tube([0, 0, -0.5], [0, 0, 0.6 * h], 0.04, 0.02, "bark", sides=4)
    return Model(join([stem, crown]), (2 * float(radii[0]), 2 * float(radii[1])))


def build_hedge(rng: np.random.Generator, *, length: float = 8.0) -> Model:
    """Return a cut hedge: a dense wall of leaves."""
    width, h = rng.uniform(0.5, 0.9), rng.uniform(1.0, 2.0)
    n = int(length * h * 60)
    centres = rng.uniform([-length / 2, -width / 2, -0.3], [length / 2, width / 2, h], (n, 3))
    return Model(leaves(centres, 0.12, rng, "leaf"), (length, width))


def build_fence(rng: np.random.Generator, *, length: float = 8.0) -> Model:
    """Return a fence of posts and rails."""
    h = rng.uniform(0.9, 1.4)
    n = max(2, int(length / 2.0) + 1)
    parts = []
    for x in np.linspace(-length / 2, length / 2, n):
        parts.append(box([x - 0.05, -0.05, -BURIED], [x + 0.05, 0.05, h], "wood"))
    for z in np.linspace(0.35, h - 0.1, 3):
        rail = box([-length / 2, -0.02, z - 0.05], [length / 2, 0.02, z + 0.05], "wood")
        parts.append(rail)
    return Model(join(parts), (length, 0.3), tilts=True)


def build_wall(rng: np.random.Generator, *, length: float | None = None) -> Model:
    """Return a free-standing wall."""
    a = rng.uniform(3.0, 9.0) if length is None else length
    h = rng.uniform(0.8, 2.6)
    return Model(slab(a, rng.uniform(0.2, 0.35), -BURIED, h, "brick"), (a, 0.4))


def build_boxes(rng: np.random.Generator) -> Model:
    """Return a small pile of boxes."""
    parts = []
    a, b, h = rng.uniform(0.8, 2.2, 3)
    parts.append(slab(a, b, -0.5, h, "wood"))
    if rng.uniform() < 0.6:
        c = rng.uniform(0.4, 0.7)
        top = slab(a * c, b * c, h, h + rng.uniform(0.4, 1.0), "wood")
        parts.append(shifted(top, 0.0, 0.0, yaw=rng.uniform(0.0, np.pi)))
    if rng.uniform() < 0.5:
        side = slab(rng.uniform(0.4, 0.9), rng.uniform(0.4, 0.9), -0.5, 0.5 * h, "wood")
        parts.append(shifted(side, a / 2 + 0.6, rng.uniform(-0.3, 0.3), yaw=rng.uniform(0, np.pi)))
    return Model(join(parts), (a + 1.0, b), tilts=True)


def build_car(rng: np.random.Generator) -> Model:
    """Return a car: wheels, a body with air below it, a cabin of glass."""
    a, b, h = rng.uniform(3.8, 4.8), rng.uniform(1.7, 1.9), rng.uniform(1.4, 1.75)
    belt = rng.uniform(0.55, 0.62) * h
    wheels = []
    for x in (-0.31 * a, 0.31 * a):
        for y in (-b / 2 + 0.1, b / 2 - 0.1):
            wheels.append(tube([x, y - 0.1, 0.3], [x, y + 0.1, 0.3], 0.31, 0.31, "rubber"))
    cabin = (rng.uniform(0.5, 0.62) * a, 0.92 * b)
    parts = [
        *wheels,
        slab(a, b, 0.22, belt, "paint"),
        shifted(
            frustum(cabin, (0.7 * cabin[0], 0.75 * b), belt, h - 0.04, "glass"), -0.06 * a, 0.0
        ),
        shifted(slab(0.7 * cabin[0], 0.75 * b, h - 0.04, h, "paint"), -0.06 * a, 0.0),
    ]
    return Model(join(parts), (a, b), tilts=True)


def build_truck(rng: np.random.Generator) -> Model:
    """Return a lorry: cab, closed load, air below."""
    a, b, h = rng.uniform(6.5, 11.0), rng.uniform(2.3, 2.5), rng.uniform(2.9, 3.8)
    parts = [
        box([-a / 2, -b / 2, 1.0], [a / 2 - 2.2, b / 2, h], "paint"),
        box([a / 2 - 2.0, -b / 2, 0.5], [a / 2, b / 2, rng.uniform(2.3, 2.9)], "paint"),
        box([-a / 2, -0.5, 0.7], [a / 2, 0.5, 1.0], "metal"),
    ]
    for x in (-0.36 * a, -0.22 * a, 0.38 * a):
        for y in (-b / 2 + 0.15, b / 2 - 0.15):
            parts.append(tube([x, y - 0.14, 0.5], [x, y + 0.14, 0.5], 0.5, 0.5, "rubber"))
    return Model(join(parts), (a, b), tilts=True)


def build_container(rng: np.random.Generator) -> Model:
    """Return a 20 foot ISO container."""
    return Model(slab(6.06, 2.44, -0.3, 2.59, "paint"), (6.06, 2.44), tilts=True)


def build_canopy(rng: np.random.Generator) -> Model:
    """Return a structure with a closed top and four open sides, with things below the roof."""
    a, b, h = rng.uniform(4.0, 8.0), rng.uniform(3.5, 6.0), rng.uniform(2.6, 3.6)
    parts = [slab(a + 0.6, b + 0.6, h, h + 0.2, "concrete")]
    for x in (-a / 2, a / 2):
        for y in (-b / 2, b / 2):
            parts.append(box([x - 0.12, y - 0.12, -BURIED], [x + 0.12, y + 0.12, h], "concrete"))
    for _ in range(int(rng.integers(2, 5))):  # only a ground robot sees these
        size = rng.uniform(0.4, 1.1, 3)
        thing = slab(size[0], size[1], -0.3, size[2], "wood")
        x, y = rng.uniform(-0.36, 0.36, 2) * [a, b]
        parts.append(shifted(thing, x, y, yaw=rng.uniform(0.0, np.pi)))
    for _ in range(int(rng.integers(0, 3))):  # only a drone sees these
        size = rng.uniform(0.4, 1.2, 3)
        thing = slab(size[0], size[1], h + 0.2, h + 0.2 + size[2], "metal")
        x, y = rng.uniform(-0.32, 0.32, 2) * [a, b]
        parts.append(shifted(thing, x, y))
    return Model(join(parts), (a + 0.6, b + 0.6))


def build_table(rng: np.random.Generator) -> Model:
    """Return a large table: a plate from above, four legs from the side."""
    a, b, h = rng.uniform(1.6, 3.2), rng.uniform(1.0, 2.0), rng.uniform(0.75, 1.5)
    parts = [slab(a, b, h - 0.08, h, "wood")]
    for x in (-a / 2 + 0.1, a / 2 - 0.1):
        for y in (-b / 2 + 0.1, b / 2 - 0.1):
            parts.append(box([x - 0.06, y - 0.06, -0.5], [x + 0.06, y + 0.06, h], "wood"))
    return Model(join(parts), (a, b), tilts=True)


def build_mushroom(rng: np.random.Generator) -> Model:
    """Return a stem under a wide closed cap: a disc from above, a post from the side."""
    h, stem, cap = rng.uniform(2.2, 4.5), rng.uniform(0.12, 0.35), rng.uniform(1.0, 2.2)
    parts = [
        tube([0, 0, -BURIED], [0, 0, h], stem, stem, "concrete", sides=10),
        lathe(
            [(0.0, h - 0.1), (cap, h - 0.15), (cap, h), (0.6 * cap, h + 0.35), (0.0, h + 0.5)],
            "concrete",
        ),
    ]
    return Model(join(parts), (2 * cap, 2 * cap))


def build_taper(rng: np.random.Generator) -> Model:
    """Return a block that narrows, or widens, from the ground up."""
    a, b = rng.uniform(1.0, 2.6, 2)
    c = rng.uniform(0.2, 0.6)
    low, high = (1.0, c) if rng.uniform() < 0.5 else (c, 1.0)
    h = rng.uniform(1.2, 3.5)
    body = frustum((a * low, b * low), (a * high, b * high), 0.0, h, "concrete")
    foot = slab(a * low, b * low, -0.8, 0.0, "concrete")
    return Model(join([foot, body]), (a, b))


def build_lamp(rng: np.random.Generator) -> Model:
    """Return a lamp post with an arm."""
    h, reach = rng.uniform(4.5, 8.0), rng.uniform(0.6, 1.8)
    parts = [
        tube([0, 0, -BURIED], [0, 0, h], 0.09, 0.06, "metal"),
        tube([0, 0, h], [reach, 0, h + 0.2], 0.05, 0.05, "metal", sides=5),
        box([reach - 0.35, -0.12, h + 0.12], [reach + 0.35, 0.12, h + 0.26], "metal"),
    ]
    return Model(join(parts), (0.4, 0.4))


def build_rock(rng: np.random.Generator) -> Model:
    """Return a boulder."""
    radius = float(np.exp(rng.uniform(np.log(0.3), np.log(1.4))))
    return Model(boulder(radius, rng, "stone"), (2 * radius, 2 * radius))


def build_log(rng: np.random.Generator) -> Model:
    """Return a fallen stem."""
    a, r = rng.uniform(3.0, 9.0), rng.uniform(0.12, 0.3)
    stem = tube([-a / 2, 0, 0.8 * r], [a / 2, 0, 0.8 * r], r, 0.6 * r, "bark")
    return Model(stem, (a, 2 * r), tilts=True)


def build_bale(rng: np.random.Generator) -> Model:
    """Return a round bale of hay."""
    r, b = rng.uniform(0.6, 0.8), rng.uniform(1.1, 1.4)
    bale = tube([0, -b / 2, 0.95 * r], [0, b / 2, 0.95 * r], r, r, "grass", sides=14)
    return Model(bale, (2 * r, b), tilts=True)


OBJECTS: dict[str, Callable[[np.random.Generator], Model]] = {
    "tree": build_tree,
    "conifer": build_conifer,
    "bush": build_bush,
    "hedge": build_hedge,
    "fence": build_fence,
    "wall": build_wall,
    "boxes": build_boxes,
    "car": build_car,
    "truck": build_truck,
    "container": build_container,
    "canopy": build_canopy,
    "table": build_table,
    "mushroom": build_mushroom,
    "taper": build_taper,
    "lamp": build_lamp,
    "rock": build_rock,
    "log": build_log,
    "bale": build_bale,
}
"""Things that can be moved, removed and added. Buildings stand in `buildings.py` and stay."""
