"""A works of halls, containers, tanks and pipe racks."""

from __future__ import annotations

from functools import partial

import numpy as np

from commonmap.sim import buildings
from commonmap.sim.mesh import join, shifted
from commonmap.sim.objects import Model, build_container
from commonmap.sim.terrain import roll_terrain
from commonmap.sim.world import Site, World


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
        site.scatter(
            "pipe rack", 1, rng, build=partial(buildings.build_pipe_rack, a=rack_length), yaw=turn,
            margin=1.2,
        )  # fmt: skip
    share = size**2 / 1e4
    site.scatter("lying tank", int(3 * share), rng, build=buildings.build_lying_tank, margin=1.2)
    for kind, count in (("truck", 6), ("car", 10), ("boxes", 14), ("lamp", 8), ("wall", 4)):
        site.scatter(kind, int(count * share * rng.uniform(0.7, 1.3)), rng)
    site.scatter("canopy", int(2 * share), rng)
    site.scatter("tree", int(3 * share), rng)
    return site.finish()


def _put_containers(site: Site, rng: np.random.Generator) -> None:
    """Put yards of containers in equal rows, some stacked, some missing."""
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
