"""Buildings and plant: what stays where it is. Built about the origin as in `objects.py`."""

from __future__ import annotations

import numpy as np

from commonmap.sim.mesh import BURIED, Mesh, box, gable, join, lathe, shifted, slab, tube
from commonmap.sim.objects import Model

DEEP = 2 * BURIED
"""How far long buildings reach below their ground level, metres."""


def _roof_things(rng: np.random.Generator, a: float, b: float, h: float) -> list[Mesh]:
    """Return boxes on a flat roof, which only a drone sees."""
    parts = []
    for _ in range(int(rng.integers(1, 5))):
        size = rng.uniform(0.8, 2.5, 3) * [1.0, 1.0, 0.8]
        x, y = rng.uniform(-0.38, 0.38, 2) * [a, b]
        parts.append(shifted(slab(size[0], size[1], h, h + size[2], "metal"), x, y))
    return parts


def _facade(rng: np.random.Generator, a: float, y: float, h: float, out: float) -> list[Mesh]:
    """Return windows, a door, balconies on the facade at `y`; `out` is +1 or -1, its normal."""
    parts = []
    storey, bay = rng.uniform(2.8, 3.4), rng.uniform(2.4, 4.0)
    n_bays = max(1, int((a - 1.0) / bay))
    door = int(rng.integers(n_bays))
    balconies = rng.uniform() < 0.5
    for i in range(n_bays):
        x = (i - (n_bays - 1) / 2) * bay
        for k in range(max(1, int(h / storey))):
            z = k * storey
            if k == 0 and i == door:  # a porch
                low, high = [x - 0.9, y, 2.3], [x + 0.9, y + out * 1.0, 2.45]
                parts.append(box(np.minimum(low, high), np.maximum(low, high), "concrete"))
                continue
            if z + 2.3 > h:
                continue
            low, high = [x - 0.6, y, z + 0.95], [x + 0.6, y + out * 0.06, z + 2.2]
            parts.append(box(np.minimum(low, high), np.maximum(low, high), "glass"))
            if balconies and k > 0 and (i + door) % 2 == 0:
                low, high = [x - 1.1, y, z + 0.1], [x + 1.1, y + out * 1.1, z + 0.25]
                parts.append(box(np.minimum(low, high), np.maximum(low, high), "concrete"))
                low, high = [x - 1.1, y + out * 1.05, z + 0.25], [x + 1.1, y + out * 1.1, z + 1.1]
                parts.append(box(np.minimum(low, high), np.maximum(low, high), "metal"))
    return parts


def build_block(rng: np.random.Generator, a: float, b: float, h: float) -> Model:
    """Return a town building with a flat roof, a parapet, windows, porches and balconies."""
    parts = [slab(a, b, -DEEP, h, "brick")]
    for y in (-b / 2, b / 2):
        parts.append(box([-a / 2, y - 0.15, h], [a / 2, y + 0.15, h + 0.6], "concrete"))
        parts += _facade(rng, a, y, h, float(np.sign(y)))
    for x in (-a / 2, a / 2):
        parts.append(box([x - 0.15, -b / 2, h], [x + 0.15, b / 2, h + 0.6], "concrete"))
    if rng.uniform() < 0.4:  # part of the building rises higher
        c, shift = rng.uniform(0.3, 0.6), rng.uniform(-0.2, 0.2)
        top = slab(c * a, 0.9 * b, h, h + rng.uniform(2.5, 5.0), "brick")
        parts.append(shifted(top, shift * a, 0.0))
    parts += _roof_things(rng, a, b, h)
    return Model(join(parts), (a + 0.3, b + 0.3))


def build_house(rng: np.random.Generator) -> Model:
    """Return a house with a pitched roof, a chimney, often a lean-to or a cross wing."""
    a, b = rng.uniform(8.0, 14.0), rng.uniform(6.0, 9.0)
    eave = rng.uniform(2.6, 5.5)
    ridge = eave + b / 2 * np.tan(rng.uniform(np.radians(25), np.radians(48)))
    parts = [slab(a, b, -DEEP, eave, "brick"), gable(a, b, eave, ridge, 0.5, "brick")]
    for y in (-b / 2, b / 2):
        parts += _facade(rng, a, y, eave, float(np.sign(y)))
    x = rng.uniform(-0.35, 0.35) * a
    parts.append(box([x - 0.3, 0.6, eave], [x + 0.3, 1.2, ridge + 0.6], "brick"))
    if rng.uniform() < 0.5:
        c, d = rng.uniform(3.0, 5.0), rng.uniform(2.5, 4.0)
        side = float(rng.choice([-1.0, 1.0]))
        wing_eave = min(eave, 2.8)
        wing = join(
            [
                slab(d * 2, c, -DEEP, wing_eave, "brick"),
                gable(d * 2, c, wing_eave, wing_eave + 0.4 * c, 0.3, "brick"),
            ]
        )
        at = side * b / 2
        parts.append(shifted(wing, rng.uniform(-0.25, 0.25) * a, at, yaw=np.pi / 2))
        return Model(join(parts), (a + 0.6, b + 2 * d + 0.6))
    return Model(join(parts), (a + 0.6, b + 0.6))


def build_shed(rng: np.random.Generator) -> Model:
    """Return a garden shed."""
    a, b, h = rng.uniform(2.0, 4.0), rng.uniform(1.8, 3.0), rng.uniform(1.9, 2.3)
    parts = [slab(a, b, -BURIED, h, "wood"), gable(a, b, h, h + 0.25 * b, 0.2, "wood")]
    return Model(join(parts), (a, b))


def build_hall(rng: np.random.Generator, a: float, b: float, h: float) -> Model:
    """Return an industrial hall: shallow roof, gates, ribs, skylights."""
    parts = [slab(a, b, -DEEP, h, "metal"), gable(a, b, h, h + 0.06 * b, 0.2, "metal")]
    spacing = rng.uniform(4.5, 7.0)
    gates = set(rng.integers(0, max(1, int(a / spacing)), 3).tolist())
    for i in range(int(a / spacing) + 1):
        x = -a / 2 + i * spacing
        for s in (-1.0, 1.0):
            low, high = [x - 0.15, s * b / 2, 0.0], [x + 0.15, s * (b / 2 + 0.25), h]
            parts.append(
                box(np.minimum(low, high) - [0, 0, BURIED], np.maximum(low, high), "metal")
            )
            if i in gates and x + spacing < a / 2:
                low = [x + 0.5, s * b / 2, 3.6]
                high = [x + spacing - 0.5, s * (b / 2 + 1.5), 3.75]
                parts.append(box(np.minimum(low, high), np.maximum(low, high), "metal"))
    for x in np.arange(-a / 2 + 5, a / 2 - 5, 10.0):
        parts.append(box([x, -1.0, h], [x + 3.0, 1.0, h + 0.06 * b + 0.7], "glass"))
    return Model(join(parts), (a + 0.5, b + 0.6))


def build_tank(rng: np.random.Generator, radius: float, h: float) -> Model:
    """Return a standing tank with a domed roof and a ladder."""
    profile = [
        (radius, -DEEP),
        (radius, h),
        (0.7 * radius, h + 0.2 * radius),
        (0.0, h + 0.3 * radius),
    ]
    ladder = box([radius, -0.25, -BURIED], [radius + 0.12, 0.25, h + 0.8], "metal")
    pipe = tube([0, radius, 0.6], [0, radius + 1.2, 0.6], 0.2, 0.2, "metal")
    return Model(
        join([lathe(profile, "metal", sides=28), ladder, pipe]), (2 * radius + 1, 2 * radius + 1)
    )


def build_lying_tank(rng: np.random.Generator) -> Model:
    """Return a lying tank on two saddles."""
    a, r = rng.uniform(5.0, 9.0), rng.uniform(0.9, 1.5)
    z = r + 0.7
    parts = [tube([-a / 2, 0, z], [a / 2, 0, z], r, r, "metal", sides=18)]
    for x in (-0.32 * a, 0.32 * a):
        parts.append(box([x - 0.2, -0.8 * r, -BURIED], [x + 0.2, 0.8 * r, z - 0.5 * r], "concrete"))
    return Model(join(parts), (a, 2 * r))


def build_pipe_rack(rng: np.random.Generator, a: float) -> Model:
    """Return a rack of pipes on frames, open below."""
    b, h = rng.uniform(2.5, 4.0), rng.uniform(4.0, 5.5)
    parts = []
    n = max(2, round(a / 5.0) + 1)
    for x in np.linspace(-a / 2, a / 2, n):
        for y in (-b / 2, b / 2):
            parts.append(box([x - 0.12, y - 0.12, -BURIED], [x + 0.12, y + 0.12, h], "metal"))
        for z in (0.7 * h, h):
            parts.append(box([x - 0.1, -b / 2, z - 0.2], [x + 0.1, b / 2, z], "metal"))
    for z in (0.7 * h, h):
        for y in np.arange(-b / 2 + 0.3, b / 2 - 0.2, rng.uniform(0.45, 0.8)):
            r = rng.uniform(0.07, 0.2)
            parts.append(tube([-a / 2, y, z + r], [a / 2, y, z + r], r, r, "metal"))
    return Model(join(parts), (a, b))
