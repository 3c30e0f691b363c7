"""From where a coarser grid saw a peak to its top on this one.

Evidence has many small tops. What two cells apart can be the two sides of one peak on cells twice
as wide, and a yaw a little off is made up for by a shift. So a pose first looks about itself in
steps of whole cells and climbs from the best that it saw; the few poses that matter in the end
climb from everywhere about them.

Poses are counted word by word, 64 cells at a time (`planes.py`): both maps are bit planes, one a
slab, and the four counts of a slab are population counts of words joined. A turned source serves
all poses of its yaw.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from commonmap.matching.evidence import sum_table, weigh, xlogx_table
from commonmap.matching.levels import Level
from commonmap.matching.planes import Words, count_planes, pack_planes, turn_planes
from commonmap.matching.slabs import Columns, SlabGrid, is_shared
from commonmap.matching.threads import in_order
from commonmap.types import Float64s

MOST_STEPS = 12
"""Steps that a pose climbs on one level at most."""

KEPT_YAWS = 32
"""Turned sources that are kept for the poses to come."""


def starts_around(cells: int, yaws: int, *, apart: int = 1) -> NDArray[np.int64]:
    """Return (S, 3) nodes of the lattice of `climb_all`, the pose itself first.

    So many whole cells to each side along x and y, and so many whole yaws; `apart` makes every step
    in yaw that many yaws.
    """
    x, y, yaw = (np.arange(-n, n + 1) for n in (cells, cells, yaws))
    nodes = np.stack(np.meshgrid(x, y, yaw, indexing="ij"), axis=-1).reshape(-1, 3)
    nodes = nodes[np.argsort(np.abs(nodes).sum(axis=1), kind="stable")]
    return np.ascontiguousarray(nodes * np.array([2, 2, 2 * apart]), dtype=np.int64)


HERE = starts_around(0, 0)
"""Only the pose itself."""


def climb_all(
    level: Level,
    columns: Columns,
    pose: Float64s,
    *,
    yaw_step: float,
    least_pairs: float,
    starts: NDArray[np.int64],
    each: bool = False,
    workers: int = 1,
) -> tuple[Float64s, Float64s, Float64s]:
    """Return every pose (P, 3) moved to a local maximum of this level, its score and its pairs.

    The nodes of the lattice about a pose lie half a cell and `yaw_step` radians apart. It climbs
    from the best of its starts, or from each of them (the best top counts). least_pairs: known
    pairs that a pose needs; where no start has as many, the score is -inf.
    """
    table = xlogx_table(len(columns.xy) + 1)
    farthest = MOST_STEPS + int(np.abs(starts).max())
    radius = float(np.hypot(*columns.xy.T).max())
    reach = radius + (0.5 * farthest + 1.0) * level.cell
    side = 2 * int(np.ceil(radius / level.cell)) + 5
    pad = side // 64 + 2
    alike = is_shared(columns.known, columns.n_slabs)
    # one after the other in yaw, so that a turned source serves many
    order = np.argsort(pose[:, 2], kind="stable")
    n_blocks = workers if level.whole is not None else len(pose)
    blocks = np.array_split(order, max(1, n_blocks))
    xy = np.ascontiguousarray(columns.xy.T)
    whole = None if level.whole is None else _pack(level.whole, pad, alike)

    def climb(block: NDArray[np.int64]) -> Float64s:
        if len(block) == 0:
            return np.zeros((0, 5))
        window, first_i, first_j = level.around(pose[block], reach)
        return np.asarray(
            _climb(
                *(whole or _pack(window, pad, alike)), pad, level.origin, level.cell, first_i,
                first_j, xy, columns.occupied, columns.known, columns.n_slabs, side,
                pose[block], yaw_step, least_pairs, starts, each, farthest + 1, table,
            )
        )  # fmt: skip

    rows = np.empty((len(pose), 5))
    rows[order] = np.concatenate([np.zeros((0, 5)), *in_order(climb, blocks, workers)])
    return rows[:, :3], rows[:, 3], rows[:, 4]


def _pack(window: SlabGrid, pad: int, source_alike: bool) -> tuple[Words, Words]:
    """Return the occupied and the known planes; of the known one where both maps know alike."""
    alike = source_alike and is_shared(window.known, window.n_slabs)
    return (
        pack_planes(window.occupied, window.n_slabs, pad),
        pack_planes(window.known, 1 if alike else window.n_slabs, pad, alone=alike),
    )


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _snap(value, step):  # type: ignore[no-untyped-def]
    """Return the multiple of a step that lies within a millionth of it, else the value."""
    nearest = np.round(value / step) * step
    return nearest if abs(value - nearest) < 1e-6 * step else value


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _climb(  # type: ignore[no-untyped-def]
    t_occupied, t_known, pad, origin, cell, first_i, first_j, xy, s_occupied, s_known, n_slabs,
    side, poses, yaw_step, least_pairs, starts, each, middle, xlogx,
):  # fmt: skip
    """Return (P, 5) x, y, yaw, score, pairs of the tops that poses (P, 3) reach.

    t_occupied, t_known: planes of a window of the target that holds all that the source reaches;
    its first cell is (first_i, first_j) of the grid at `origin`. side: cells, odd, of a square
    about the source at any yaw. Every node of the lattice is scored once; `middle` is the pose's
    own index in it.
    """
    out = np.empty((poses.shape[0], 5))
    n_words = (side + 63) // 64
    n_planes, n_known = t_occupied.shape[2], t_known.shape[2]
    half_o = np.empty((2 * side, 2 * n_words, n_planes), np.uint64)
    half_k = np.empty((2 * side, 2 * n_words, n_known), np.uint64)
    kept = np.full((KEPT_YAWS, 3), np.nan)  # yaw, and where in its cell the source's origin lies
    turned_o = np.empty((KEPT_YAWS, 4, side, n_words, n_planes), np.uint64)
    turned_k = np.empty((KEPT_YAWS, 4, side, n_words, n_known), np.uint64)
    counts = np.empty((4, n_planes), np.uint64)
    size = 2 * middle + 1
    score, pairs = np.empty((size, size, size)), np.zeros((size, size, size), np.int64)
    at, way, top = np.empty(3, np.int64), np.empty(3, np.int64), np.empty(3, np.int64)
    place = np.empty(5)  # cell and place in it of the pose, in cells, and its yaw
    for p in range(poses.shape[0]):
        score[:] = np.nan
        # poses that come from a lattice lie on it to the last bit
        for k in range(2):
            place[k] = _snap((poses[p, k] - origin[k]) / cell, 1.0 / 4096.0)
            place[2 + k] = place[k] - np.floor(place[k])
            place[k] = np.floor(place[k])
        place[4] = _snap(poses[p, 2], yaw_step)
        best, first = -np.inf, 0
        for s in range(0 if each else starts.shape[0]):
            at[:] = middle + starts[s]
            value = _score(
                t_occupied, t_known, pad, cell, first_i, first_j, xy, s_occupied, s_known, place,
                yaw_step, least_pairs, middle, xlogx, at, n_slabs, half_o, half_k, kept, turned_o,
                turned_k, counts, score, pairs,
            )  # fmt: skip
            if value > best + 1e-9:
                best, first = value, s
        best = -np.inf
        top[:] = middle
        for s in range(0 if each else first, starts.shape[0] if each else first + 1):
            way[:] = middle + starts[s]
            here = -np.inf
            for _ in range(MOST_STEPS):
                a0, b0, c0 = way
                won = False
                for c in range(c0 - 1, c0 + 2):
                    for a in range(a0 - 1, a0 + 2):
                        for b in range(b0 - 1, b0 + 2):
                            at[0], at[1], at[2] = a, b, c
                            value = _score(
                                t_occupied, t_known, pad, cell, first_i, first_j, xy, s_occupied,
                                s_known, place, yaw_step, least_pairs, middle, xlogx, at, n_slabs,
                                half_o, half_k, kept, turned_o, turned_k, counts, score, pairs,
                            )  # fmt: skip
                            if value > here + 1e-9:
                                here, won = value, True
                                way[:] = at
                if not won:
                    break  # nothing about is better
            if here > best + 1e-9:
                best = here
                top[:] = way
        for k in range(2):
            out[p, k] = origin[k] + (place[k] + place[2 + k] + 0.5 * (top[k] - middle)) * cell
        out[p, 2] = _snap(place[4] + (top[2] - middle) * yaw_step, yaw_step)
        out[p, 3], out[p, 4] = best, pairs[top[0], top[1], top[2]]
    return out


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _score(  # type: ignore[no-untyped-def]
    t_occupied, t_known, pad, cell, first_i, first_j, xy, s_occupied, s_known, place, yaw_step,
    least_pairs, middle, xlogx, at, n_slabs, half_o, half_k, kept, turned_o, turned_k, counts,
    score, pairs,
):  # fmt: skip
    """Return the evidence of a node, looked up or counted; -inf with too few pairs.

    turned_o, turned_k: the planes of turned sources, of the yaws and places in `kept`.
    """
    a, b, c = at
    if score[a, b, c] == score[a, b, c]:
        return score[a, b, c]
    yaw = _snap(place[4] + (c - middle) * yaw_step, yaw_step)
    slot = int(np.round(yaw / yaw_step)) % KEPT_YAWS
    if kept[slot, 0] != yaw or kept[slot, 1] != place[2] or kept[slot, 2] != place[3]:
        kept[slot, 0], kept[slot, 1], kept[slot, 2] = yaw, place[2], place[3]
        turn_planes(
            xy, s_occupied, s_known, yaw, cell, place[2], place[3], half_o, half_k,
            turned_o[slot], turned_k[slot],
        )  # fmt: skip
    i, j = a - middle, b - middle
    around = (turned_o.shape[2] - 1) // 2
    way = 2 * (i & 1) + (j & 1)
    count_planes(
        turned_o[slot, way], turned_k[slot, way], t_occupied, t_known,
        int(place[0]) + (i >> 1) - around - first_i, int(place[1]) + (j >> 1) - around - first_j,
        pad, counts,
    )  # fmt: skip
    most = int(counts[0, :n_slabs].max())
    evidence, doubt = sum_table(counts[:, :n_slabs].T, xlogx)
    node = at[0], at[1], at[2]
    score[node] = weigh(evidence, doubt) if most >= least_pairs else -np.inf
    pairs[node] = most
    return score[node]
