"""The occupancy octree: scans go in ray by ray, leaves come out; results are OctoMap's, bit by bit.

Hornung, Wurm, Bennewitz, Stachniss and Burgard, "OctoMap: An Efficient Probabilistic 3D Mapping
Framework Based on Octrees", Autonomous Robots 2013. Occupancy is log-odds (eq. 2), clamped (eq. 4).
The tree is kept as blocks of 8^3 voxels behind a hash table and pruned when leaves are asked for;
`docs/octree.md` says why, with measurements.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from commonmap import frames
from commonmap.errors import InputError
from commonmap.io import morton
from commonmap.mapping import octree_kernels as kernels
from commonmap.mapping import octree_rays, octree_threads
from commonmap.mapping.octree_blocks import BLOCK, Blocks, leaf_parts, leaves_of, leaves_to_blocks
from commonmap.mapping.octree_scan import ScanBits
from commonmap.types import KEY_ORIGIN, TREE_DEPTH, Bools, Float32s, Float64s, LeafParts, Leaves

MAX_THREADS = 64


@dataclass(frozen=True, eq=False)
class RayHits:
    """Where rays ended. hit: (N,) the ray met an occupied voxel; end: (N, 3) float32 metres, the
    centre of the last voxel it came to."""

    hit: Bools
    end: Float32s


class Octree:
    """An occupancy octree of 16 levels that scans are inserted into (it changes in place).

    resolution: edge of a voxel, metres. hit, miss: occupancy probability that one hit, one miss
    stands for (l_occ and l_free of the paper as log-odds). clamp_min, clamp_max: probabilities that
    the occupancy is kept between (l_min, l_max). The frame is
    the map's; voxel keys run from 0 to 65535 and voxel 32768 begins at the origin, so that the tree
    reaches 32768 voxels each way, and what lies beyond is left out.

    threads: how many work on a scan; the result is the same to the bit for any number.
    """

    def __init__(
        self,
        resolution: float,
        *,
        hit: float = 0.7,
        miss: float = 0.4,
        clamp_min: float = 0.1192,
        clamp_max: float = 0.971,
        threads: int = 1,
    ) -> None:
        if not (math.isfinite(resolution) and resolution > 0):
            raise InputError(
                f"resolution must be a voxel edge in metres above 0; {resolution} came"
            )
        if not 0 < miss <= 0.5 <= hit < 1:
            raise InputError(
                "miss must lie between 0 and 0.5 and hit between 0.5 and 1;"
                f" miss={miss} and hit={hit} came"
            )
        if not 0 < clamp_min < 0.5 < clamp_max < 1:
            raise InputError(
                "clamp_min must lie between 0 and 0.5 and clamp_max between 0.5 and 1;"
                f" clamp_min={clamp_min} and clamp_max={clamp_max} came"
            )
        if not 1 <= threads <= MAX_THREADS:
            raise InputError(f"threads must be from 1 to {MAX_THREADS}; {threads} came")
        self.resolution = float(resolution)
        self.hit = log_odds(hit)
        self.miss = log_odds(miss)
        self.clamp_min = log_odds(clamp_min)
        self.clamp_max = log_odds(clamp_max)
        self._n_blocks = 0
        self._codes = np.empty(16, np.int64)
        self._values = np.empty((16, BLOCK), np.float32)
        self._table_codes = np.full(64, -1, np.int64)
        self._table_slots = np.zeros(64, np.int32)
        self._scratch = [ScanBits() for _ in range(threads)]
        self._pool = ThreadPoolExecutor(threads - 1) if threads > 1 else None

    @classmethod
    def from_leaves(cls, leaves: Leaves, *, threads: int = 1, **options: float) -> Octree:
        """Return an octree that holds what the leaves say. options: as of `Octree`."""
        tree = cls(leaves.resolution, threads=threads, **options)
        tree._take(leaves_to_blocks(leaves))
        return tree

    def insert(
        self,
        origin: ArrayLike,
        points: ArrayLike,
        *,
        max_range: float = -1.0,
        T_map_sensor: ArrayLike | None = None,
        discretize: bool = False,
    ) -> None:
        """Insert one scan: free along its rays, occupied at their ends, each voxel once.

        origin: (3,) where the sensor stood, or (N, 3) where it was for each point, metres.
        points: (N, 3) ray ends, metres; points that are not finite are left out. Both are of the
        map's frame, or of the sensor's where `T_map_sensor` (4, 4) is given.
        max_range: a longer ray only frees, up to this range, metres; negative for no limit.
        discretize: one ray a voxel, to its centre, from the origin of its first point: faster, and
        slightly other rays.

        As OctoMap's `insertPointCloud`: a voxel with a hit is not freed by the same scan.
        """
        starts, ends = self._ray_arrays(origin, points, T_map_sensor)
        if discretize:
            starts, ends = self._discretized(starts, ends)
        if len(ends) == 0:
            return
        state = np.empty(len(ends), np.uint8)
        cut = np.empty_like(ends)
        box = kernels.clip(starts, ends, 1.0 / self.resolution, float(max_range), cut, state)
        if box[1, 0] < 0:
            return
        self._settle(self._trace(box, starts, cut, state))

    def insert_rays(self, origin: ArrayLike, points: ArrayLike, *, max_range: float = -1.0) -> None:
        """Insert rays one after the other, each its own measurement: OctoMap's `insertRay`.

        Arguments as of `insert`; a voxel that many rays pass is freed many times.
        """
        starts, ends = self._ray_arrays(origin, points, None)
        state = np.empty(len(ends), np.uint8)
        cut = np.empty_like(ends)
        kernels.clip(starts, ends, 1.0 / self.resolution, float(max_range), cut, state)
        done = 0
        while done < len(ends):
            self._reserve(self._n_blocks + octree_rays.RAY_BLOCKS)
            done, self._n_blocks = octree_rays.insert_rays(
                done, starts, cut, state, self.resolution, self._codes, self._n_blocks,
                self._values, self._table_codes, self._table_slots,
                self.hit, self.miss, self.clamp_min, self.clamp_max,
            )  # fmt: skip

    def update(self, points: ArrayLike, *, occupied: bool) -> None:
        """Count a hit (occupied) or a miss for the voxel of each point (N, 3), once per point."""
        xyz = frames.check_points(points).astype(np.float32)
        codes, inside = self._codes_at(xyz)
        codes = codes[inside]
        slots = self._make_slots(codes >> 9)
        octree_rays.add(
            codes, slots, self._values, self.hit if occupied else self.miss,
            self.clamp_min, self.clamp_max,
        )  # fmt: skip

    def leaves(self, *, pruned: bool = True) -> Leaves:
        """Return the leaves in Morton order; not pruned: every known voxel by itself."""
        return leaves_of(self.resolution, self._codes, self._values, self._order(), pruned=pruned)

    def leaf_parts(self, *, pruned: bool = True) -> LeafParts:
        """Return the leaves as `leaves` does, made part by part whenever they are gone through.

        `write_octree` takes them: a file costs no more memory than the tree itself.
        """
        return LeafParts(
            self.resolution,
            lambda: leaf_parts(
                self.resolution, self._codes, self._values, self._order(), pruned=pruned
            ),
        )

    def blocks(self) -> Blocks:
        """Return the voxels as blocks sorted by code (a copy)."""
        order = self._order()
        return Blocks(self.resolution, self._codes[order], self._values[order])

    def count_nodes(self, *, pruned: bool = True) -> int:
        """Return the number of nodes, inner and leaf, that OctoMap's `size()` gives."""
        return morton.count_nodes(self.leaves(pruned=pruned))

    def memory_bytes(self) -> int:
        """Return the bytes of log-odds, hash table and scratch that this tree holds."""
        arrays = (self._codes, self._values, self._table_codes, self._table_slots)
        return sum(a.nbytes for a in arrays) + sum(s.memory_bytes() for s in self._scratch)

    def log_odds_at(self, points: ArrayLike) -> Float32s:
        """Return the log-odds (N,) of the voxels of points (N, 3), NaN where unknown."""
        xyz = frames.check_points(points)
        codes, inside = self._codes_at(xyz)
        slots = np.empty(len(codes), np.int32)
        kernels.find_blocks(codes >> 9, self._table_codes, self._table_slots, slots)
        known = inside & (slots >= 0)
        value = np.full(len(xyz), np.nan, np.float32)
        value[known] = self._values[slots[known], codes[known] & (BLOCK - 1)]
        return value

    def occupied_centres(self) -> Float64s:
        """Return the centres (N, 3) of all occupied voxels at the finest level, metres."""
        leaves = self.leaves(pruned=False)
        keys = leaves.keys[leaves.occupied].astype(np.float64)
        return (keys - KEY_ORIGIN + 0.5) * self.resolution

    def cast_rays(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        *,
        max_range: float = -1.0,
        ignore_unknown: bool = False,
    ) -> RayHits:
        """Send a ray from each origin until it meets an occupied voxel: OctoMap's `castRay`.

        origins: (3,) or (N, 3); directions: (N, 3), any length. A ray ends without a hit at
        `max_range` metres (0 or less: no limit), at the border of the tree, or at an unknown voxel
        where these are not ignored.
        """
        starts, along = self._ray_arrays(origins, directions, None)
        hit = np.zeros(len(along), np.bool_)
        end = np.full((len(along), 3), np.nan, np.float32)
        octree_rays.cast(
            starts, along, self.resolution, self._values, self._table_codes, self._table_slots,
            float(max_range), bool(ignore_unknown), hit, end,
        )  # fmt: skip
        return RayHits(hit, end)

    def cast_ray(
        self,
        origin: ArrayLike,
        direction: ArrayLike,
        *,
        max_range: float = -1.0,
        ignore_unknown: bool = False,
    ) -> Float64s | None:
        """Return the centre (3,) of the first occupied voxel on a ray, or None."""
        one = np.asarray(direction, dtype=np.float64).reshape(1, -1)
        hits = self.cast_rays(origin, one, max_range=max_range, ignore_unknown=ignore_unknown)
        return hits.end[0].astype(np.float64) if hits.hit[0] else None

    def _ray_arrays(
        self, origin: ArrayLike, points: ArrayLike, T_map_sensor: ArrayLike | None
    ) -> tuple[Float32s, Float32s]:
        """Return origins (1 or N, 3) and points (N, 3) as float32 of the map's frame."""
        xyz: NDArray[Any] = np.asarray(points)
        if xyz.dtype != np.float32 or xyz.ndim != 2 or xyz.shape[1] != 3:
            xyz = frames.check_points(points)
        start: NDArray[Any] = np.asarray(origin)
        if start.shape == (3,):
            start = start.reshape(1, 3)
        if start.shape != (1, 3) and start.shape != xyz.shape:
            raise InputError(
                f"origin must be (3,), or (N, 3) as the points {xyz.shape}; {start.shape} came"
            )
        if T_map_sensor is not None:
            T = frames.check_T(T_map_sensor, "T_map_sensor")
            start, xyz = frames.apply(T, start), frames.apply(T, xyz)
        return (
            np.ascontiguousarray(start, dtype=np.float32),
            np.ascontiguousarray(xyz, dtype=np.float32),
        )

    def _codes_at(self, xyz: NDArray[Any]) -> tuple[NDArray[np.int64], Bools]:
        """Return the Morton codes of the voxels of points, and which lie in the tree."""
        with np.errstate(invalid="ignore"):
            keys = np.floor(xyz.astype(np.float64) * (1.0 / self.resolution)) + KEY_ORIGIN
            inside: Bools = np.all((keys >= 0) & (keys < 2 * KEY_ORIGIN), axis=1)
        keys[~inside] = 0
        return morton.encode(keys.astype(np.uint16)), inside

    def _discretized(self, starts: Float32s, points: Float32s) -> tuple[Float32s, Float32s]:
        """Return origins (1 or M, 3) and the centres (M, 3) of the voxels that hold points."""
        codes, inside = self._codes_at(points)
        codes, first = np.unique(codes[inside], return_index=True)
        centres = (morton.decode(codes).astype(np.float64) - KEY_ORIGIN + 0.5) * self.resolution
        if len(starts) > 1:
            starts = starts[inside][first]
        return starts, centres.astype(np.float32)

    def _trace(
        self,
        box: NDArray[np.int64],
        starts: Float32s,
        ends: Float32s,
        state: NDArray[np.uint8],
    ) -> NDArray[np.int64]:
        """Set the bits of one scan, each thread those of its rays; return the addresses of hits."""
        scratch = self._scratch
        for bits in scratch:
            bits.open(box)
        at = scratch[0].mark_ends(ends, state, self.resolution)
        bounds = np.array([0, len(ends)])
        if len(scratch) > 1:
            bounds = np.empty(len(scratch) + 1, np.int64)
            octree_threads.share_rays(starts, ends, state, 1.0 / self.resolution, bounds)
        self._in_threads(
            lambda part: scratch[part].trace(
                starts, ends, state, self.resolution, int(bounds[part]), int(bounds[part + 1])
            )
        )
        for other in scratch[1:]:
            scratch[0].join(other)
        return at

    def _in_threads(self, work: Callable[[int], None]) -> None:
        """Call `work` with the number of each thread, all at once; 0 is the calling thread."""
        others = []
        if self._pool is not None:
            others = [self._pool.submit(work, part) for part in range(1, len(self._scratch))]
        work(0)
        for other in others:
            other.result()

    def _settle(self, at: NDArray[np.int64]) -> None:
        """Bring the marks of one scan into the log-odds. at: (N,) addresses of hits, or -1."""
        scratch = self._scratch[0]
        kernels.keep_ends(at, scratch.words)
        cubes, wanted = scratch.touched_cubes()
        slots = self._make_slots(wanted)
        limits = self.clamp_min, self.clamp_max
        bounds = np.linspace(0, len(cubes), len(self._scratch) + 1).astype(np.int64)
        self._in_threads(
            lambda part: kernels.apply_misses(
                cubes, slots, bounds[part], bounds[part + 1], scratch.words, self._values,
                self.miss, *limits,
            )
        )  # fmt: skip
        scratch.slot_of[cubes] = slots
        kernels.apply_hits(at, scratch.slot_of, scratch.words, self._values, self.hit, *limits)
        scratch.close(cubes)

    def _order(self) -> NDArray[np.int64]:
        """Return the slots of the blocks in Morton order."""
        return np.argsort(self._codes[: self._n_blocks], kind="stable")

    def _make_slots(self, wanted: NDArray[np.int64]) -> NDArray[np.int32]:
        """Return the slots of block codes; blocks that are not there begin unknown."""
        before = self._n_blocks
        self._reserve_codes(before + len(wanted))
        slots = np.empty(len(wanted), np.int32)
        self._n_blocks = kernels.make_blocks(
            wanted, self._codes, before, self._table_codes, self._table_slots, slots
        )
        self._reserve_values(self._n_blocks)
        kernels.clear_blocks(self._values, before, self._n_blocks)
        return slots

    def _reserve(self, n_blocks: int) -> None:
        self._reserve_codes(n_blocks)
        self._reserve_values(n_blocks)

    def _reserve_codes(self, n_blocks: int) -> None:
        """Make room for block codes, and keep the hash table at most half full."""
        if n_blocks > len(self._codes):
            codes = np.empty(max(n_blocks, len(self._codes) * 3 // 2), np.int64)
            codes[: self._n_blocks] = self._codes[: self._n_blocks]
            self._codes = codes
        if 2 * n_blocks > len(self._table_codes):
            size = 1 << (2 * n_blocks - 1).bit_length()
            self._table_codes = np.full(size, -1, np.int64)
            self._table_slots = np.zeros(size, np.int32)
            kernels.rehash(self._codes, self._n_blocks, self._table_codes, self._table_slots)

    def _reserve_values(self, n_blocks: int) -> None:
        if n_blocks > len(self._values):
            # in place where the system can remap pages: no moment with both copies
            room = max(n_blocks, len(self._values) * 5 // 4)
            self._values.resize((room, BLOCK), refcheck=False)

    def _take(self, blocks: Blocks) -> None:
        """Fill an empty tree with blocks."""
        slots = self._make_slots(blocks.codes)
        self._values[slots] = blocks.values


def log_odds(probability: float) -> np.float32:
    """Return ln(p / (1 - p)) as OctoMap rounds it, to float32."""
    return np.float32(math.log(probability / (1.0 - probability)))


def probability(log_odds: float) -> float:
    """Return the probability 1 / (1 + exp(-l)) that log-odds l stand for."""
    return 1.0 / (1.0 + math.exp(-log_odds))


def octree_from_points(
    xyz: ArrayLike, resolution: float, *, hit: float = 0.7, clamp_max: float = 0.971
) -> Leaves:
    """Return the leaves of a cloud without sensor origins: occupied where points are, else unknown.

    xyz: (N, 3) metres; a voxel gets one hit for each of its points, up to `clamp_max`, so that a
    voxel with one stray point is less sure than a voxel with ten. Points that are not finite or
    lie beyond the tree (32768 voxels from the origin) are left out.
    """
    tree = Octree(resolution, hit=hit, clamp_max=clamp_max)
    points = frames.check_points(xyz)
    codes, inside = tree._codes_at(points)
    codes, counts = np.unique(codes[inside], return_counts=True)
    n_max = math.ceil(tree.clamp_max / tree.hit) + 1
    sums = np.zeros(n_max + 1, np.float32)  # what n hits make, added one by one as a scan would
    for n in range(1, n_max + 1):
        sums[n] = min(sums[n - 1] + tree.hit, tree.clamp_max)
    value = sums[np.minimum(counts, n_max)]
    depth = np.full(len(codes), TREE_DEPTH, np.uint8)
    return morton.prune(Leaves(tree.resolution, morton.decode(codes), depth, value))
