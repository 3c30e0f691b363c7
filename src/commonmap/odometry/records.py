"""What odometry hands back: poses, and for each turn how far it can be believed."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from commonmap.odometry.geometry import complete_scans
from commonmap.types import Float64s, Scan, Trajectory


@dataclass(frozen=True, eq=False)
class ScanHealth:
    """How well the pose of one turn is known.

    moment: seconds, the time of the pose.
    n_matched: features that found their line or plane. share_matched: of those that looked.
    residual: metres, robust standard deviation of their distances; NaN where nothing matched.
    degenerate: (K, 6) unit vectors, shift along x, y, z and turn about x, y, z (times a length,
        so that angles and shifts compare), map frame: directions in which the scene says nothing
        and the pose follows the motion of the turns before.
    lost: the pose is only a guess from the motion before.
    """

    moment: float
    n_matched: int
    share_matched: float
    residual: float
    degenerate: Float64s
    lost: bool

    def tell(self) -> str:
        """Return the trouble in plain words, empty where there is none."""
        if self.lost:
            return f"odometry is lost at {self.moment:.2f} s: {self.n_matched} features match"
        if not len(self.degenerate):
            return ""
        named = " and ".join(name_direction(row) for row in self.degenerate)
        return f"at {self.moment:.2f} s the scene does not hold {named}"

    def turned(self, R: Float64s) -> ScanHealth:
        """Return the same in a map frame turned by R (3, 3)."""
        parts = self.degenerate[:, :3] @ R.T, self.degenerate[:, 3:] @ R.T
        return replace(self, degenerate=np.hstack(parts))


@dataclass(frozen=True, eq=False)
class Trouble:
    """A stretch of turns whose poses are not to be relied on.

    kind: "lost" (the poses are guesses) or "degenerate" (along some directions they are).
    begin, end: seconds, moments of the first and the last turn. n: turns.
    directions: (K, 6) as in `ScanHealth.degenerate`, of the turn in the middle.
    """

    kind: str
    begin: float
    end: float
    n: int
    directions: Float64s

    def tell(self) -> str:
        """Return the trouble as a sentence."""
        stretch = f"from {self.begin:.2f} to {self.end:.2f} s"
        if self.kind == "lost":
            return f"odometry is lost {stretch} ({self.n} turns)"
        named = " and ".join(name_direction(row) for row in self.directions)
        return f"{stretch} ({self.n} turns) the scene does not hold {named}"


def name_direction(direction: Float64s) -> str:
    """Return a degenerate direction (6,) in words, map frame."""
    shift, turn = direction[:3], direction[3:]
    if float(shift @ shift) >= float(turn @ turn):
        x, y, z = shift / max(float((shift @ shift) ** 0.5), 1e-12)
        return f"the position along ({x:.2f}, {y:.2f}, {z:.2f})"
    x, y, z = turn / max(float((turn @ turn) ** 0.5), 1e-12)
    return f"the rotation about ({x:.2f}, {y:.2f}, {z:.2f})"


@dataclass(frozen=True, eq=False)
class Odometry:
    """Answer of `estimate`.

    method: row of `ODOMETRY`. trajectory: one pose a turn, at its `moment`; the map frame is the
    sensor's at the first pose, not level. health: one a turn. notes: what the user should know.
    deskewed: the points of each turn are taken to be of one moment already, its stamp.
    """

    method: str
    trajectory: Trajectory
    health: tuple[ScanHealth, ...]
    notes: tuple[str, ...] = field(default=())
    deskewed: bool = False

    def as_taken(self, scans: Iterable[Scan]) -> Iterator[Scan]:
        """Yield the turns with the times at which their points are to be placed."""
        if self.deskewed:
            return (replace(scan, time=np.full(len(scan.xyz), scan.stamp)) for scan in scans)
        return complete_scans(scans, [])

    @property
    def n_lost(self) -> int:
        """Turns whose pose is only a guess."""
        return sum(h.lost for h in self.health)

    @property
    def n_degenerate(self) -> int:
        """Turns with at least one direction that the scene does not hold."""
        return sum(len(h.degenerate) > 0 for h in self.health)
