"""The target on cells of one width of the pyramid: whole where it is small, else by windows."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from commonmap.config import ComputeConfig
from commonmap.matching.slabs import (
    Range,
    SlabGrid,
    coarse_origin,
    coarse_shape,
    coarse_window,
    coarsen,
    mirror_grid,
)
from commonmap.types import Float64s


@dataclass(frozen=True, eq=False)
class Level:
    """The target on cells `factor` times as wide: whole where it is small, else by windows.

    origin: (2,) metres, lower corner of the level's cell [0, 0]. cell: metres. mirrored: the level
    is that of the target reflected, x -> -x; `target` is as it was.
    """

    target: SlabGrid
    factor: int
    origin: Float64s
    cell: float
    shape: tuple[int, int]
    whole: SlabGrid | None
    mirrored: bool = False

    def mirror(self) -> Level:
        """Return the level of the reflected target: cells lie alike to multiples of their width."""
        low = -(self.origin[0] + self.shape[0] * self.cell)
        return replace(
            self,
            origin=np.array([low, self.origin[1]]),
            whole=None if self.whole is None else mirror_grid(self.whole),
            mirrored=not self.mirrored,
        )

    def window(self, rows: Range, columns: Range) -> SlabGrid:
        """Return these cells of the level, which must lie in it."""
        if self.whole is None:
            if not self.mirrored:
                return coarse_window(self.target, self.factor, rows, columns)
            n_x = self.shape[0]
            back = n_x - rows[1], n_x - rows[0]
            return mirror_grid(coarse_window(self.target, self.factor, back, columns))
        region = slice(*rows), slice(*columns)
        origin = self.origin + np.array([rows[0], columns[0]]) * self.cell
        occupied, known = (
            np.ascontiguousarray(bits[region]) for bits in (self.whole.occupied, self.whole.known)
        )
        return SlabGrid(origin, self.cell, occupied, known, self.target.n_slabs)

    def around(self, pose: Float64s, reach: float) -> tuple[SlabGrid, int, int]:
        """Return a window that holds all cells nearer than `reach` to poses (P, 3).

        Also the cell of the level on which the window's first cell lies.
        """
        if self.whole is not None:
            return self.whole, 0, 0
        low = np.floor((pose[:, :2].min(axis=0) - reach - self.origin) / self.cell) - 1
        high = np.floor((pose[:, :2].max(axis=0) + reach - self.origin) / self.cell) + 2
        (i0, j0), (i1, j1) = (np.clip(x, 0, self.shape).astype(int).tolist() for x in (low, high))
        return self.window((i0, i1), (j0, j1)), i0, j0


def find_level(target: SlabGrid, factor: int, compute: ComputeConfig) -> Level:
    """Return the level; it is kept whole if its bits take less than an eighth of the memory."""
    shape = coarse_shape(target, factor)
    small = 8.0 * shape[0] * shape[1] <= 0.125e9 * compute.memory_gb
    return Level(
        target, factor, coarse_origin(target, factor), target.cell * factor, shape,
        coarsen(target, factor) if small else None,
    )  # fmt: skip
