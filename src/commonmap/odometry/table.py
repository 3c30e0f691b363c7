"""The ways to a trajectory, one table. `estimate` runs a row of it over a stream of scans."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from itertools import chain, islice

import numpy as np

from commonmap.errors import InputError, MissingExtraError
from commonmap.frames import check_T
from commonmap.odometry.geometry import complete_scans
from commonmap.odometry.georeference import covers
from commonmap.odometry.kiss import estimate_kiss_icp
from commonmap.odometry.loam import Loam, LoamOptions
from commonmap.odometry.records import Odometry, ScanHealth, Trouble
from commonmap.types import Progress, Scan, Trajectory, no_progress

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class OdometryMethod:
    """A row of the table.

    run: takes scans (ring and time per point), the options and the progress; gives the answer.
    extra: the optional package it needs, empty for none. needs_poses: poses must be given.
    """

    run: Callable[[Iterable[Scan], LoamOptions, Progress], Odometry] | None
    summary: str
    extra: str = ""
    needs_poses: bool = False

    def available(self) -> str:
        """Return why the row cannot be used, empty where it can."""
        if self.extra and find_spec(self.extra.replace("-", "_")) is None:
            return f"it needs the package {self.extra} (pip install {self.extra})"
        return ""


def estimate(
    scans: Iterable[Scan],
    *,
    method: str = "loam",
    poses: Trajectory | None = None,
    options: LoamOptions | None = None,
    progress: Progress = no_progress,
) -> Odometry:
    """Return where the sensor was at each turn, from the turns alone.

    scans: in order of time, read once, one at a time. Turns without rings or times (all the same)
        get them from the geometry, with a note.
    method: a row of `ODOMETRY`. poses: for method "poses", the trajectory that is known.
    options: of LOAM.
    """
    if method not in ODOMETRY:
        raise InputError(f"odometry must be one of {', '.join(ODOMETRY)}; '{method}' came")
    row = ODOMETRY[method]
    missing = row.available()
    if missing:
        raise MissingExtraError(f"odometry '{method}' cannot run: {missing}")
    if row.needs_poses != (poses is not None):
        need = "needs" if row.needs_poses else "does not take"
        raise InputError(f"odometry '{method}' {need} known poses")
    if poses is not None:
        return take_poses(check_order(scans), poses, progress)
    assert row.run is not None
    notes: list[str] = []
    completed = complete_scans(check_order(scans), notes)
    answer = row.run(completed, options or LoamOptions(), progress)
    for note in notes:
        log.warning("%s", note)
    return replace(answer, notes=(*notes, *answer.notes))


def check_order(scans: Iterable[Scan]) -> Iterator[Scan]:
    """Yield the scans; raise where arrays are of unequal length, times are not finite or fall."""
    last, number = -np.inf, -1
    for number, scan in enumerate(scans):
        n = len(scan.xyz)
        if scan.xyz.shape != (n, 3) or scan.time.shape != (n,) or scan.ring.shape != (n,):
            raise InputError(
                f"scan {number} must have (N, 3) points, (N,) times and (N,) rings; shapes "
                f"{scan.xyz.shape}, {scan.time.shape} and {scan.ring.shape} came"
            )
        if not (np.isfinite(scan.stamp) and np.isfinite(scan.time).all()):
            raise InputError(f"scan {number} must have finite times; NaN or infinity came")
        if scan.stamp <= last:
            raise InputError(
                f"scans must come in order of time; scan {number} is of {scan.stamp:.6f} s, "
                f"the one before of {last:.6f} s"
            )
        last = scan.stamp
        yield scan
    if number < 0:
        raise InputError("odometry needs at least one scan; none came")


TRIAL_TURNS = 10
MOST_TRIAL_TURNS = 60
"""Turns on which both readings of a log without times are tried: more where the first cannot tell,
as of a robot that stands."""

CLEAR = 1.05
"""Residuals of the two readings differ by this ratio where the turns tell them apart."""


def estimate_loam(scans: Iterable[Scan], options: LoamOptions, progress: Progress) -> Odometry:
    """Return the trajectory by LOAM."""
    progress("odometry")
    stream = iter(scans)
    first = list(islice(stream, TRIAL_TURNS))
    notes: tuple[str, ...] = ()
    if options.deskew is None and not all(scan.timed for scan in first):
        trial = Trial(options)
        trial.add(first)
        while not trial.clear and len(first) < MOST_TRIAL_TURNS:
            more = list(islice(stream, TRIAL_TURNS))
            if not more:
                break
            trial.add(more)
            first += more
        options = replace(options, deskew=trial.deskew)
        notes = (trial.tell(),)
    loam = Loam(options)
    for number, scan in enumerate(chain(first, stream)):
        loam.add(scan)
        if number % 50 == 49:
            progress(f"odometry, {number + 1} turns")
    trajectory = Trajectory(np.array(loam.moments), np.array(loam.poses))
    notes += describe_health(loam.health)
    deskewed = options.deskew is False
    return Odometry("loam", trajectory, tuple(loam.health), notes, deskewed)


class Trial:
    """Whether turns without times were measured while the sensor moved, or moved to one moment by
    whoever made the log: both readings go through LOAM, and the one whose features lie closer to
    the map is taken."""

    def __init__(self, options: LoamOptions):
        self._both = [Loam(replace(options, deskew=deskew)) for deskew in (True, False)]

    def add(self, scans: Iterable[Scan]) -> None:
        """Take in the next turns."""
        for scan in scans:
            for loam in self._both:
                loam.add(scan)

    @property
    def residual(self) -> tuple[float, float]:
        """Metres, the mean residual with deskewing by the derived times and without."""
        found = []
        for loam in self._both:
            known = [h.residual for h in loam.health[2:] if np.isfinite(h.residual)]
            found.append(float(np.mean(known)) if known else np.inf)
        return found[0], found[1]

    @property
    def clear(self) -> bool:
        """Whether one reading fits clearly better."""
        here, given = self.residual
        return not 1.0 / CLEAR < here / max(given, 1e-9) < CLEAR

    @property
    def deskew(self) -> bool:
        """Whether the turns are to be deskewed."""
        here, given = self.residual
        return here < given

    def tell(self) -> str:
        """Return the decision as a sentence."""
        here, given = self.residual
        does = "deskewed here" if self.deskew else "taken as already deskewed"
        return (
            f"the scans are {does}: features lie within {here * 1e3:.1f} mm of the map with "
            f"deskewing by the derived times and within {given * 1e3:.1f} mm without"
        )


def describe_health(health: Sequence[ScanHealth]) -> tuple[str, ...]:
    """Return one sentence for each stretch of turns in trouble."""
    return tuple(trouble.tell() for trouble in find_troubles(health))


def find_troubles(health: Sequence[ScanHealth]) -> tuple[Trouble, ...]:
    """Return the stretches of turns in trouble, in order of time."""
    troubles: list[Trouble] = []
    start = 0
    kinds = ["lost" if h.lost else "degenerate" if len(h.degenerate) else "" for h in health]
    for k in range(1, len(kinds) + 1):
        if k < len(kinds) and kinds[k] == kinds[start]:
            continue
        if kinds[start]:
            middle = health[(start + k) // 2] if k - start > 1 else health[start]
            troubles.append(
                Trouble(
                    kinds[start], health[start].moment, health[k - 1].moment, k - start,
                    middle.degenerate,
                )
            )  # fmt: skip
        start = k
    return tuple(troubles)


BREAK = 5
"""So many guessed poses in a row (half a second) part a log: where the motion changes by a few
centimetres a turn, the last of them is off by more than a voxel, and what comes behind with it."""


def find_sound_part(health: Sequence[ScanHealth]) -> range:
    """Return the most turns in a row that no stretch of `BREAK` lost turns or more parts."""
    start = -1
    longest = range(0)
    lost = 0
    for k, h in enumerate(health):
        lost = lost + 1 if h.lost else 0
        if lost == BREAK:
            start = -1  # the part ended before this stretch
        if not h.lost:
            start = k if start < 0 else start
            if k + 1 - start > len(longest):
                longest = range(start, k + 1)
    return longest


def take_poses(scans: Iterable[Scan], poses: Trajectory, progress: Progress) -> Odometry:
    """Return the known poses as an answer; the scans must lie within their time."""
    T = np.array([check_T(T, "a pose") for T in poses.T_map_sensor])
    if len(poses.time) < 2 or len(T) != len(poses.time) or (np.diff(poses.time) <= 0).any():
        raise InputError("known poses must be at least two, with rising times")
    progress("odometry")
    known = Trajectory(np.asarray(poses.time, np.float64), T)
    stamps, n_outside = [], 0
    first, last = np.inf, -np.inf
    spread = False  # points that all have the time of their turn were moved there
    for scan in scans:
        spread = spread or bool((scan.time != scan.time[:1]).any())
        stamps.append(scan.stamp)
        n_outside += not covers(known, scan)
        first = min(first, float(scan.time.min(initial=scan.stamp)))
        last = max(last, float(scan.time.max(initial=scan.stamp)))
    if n_outside == len(stamps):
        raise InputError(
            f"known poses must cover the scans ({stamps[0]:.3f} to {stamps[-1]:.3f} s); they are "
            f"of {poses.time[0]:.3f} to {poses.time[-1]:.3f} s"
        )
    outside = f"{n_outside} of {len(stamps)} turns lie outside the time of the known poses"
    notes = (outside,) if n_outside else ()
    return Odometry("poses", _cut(known, first, last), (), notes, deskewed=not spread)


def _cut(known: Trajectory, first: float, last: float) -> Trajectory:
    """Return the poses of a stretch of time, with two more on either side."""
    low = max(int(np.searchsorted(known.time, first)) - 2, 0)
    high = int(np.searchsorted(known.time, last, side="right")) + 2
    return Trajectory(known.time[low:high], known.T_map_sensor[low:high])


def _run_kiss_icp(scans: Iterable[Scan], options: LoamOptions, progress: Progress) -> Odometry:
    """Return the trajectory by KISS-ICP; scans with derived times are not deskewed."""
    stream = iter(scans)
    first = list(islice(stream, 1))
    deskew = all(scan.timed for scan in first) if options.deskew is None else options.deskew
    return estimate_kiss_icp(chain(first, stream), deskew=deskew, progress=progress)


ODOMETRY: dict[str, OdometryMethod] = {
    "loam": OdometryMethod(estimate_loam, "LOAM (Zhang and Singh 2014): edges and planes"),
    "poses": OdometryMethod(None, "poses that are known", needs_poses=True),
    "kiss-icp": OdometryMethod(
        _run_kiss_icp, "KISS-ICP (Vizzo et al. 2023), for comparison", extra="kiss-icp"
    ),
}
