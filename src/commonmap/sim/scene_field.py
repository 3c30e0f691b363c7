"""An almost empty place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from commonmap.sim.objects import build_fence
from commonmap.sim.terrain import Terrain, roll_terrain, winding_line
from commonmap.sim.world import Site, World


def build_field(rng: np.random.Generator, *, size: float, relief: float) -> World:
    """Return an almost empty place: rolling ground, a ditch, a fence, few bushes and bales."""
    terrain = roll_terrain(rng, size=size, relief=relief, wavelength=(15.0, 120.0), roughness=0.025)
    terrain = _dig_ditch(terrain, rng, size)
    site = Site("field", size, terrain, "grass")
    line = winding_line(rng, size)
    length = 6.0
    heading = np.arctan2(*np.gradient(line, axis=0).T[::-1])
    for i in range(3, len(line) - 3, 6):
        if rng.uniform() < 0.8:
            x, y = line[i]
            site.put("fence", build_fence(rng, length=length), x, y, heading[i], margin=-0.1)
    share = size**2 / 1e4
    for kind, count in (("bush", 8), ("tree", 2), ("bale", 5), ("rock", 5)):
        site.scatter(kind, max(1, int(count * share * rng.uniform(0.6, 1.4))), rng)
    return site.finish()


def _dig_ditch(terrain: Terrain, rng: np.random.Generator, size: float) -> Terrain:
    """Return the ground with a winding ditch of 0.4 to 0.9 m depth."""

    line = winding_line(rng, size + 20.0)
    nx, ny = terrain.z.shape
    i, j = np.meshgrid(np.arange(nx), np.arange(ny), indexing="ij")
    xy = terrain.origin + terrain.cell * np.stack([i.ravel(), j.ravel()], axis=1)
    away, _ = cKDTree(line).query(xy, workers=1)
    depth, width = rng.uniform(0.4, 0.9), rng.uniform(0.8, 1.4)
    ditch = depth * np.exp(-0.5 * (away / width) ** 4)
    return replace(terrain, z=(terrain.z - ditch.reshape(nx, ny)).astype(np.float32))
