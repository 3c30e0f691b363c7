"""Octrees moved into one frame and fused: who saw what, and where two robots disagree, kept apart.

`resample` moves a tree by any rigid motion into voxels of any size. The motion rarely takes voxels
onto voxels, so each new voxel is filled by volume: what share of it lies in occupied, in free and
in unknown space of the source. `merge` adds log-odds voxel by voxel (Hornung et al. 2013, eq. 2).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from commonmap.errors import InputError
from commonmap.frames import check_T, invert
from commonmap.io import morton
from commonmap.mapping.octree import log_odds
from commonmap.mapping.octree_blocks import (
    MAX_BLOCKS,
    Blocks,
    blocks_to_labelled_leaves,
    blocks_to_leaves,
    hash_blocks,
    leaves_to_blocks,
)
from commonmap.merging import octree_kernels as kernels
from commonmap.types import KEY_ORIGIN, Bools, Leaves

SAMPLES = 3
"""Sample points along each axis of the smaller of the two voxels, by which volume is measured."""

MOST_SAMPLES = 12
"""Sample points along each axis of a target voxel, at most."""

OCCUPIED_SHARE = 0.25
"""A voxel is occupied where at least this share of its volume is. A wall one voxel thick, however
it lies, fills a quarter of some voxel of every column it crosses, and so keeps no hole."""

KNOWN_SHARE = 0.5
"""A voxel that is not occupied is free where at least this share of its volume is known."""

MAX_ROBOTS = 32


@dataclass(frozen=True)
class MergeRule:
    """How log-odds of several robots become one: its name, what it does, its number in kernels."""

    name: str
    meaning: str
    code: int


MERGE_RULES: Mapping[str, MergeRule] = MappingProxyType(
    {
        rule.name: rule
        for rule in (
            MergeRule("add", "log-odds are added, then clamped", kernels.ADD),
            MergeRule("keep-target", "what the target knows stays; elsewhere add", kernels.KEEP),
            MergeRule("occupied-wins", "the largest log-odds of all", kernels.LARGEST),
        )
    }
)


@dataclass(frozen=True, eq=False)
class MergedOctree:
    """Several octrees in one.

    leaves: in the frame of the target, in Morton order, joined where all three layers agree
        (`commonmap.io.morton.prune` joins further, by log-odds alone).
    provenance: (N,) uint32, bit 0: the target saw the leaf, bit i: source i (from 1) saw it.
    conflict: (N,) one robot says occupied, another free.
    """

    leaves: Leaves
    provenance: NDArray[np.uint32]
    conflict: Bools

    def seen_by(self, robot: int) -> Bools:
        """Return (N,) whether a robot saw the leaf: 0 is the target, i the i-th source from 1."""
        seen: Bools = np.bitwise_and(self.provenance, np.uint32(1 << robot)) > 0
        return seen


def resample(leaves: Leaves, T_target_source: ArrayLike, resolution: float) -> Leaves:
    """Return the octree in the target's frame, in voxels of `resolution` metres, pruned.

    A target voxel is occupied where at least a quarter of its volume is occupied in the source, or
    where it holds the centre of an occupied voxel of the source (so that nothing thin vanishes);
    else free where at least half of it is known; else unknown. Its log-odds are the mean over the
    known part by volume, but of the sign of its class: at least the occupied (at most the free)
    log-odds times the share of volume they fill. The identity at the same resolution changes
    nothing, and so do shifts by whole voxels. Volume is measured at sample points, 3 along an edge
    of the smaller of the two voxels.

    Bounds, r the edge of the larger voxel: every occupied source voxel has an occupied target voxel
    whose centre is at most sqrt(3)/2 r from its own; every occupied target voxel overlaps an
    occupied source voxel, so the centres are at most sqrt(3) r apart. There and back again: nothing
    occupied is farther than sqrt(3) r from where it was, and nothing new farther than 2 sqrt(3) r.
    """
    T = check_T(T_target_source, "T_target_source")
    if not (np.isfinite(resolution) and resolution > 0):
        raise InputError(f"resolution must be a voxel edge in metres above 0; {resolution} came")
    if np.array_equal(T, np.eye(4)) and resolution == leaves.resolution:
        return morton.prune(leaves)
    return blocks_to_leaves(resample_blocks(leaves_to_blocks(leaves), T, resolution))


def resample_blocks(source: Blocks, T_target_source: ArrayLike, resolution: float) -> Blocks:
    """Return voxels in the target's frame: `resample` before pruning."""
    T = check_T(T_target_source, "T_target_source")
    codes = _blocks_reached(source, T, resolution)
    ratio = resolution / source.resolution
    samples = int(min(max(SAMPLES, np.ceil(SAMPLES * ratio)), MOST_SAMPLES))
    A, b = _voxel_motion(invert(T), resolution, source.resolution)
    values = np.full((len(codes), 512), np.nan, np.float32)
    table = hash_blocks(source.codes)
    kernels.fill_by_volume(
        codes, values, source.values, *table, A, b, samples, OCCUPIED_SHARE, KNOWN_SHARE
    )
    A, b = _voxel_motion(T, source.resolution, resolution)
    part = np.float32(min(1.0, ratio**-3))
    kernels.keep_centres(source.codes, source.values, A, b, part, values, *hash_blocks(codes))
    known = ~np.isnan(values).all(axis=1)
    return Blocks(float(resolution), codes[known], values[known])


def merge(
    target: Leaves,
    sources: Sequence[tuple[Leaves, ArrayLike]],
    *,
    mode: str = "add",
    resolution: float | None = None,
    clamp_min: float = 0.1192,
    clamp_max: float = 0.971,
) -> MergedOctree:
    """Return one octree of the target and of every source moved into the target's frame.

    sources: (leaves, T_target_source) each. mode: a name of `MERGE_RULES`. resolution: of the
    result, metres; the target's where not given. clamp_min, clamp_max: probabilities between which
    a sum is kept; what one robot alone saw stays as it is.

    Sums are made in double precision, so the order of maps that share a frame changes nothing but
    the last bit. Unknown of one robot never weakens what another saw.
    """
    if mode not in MERGE_RULES:
        raise InputError(f"mode must be one of {', '.join(MERGE_RULES)}; {mode!r} came")
    if len(sources) >= MAX_ROBOTS:
        raise InputError(f"at most {MAX_ROBOTS} maps are merged at once; {len(sources) + 1} came")
    edge = target.resolution if resolution is None else float(resolution)
    maps = [_moved(leaves, T, edge) for leaves, T in [(target, np.eye(4)), *sources]]
    codes = np.unique(np.concatenate([m.codes for m in maps]))
    total = np.zeros((len(codes), 512))
    seen = np.zeros((len(codes), 512), np.int64)
    for robot, blocks in enumerate(maps):
        rows = np.searchsorted(codes, blocks.codes)
        kernels.accumulate(rows, blocks.values, robot, MERGE_RULES[mode].code, total, seen)
    values, labels = np.empty(total.shape, np.float32), np.empty(total.shape, np.int64)
    low, high = float(log_odds(clamp_min)), float(log_odds(clamp_max))
    kernels.settle(total, seen, MERGE_RULES[mode].code, low, high, values, labels)
    leaves, label = blocks_to_labelled_leaves(Blocks(edge, codes, values), labels)
    provenance = (label & 0xFFFFFFFF).astype(np.uint32)
    return MergedOctree(leaves, provenance, (label >> 32) > 0)


def _moved(leaves: Leaves, T_target_source: ArrayLike, resolution: float) -> Blocks:
    T = check_T(T_target_source, "T_target_source")
    blocks = leaves_to_blocks(leaves)
    if np.array_equal(T, np.eye(4)) and resolution == leaves.resolution:
        return blocks
    return resample_blocks(blocks, T, resolution)


def _voxel_motion(
    T_a_b: NDArray[np.float64], edge_b: float, edge_a: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (A, b) that take voxel coordinates of b (keys, not whole) to those of a."""
    A = T_a_b[:3, :3] * (edge_b / edge_a)
    b = T_a_b[:3, 3] / edge_a + KEY_ORIGIN - A @ np.full(3, float(KEY_ORIGIN))
    return A, b


def _blocks_reached(
    source: Blocks, T_target_source: NDArray[np.float64], resolution: float
) -> NDArray[np.int64]:
    """Return the codes of the target blocks that the moved blocks of the source can touch."""
    A, b = _voxel_motion(T_target_source, source.resolution, resolution)
    low, high = kernels.reach(source.codes, A, b)
    if len(low) and (low.min() < 0 or high.max() >= 2 * KEY_ORIGIN >> 3):
        raise InputError(
            f"an octree reaches {KEY_ORIGIN * resolution:g} m from the origin of its frame at"
            f" {resolution:g} m voxels; the moved map lies beyond that"
        )
    pieces = [np.empty(0, np.int64)]
    counts = np.prod(high - low + 1, axis=1, dtype=np.float64)
    ends = np.cumsum(counts)
    start = 0
    while start < len(low):  # some at a time, so that repeats do not pile up
        stop = max(start + 1, int(np.searchsorted(ends, ends[start] + 4 * MAX_BLOCKS)))
        if counts[start] > MAX_BLOCKS:
            break
        pieces.append(np.unique(kernels.list_blocks(low[start:stop], high[start:stop])))
        start = stop
    codes = np.unique(np.concatenate(pieces))
    if start < len(low) or len(codes) > MAX_BLOCKS:
        raise InputError(
            f"the octree has too many voxels at a resolution of {resolution:g} m;"
            " give a coarser one"
        )
    return codes
