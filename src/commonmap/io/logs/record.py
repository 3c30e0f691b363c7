"""What a log is: the record that `open_log` returns, and the options that its readers share."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from commonmap.io.source import log


@dataclass(frozen=True)
class Topic:
    """One stream of messages of a log.

    name: as the log has it; of a capture of packets, sender and port ("192.168.1.201:2368").
    type: of the messages ("sensor_msgs/msg/PointCloud2", "Velodyne VLP-16"). count: how many
    there are, where the log says so without being read. holds: "scans", "poses", or "other".
    """

    name: str
    type: str
    count: int | None = None
    holds: str = "other"


@dataclass(frozen=True)
class Log:
    """What is known of a log before it is read.

    kind: name of its row in `LOGS`. topics: all of them. topic: the one whose scans are read,
    None where the choice is the user's. n_scans: how many there are, where known. time_span:
    (first, last) in seconds on the clock of the log, where known. poses: topics, or files beside
    the log, that hold poses of the robot from elsewhere.
    """

    path: Path
    kind: str
    topics: tuple[Topic, ...] = ()
    topic: str | None = None
    n_scans: int | None = None
    time_span: tuple[float, float] | None = None
    poses: tuple[str, ...] = ()


@dataclass(frozen=True)
class Options:
    """How a log is to be read. See `iter_scans` for what each means."""

    topic: str | None = None
    model: str | None = None
    keep_partial: bool = False
    deskewed: bool = False


@dataclass
class Teller:
    """Says a thing about a log once, however often it happens."""

    path: Path
    said: set[str] = field(default_factory=set)

    def tell(self, what: str) -> None:
        """Warn that `what` holds for the log, unless it was said before."""
        if what not in self.said:
            self.said.add(what)
            log.warning("%s: %s", self.path, what)
