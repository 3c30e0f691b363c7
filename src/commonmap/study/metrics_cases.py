"""The pairs of the metric study: several areas of each simulated place, with the exact truth.

A place is recorded once by both robots. The ground robot's map is cut into areas, as in the
source paper, and each is searched in a window of the drone's map. Both go the product's
way: levelled, their ground found, height maps built.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from commonmap.config import Config
from commonmap.frames import fit_motion, invert
from commonmap.io.logs.poses import interpolate
from commonmap.mapping.height_map import build_height_map, choose_slabs
from commonmap.matching.maps import Prepared
from commonmap.matching.maps import prepare as prepare_map
from commonmap.sim.pairs import Pair, simulate_pair
from commonmap.sim.scanning import place_points
from commonmap.types import Bools, Float64s, GridMap

PLACE, DRIVEN, WIDER = 60.0, 32.0, 14.0
"""Metres: edges of the place and of what the ground robot drives in; by how much the window in the
drone's map is wider than the area."""

N_sizeS = 4
"""Areas of each place: the quarters of what was driven in."""

LOW = 1.0
"""Metres: the heights that the source paper looks at."""


@dataclass(frozen=True, eq=False)
class Place:
    """A simulated place. target_true, source_true: where the points truly are, world frame."""

    pair: Pair
    target_true: Float64s
    source_true: Float64s


@dataclass(frozen=True, eq=False)
class Area:
    """One area and its window, ready to be made into height maps.

    T_target_source: (4, 4) the truth between the prepared frames, the best rigid motion over the
    area's points. overlap: share of the area's cells that the window saw.
    """

    target: Prepared
    source: Prepared
    T_target_source: Float64s
    overlap: float


def record_place(
    kind: str, *, drift: float, tilt: float, change: float, rng: np.random.Generator
) -> Place:
    """Return a new place of a kind, recorded by both robots; arguments as in `simulate_pair`."""
    pair = simulate_pair(
        kind, rng=rng, drift=drift, tilt=tilt, change=change, size=PLACE, draft_size=DRIVEN,
        azimuth_decimation=8, max_points=180_000,
    )  # fmt: skip
    clouds = (pair.target, pair.target_trajectory, pair.target_mission), (
        pair.source, pair.source_trajectory, pair.source_mission,
    )  # fmt: skip
    true = []
    for cloud, known, mission in clouds:
        assert cloud.time is not None
        T = invert(interpolate(known, cloud.time))
        local = np.einsum("nij,nj->ni", T[:, :3, :3], cloud.xyz) + T[:, :3, 3]
        true.append(place_points(mission.sensor, cloud.time, local))
    return Place(pair, *true)


def cut_area(
    place: Place,
    quarter: int,
    *,
    size: float,
    overlap: float,
    noise: float,
    rng: np.random.Generator,
) -> Area:
    """Return one area of a place and its window.

    size: metres, edge of the area. overlap: share of its cells that the window keeps, by a line at
    which it ends. noise: metres, standard deviation added to every coordinate of the area's points.
    """
    driven = place.pair.source_mission.sensor.T_map_sensor[:, :2, 3]
    middle = 0.5 * (driven.min(axis=0) + driven.max(axis=0))
    offset = 0.25 * DRIVEN * np.array([1 - 2 * (quarter % 2), 1 - 2 * (quarter // 2)])
    turn = rng.uniform(0.0, 2.0 * np.pi)
    inside = _in_square(place.source_true, middle + offset, size, turn)
    source_true = place.source_true[inside]
    source = place.pair.source.xyz[inside]
    source = source + rng.normal(0.0, 1.0, source.shape) * noise

    # the window holds the area anywhere, and lies in the place where it can
    room = 0.5 * WIDER - 2.0
    reach = 0.5 * (PLACE - size - WIDER)
    at = np.clip(middle + offset + rng.uniform(-room, room, 2), -reach, reach)
    shown = _in_square(place.target_true, at, size + WIDER, 0.0)
    away = middle + offset - at
    away = away / max(float(np.hypot(*away)), 1e-6)
    cells_s, cells_t = (
        np.unique(np.floor(p[:, :2] / 0.5), axis=0) for p in (source_true, place.target_true[shown])
    )
    both = _rows_in(cells_s, cells_t)
    n_asked = round(overlap * len(cells_s))
    if np.count_nonzero(both) > n_asked:
        along = (cells_s[both] + 0.5) @ away * 0.5
        shown &= place.target_true[:, :2] @ away <= np.sort(along)[n_asked]
        cells_t = np.unique(np.floor(place.target_true[shown, :2] / 0.5), axis=0)
    reached = float(np.mean(_rows_in(cells_s, cells_t)))

    target = prepare_map(place.pair.target.xyz[shown], "base", Config())
    draft = prepare_map(source, "draft", Config())
    T_world_target = fit_motion(place.target_true[shown], place.pair.target.xyz[shown])
    T_world_source = fit_motion(source_true, place.pair.source.xyz[inside])
    truth = (
        target.T_prepared_map @ invert(T_world_target) @ T_world_source
        @ invert(draft.T_prepared_map)
    )  # fmt: skip
    return Area(target, draft, truth, reached)


def build_maps(area: Area, cell: float, *, low: bool) -> tuple[GridMap, GridMap]:
    """Return the height maps of window and area on half of `cell`, with slabs.

    low: take only what is less than `LOW` metres above ground.
    """
    limit = LOW if low else None
    edges = choose_slabs(area.source.height, cell=cell, max_height=limit)
    target, source = (
        build_height_map(
            item.xyz, cell=0.5 * cell, slab_edges=edges, ground=item.ground, max_height=limit,
            height=item.height,
        )
        for item in (area.target, area.source)
    )  # fmt: skip
    return target, source


def _in_square(points: Float64s, middle: Float64s, edge: float, turn: float) -> Bools:
    cosine, sine = np.cos(turn), np.sin(turn)
    d = points[:, :2] - middle
    along = d @ np.array([[cosine, -sine], [sine, cosine]])
    return np.asarray((np.abs(along) <= 0.5 * edge).all(axis=1))


def _rows_in(rows: Float64s, others: Float64s) -> Bools:
    """Return which rows (N, 2) of whole numbers are among the others (M, 2)."""
    own, other = (r[:, 0] * 65536.0 + r[:, 1] for r in (rows, others))
    return np.asarray(np.isin(own, other))
