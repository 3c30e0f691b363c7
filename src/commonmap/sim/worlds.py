"""The kinds of places that can be simulated, one table.

Two seeds are two different places: streets, relief, shapes, numbers and positions are all drawn.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from commonmap.errors import InputError
from commonmap.sim.scene_city import build_city
from commonmap.sim.scene_field import build_field
from commonmap.sim.scene_forest import build_forest
from commonmap.sim.scene_industrial import build_industrial
from commonmap.sim.scene_paper import build_paper
from commonmap.sim.scene_village import build_village
from commonmap.sim.world import World


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
