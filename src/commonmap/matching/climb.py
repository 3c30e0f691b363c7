"""From where a coarser grid saw a peak to its top on this one.

Evidence has many small tops. What two cells apart can be the two sides of one peak on cells twice
as wide, and a yaw a little off is made up for by a shift. So a pose first looks about itself in
steps of whole cells and climbs from the best that it saw; the few poses that matter in the end
climb from everywhere about them.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numba
import numpy as np
from numpy.typing import NDArray

from commonmap.matching.evidence import (
    SPREAD,
    Columns,
    count_bits,
    sum_table,
    weigh,
    xlogx_table,
)
from commonmap.matching.tiles import Level
from commonmap.types import Float64s

MOST_STEPS = 12
"""Steps that a pose climbs on one level at most."""

YAWS_HELD = 5
"""Yaws at which a climb keeps the turned columns."""


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
    reach = float(np.hypot(*columns.xy.T).max()) + (0.5 * farthest + 1.0) * level.cell
    n_blocks = min(len(pose), 4 * workers) if level.whole is not None else len(pose)
    blocks = np.array_split(np.arange(len(pose)), max(1, n_blocks))

    def climb(block: NDArray[np.int64]) -> Float64s:
        if len(block) == 0:
            return np.zeros((0, 5))
        window, first_i, first_j = level.around(pose[block], reach)
        return np.asarray(
            _climb(
                window.occupied, window.known, level.origin, level.cell, columns.xy,
                columns.occupied, columns.known, columns.n_slabs, pose[block], yaw_step,
                least_pairs, starts, each, farthest + 1, table, first_i, first_j,
            )
        )  # fmt: skip

    with ThreadPoolExecutor(max_workers=workers) as pool:
        rows = np.concatenate([np.zeros((0, 5)), *pool.map(climb, blocks)])
    return rows[:, :3], rows[:, 3], rows[:, 4]


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _climb(  # type: ignore[no-untyped-def]
    t_occupied, t_known, origin, cell, xy, s_occupied, s_known, n_slabs, poses, yaw_step,
    least_pairs, starts, each, middle, xlogx, first_i, first_j,
):  # fmt: skip
    """Return (P, 5) x, y, yaw, score, pairs of the tops that poses (P, 3) reach.

    Every node of the lattice is scored once; `middle` is the pose's own index in it.
    """
    out = np.empty((poses.shape[0], 5))
    farthest = 0.0
    for n in range(xy.shape[0]):
        farthest = max(farthest, xy[n, 0] ** 2 + xy[n, 1] ** 2)
    side = 2 * int(np.ceil(np.sqrt(farthest) / cell)) + 3
    laid = np.empty((4 * YAWS_HELD, 2, side, side), np.uint32)
    holds = np.empty(4 * YAWS_HELD, np.int64)
    size = 2 * middle + 1
    score, pairs = np.empty((size, size, size)), np.zeros((size, size, size), np.int64)
    lanes = np.zeros((4, 8 * ((n_slabs + 7) // 8)), np.int64)
    at, way, top = np.empty(3, np.int64), np.empty(3, np.int64), np.empty(3, np.int64)
    for p in range(poses.shape[0]):
        score[:] = np.nan
        holds[:] = -1
        best, first = -np.inf, 0
        for s in range(0 if each else starts.shape[0]):
            at[:] = middle + starts[s]
            value = _score(
                t_occupied, t_known, origin, cell, xy, s_occupied, s_known, n_slabs, poses[p],
                yaw_step, least_pairs, middle, xlogx, first_i, first_j, at, laid, holds, lanes,
                score, pairs,
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
                                t_occupied, t_known, origin, cell, xy, s_occupied, s_known,
                                n_slabs, poses[p], yaw_step, least_pairs, middle, xlogx, first_i,
                                first_j, at, laid, holds, lanes, score, pairs,
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
            out[p, k] = poses[p, k] + (top[k] - middle) * 0.5 * cell
        out[p, 2] = poses[p, 2] + (top[2] - middle) * yaw_step
        out[p, 3], out[p, 4] = best, pairs[top[0], top[1], top[2]]
    return out


@numba.njit(cache=True, nogil=True)  # type: ignore[misc]
def _score(  # type: ignore[no-untyped-def]
    t_occupied, t_known, origin, cell, xy, s_occupied, s_known, n_slabs, pose, yaw_step,
    least_pairs, middle, xlogx, first_i, first_j, at, laid, holds, lanes, score, pairs,
):  # fmt: skip
    """Return the evidence of a node, looked up or counted; -inf with too few pairs.

    laid: (4 YAWS_HELD, 2, side, side) the columns on cells, once for a yaw and each of the four
    shifts by half cells: nodes that lie whole cells apart share them. holds: the yaw of each.
    """
    a, b, c = at
    if score[a, b, c] == score[a, b, c]:
        return score[a, b, c]
    side = laid.shape[2]
    half_a, half_b = (a - middle) & 1, (b - middle) & 1
    dx = pose[0] + half_a * 0.5 * cell - origin[0]
    dy = pose[1] + half_b * 0.5 * cell - origin[1]
    i0 = int(np.floor(dx / cell)) - side // 2
    j0 = int(np.floor(dy / cell)) - side // 2
    slot = (c % YAWS_HELD) * 4 + half_a * 2 + half_b
    if holds[slot] != c:
        holds[slot] = c
        laid[slot] = 0
        yaw = pose[2] + (c - middle) * yaw_step
        cosine, sine = np.cos(yaw), np.sin(yaw)
        for n in range(xy.shape[0]):
            i = int(np.floor((cosine * xy[n, 0] - sine * xy[n, 1] + dx) / cell)) - i0
            j = int(np.floor((sine * xy[n, 0] + cosine * xy[n, 1] + dy) / cell)) - j0
            laid[slot, 0, i, j] |= s_occupied[n]
            laid[slot, 1, i, j] |= s_known[n]
    i0 += (a - middle) // 2 - first_i
    j0 += (b - middle) // 2 - first_j
    count_bits(
        laid[slot, 0], laid[slot, 1], t_occupied, t_known, i0, j0, lanes.shape[1] // 8, SPREAD,
        lanes,
    )  # fmt: skip
    most = lanes[0, :n_slabs].max()
    evidence, doubt = sum_table(lanes[:, :n_slabs].T, xlogx)
    score[a, b, c] = weigh(evidence, doubt) if most >= least_pairs else -np.inf
    pairs[a, b, c] = most
    return score[a, b, c]
