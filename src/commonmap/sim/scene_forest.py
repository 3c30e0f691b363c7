"""A wood on a slope."""

from __future__ import annotations

import numpy as np

from commonmap.sim.objects import build_conifer, build_tree
from commonmap.sim.terrain import roll_terrain
from commonmap.sim.world import Site, World


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
