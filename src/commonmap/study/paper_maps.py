"""Two robots' maps as the paper compares them: height maps under 1 m, and areas of 10 m."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from commonmap.config import Config
from commonmap.errors import EmptyMapError
from commonmap.frames import apply, invert
from commonmap.mapping.height_map import build_height_map
from commonmap.matching.maps import Prepared, prepare
from commonmap.study.readings import LEAST, Columns, Lattice, list_columns, make_lattice
from commonmap.types import Float64s, GridMap

CELL = 0.5
"""Metres, of the cells on which the study compares heights."""

MAX_HEIGHT = 1.0
"""Metres above ground below which heights are used, as in the paper."""

AREA = 10.0
"""Metres, edge of the paper's areas."""

LEAST_KNOWN = 0.5
"""Share of an area's cells that the draft must know; less of it is no area to compare."""


@dataclass(frozen=True, eq=False)
class HeightMaps:
    """Both robots' height maps under 1 m and where the draft truly lies.

    target, source: level, near their own origins, with their ground. grids: on half cells, of the
    target and of the source. lattice: the target on whole cells. T_truth: (4, 4), from the
    prepared source into the prepared target.
    """

    target: Prepared
    source: Prepared
    grids: tuple[GridMap, GridMap]
    lattice: Lattice
    T_truth: Float64s

    @property
    def yaw(self) -> float:
        """Radians by which the source is truly turned in the target's frame."""
        return float(np.arctan2(self.T_truth[1, 0], self.T_truth[0, 0]))

    def true_pose(self, columns: Columns) -> Float64s:
        """Return x, y, yaw at which the columns' centre truly lies."""
        here = np.append(columns.centre, self.source.ground.height_at(columns.centre[None]))
        return np.append(apply(self.T_truth, here[None])[0, :2], self.yaw)

    def error(self, columns: Columns, pose: Float64s) -> tuple[float, float]:
        """Return how far a pose of the columns is from the truth, metres and radians."""
        true = self.true_pose(columns)
        turn = float(np.abs(np.angle(np.exp(1j * (pose[2] - true[2])))))
        return float(np.hypot(*(pose[:2] - true[:2]))), turn

    def T_target_source(self, columns: Columns, pose: Float64s) -> Float64s:
        """Return the planar motion (4, 4) of the prepared source at a pose of the columns."""
        c, s = np.cos(pose[2]), np.sin(pose[2])
        T = np.eye(4)
        T[:2, :2] = [[c, -s], [s, c]]
        T[:2, 3] = pose[:2] - T[:2, :2] @ columns.centre
        return T


@dataclass(frozen=True, eq=False)
class Area:
    """A 10 m square of the draft. corner: (2,) metres, lower, prepared draft frame. grid: its
    height map on half cells. objects: share of its known cells that hold an object."""

    corner: Float64s
    grid: GridMap
    columns: Columns
    objects: float


def make_height_maps(
    target: Float64s, source: Float64s, T_target_source: Float64s, *, cell: float = CELL
) -> HeightMaps:
    """Return the height maps of two (N, 3) maps, z up, and the truth between them."""
    config = Config()
    base, draft = prepare(target, "base map", config), prepare(source, "draft map", config)
    edges = np.array([LEAST, MAX_HEIGHT])
    grids = [
        build_height_map(
            item.xyz, cell=0.5 * cell, slab_edges=edges, ground=item.ground, height=item.height,
            max_height=MAX_HEIGHT,
        )
        for item in (base, draft)
    ]  # fmt: skip
    T_truth = base.T_prepared_map @ T_target_source @ invert(draft.T_prepared_map)
    return HeightMaps(base, draft, (grids[0], grids[1]), make_lattice(grids[0], cell), T_truth)


def cut_areas(grid: GridMap, *, size: float = AREA) -> tuple[Area, ...]:
    """Return the areas of a draft, row by row, that it knows to `LEAST_KNOWN` at least.

    Raises EmptyMapError where there is none.
    """
    n = round(size / grid.cell)
    areas = []
    for i in range(0, grid.shape[0], n):
        for j in range(0, grid.shape[1], n):
            part = np.s_[i : i + n, j : j + n]
            known = grid["known"][part]
            if np.count_nonzero(known) < LEAST_KNOWN * n * n:
                continue
            height = grid["height"][part]
            corner = grid.origin + np.array([i, j]) * grid.cell
            piece = GridMap(corner, grid.cell, {"known": known, "height": height})
            objects = float(np.mean(height[known] >= LEAST))
            areas.append(Area(corner, piece, list_columns(piece), objects))
    if not areas:
        raise EmptyMapError(
            f"the draft knows no area of {size:g} m to a half; it is too small for the study"
        )
    return tuple(areas)
