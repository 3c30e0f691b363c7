"""LOAM: lidar odometry and mapping in one pass over the turns.

J. Zhang and S. Singh, "LOAM: Lidar Odometry and Mapping in Real-time", RSS 2014, as the source
paper uses it; degeneracy after Zhang, Kaess and Singh, ICRA 2016. What is done otherwise, and why,
stands in docs/odometry.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from commonmap.odometry.features import Features, pick_features
from commonmap.odometry.local_map import LocalMap, thin
from commonmap.odometry.map_match import match_map
from commonmap.odometry.motion import (
    damp_rate,
    deskew,
    motion_between,
    motion_to_T,
    place,
    sweep_motion,
)
from commonmap.odometry.records import ScanHealth
from commonmap.odometry.scan_match import RingedPoints, by_ring, match_scan
from commonmap.odometry.solve import NOTHING, Openness, Prior, Rows, residuals, settle
from commonmap.odometry.turn import Turn, arrange, select
from commonmap.types import Float64s, Scan

STILL = np.zeros(6)
STAY = np.eye(4)

LEAST_CHANGE = np.array([0.02, 0.02, 0.02, 0.005, 0.005, 0.005])
FIRST_CHANGE = np.array([0.15, 0.15, 0.15, 0.03, 0.03, 0.03])
"""Metres and radians by which the motion of one turn differs from that of the turn before, for
turns of 0.1 s: the least that is believed, and what is believed before any is seen. The prior is no
surer than that; it matters only where the scene says nearly nothing."""

WHOLE = 10
"""The first turns enter the map whole, of later ones every other planar point: most would fall into
voxels that are full."""

LEAST_MATCHED = 30
LEAST_SHARE = 0.15
"""Below so many matched features, or so small a share of those that looked, odometry is lost."""

FALL = 0.5
"""Odometry is lost where that share falls below so much of what it was in the turns before."""


@dataclass(frozen=True)
class LoamOptions:
    """Settings of `Loam`. Lengths that are None follow from the first turn.

    voxel: metres, edge of the fine map's voxels; the median range / 45 (0.3 to 1 m) unless given.
    coarse: the coarse map's voxels, in fine ones.
    n_planar: planar points a turn to register to the map, about.
    scan_rounds, map_rounds: how often partners are looked for, at most.
    tolerance: metres; a direction whose pose would be less certain is degenerate.
    deskew: whether the points were measured while the sensor moved (else all of a turn are of its
        stamp); None tries both on the first turns where the log has no time per point, and is True
        else.
    """

    voxel: float | None = None
    coarse: float = 3.0
    per_voxel: int = 20
    n_planar: int = 1500
    scan_rounds: int = 2
    map_rounds: int = 4
    tolerance: float = 0.1
    deskew: bool | None = None


@dataclass(frozen=True, eq=False)
class Taken:
    """A turn with what was chosen from it, points as measured (not deskewed), (N, 3) float64."""

    turn: Turn
    sharp: Float64s
    sharp_delay: Float64s
    sharp_ring: NDArray[np.int64]
    flat: Float64s
    flat_delay: Float64s
    flat_ring: NDArray[np.int64]
    edge: Float64s
    edge_delay: Float64s
    edge_ring: NDArray[np.int64]
    smooth: Float64s
    smooth_delay: Float64s
    smooth_ring: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Registered:
    """A pose found in the map. T: (4, 4), T_map_turn. rows: the constraints at it. directions:
    (K, 6) as in `Openness`. n_matched: rows that count."""

    T: Float64s
    rows: Rows
    directions: Float64s
    n_matched: int


class Loam:
    """The state of the odometry. Feed turns in order of time with `add`.

    poses, moments, health: one a turn so far.
    """

    def __init__(self, options: LoamOptions | None = None):
        self.options = options or LoamOptions()
        self.poses: list[Float64s] = []
        self.moments: list[float] = []
        self.health: list[ScanHealth] = []
        self._last: Taken | None = None
        self._rate: Float64s = STILL  # motion per second of the last turn, its own frame
        self._deskew_rate_last: Float64s = STILL
        self._stamp = 0.0
        self._change = FIRST_CHANGE  # see there; running mean
        self._share = 0.0  # of features that match, running mean of the turns that were not lost
        self._cell = 0.0
        self._cropped: Float64s = np.zeros(3)

    # ------------------------------------------------------------ one turn

    def add(self, scan: Scan) -> None:
        """Take in the next turn."""
        turn = arrange(scan)
        if self.options.deskew is False:  # all of it is of one moment already
            turn = replace(turn, moment=scan.stamp)
        if not self.poses:
            self._begin(turn)
            self._stamp = scan.stamp
            return
        if not turn.moment > self.moments[-1]:  # an empty turn, or one stray early point
            turn = replace(turn, moment=self.moments[-1] + max(scan.stamp - self._stamp, 1e-3))
        self._stamp = scan.stamp
        taken = self._take(turn)
        dt = turn.moment - self.moments[-1]
        # scan to scan: the prior
        T_last_turn = self._match_last(taken, dt)
        # scan to map: the pose
        T_map_turn, health = self._match_map(taken, self.poses[-1] @ T_last_turn, dt)
        self.poses.append(T_map_turn)
        self.moments.append(turn.moment)
        self.health.append(health)
        # the turn before lies between two known poses now: deskew it for good and keep it
        self._keep_last()
        self._rate = self._motion_of(T_map_turn, dt)
        self._last = taken

    def _begin(self, turn: Turn) -> None:
        """Derive the lengths from the first turn and make the maps."""
        o = self.options
        median = float(np.median(turn.range)) if len(turn.range) else 10.0
        self.voxel = float(np.clip(median / 45.0, 0.3, 1.0)) if o.voxel is None else o.voxel
        self.lever = median
        reach = float(np.clip(1.2 * turn.range.max(initial=10.0), 10.0, 250.0))
        self.fine = LocalMap(self.voxel, per_voxel=o.per_voxel, reach=reach)
        self.coarse = LocalMap(o.coarse * self.voxel, per_voxel=o.per_voxel, reach=reach)
        self.edges = LocalMap(2.0 * self.voxel, per_voxel=o.per_voxel, reach=reach)
        self._cell = 2.0 * self.voxel
        self.poses.append(np.eye(4))
        self.moments.append(turn.moment)
        self.health.append(ScanHealth(turn.moment, 0, 0.0, float("nan"), np.zeros((0, 6)), False))
        self._last = self._take(turn)

    def _take(self, turn: Turn) -> Taken:
        """Pick the features of a turn."""
        features: Features = pick_features(turn)
        smooth = features.smooth[thin(turn.xyz[features.smooth], self.fine.apart)]
        parts: list[NDArray[np.float64] | NDArray[np.int64]] = []
        for chosen in (features.sharp, features.flat, features.less_sharp, smooth):
            parts += select(turn.xyz, turn.delay, turn.ring, chosen)
        return Taken(turn, *parts)  # type: ignore[arg-type]

    def _motion_of(self, T_map_turn: Float64s, dt: float) -> Float64s:
        """Return the motion per second (6,) that led from the last pose to this one."""
        last = self.poses[-2 if len(self.poses) > 1 else -1]
        rate, _ = sweep_motion(motion_between(T_map_turn, last), dt)
        return rate

    def _foresee(self, dt: float) -> Prior:
        """Return where the motion of the turns before leads from the last pose, and how sure that
        is: from how much the motion changed between turns so far."""
        if len(self.poses) < 3:
            return NOTHING
        spread = np.maximum(self._change, LEAST_CHANGE) * max(dt / 0.1, 1.0) ** 2
        return Prior(motion_to_T(self._rate * dt), 1.0 / spread**2)

    def _learn(self, off: Float64s) -> None:
        """Take in by how much a motion differed from what was foreseen, (6,)."""
        square = np.minimum(off, 3.0 * self._change) ** 2
        self._change = np.sqrt(0.95 * self._change**2 + 0.05 * square)

    def _unskew(
        self, points: Float64s, delay: Float64s, rate: Float64s, bend: Float64s
    ) -> Float64s:
        return points if self.options.deskew is False else deskew(points, delay, rate, bend)

    # ------------------------------------------------------------ scan to scan

    def _match_last(self, taken: Taken, dt: float) -> Float64s:
        """Return T_last_turn from the features of this turn and the last (section V of LOAM)."""
        assert self._last is not None
        o, first, rate = self.options, len(self.poses) == 1, self._rate
        rounds = 8 if first else o.scan_rounds
        prior = self._foresee(dt)
        points = np.concatenate([taken.sharp, taken.flat])
        delay = np.concatenate([taken.sharp_delay, taken.flat_delay])
        ring = np.concatenate([taken.sharp_ring, taken.flat_ring])
        T = motion_to_T(rate * dt)
        before: tuple[RingedPoints, RingedPoints] | None = None
        for _ in range(rounds):
            # the first two turns are deskewed together, by the motion between them
            if before is None or first:
                before = self._ringed(self._last, rate if first else self._deskew_rate_last)
            here = self._unskew(points, delay, rate, STILL)
            reach = 1.0 if first else max(2.0 * self.voxel, 0.5)
            rows = match_scan(here, ring, len(taken.sharp), T, *before, reach)
            if len(rows) < 20:
                break
            T_new, _, _ = self._settle(T, rows, None, prior)
            step = self._moved(T, T_new)
            T = T_new
            new_rate, _ = sweep_motion(motion_between(T, STAY), dt)
            rate = damp_rate(new_rate, None if first else self._rate)
            if step < 0.05 * self.voxel:
                break
        if first:
            self._rate = rate
            self._deskew_rate_last = rate
            self._insert(self._last, self.poses[0], rate, STILL)
        return T

    def _ringed(self, last: Taken, rate: Float64s) -> tuple[RingedPoints, RingedPoints]:
        """Return the last turn's edges and planar points, deskewed, ready for look-up."""
        n = last.turn.n_rings
        edge = self._unskew(last.edge, last.edge_delay, rate, STILL)
        some = slice(None, None, max(1, len(last.smooth) // 6000))
        smooth = self._unskew(last.smooth[some], last.smooth_delay[some], rate, STILL)
        return by_ring(edge, last.edge_ring, n), by_ring(smooth, last.smooth_ring[some], n)

    # ------------------------------------------------------------ scan to map

    def _match_map(self, taken: Taken, T: Float64s, dt: float) -> tuple[Float64s, ScanHealth]:
        """Return T_map_turn and how well it is known (section VI of LOAM)."""
        chosen = thin(taken.smooth, self._cell)
        growth = np.sqrt(max(len(chosen), 1) / self.options.n_planar)
        self._cell = float(np.clip(self._cell * growth, 0.5 * self.voxel, 6.0 * self.voxel))
        points = np.concatenate([taken.smooth[chosen], taken.edge])
        delay = np.concatenate([taken.smooth_delay[chosen], taken.edge_delay])
        prior = self._foresee(dt)
        ahead = Prior(self.poses[-1] @ prior.T, prior.information)
        found = self._register(points, delay, len(chosen), T, ahead, dt)
        # a map of two or three turns is thin: that few features find a plane there is no trouble
        usual = max(LEAST_SHARE, FALL * self._share) if len(self.poses) >= 5 else 0.0
        enough = max(LEAST_MATCHED, usual * len(points))
        if found.n_matched < enough:  # the scans agree on a way that the map does not know: others?
            for start in (ahead.T, self.poses[-1]):
                other = self._register(points, delay, len(chosen), start, ahead, dt)
                found = other if other.n_matched > found.n_matched else found
        lost = found.n_matched < enough
        share = min(found.n_matched / max(len(points), 1), 1.0)
        if not lost:
            self._share += 0.1 * (share - self._share) if self._share else share
            T = found.T
            if prior is not NOTHING and not len(found.directions):
                self._learn(np.abs(motion_between(ahead.T, T)))
        self._deskew_rate_last = sweep_motion(motion_between(T, self.poses[-1]), dt)[0]
        R = np.ascontiguousarray(found.T[:3, :3])
        degenerate = np.hstack([found.directions[:, :3] @ R.T, found.directions[:, 3:] @ R.T])
        residual, rows = float("nan"), found.rows
        if len(rows):
            d = residuals(R, found.T[:3, 3].copy(), rows.p, rows.c, rows.u)
            residual = 1.4826 * float(np.median(np.abs(d)))
        moment = taken.turn.moment
        return T, ScanHealth(moment, found.n_matched, share, residual, degenerate, lost)

    def _register(
        self, points: Float64s, delay: Float64s, n_planar: int, T: Float64s, prior: Prior, dt: float
    ) -> Registered:
        """Return the pose to which rounds of matching to the map lead from T."""
        o, w, rows = self.options, np.zeros(0), Rows.room(0)
        open_: Openness | None = None
        asked: Float64s | None = None  # the pose at which the map was asked for partners
        for _ in range(o.map_rounds):
            rate, _ = sweep_motion(motion_between(T, self.poses[-1]), dt)
            here = self._unskew(points, delay, rate, STILL)
            if asked is None or self._moved(asked, T) > 0.2 * self.voxel:
                rows = match_map(here, n_planar, T, self.fine, self.coarse, self.edges)
                asked, open_ = T, None
            else:
                rows = rows.refresh(here)
            if len(rows) < LEAST_MATCHED:
                break
            T_new, open_, w = self._settle(T, rows, open_, prior)
            step = self._moved(T, T_new)
            T = T_new
            if step < 0.01 * self.voxel:
                break
        directions = np.zeros((0, 6)) if open_ is None else open_.directions
        return Registered(T, rows, directions, int((w > 0).sum()))

    def _settle(
        self, T: Float64s, rows: Rows, open_: Openness | None, prior: Prior
    ) -> tuple[Float64s, Openness, Float64s]:
        """Return what `settle` does; the pretended hold of noisy normals is taken off where a prior
        holds what is left open."""
        return settle(
            T, rows, open_, prior, lever=self.lever, tolerance=self.options.tolerance,
            correct=bool(prior.information.any()),
        )  # fmt: skip

    def _moved(self, T: Float64s, T_new: Float64s) -> float:
        """Return how far the scene moves between two poses, metres: shift and turn together."""
        step = motion_between(T, T_new)
        return float(np.linalg.norm(step[:3]) + self.lever * np.linalg.norm(step[3:]))

    # ------------------------------------------------------------ the map

    def _keep_last(self) -> None:
        """Deskew the turn before the last pose for good and insert it into the map."""
        if len(self.poses) < 3:
            return
        assert self._last is not None
        T, dt0 = self.poses[-2], self.moments[-2] - self.moments[-3]
        before = motion_between(T, self.poses[-3])
        after, dt1 = motion_between(T, self.poses[-1]), self.moments[-1] - self.moments[-2]
        rate, bend = sweep_motion(before, dt0, after, dt1)
        self._insert(self._last, T, rate, bend)

    def _insert(self, taken: Taken, T: Float64s, rate: Float64s, bend: Float64s) -> None:
        some = slice(len(self.poses) % 2, None, 2) if len(self.poses) > WHOLE else slice(None)
        smooth, delay = taken.smooth[some], taken.smooth_delay[some]
        smooth = place(T, self._unskew(smooth, delay, rate, bend))
        edge = place(T, self._unskew(taken.edge, taken.edge_delay, rate, bend))
        t = T[:3, 3]
        self.fine.insert(smooth)
        self.coarse.insert(smooth)
        self.edges.insert(edge)
        if float(np.linalg.norm(t - self._cropped)) > 0.1 * self.fine.reach:
            for part in (self.fine, self.coarse, self.edges):
                part.crop(np.ascontiguousarray(t))
            self._cropped = t.copy()
