"""The source paper's scene."""

from __future__ import annotations

from functools import partial

import numpy as np

from commonmap.sim.buildings import build_block
from commonmap.sim.terrain import roll_terrain
from commonmap.sim.world import Site, World


def build_paper(rng: np.random.Generator, *, size: float, relief: float) -> World:
    """Return the source paper's scene: trees, roofs on posts, walls, boxes, vehicles, and things
    that only one of the two robots can see or that look different from above and from the side."""
    site = Site("paper", size, roll_terrain(rng, size=size, relief=relief), "soil")
    share = size**2 / 60.0**2

    def n(low: int, high: int) -> int:
        return max(1, round(share * rng.integers(low, high + 1)))

    for _ in range(n(1, 3)):
        a, b, h = rng.uniform(6.0, 11.0), rng.uniform(5.0, 8.0), rng.uniform(3.0, 6.0)
        site.scatter("block", 1, rng, build=partial(build_block, a=a, b=b, h=h), margin=1.2)
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
