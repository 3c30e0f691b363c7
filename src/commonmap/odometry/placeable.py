"""Which turns of a log belong into a map: those whose poses are known, and known to each other."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from commonmap.odometry.georeference import covers
from commonmap.odometry.records import Odometry
from commonmap.odometry.table import find_sound_part
from commonmap.types import Scan, Trajectory


class PlaceableTurns:
    """Passes on the turns of a log that a map may hold, and counts all and the others.

    Left out are turns where odometry was lost, so that their pose is a guess; those of the parts
    before and after the longest one that holds together (`find_sound_part`), since how they lie to
    it is a guess; and those that the poses do not cover.

    n, n_left_out, n_apart: of the turns so far, how many, how many were left out, and how many of
    these for the second reason. sound: numbers of the turns of the longest part.
    every: only each so many-th turn is passed on, from the first; the others are not left out.
    """

    def __init__(self, odometry: Odometry, scans: Iterable[Scan], *, every: int = 1) -> None:
        self.n = self.n_left_out = self.n_apart = 0
        self.sound = find_sound_part(odometry.health)
        self._odometry, self._scans, self._every = odometry, scans, every

    def __iter__(self) -> Iterator[Scan]:
        health, trajectory = self._odometry.health, self._odometry.trajectory
        for number, scan in enumerate(self._odometry.as_taken(self._scans)):
            self.n = number + 1
            known = number < len(health)
            lost = known and health[number].lost
            apart = known and not lost and number not in self.sound
            self.n_apart += apart
            if lost or apart or not covers(trajectory, scan):
                self.n_left_out += 1
            elif number % self._every == 0:
                yield scan

    @property
    def sound_way(self) -> Trajectory:
        """The poses of the longest part; all of them where nothing says how sound they are."""
        trajectory = self._odometry.trajectory
        if not self._odometry.health:
            return trajectory
        part = slice(self.sound.start, self.sound.stop)
        return Trajectory(trajectory.time[part], trajectory.T_map_sensor[part])
