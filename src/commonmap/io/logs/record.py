"""What a log is: the record that `open_log` returns, and the options that its readers share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from commonmap.errors import InputError
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

    kind: in words. topics: all of them; a folder has none. topic: the one whose scans are read,
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
    deskewed: bool | None = None


@dataclass
class Teller:
    """Says a thing about a log once, however often it happens."""

    path: Path
    silent: bool = False
    said: set[str] = field(default_factory=set)

    def tell(self, what: str) -> None:
        """Warn that `what` holds for the log, unless it was said before."""
        if what not in self.said and not self.silent:
            self.said.add(what)
            log.warning("%s: %s", self.path, what)


def choose_topic(path: Path, topics: Sequence[Topic], wanted: str | None) -> Topic | None:
    """Return the topic to read: the one asked for, or the only one that holds scans.

    None where there are several. A topic that is not there, or holds no scans, raises.
    """
    with_scans = [topic for topic in topics if topic.holds == "scans" and topic.count != 0]
    if wanted is not None:
        for topic in topics:
            if topic.name in (wanted, "/" + wanted):
                if topic.holds != "scans":
                    raise InputError(
                        f"{path}: topic {wanted} holds {shown(topic.type)}, no scans; "
                        f"{_list(with_scans)}"
                    )
                return topic
        raise InputError(f"{path} has no topic {wanted}; {_list(with_scans)}")
    return with_scans[0] if len(with_scans) == 1 else None


def require_topic(path: Path, topics: Sequence[Topic], wanted: str | None) -> Topic:
    """Return the topic to read, or raise with the names of those there are."""
    topic = choose_topic(path, topics, wanted)
    if topic is not None:
        return topic
    with_scans = [topic for topic in topics if topic.holds == "scans" and topic.count != 0]
    if with_scans:
        raise InputError(
            f"{path} has several topics with scans, give topic (--topic): {_list(with_scans)}"
        )
    raise InputError(f"{path} has no topic with scans; {_list(topics)}")


def shown(name: str) -> str:
    """Return a name from a file as part of a sentence: short, on one line."""
    text = "".join(c if c.isprintable() else "?" for c in name)
    return text if len(text) <= 60 else text[:57] + "..."


def _list(topics: Sequence[Topic]) -> str:
    if not topics:
        return "it has none with scans"
    listed = ", ".join(
        f"{shown(topic.name)} ({shown(topic.type)}"
        + (")" if topic.count is None else f", {topic.count})")
        for topic in topics[:12]
    )
    more = f", and {len(topics) - 12} more" if len(topics) > 12 else ""
    return f"it has {listed}{more}"
