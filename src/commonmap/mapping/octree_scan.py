"""Which voxels the rays of one scan passed: the bits that `octree_kernels.trace` sets."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from commonmap.errors import InputError
from commonmap.mapping import octree_kernels as kernels
from commonmap.mapping import octree_threads
from commonmap.types import Float32s

MAX_TABLE = 1 << 26
"""The most tiles (of 32^3 voxels) that the box of one scan may hold: 3 km cubed at 0.25 m."""


class ScanBits:
    """The bits of one scan: which voxels its rays passed. Empty between scans, kept for the next.

    words: 512 words of bits a tile; touched: 64 marks a tile, one for each cube of 8^3 voxels;
    slot_of: block slot of each cube, valid for the cubes touched now.
    """

    def __init__(self) -> None:
        self.table = np.empty(0, np.int32)
        self.tiles = np.empty(0, np.int64)
        self.words = np.empty(0, np.int64)
        self.touched = np.empty(0, np.uint8)
        self.slot_of = np.empty(0, np.int32)
        self.n_tiles = 0
        self.low = np.zeros(3, np.int64)
        self.bits = np.zeros(3, np.int64)

    def open(self, box: NDArray[np.int64]) -> None:
        """Make the table of tiles for the keys of `box` (2, 3), first and last included."""
        self.low = (box[0] - 2) >> 5  # a ray may overshoot its end by a voxel
        n = ((box[1] + 2) >> 5) - self.low + 1
        self.bits = np.array([int(k - 1).bit_length() for k in n], np.int64)
        size = 1 << int(self.bits.sum())
        if size > MAX_TABLE:
            raise InputError(
                f"one scan spans {' x '.join(str(32 * k) for k in n)} voxels, too many at once;"
                " give max_range, or a coarser resolution"
            )
        if size > len(self.table):
            self.table = np.full(size, -1, np.int32)
        self.n_tiles = 0

    def mark_ends(
        self, ends: Float32s, state: NDArray[np.uint8], resolution: float
    ) -> NDArray[np.int64]:
        """Return the address (N,) of each hit, or -1; its cube counts as touched."""
        at = np.empty(len(ends), np.int64)
        done = 0
        while done < len(ends):
            done, self.n_tiles = kernels.mark_ends(
                done, ends, state, resolution, self.low, self.bits, self.table, self.tiles,
                self.n_tiles, self.touched, at,
            )  # fmt: skip
            if done < len(ends):
                self._add_tiles(max(64, len(self.tiles) // 2))
        return at

    def trace(
        self, starts: Float32s, ends: Float32s, state: NDArray[np.uint8], resolution: float,
        first: int, last: int,
    ) -> None:  # fmt: skip
        """Set the bits of the rays first..last, the last not included."""
        done = first
        while done < last:
            done, self.n_tiles = kernels.trace(
                done, last, starts, ends, state, resolution, self.low, self.bits, self.table,
                self.tiles, self.n_tiles, self.words, self.touched,
            )  # fmt: skip
            if done < last:
                self._add_tiles(max(64, len(self.tiles) // 2))

    def join(self, other: ScanBits) -> None:
        """Take over the bits of another with the same box, which is empty then."""
        new = octree_threads.count_new_tiles(other.tiles, other.n_tiles, self.table)
        if self.n_tiles + new > len(self.tiles):
            self._add_tiles(self.n_tiles + new - len(self.tiles))
        self.n_tiles = octree_threads.join_bits(
            other.tiles, other.n_tiles, other.words, other.touched, other.table,
            self.tiles, self.n_tiles, self.words, self.touched, self.table,
        )  # fmt: skip
        other.n_tiles = 0

    def touched_cubes(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the touched cubes, and the Morton code of the block behind each."""
        n = kernels.count_touched(self.touched, self.n_tiles)
        cubes, wanted = np.empty(n, np.int64), np.empty(n, np.int64)
        n = kernels.locate(
            self.tiles, self.n_tiles, self.touched, self.low, self.bits, cubes, wanted
        )
        return cubes[:n], wanted[:n]

    def close(self, cubes: NDArray[np.int64]) -> None:
        """Forget the scan."""
        kernels.forget(cubes, self.tiles, self.n_tiles, self.words, self.touched, self.table)
        self.n_tiles = 0

    def memory_bytes(self) -> int:
        return sum(
            a.nbytes for a in (self.table, self.tiles, self.words, self.touched, self.slot_of)
        )

    def _add_tiles(self, more: int) -> None:
        n = len(self.tiles) + more
        for name, width in (("tiles", 1), ("words", 512), ("touched", 64), ("slot_of", 64)):
            array: NDArray[Any] = getattr(self, name)
            array.resize(n * width, refcheck=False)
        self.slot_of[-more * 64 :] = -1
